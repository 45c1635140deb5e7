"""Rotations as unit quaternions (w, x, y, z), over any leading batch axes."""

from __future__ import annotations

from tsbench.core.arrays import Array, array_namespace


def multiply(p: Array, q: Array) -> Array:
    """Product of quaternions, shape (..., 4)."""
    xp = array_namespace(p)
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    return xp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def angle_between(p: Array, q: Array) -> Array:
    """Rotation angle from one unit quaternion to another in rad, in [0, pi], shape (...,)."""
    xp = array_namespace(p)
    return 2.0 * xp.acos(xp.clip(xp.abs(xp.sum(p * q, axis=-1)), 0.0, 1.0))


def upward(orientation: Array) -> Array:
    """World z component of the body's z axis, shape (...,): 1 if upright, negative beyond a tilt of
    90 degrees."""
    x, y = orientation[..., 1], orientation[..., 2]
    return 1.0 - 2.0 * (x * x + y * y)


def to_heading(vectors: Array, orientation: Array) -> Array:
    """World-frame vectors (..., n, 3) in the heading frame, which is the world frame turned about z
    by the body's yaw."""
    xp = array_namespace(vectors)
    w, x, y, z = (orientation[..., i] for i in range(4))
    yaw = xp.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))[..., None]
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    return xp.stack(
        [
            cos * vectors[..., 0] + sin * vectors[..., 1],
            -sin * vectors[..., 0] + cos * vectors[..., 1],
            vectors[..., 2],
        ],
        axis=-1,
    )
