"""Shows made from recordings: their actors, props, legend and timeline."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.drawing import Drawing
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import ReferenceMotion, Roadmap
from tsbench.viewer.compose import compose, compose_pair, compose_plan, spans
from tsbench.viewer.pushes import parse_push
from tsbench.viewer.recording import Recording, record_episode, record_motion
from tsbench.viewer.show import Band, Curve, Prop, Show
from tsbench.viewer.stage import furnish


def stands(push: str | None = None) -> Recording:
    force = None if push is None else parse_push(push, tasks.make("laikago_trot"))
    return record_episode(tasks.make("laikago_trot"), lambda o: np.zeros((len(o), 12)), force)


def flies(main: float, side: float) -> Recording:
    return record_episode(tasks.make("rocket_obstacles"), lambda o: np.array([[main, side]]))


def prop(show: Show, words: str) -> Prop:
    (found,) = [prop for prop in show.props if words in prop.name]
    return found


@pytest.fixture(scope="module")
def plan(naive_reference: Callable[[str], ReferenceMotion]) -> Recording:
    return record_motion(tasks.make("laikago_trot"), naive_reference("laikago_trot"))


def test_spans_by_hand() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0])
    assert spans(times, np.array([True, True, False, True])) == [[0.0, 2.0], [3.0, 3.0]]
    assert spans(times, np.zeros(4, bool)) == []


def test_marks_lie_below_the_feet_that_stand(plan: Recording) -> None:
    show = compose(stands(), plan, title="")
    for number, foot in enumerate(("FR_foot", "FL_foot", "RR_foot", "RL_foot")):
        planned, actual = prop(show, f"{foot} to stand"), prop(show, f"{foot} stands")
        assert plan.scheduled is not None
        np.testing.assert_array_equal(planned.scale[:, 0] > 0.0, plan.scheduled[:, number])
        np.testing.assert_array_equal(planned.position[:, :2], plan.support.feet[:, number, :2])
        assert actual.scale[90:].all()
        assert 0.0 < planned.position[0, 2] < actual.position[0, 2] < 0.01
    assert {entry.name for entry in show.legend} == {
        "planned contact", "contact", "centre of mass", "centre of pressure",
    }  # fmt: skip


def test_the_timeline_shows_both(plan: Recording) -> None:
    recording = stands()
    bands = compose(recording, plan, title="").timeline
    first = bands[0]
    assert isinstance(first, Band)
    period = 16 / 30
    np.testing.assert_allclose(first.planned[1], [period, 1.5 * period], atol=1e-3)
    assert first.executed[-1][1] == pytest.approx(6.0)
    distance = bands[4]
    assert isinstance(distance, Curve)
    assert [line[2][0] for line in distance.lines] == pytest.approx([3.0, 3.0])
    assert distance.lines[0][2][-1] < 0.1 < 2.9 < distance.lines[1][2][-1]


def test_an_arrow_is_there_while_the_push_lasts_and_points_where_it_goes() -> None:
    recording = stands("60N@0.5s:+y")
    show = compose(recording, None, title="")
    arrow = prop(show, "push on trunk")
    np.testing.assert_array_equal(np.flatnonzero(arrow.scale[:, 2]), [15, 16, 17])
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), arrow.quaternion[16])
    np.testing.assert_allclose(axis, [0.0, 1.0, 0.0], atol=1e-9)
    tip = arrow.position[16] + arrow.size[1] * axis
    to_body = recording.qpos[16, :3] - tip
    assert to_body[1] > 0.0  # the arrow lies on the side that the push comes from
    assert np.linalg.norm(to_body) < 0.3
    assert "push" in {entry.name for entry in show.legend}
    assert not [prop for prop in compose(stands(), None, title="").props if "push" in prop.name]


def test_flames_are_as_long_as_the_throttle() -> None:
    strong, weak = (compose(flies(main, 0.6), None, title="") for main in (1.0, 0.5))
    lengths = [
        2.0 * prop(s, "flame 0").size[2] * prop(s, "flame 0").scale[3, 2] for s in (strong, weak)
    ]
    assert lengths == pytest.approx([1.5, 0.75])
    right, left = prop(strong, "flame 1"), prop(strong, "flame 2")
    assert right.scale[:-1].all()  # a positive side force turns it left: the gas leaves right
    assert not left.scale.any()
    below = prop(strong, "flame 0").position[0]
    assert below[2] < -0.58
    assert right.position[0, 0] > 0.59
    assert not prop(compose(flies(0.4, 0.0), None, title=""), "flame 0").scale.any()  # dead zone


def test_the_reward_is_drawn_where_it_is() -> None:
    show = compose(flies(0.7, 0.0), None, title="")
    model = show.model
    task = tasks.make("rocket_obstacles")
    texture = model.texture("worth")
    height, width = int(texture.height[0]), int(texture.width[0])
    data = model.tex_data[int(texture.adr[0]) :][: height * width * 3]
    image = np.reshape(data, (height, width, 3)).astype(int)
    drawing = task.drawing()
    assert drawing.bounds is not None
    low, high = drawing.bounds

    def pixel(x: float, z: float) -> np.ndarray:
        column = int((x - low[0]) / (high[0] - low[0]) * width)
        row = int((high[2] - z) / (high[2] - low[2]) * height)
        return image[row, column]

    places = {mark.text: mark.position for mark in show.landmarks}
    goal, obstacle = places["goal"], places["obstacle 1"]
    gold, red, sky = pixel(goal[0], goal[2]), pixel(obstacle[0], obstacle[2]), pixel(0.0, 0.0)
    assert gold[0] > 240
    assert gold[2] < 80
    assert red[0] > red[1] + 80
    np.testing.assert_allclose(sky, (208, 220, 231), atol=6)


def test_only_flat_worlds_have_drawn_bounds() -> None:
    furnished = mujoco.MjSpec()
    furnish(furnished, Drawing(), 1.0)
    assert len(furnished.worldbody.geoms) == 0
    corners = np.zeros(3), np.array([1.0, 2.0, 3.0])
    with pytest.raises(TsbenchError, match="flat"):
        furnish(furnished, Drawing(bounds=corners), 1.0)


def test_a_roadmap_is_drawn_where_it_is() -> None:
    """Each edge is a thin tube from node to node, the way a thicker one; no contact with either."""
    nodes = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 10.0], [20.0, 0.0, 0.0], [5.0, 0.0, 5.0]])
    edges = np.array([[0, 3], [1, 2], [0, 1]])  # the shortest is drawn first
    path = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 10.0]])
    task = tasks.make("rocket_obstacles")
    roadmap = Roadmap(task.name, task.version, 0.05, nodes, edges, path, checked=9)
    show = compose(flies(0.7, 0.0), None, title="", roadmap=roadmap)
    assert {"roadmap", "way"} <= {entry.name for entry in show.legend}
    model, data = show.model, mujoco.MjData(show.model)
    mujoco.mj_kinematics(model, data)
    width = []
    for number, ends in enumerate((nodes[edges], path[None])):
        geom = model.geom(f"lines_{number}")
        assert geom.contype[0] == geom.conaffinity[0] == 0
        mesh = model.mesh(f"lines_{number}")
        first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
        placed = data.geom(f"lines_{number}")
        vertices = model.mesh_vert[first : first + count] @ placed.xmat.reshape(3, 3).T
        vertices = (vertices + placed.xpos).reshape(len(ends), 2, 3, 3)
        np.testing.assert_allclose(vertices.mean(axis=2), ends, atol=1e-3)
        width.append(np.linalg.norm(vertices - ends[:, :, None], axis=-1).max())
    assert 0.0 < width[0] < width[1] < 0.05
    plain = compose(flies(0.7, 0.0), None, title="")
    assert "roadmap" not in {entry.name for entry in plain.legend}
    assert plain.model.nmesh == model.nmesh - 2


def test_a_plan_alone(plan: Recording) -> None:
    show = compose_plan(plan, title="")
    assert [actor.name for actor in show.actors] == ["plan"]
    assert len(show.props) == 4
    first = show.timeline[0]
    assert isinstance(first, Band)
    assert first.planned
    assert not first.executed


def test_two_walk_side_by_side_and_fly_together() -> None:
    show = compose_pair(stands(), stands("60N@0.5s:+y"), title="", verdict="")
    assert [actor.lane > 0.5 for actor in show.actors] == [False, True]
    goals = [
        show.model.site(i).pos[1] for i in range(show.model.nsite) if show.model.site(i).pos[0] > 1
    ]
    assert goals == pytest.approx([0.0, show.actors[1].lane])
    arrow = prop(show, "B push")
    assert arrow.position[16, 1] == pytest.approx(show.actors[1].lane, abs=1.0)
    assert math.isclose(show.actors[0].lane, 0.0)
    flat = compose_pair(flies(0.7, 0.0), flies(1.0, 0.0), title="", verdict="")
    assert [actor.lane for actor in flat.actors] == [0.0, 0.0]
    assert flat.actors[0].colour != flat.actors[1].colour
    with pytest.raises(TsbenchError, match="not for laikago_trot and rocket_obstacles"):
        compose_pair(stands(), flies(0.7, 0.0), title="", verdict="")
    short = record_episode(
        tasks.make("rocket_obstacles", distance=40.0), lambda o: np.array([[0.7, 0.0]])
    )
    with pytest.raises(TsbenchError, match="rocket_obstacles with other constants"):
        compose_pair(flies(0.7, 0.0), short, title="", verdict="")
