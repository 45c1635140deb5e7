"""The converter: the pose and colour of every shape, for every model at hand."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import dm_control.suite
import meshcat.geometry as shapes
import mujoco
import numpy as np
import pytest
import umsgpack
from meshcat import Visualizer
from PIL import Image

from tsbench.core.errors import TsbenchError
from tsbench.sim.model import model_path
from tsbench.viewer import scene
from tsbench.viewer.page import Recorder

SUITE = sorted(Path(dm_control.suite.__file__).parent.glob("*.xml"))
OWN = [model_path("laikago"), model_path("rocket")]

SHAPES = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.4 0 0  0 0.3 0  0 0 0.2"/>
    <hfield name="hills" nrow="3" ncol="4" size="0.4 0.3 0.2 0.1"
            elevation="0 0 0 0  0 1 0.5 0  0 0 0 0"/>
  </asset>
  <worldbody>
    <body pos="0.3 -0.2 0.5" euler="20 30 40">
      <freejoint/>
      <geom size="0.1"/>
      <body pos="0.1 0.2 0.3" euler="-70 10 50">
        <geom name="sphere" type="sphere" size="0.1"/>
        <geom name="capsule" type="capsule" size="0.1 0.2" pos="0.1 0 0" euler="10 20 30"/>
        <geom name="ellipsoid" type="ellipsoid" size="0.1 0.2 0.3"/>
        <geom name="cylinder" type="cylinder" size="0.1 0.2" pos="0 0 0.2"/>
        <geom name="box" type="box" size="0.1 0.2 0.3" euler="0 45 0"/>
        <geom name="wedge" type="mesh" mesh="wedge" pos="0 0.1 0"/>
        <site name="sphere" type="sphere" size="0.1"/>
        <site name="capsule" type="capsule" size="0.1 0.2"/>
        <site name="ellipsoid" type="ellipsoid" size="0.1 0.2 0.3"/>
        <site name="cylinder" type="cylinder" size="0.1 0.2"/>
        <site name="box" type="box" size="0.1 0.2 0.3" pos="0 1 0"/>
      </body>
    </body>
    <geom name="plane" type="plane" size="0.5 0.4 0.1" pos="0 0 -1" euler="30 0 0"/>
    <geom name="hills" type="hfield" hfield="hills" pos="0 2 0" euler="0 0 30"/>
  </worldbody>
</mujoco>
"""


def compiled(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def by_name(model: mujoco.MjModel) -> dict[str, scene.Part]:
    return {part.name: part for part in scene.parts(model)}


def corners(geometry: shapes.Geometry) -> scene.Array:
    """Points that span a geometry as three.js builds it, shape (N, 3)."""
    description: dict[str, Any] = geometry.lower({})
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    match description["type"]:
        case "BoxGeometry":
            return 0.5 * signs * [description[side] for side in ("width", "height", "depth")]
        case "PlaneGeometry":
            return 0.5 * signs * [description["width"], description["height"], 0.0]
        case "SphereGeometry":
            up = np.linspace(0.0, np.pi, 25)
            around, up = (angle.ravel() for angle in np.meshgrid(turn, up))
            ball = [np.sin(up) * np.cos(around), np.cos(up), np.sin(up) * np.sin(around)]
            return description["radius"] * np.stack(ball, axis=1)
        case "CylinderGeometry":
            outline = [
                (description["radiusTop"], end * description["height"] / 2) for end in (-1, 1)
            ]
        case "LatheGeometry":
            outline = [(point["x"], point["y"]) for point in description["points"]]
        case "BufferGeometry":
            packed = description["data"]["attributes"]["position"]["array"]
            return np.frombuffer(packed.data, "<f4").reshape(-1, 3).astype(float)
    return np.concatenate(
        [np.stack([x * np.cos(turn), y + 0 * turn, x * np.sin(turn)], axis=1) for x, y in outline]
    )


def triangles(geometry: shapes.Geometry) -> scene.Array:
    """Corners of a mesh's triangles, shape (F, 3, 3)."""
    faces = np.frombuffer(geometry.lower({})["data"]["index"]["array"].data, "<u4")
    return corners(geometry)[faces.reshape(-1, 3)]


@pytest.mark.parametrize("path", SUITE + OWN, ids=lambda path: path.stem)
def test_every_model_is_drawn(path: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(path))
    recorder = Recorder()
    found = scene.parts(model)
    scene.draw(Visualizer(window=recorder), model, found)
    assert len({part.name for part in found}) == len(found)
    assert len(recorder.packed()) == 2 * len(found)


@pytest.mark.parametrize(
    ("name", "half_sizes"),
    [
        ("geom sphere", (0.1, 0.1, 0.1)),
        ("geom capsule", (0.1, 0.1, 0.3)),
        ("geom ellipsoid", (0.1, 0.2, 0.3)),
        ("geom cylinder", (0.1, 0.1, 0.2)),
        ("geom box", (0.1, 0.2, 0.3)),
        ("geom plane", (0.5, 0.4, 0.0)),
        ("site sphere", (0.1, 0.1, 0.1)),
        ("site capsule", (0.1, 0.1, 0.3)),
        ("site ellipsoid", (0.1, 0.2, 0.3)),
        ("site cylinder", (0.1, 0.1, 0.2)),
        ("site box", (0.1, 0.2, 0.3)),
    ],
)
def test_shapes_have_their_size_at_their_place(
    name: str, half_sizes: tuple[float, float, float]
) -> None:
    """A shape spans exactly its sizes in the frame that MuJoCo gives for it."""
    model = compiled(SHAPES)
    data = mujoco.MjData(model)
    data.qpos[:3] += (1.0, 2.0, 3.0)
    data.qpos[3:7] = (0.5, -0.5, 0.1, 0.7)
    mujoco.mj_kinematics(model, data)
    part = by_name(model)[name]
    kind, element = name.split()
    placed = getattr(data, kind)(element)
    carrier = scene.frame(data.xpos[part.body], data.xmat[part.body])
    to_geom = np.linalg.inv(scene.frame(placed.xpos, placed.xmat)) @ carrier @ part.transform
    points = corners(part.geometry) @ to_geom[:3, :3].T + to_geom[:3, 3]
    np.testing.assert_allclose(points.max(axis=0), half_sizes, atol=2e-3)
    np.testing.assert_allclose(points.min(axis=0), np.negative(half_sizes), atol=2e-3)


def test_a_mesh_is_where_its_vertices_are() -> None:
    """MuJoCo moves meshes to their inertial frame; the part moves them back to the MJCF's place."""
    model = compiled(SHAPES)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    part = by_name(model)["geom wedge"]
    body = int(model.geom("wedge").bodyid[0])
    to_body = np.linalg.inv(scene.frame(data.xpos[body], data.xmat[body]))
    to_body = to_body @ scene.frame(data.xpos[part.body], data.xmat[part.body]) @ part.transform
    points = corners(part.geometry) @ to_body[:3, :3].T + to_body[:3, 3] - (0.0, 0.1, 0.0)
    expected = {(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.2)}
    assert {tuple(point) for point in points.round(4) + 0.0} == expected


def test_surfaces_face_outwards() -> None:
    found = by_name(compiled(SHAPES))
    first, second, third = np.moveaxis(triangles(found["geom wedge"].geometry), 1, 0)
    volume = np.sum(np.cross(first, second) * third) / 6.0  # positive if counter-clockwise
    assert volume == pytest.approx(0.4 * 0.3 * 0.2 / 6.0, rel=1e-4)
    first, second, third = np.moveaxis(triangles(found["geom hills"].geometry), 1, 0)
    assert np.all(np.cross(second - first, third - first)[:, 2] > 0.0)


def test_a_height_field_has_its_heights() -> None:
    model = compiled(SHAPES)
    points = corners(by_name(model)["geom hills"].geometry)
    assert points.shape == (12, 3)
    np.testing.assert_allclose(points.min(axis=0), (-0.4, -0.3, 0.0), atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), (0.4, 0.3, 0.2), atol=1e-6)
    # Row 1, column 1 of the elevations is the top: x from left to right, y from row to row.
    np.testing.assert_allclose(points[5], (-0.4 + 0.8 / 3, 0.0, 0.2), atol=1e-6)


def test_welded_bodies_are_carried_by_the_one_that_moves() -> None:
    model = compiled(SHAPES)
    assert scene.moving_bodies(model) == [1]
    assert by_name(model)["geom box"].body == 1
    assert by_name(model)["geom plane"].body == 0


COLOURS = """
<mujoco>
  <asset>
    <texture name="red" type="cube" builtin="flat" rgb1="1 0 0" rgb2="1 0 0" width="4" height="24"/>
    <texture name="squares" type="2d" builtin="checker" rgb1="0 0 0" rgb2="1 1 1"
             width="8" height="8"/>
    <material name="green" rgba="0 0.5 0 0.7" specular="0.9" shininess="0.2"/>
    <material name="red" texture="red" rgba="0.5 0.5 0.5 1"/>
    <material name="squares" texture="squares" texrepeat="0.8 1" texuniform="true"/>
  </asset>
  <worldbody>
    <geom name="ground" type="plane" size="0 3 0.1" material="squares"/>
    <body name="a/b">
      <freejoint/>
      <geom name="c/d" size="1" material="green"/>
      <geom name="own" size="1" material="green" rgba="0 0 1 1"/>
      <geom name="red" size="1" material="red"/>
      <geom name="plain" size="1"/>
      <geom name="collision" size="1" group="3"/>
      <geom name="clear" size="1" rgba="1 1 1 0"/>
      <geom size="1"/>
      <geom size="1"/>
      <site name="hidden" group="4"/>
      <site name="plain" rgba="1 1 0 0.5"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_colours_follow_mujoco() -> None:
    found = by_name(compiled(COLOURS))
    np.testing.assert_allclose(found["geom c:d"].rgba, (0, 0.5, 0, 0.7), atol=1e-6)
    np.testing.assert_allclose(found["geom own"].rgba, (0, 0, 1, 1))
    np.testing.assert_allclose(found["geom red"].rgba, (0.5, 0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(found["geom plain"].rgba, (0.5, 0.5, 0.5, 1))
    np.testing.assert_allclose(found["site plain"].rgba, (1, 1, 0, 0.5))
    np.testing.assert_allclose(found["geom c:d"].shine, (0.9, 0.2), atol=1e-6)


def test_hidden_groups_and_clear_geoms_are_left_out() -> None:
    names = set(by_name(compiled(COLOURS)))
    assert not names & {"geom collision", "geom clear", "site hidden"}
    assert len(names) == 8


def test_ground_tiles_are_as_large_as_in_mujoco() -> None:
    """`texrepeat` textures over every two metres, and whole ones on each side of the centre."""
    model = compiled(COLOURS)
    ground = {part.name: part for part in scene.parts(model, reach=20.0)}["geom ground"]
    plane = ground.geometry.lower({})
    assert plane["width"] == pytest.approx(2 * 20.0)
    assert plane["height"] == pytest.approx(2 * 3.0)
    assert ground.texture is not None
    assert ground.texture.repeat == pytest.approx([0.8 * 20.0, 3.0])
    image = Image.open(io.BytesIO(ground.texture.image.data))
    assert np.asarray(image).shape == (8, 8, 3)


def test_commands_name_the_carrying_body_and_tint_all_but_the_shape() -> None:
    model = compiled(COLOURS)
    recorder = Recorder()
    part = by_name(model)["geom c:d"]
    scene.draw(Visualizer(window=recorder)["robot"], model, [part], tint=(1.0, 0.5, 0.0, 0.25))
    drawn, placed = recorder.commands
    assert drawn["path"] == placed["path"] == "/meshcat/robot/a:b/geom c:d"
    (material,) = drawn["object"]["materials"]
    assert (material["color"], material["opacity"]) == (0xFF8000, 0.25)
    assert material["transparent"]
    # meshcat takes matrices column after column.
    np.testing.assert_allclose(np.reshape(placed["matrix"], (4, 4)).T, part.transform)


def test_recorded_commands_tell_nothing_of_the_machine() -> None:
    model = compiled(COLOURS)
    texts = []
    for _ in range(2):
        recorder = Recorder()
        scene.draw(Visualizer(window=recorder), model, scene.parts(model))
        texts.append(recorder.packed())
    assert texts[0] == texts[1]


def test_packed_numbers_are_what_the_page_unpacks() -> None:
    packed = umsgpack.unpackb(umsgpack.packb(scene.packed([[1.0, 2.0], [3.0, 4.0]])))
    assert packed.type == 0x17
    np.testing.assert_array_equal(np.frombuffer(packed.data, "<f4"), [1, 2, 3, 4])


def test_body_poses_are_those_of_kinematics() -> None:
    model = mujoco.MjModel.from_xml_path(str(model_path("laikago")))
    poses = np.tile(model.key_qpos[0], (3, 1))
    poses[:, 7:] += np.random.default_rng(0).uniform(-0.2, 0.2, (3, 12))
    positions, quaternions = scene.body_poses(model, poses)
    data = mujoco.MjData(model)
    for pose, position, quaternion in zip(poses, positions, quaternions, strict=True):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        np.testing.assert_array_equal(position, data.xpos)
        np.testing.assert_array_equal(quaternion, data.xquat)


@pytest.mark.parametrize("shape", [(5, 18), (19,), (0, 19), (2, 3, 19)])
def test_poses_of_another_model_are_refused(shape: tuple[int, ...]) -> None:
    model = mujoco.MjModel.from_xml_path(str(model_path("laikago")))
    with pytest.raises(TsbenchError, match=r"the plan motion has shape .* needs \(frames, 19\)"):
        scene.body_poses(model, np.zeros(shape), "plan")


def test_poses_that_are_not_finite_are_refused() -> None:
    model = mujoco.MjModel.from_xml_path(str(model_path("rocket")))
    with pytest.raises(TsbenchError, match="not finite"):
        scene.body_poses(model, [[0.0, np.nan, 0.0]])
