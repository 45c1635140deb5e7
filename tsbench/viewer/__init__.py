"""The viewer: motions of MuJoCo models in meshcat, as pages, videos and pictures."""
