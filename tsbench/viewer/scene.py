"""Converts a compiled MuJoCo model to meshcat objects.

`parts` turns every visible geom and site into a three.js geometry with its colour and its pose on
the body that carries it. `draw` sends the parts to a meshcat `Visualizer`. `body_poses` computes
the poses of the bodies. All lengths are in metres, in MuJoCo's frames. In meshcat z is up too, but
its shapes are built around y.

The module draws every geom type (a signed distance field as its mesh), 2-D textures on planes, and
the mean colours of textures elsewhere. It does not draw tendons, skins and flexes.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import meshcat.geometry as shapes
import mujoco
import numpy as np
import umsgpack
from meshcat import Visualizer
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from tsbench.core.errors import TsbenchError

Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]  # red, green, blue, opacity in [0, 1]

VISIBLE_GROUPS = 3  # groups 0, 1, 2 of geoms and sites, as in MuJoCo's viewers by default
UNSET_RGBA = (0.5, 0.5, 0.5, 1.0)  # MJCF's default, which gives way to a material's colour
CAPSULE_ARC = 9  # points on each half circle of a capsule's outline
LATHE_SEGMENTS = 24  # around the axis of a capsule

# three.js: which sides of a face are drawn, how a texture continues, ids of packed arrays.
FRONT_SIDE, DOUBLE_SIDE = 0, 2
REPEAT = 1000
FLOAT32, UINT32 = 0x17, 0x16

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # turns y into z


@dataclass(frozen=True, eq=False)
class Part:
    """One visible geom or site.

    Attributes:
        name: unique in the model.
        body: the body that carries the part: its own body, or the root of the bodies that this
            body is welded to; 0, the world, if that body cannot move.
        geometry: meshcat's description of the shape.
        transform: from the shape to the carrying body's frame, scale included, shape (4, 4).
        rgba: the part's colour in the model.
        texture: the texture drawn on the part, or None.
        closed: whether the shape's surface is closed, so that its inside is not drawn.
        faceted: whether its faces are flat, so that light is not smoothed over their edges.
        shine: specular reflection and shininess, MuJoCo's numbers in [0, 1].
        glows: whether the part emits its colour, so that no light changes it.
    """

    name: str
    body: int
    geometry: shapes.Geometry
    transform: Array
    rgba: Colour
    texture: shapes.ImageTexture | None
    closed: bool
    faceted: bool
    shine: tuple[float, float]
    glows: bool


class Described(shapes.Geometry):
    """A geometry of three.js without a class in meshcat, given by its JSON description."""

    def __init__(self, kind: str, **description: Any) -> None:
        super().__init__()
        self.description = {"type": kind, **description}

    def lower(self, _object_data: dict[str, Any]) -> dict[str, Any]:
        return {"uuid": self.uuid, **self.description}


def packed(array: ArrayLike, code: int = FLOAT32) -> umsgpack.Ext:
    """An array as the typed array that meshcat's page unpacks, in row-major order."""
    return umsgpack.Ext(code, np.asarray(array, "<f4" if code == FLOAT32 else "<u4").tobytes())


def surface(vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike | None = None) -> Described:
    """A triangle mesh.

    Args:
        vertices: shape (V, 3).
        faces: indices of vertices, counter-clockwise seen from outside, shape (F, 3).
        normals: normals of the vertices, shape (V, 3); None lets three.js compute them.
    """
    attributes = {"position": vertices} | ({} if normals is None else {"normal": normals})
    return Described(
        "BufferGeometry",
        data={
            "attributes": {
                name: {"itemSize": 3, "type": "Float32Array", "array": packed(values)}
                for name, values in attributes.items()
            },
            "index": {"itemSize": 1, "type": "Uint32Array", "array": packed(faces, UINT32)},
        },
    )


# Each function below makes a shape from a geom's size or asset: a geometry, and the 3 x 3 map from
# the geometry to the geom's frame.

Shape = tuple[shapes.Geometry, Array]


def _plane(size: Array) -> Shape:
    return Described("PlaneGeometry", width=2 * size[0], height=2 * size[1]), np.eye(3)


def _sphere(size: Array) -> Shape:
    return shapes.Sphere(size[0]), UPRIGHT


def _ellipsoid(size: Array) -> Shape:
    return shapes.Sphere(1.0), np.diag(size)


def _capsule(size: Array) -> Shape:
    radius, half_length = size[:2]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2 * CAPSULE_ARC)
    height = radius * np.sin(angle) + half_length * np.sign(angle)
    outline = [{"x": x, "y": y} for x, y in zip(radius * np.cos(angle), height, strict=True)]
    return Described("LatheGeometry", points=outline, segments=LATHE_SEGMENTS), UPRIGHT


def _cylinder(size: Array) -> Shape:
    return shapes.Cylinder(height=2 * size[1], radius=size[0]), UPRIGHT


def _box(size: Array) -> Shape:
    return shapes.Box(2 * size), np.eye(3)


def _arrow(size: Array) -> Shape:
    """An arrow from the origin along z. Models have none; MuJoCo draws forces with it."""
    radius, length = size[:2]
    head = min(3.0 * radius, 0.5 * length)
    outline = [(0.0, 0.0), (radius, 0.0), (radius, length - head), (2 * radius, length - head)]
    points = [{"x": x, "y": y} for x, y in (*outline, (0.0, length))]
    return Described("LatheGeometry", points=points, segments=LATHE_SEGMENTS), UPRIGHT


def _mesh(model: mujoco.MjModel, data: int) -> Shape:
    first, count = model.mesh_vertadr[data], model.mesh_vertnum[data]
    vertices = model.mesh_vert[first : first + count]
    first, count = model.mesh_faceadr[data], model.mesh_facenum[data]
    return surface(vertices, model.mesh_face[first : first + count]), np.eye(3)


def _height_field(model: mujoco.MjModel, data: int) -> Shape:
    x_reach, y_reach, height, _ = model.hfield_size[data]
    rows, columns = int(model.hfield_nrow[data]), int(model.hfield_ncol[data])
    start = model.hfield_adr[data]
    y, x = np.meshgrid(
        np.linspace(-y_reach, y_reach, rows), np.linspace(-x_reach, x_reach, columns), indexing="ij"
    )
    z = height * model.hfield_data[start : start + rows * columns]
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corners = first[:, None] + np.array([0, 1, columns + 1, 0, columns + 1, columns])
    return surface(np.stack([x.ravel(), y.ravel(), z], axis=1), corners.reshape(-1, 3)), np.eye(3)


GEOM = mujoco.mjtGeom
FROM_SIZE: dict[mujoco.mjtGeom, Callable[[Array], Shape]] = {
    GEOM.mjGEOM_PLANE: _plane,
    GEOM.mjGEOM_SPHERE: _sphere,
    GEOM.mjGEOM_CAPSULE: _capsule,
    GEOM.mjGEOM_ELLIPSOID: _ellipsoid,
    GEOM.mjGEOM_CYLINDER: _cylinder,
    GEOM.mjGEOM_BOX: _box,
    GEOM.mjGEOM_ARROW: _arrow,
}
FROM_ASSET: dict[mujoco.mjtGeom, Callable[[mujoco.MjModel, int], Shape]] = {
    GEOM.mjGEOM_MESH: _mesh,
    GEOM.mjGEOM_SDF: _mesh,
    GEOM.mjGEOM_HFIELD: _height_field,
}
OPEN_SHAPES = (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_HFIELD)


# Colours and textures


def _pixels(model: mujoco.MjModel, texture: int) -> NDArray[np.uint8]:
    """A texture's image, shape (height, width, channels)."""
    shape = (model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture])
    start = model.tex_adr[texture]
    return np.asarray(model.tex_data[start : start + int(np.prod(shape))]).reshape(shape)


def _texture(model: mujoco.MjModel, material: int) -> int:
    """The texture that colours a material, or -1."""
    if material < 0:
        return -1
    return int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])


def _tiles(model: mujoco.MjModel, material: int, size: Array) -> tuple[shapes.ImageTexture, Array]:
    """The texture of a plane, and the plane's half sizes.

    MuJoCo's renderer (3.17) repeats a texture `texrepeat` times over a plane. If the texture is
    uniform or the plane infinite, it repeats `texrepeat` times over every two metres from the
    centre.

    Args:
        model: compiled model.
        material: the plane's material.
        size: half sizes in metres, negative where the plane is infinite. An infinite plane grows
            until whole textures lie on both sides of its centre.
    """
    repeat = np.array(model.mat_texrepeat[material], np.float64)
    infinite = size < 0.0
    size = np.where(infinite, np.ceil(-size * repeat / 2.0 - 1e-6) * 2.0 / repeat, size)
    repeat *= np.where(infinite | model.mat_texuniform[material], size, 1.0)
    png = io.BytesIO()
    Image.fromarray(_pixels(model, _texture(model, material)).squeeze()).save(png, "PNG")
    texture = shapes.ImageTexture(
        shapes.PngImage(png.getvalue()), wrap=[REPEAT, REPEAT], repeat=repeat.tolist(), anisotropy=8
    )
    return texture, size


def _colour(model: mujoco.MjModel, rgba: Array, material: int) -> Colour:
    """The colour of an element by MuJoCo's rule: its own rgba if set, else its material's."""
    if material >= 0 and np.array_equal(rgba, np.array(UNSET_RGBA, np.float32)):
        rgba = model.mat_rgba[material]
    red, green, blue, opacity = (float(value) for value in rgba)
    return red, green, blue, opacity


def _shaded(model: mujoco.MjModel, colour: Colour, texture: int) -> Colour:
    """A colour times the mean colour of a texture that is not drawn."""
    mean = _pixels(model, texture)[..., :3].mean(axis=(0, 1)) / 255.0
    red, green, blue = (float(value) for value in np.asarray(colour[:3]) * mean)
    return red, green, blue, colour[3]


# The model


def frame(position: ArrayLike, rotation: ArrayLike) -> Array:
    """Homogeneous transform of a position (3,) and a rotation matrix (9,) or (3, 3)."""
    transform = np.eye(4)
    transform[:3, :3] = np.reshape(rotation, (3, 3))
    transform[:3, 3] = position
    return transform


def parts(model: mujoco.MjModel, reach: float = 20.0) -> tuple[Part, ...]:
    """The visible parts of a model: geoms and sites of groups 0 to 2 that are not transparent.

    Args:
        model: compiled model.
        reach: half side in metres of planes that are infinite in MuJoCo.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # qpos0 suffices: welded bodies keep their relative poses
    found = []
    for kind, count, types in (
        ("geom", model.ngeom, model.geom_type),
        ("site", model.nsite, model.site_type),
    ):
        for index in range(count):
            element = getattr(model, kind)(index)
            material = int(element.matid[0])
            rgba = _colour(model, element.rgba, material)
            if element.group[0] >= VISIBLE_GROUPS or rgba[3] == 0.0:
                continue
            size, texture = np.array(element.size), None
            form = GEOM(types[index])
            if form == GEOM.mjGEOM_PLANE:
                size = np.where(size > 0.0, size, -reach)[:2]
                if _texture(model, material) >= 0:
                    texture, size = _tiles(model, material, size)
                size = np.abs(size)
            elif _texture(model, material) >= 0:
                rgba = _shaded(model, rgba, _texture(model, material))
            if form in FROM_SIZE:
                geometry, shape = FROM_SIZE[form](size)
            else:
                geometry, shape = FROM_ASSET[form](model, int(element.dataid[0]))
            body = int(model.body_weldid[element.bodyid[0]])
            placed = getattr(data, kind)(index)
            carrier = frame(data.xpos[body], data.xmat[body])
            transform = np.linalg.solve(carrier, frame(placed.xpos, placed.xmat))
            shine = (0.5, 0.5)  # MJCF's defaults
            if material >= 0:
                shine = model.mat_specular[material], model.mat_shininess[material]
            name = element.name.replace("/", ":") or str(index)  # "/" separates meshcat's paths
            found.append(
                Part(
                    f"{kind} {name}",
                    body,
                    geometry,
                    transform @ frame(np.zeros(3), shape),
                    rgba,
                    texture,
                    form not in OPEN_SHAPES,
                    form in FROM_ASSET,
                    (float(shine[0]), float(shine[1])),
                    material >= 0 and bool(model.mat_emission[material] > 0.0),
                )
            )
    return tuple(found)


def hexadecimal(colour: Sequence[float]) -> int:
    """Red, green and blue in [0, 1] as 0xRRGGBB."""
    red, green, blue = (round(255 * min(max(value, 0.0), 1.0)) for value in colour[:3])
    return red << 16 | green << 8 | blue


def node(model: mujoco.MjModel, body: int) -> str:
    """The name of a body's node below the node of its robot."""
    return model.body(body).name.replace("/", ":") or f"body {body}"


def draw(
    vis: Visualizer, model: mujoco.MjModel, elements: Iterable[Part], tint: Colour | None = None
) -> None:
    """Sends parts to meshcat, each below the node of the body that carries it.

    Args:
        vis: the node below which the parts are drawn.
        model: the model of the parts.
        elements: the parts.
        tint: one colour for all parts in place of their own, or None.
    """
    for part in elements:
        *colour, opacity = tint or part.rgba
        specular, shininess = part.shine
        kind = shapes.MeshBasicMaterial if part.glows else shapes.MeshPhongMaterial
        light = {} if part.glows else {
            "flatShading": part.faceted,
            "specular": hexadecimal([0.4 * specular] * 3),
            "shininess": 1.0 + 100.0 * shininess,
        }  # fmt: skip
        material = kind(
            color=0xFFFFFF if part.texture and not tint else hexadecimal(colour),
            map=None if tint else part.texture,
            opacity=opacity,
            side=FRONT_SIDE if part.closed else DOUBLE_SIDE,
            # An untinted part covers a tinted one where both coincide.
            polygonOffset=tint is not None,
            polygonOffsetFactor=1,
            polygonOffsetUnits=1,
            **light,
        )
        place = vis[node(model, part.body)][part.name]
        place.set_object(part.geometry, material)
        place.set_transform(part.transform)


def draw_shape(
    vis: Visualizer, geom: mujoco.mjtGeom, size: Sequence[float], colour: Colour
) -> None:
    """Sends one shape in a colour that no light changes, such as a mark.

    Args:
        vis: the node of the shape.
        geom: a geom type that has sizes, or an arrow with a radius and a length along z.
        size: metres, as in MJCF.
        colour: the colour, with opacity.
    """
    geometry, shape = FROM_SIZE[geom](np.asarray(size, np.float64))
    *rgb, opacity = colour
    vis.set_object(
        geometry, shapes.MeshBasicMaterial(color=hexadecimal(rgb), opacity=opacity, side=2)
    )
    vis.set_transform(frame(np.zeros(3), shape))


def placed(position: Array, quaternion: Array) -> Array:
    """Homogeneous transform of a position (3,) and a quaternion (w, x, y, z)."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return frame(position, rotation)


def moving_bodies(model: mujoco.MjModel) -> list[int]:
    """The bodies that a pose can move: all but the world and those welded to another body."""
    return [body for body in range(1, model.nbody) if model.body_weldid[body] == body]


def body_poses(model: mujoco.MjModel, qpos: ArrayLike, name: str = "given") -> tuple[Array, Array]:
    """World positions in metres and orientations of all bodies at many poses.

    Args:
        model: compiled model.
        qpos: generalised positions, shape (T, nq).
        name: name of the motion for errors.

    Returns:
        Positions, shape (T, nbody, 3), and unit quaternions (w, x, y, z), shape (T, nbody, 4).

    Raises:
        TsbenchError: the poses have another shape or are not finite.
    """
    qpos = np.asarray(qpos, float)
    if qpos.ndim != 2 or len(qpos) == 0 or qpos.shape[1] != model.nq:
        raise TsbenchError(
            f"the {name} motion has shape {qpos.shape}, this model needs (frames, {model.nq})"
        )
    if not np.all(np.isfinite(qpos)):
        raise TsbenchError(f"the {name} motion holds values that are not finite")
    data = mujoco.MjData(model)
    positions = np.empty((len(qpos), model.nbody, 3))
    quaternions = np.empty((len(qpos), model.nbody, 4))
    for index, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        positions[index], quaternions[index] = data.xpos, data.xquat
    return positions, quaternions
