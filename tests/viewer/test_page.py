"""The page: a self-contained file, and its look in a browser."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import dm_control.suite
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_new
from tsbench.runs.directory import RunDirectory
from tsbench.sim.model import load_spec
from tsbench.viewer import page, report, scene
from tsbench.viewer.framing import framing
from tsbench.viewer.show import (
    EXECUTED_COLOUR,
    PLAN_COLOUR,
    PUSH_COLOUR,
    SKY,
    Actor,
    Figures,
    Show,
    landmarks,
    track,
)
from tsbench.viewer.subject import subject

if TYPE_CHECKING:
    from tests.viewer.conftest import Browser

LAIKAGO_GOAL = (1.5, 0.0, 0.0)
ROCKET_GOAL = (52.0, 0.0, 30.0)
SUMMARY = [("success", "yes"), ("normalized reward", "0.41")]


def laikago() -> mujoco.MjModel:
    spec = load_spec("laikago")
    spec.worldbody.add_site(name="goal", pos=LAIKAGO_GOAL, size=[0.1] * 3, rgba=[1, 0.8, 0.1, 1])
    return spec.compile()


def rocket() -> mujoco.MjModel:
    spec = load_spec("rocket")
    spec.worldbody.add_site(name="goal", pos=ROCKET_GOAL, size=[1.0] * 3, rgba=[1, 0.8, 0.1, 1])
    spec.worldbody.add_geom(
        name="obstacle_1", size=[2.0, 0, 0], pos=[20, 0, 18], rgba=[0.8, 0.1, 0.1, 1]
    )
    return spec.compile()


def trot(model: mujoco.MjModel, speed: float, timestep: float, duration: float) -> scene.Array:
    """A rough trot, straight ahead, as qpos (T, nq)."""
    times = np.arange(0.0, duration + 1e-9, timestep)
    qpos = np.tile(model.key_qpos[0], (len(times), 1))
    qpos[:, 0] += speed * times
    for leg, phase in enumerate((0.0, 0.5, 0.5, 0.0)):
        qpos[:, 8 + 3 * leg] += 0.3 * np.sin(2.0 * np.pi * (times / 0.5 + phase))
    return qpos


def flight(timestep: float, late: float = 0.0) -> scene.Array:
    """A flight from the rocket's start to its goal in 10 s, as qpos (T, 3)."""
    progress = np.clip((np.arange(0.0, 12.0, timestep) - late) / 10.0, 0.0, 1.0)
    sway = np.sin(np.pi * progress)
    x, _, z = ROCKET_GOAL
    return np.stack([x * progress, z * progress - 3.0 * sway, -0.5 * sway], axis=1)


def show(
    model: mujoco.MjModel,
    executed: scene.Array,
    timestep: float,
    *,
    ghost: scene.Array | None = None,
    ghost_timestep: float | None = None,
    title: str = "",
    summary: list[tuple[str, ...]] | None = None,
) -> Show:
    """A show of motions without props."""
    actors = [Actor("executed", executed, timestep, EXECUTED_COLOUR, "")]
    if ghost is not None:
        actors.append(Actor("plan", ghost, ghost_timestep or timestep, PLAN_COLOUR, "", ghost=True))
    tables = [Figures(("score", ""), summary)] if summary else []
    return Show(model=model, actors=actors, title=title, tables=tables)


def write_page(path: Path, *motions: Any, **words: Any) -> None:
    write_new(path, page.render(show(*motions, **words)).encode())


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="page">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


# The file


def test_a_page_is_one_small_file_that_loads_nothing(tmp_path: Path) -> None:
    model = laikago()
    path = tmp_path / "run.html"
    motion = trot(model, 0.3, 1 / 30, 10.0)
    write_page(path, model, motion, 1 / 30, ghost=motion, title="trot", summary=SUMMARY)
    assert [file.name for file in tmp_path.iterdir()] == ["run.html"]
    assert path.stat().st_size < 1.6e6
    text = path.read_text("utf-8")
    assert "Content-Security-Policy" in text
    assert "default-src 'none'" in text
    own = text.replace(page._viewer_file("dist/main.min.js"), "")
    own = re.sub(r'<script type="text/plain" id="licences">.*?</script>', "", own, flags=re.DOTALL)
    assert "MIT License" in text
    assert not re.search(r"https?:|[\"'(]//|\bsrc=|\bhref=|@import|url\(", own)


def test_ten_seconds_at_the_simulation_rate_stay_below_three_megabytes(tmp_path: Path) -> None:
    model = laikago()
    motion = trot(model, 0.3, 1 / 600, 10.0)
    write_page(tmp_path / "p.html", model, motion, 1 / 600, ghost=motion, title="")
    assert (tmp_path / "p.html").stat().st_size < 3e6


def test_writing_starts_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        pytest.fail("a process was started")

    monkeypatch.setattr(subprocess.Popen, "__init__", refuse)
    write_page(tmp_path / "p.html", rocket(), flight(0.02), 0.02, title="")


def test_equal_motions_give_equal_pages() -> None:
    model = rocket()
    assert page.render(show(model, flight(0.02), 0.02)) == page.render(
        show(model, flight(0.02), 0.02)
    )


def test_texts_cannot_break_the_page(tmp_path: Path) -> None:
    hostile = "</script><b onload=x>{{meshcat}}&"
    spec = load_spec("rocket")
    spec.body("rocket").name = hostile
    model = spec.compile()
    path = tmp_path / "p.html"
    write_page(path, model, flight(0.02), 0.02, title=hostile, summary=[(hostile, hostile)])
    text = path.read_text("utf-8")
    assert hostile not in text
    assert text.count("&lt;/script&gt;&lt;b onload=x&gt;{{meshcat}}&amp;") == 5
    assert data_of(text)["actors"][0]["base"].startswith("meshcat/executed/<:script><b onload")


def test_an_existing_page_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "p.html"
    path.write_text("mine")
    with pytest.raises(TsbenchError, match=r"p\.html exists and nothing is overwritten"):
        write_page(path, rocket(), flight(0.02), 0.02, title="")
    assert path.read_text() == "mine"


@pytest.mark.parametrize("place", ["missing/p.html", "file/p.html"])
def test_an_unwritable_place_is_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TsbenchError, match=f"{place}: [A-Z]"):
        write_page(tmp_path / place, rocket(), flight(0.02), 0.02, title="")


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fill)
    with pytest.raises(TsbenchError, match="No space left"):
        write_page(tmp_path / "p.html", rocket(), flight(0.02), 0.02)
    assert not list(tmp_path.iterdir())


def test_motions_of_another_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TsbenchError, match=r"the executed motion has shape \(9, 4\)"):
        write_page(tmp_path / "p.html", rocket(), np.zeros((9, 4)), 0.02, title="")
    ghost, still = np.zeros((0, 3)), mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(TsbenchError, match=r"the plan motion has shape \(0, 3\)"):
        write_page(tmp_path / "p.html", rocket(), flight(0.02), 0.02, ghost=ghost, title="")
    with pytest.raises(TsbenchError, match="the time step of the executed motion is 0"):
        write_page(tmp_path / "p.html", rocket(), flight(0.02), 0.0, title="")
    with pytest.raises(TsbenchError, match="nothing in this model can move"):
        write_page(tmp_path / "p.html", still, np.zeros((2, 0)), 0.02, title="")
    assert not list(tmp_path.iterdir())


# The content


def test_tracks_are_thinned_and_keep_the_end() -> None:
    model = rocket()
    qpos = flight(1 / 600)
    found = track(model, Actor("executed", qpos, 1 / 600, EXECUTED_COLOUR, ""))
    np.testing.assert_allclose(np.diff(found.times)[:-1], 1 / 60)
    assert found.times[-1] == pytest.approx((len(qpos) - 1) / 600)
    np.testing.assert_array_equal(found.positions[-1, 1, [0, 2]], qpos[-1, :2])
    slow = track(model, Actor("plan", qpos, 0.05, PLAN_COLOUR, ""))
    assert len(slow.times) == len(qpos)


def test_only_what_moves_is_animated() -> None:
    playback = page.Playback(1.0)
    times = np.array([0.0, 1.0])
    still, turned = np.tile([1.0, 0, 0, 0], (2, 1)), np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    playback.move("still", times, np.ones((2, 3)), still)
    playback.move("turning", times, np.ones((2, 3)), turned)
    playback.move("moving", times, np.array([[0.0, 0, 0], [1, 0, 0]]), still)
    found = {
        animation["path"]: [track["name"] for track in animation["clip"]["tracks"]]
        for animation in playback.lower()["animations"]
    }
    assert found == {"turning": [".quaternion"], "moving": [".position"]}


def test_quaternions_are_in_the_order_of_three_js() -> None:
    playback = page.Playback(1.0)
    quaternions = np.array([[1.0, 0, 0, 0], [0.1, 0.2, 0.3, 0.4]])
    playback.move("body", np.array([0.0, 1.0]), np.zeros((2, 3)), quaternions)
    (track,) = playback.clips[0]["clip"]["tracks"]
    values = np.frombuffer(track["values"].data, "<f4").reshape(2, 4)
    np.testing.assert_allclose(values[1], [0.2, 0.3, 0.4, 0.1])


def test_a_trail_runs_along_its_path() -> None:
    angle = np.linspace(0.0, 3.0, 200)
    points = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    tube, kept = page.trail(points, 0.02)
    attributes = tube.lower({})["data"]["attributes"]
    rings, outward = (
        np.frombuffer(attributes[name]["array"].data, "<f4").reshape(-1, page.TRAIL_SIDES, 3)
        for name in ("position", "normal")
    )
    assert np.all(np.diff(kept) > 0)
    assert kept[0] == 0
    np.testing.assert_allclose(rings.mean(axis=1), points[kept], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=2), 1.0, atol=1e-5)
    np.testing.assert_allclose(rings - points[kept][:, None], 0.02 * outward, atol=1e-6)
    ahead = np.gradient(points[kept], axis=0)
    np.testing.assert_allclose(np.einsum("ki,kji->kj", ahead, outward), 0.0, atol=1e-6)


def test_a_trail_of_something_still_or_turning_back_is_finite() -> None:
    assert len(page.trail(np.ones((50, 3)), 0.01)[1]) == 1
    there_and_back = np.zeros((101, 3))
    there_and_back[:, 0] = 1.0 - np.abs(np.linspace(-1.0, 1.0, 101))
    tube, _ = page.trail(there_and_back, 0.01)
    packed = tube.lower({})["data"]["attributes"]["position"]["array"]
    assert np.all(np.isfinite(np.frombuffer(packed.data, "<f4")))


def test_goal_and_obstacles_are_explained(tmp_path: Path) -> None:
    path = tmp_path / "p.html"
    write_page(path, rocket(), flight(0.02), 0.02, title="A <title>", summary=SUMMARY)
    text = path.read_text("utf-8")
    labels = {label["text"]: label for label in data_of(text)["labels"]}
    assert labels["goal"]["position"] == list(ROCKET_GOAL)
    assert labels["obstacle 1"]["position"] == [20.0, 0.0, 18.0]
    assert "50 m" in labels  # the grid
    for words in ("A &lt;title&gt;", "<b>goal</b>", "<b>obstacle</b>", "<td>0.41</td>"):
        assert words in text
    assert "<b>plan</b>" not in text


def test_the_camera_looks_from_where_motion_goes_from_left_to_right() -> None:
    start = np.zeros(3)
    model = rocket()
    actor = Actor("executed", flight(0.02), 0.02, EXECUTED_COLOUR, "")
    view = framing(model, start, [track(model, actor)], landmarks(model))
    assert view.flat
    assert view.direction == (0.0, -1.0, 0.0)
    assert 0.5 < view.size < 1.5
    low, high = view.box
    assert np.all(low < 0.0)
    assert np.all(high > ROCKET_GOAL)

    model = laikago()
    for heading in (0.0, 1.0, -2.5):
        qpos = trot(model, 0.0, 1 / 30, 2.0)
        along = np.linspace(0.0, 2.0, len(qpos))
        qpos[:, :2] = np.stack([along * math.cos(heading), along * math.sin(heading)], axis=1)
        actor = Actor("executed", qpos, 1 / 30, EXECUTED_COLOUR, "")
        view = framing(model, qpos[0], [track(model, actor)], [])
        assert not view.flat
        to_the_right = np.cross([0.0, 0.0, 1.0], view.direction)
        assert to_the_right @ [math.cos(heading), math.sin(heading), 0.0] > 0.9
        assert view.direction[2] > 0.0


# The look in a browser


def centre(mask: NDArray[np.bool_]) -> float:
    """Mean column of the pixels that are set."""
    return float(np.nonzero(mask)[1].mean())


def blue(pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
    return (pixels[..., 2] > pixels[..., 0] + 60) & (pixels[..., 2] > 120)


def orange(pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.all(np.abs(pixels - (214, 94, 0)) < 30, axis=-1)


def dark(pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.all(pixels < 45, axis=-1)


def solid(pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The pixels that are neither sky nor a thin line on it."""
    return np.abs(pixels - SKY).max(axis=-1) > 25


@pytest.mark.browser
@pytest.mark.parametrize("fault", ["console.warn('oh')", "oh.no()", "fetch('http://localhost:9')"])
def test_a_fault_on_a_page_would_be_noticed(browser: Browser, tmp_path: Path, fault: str) -> None:
    path = tmp_path / "fault.html"
    policy = "default-src 'none'; script-src 'unsafe-inline'"
    path.write_text(
        f'<meta http-equiv="Content-Security-Policy" content="{policy}"><script>{fault}</script>'
    )
    with pytest.raises(AssertionError), browser.open(path.as_uri()):
        pass


@pytest.mark.browser
def test_robot_and_plan_are_seen_and_move(browser: Browser, tmp_path: Path) -> None:
    model = laikago()
    executed, plan = trot(model, 0.4, 1 / 30, 3.0), trot(model, 0.6, 1 / 30, 3.0)
    path = tmp_path / "trot.html"
    write_page(path, model, executed, 1 / 30, ghost=plan, title="trot", summary=SUMMARY)
    early, late = browser.picture(path, "t=0.5"), browser.picture(path, "t=2.5")

    for pixels in (early, late):
        assert dark(pixels).sum() > 300  # Laikago is black
        assert blue(pixels).sum() > 300
    assert centre(dark(late)) > centre(dark(early)) + 50
    assert orange(late).sum() > 2 * orange(early).sum()  # the path grows

    # The plan's path is in both pictures. Pixels blue in one only are the plan's robot, which is
    # ahead of the executed one.
    moved = blue(late) & ~blue(early)
    assert moved.sum() > 200
    assert centre(moved) > centre(blue(early) & ~blue(late)) + 50
    assert centre(moved) > centre(dark(late)) + 20

    alone = tmp_path / "alone.html"
    write_page(alone, model, executed, 1 / 30, title="trot")
    assert blue(browser.picture(alone, "t=0.5")).sum() < 20  # edges of letters


@pytest.mark.browser
def test_a_small_rocket_in_a_large_world_is_seen(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "flight.html"
    write_page(
        path,
        rocket(),
        flight(0.02, late=1.0),
        0.02,
        ghost=flight(0.05),
        ghost_timestep=0.05,
        title="",
    )
    whole, close = browser.picture(path, "t=5"), browser.picture(path, "t=5&view=follow")
    red = (whole[..., 0] > 150) & (whole[..., 1] < 60) & (whole[..., 2] < 60)
    yellow = (whole[..., 0] > 150) & (whole[..., 1] > 120) & (whole[..., 2] < 80)
    assert red[:200, :400].sum() > 30  # the obstacle
    assert yellow[:, -150:].sum() > 50  # the goal
    assert orange(whole).sum() > 100
    assert blue(whole).sum() > 300
    lens = solid(whole[40:168, 14:196])
    assert 1000 < lens.sum() < 0.5 * lens.size  # the rocket's close-up
    assert solid(close).sum() > 2 * lens.sum()


@pytest.mark.browser
def test_a_page_plays_when_opened_and_rests_where_asked(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "flight.html"
    write_page(path, rocket(), flight(0.02), 0.02, title="")

    def shown(address: str) -> float:
        with browser.open(path.as_uri() + address):
            text = browser.ask("document.getElementById('clock').textContent")
        clock = re.fullmatch(r"([\d.]+) / 11\.98 s", text)
        assert clock
        return float(clock[1])

    assert shown("") > 0.0
    assert shown("#t=1.25") == 1.25
    assert shown("#t=99") == 11.98


@pytest.mark.browser
def test_a_push_by_an_angle_is_in_the_form(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "flight.html"
    write_page(path, rocket(), flight(0.02), 0.02, title="")
    form = "Object.values(Object.fromEntries(new FormData(document.getElementById('push'))))"
    for heading in ("45", "+x"):
        with browser.open(f"{path.as_uri()}?push=100N@0.5s:{heading.replace('+', '%2B')}"):
            assert browser.ask(form) == ["100", "0.5", heading]


@pytest.mark.browser
def test_a_push_is_seen_while_it_lasts(
    browser: Browser, make_run: Callable[..., Path], tmp_path: Path
) -> None:
    path = tmp_path / "push.html"
    shown = subject(str(make_run("laikago_trot"))).show("100N@0.5s:+y")
    write_new(path, page.render(shown).encode())
    assert path.stat().st_size < 2e6
    during, after = browser.picture(path, "t=0.55&view=follow"), browser.picture(path, "t=0.7")

    def pixels_of(picture: NDArray[np.int64], colour: tuple[float, float, float]) -> int:
        return int(np.all(np.abs(picture - 255 * np.array(colour)) < 30, axis=-1).sum())

    assert pixels_of(during, PUSH_COLOUR) > 300
    assert pixels_of(after, PUSH_COLOUR) == 0
    assert pixels_of(during, EXECUTED_COLOUR) > 50  # the feet stand


@pytest.mark.browser
def test_a_report_follows_its_view(browser: Browser, make_run: Callable[..., Path]) -> None:
    run = make_run("rocket_obstacles", 0.7)
    path = run / "report.html"
    write_new(path, report.render(RunDirectory(run)).encode())
    heads = "[...document.querySelectorAll('.chart i')].map((head) => parseFloat(head.style.left))"
    with browser.open(path.as_uri()):
        browser.ask(f"""new Promise((done) => {{
          const look = () => {heads}.every((x) => x > 0) ? done() : requestAnimationFrame(look);
          look();
        }})""")
        assert len(browser.ask(heads)) == 4 + 3  # the reward and its terms, the joints
        browser.screenshot("report")


@pytest.mark.browser
@pytest.mark.parametrize("name", ["quadruped", "fish"])
def test_models_of_others_are_rendered(browser: Browser, tmp_path: Path, name: str) -> None:
    """The models have a plane, a height field, capsules, cylinders, ellipsoids, boxes, sites."""
    model = mujoco.MjModel.from_xml_path(
        str(Path(dm_control.suite.__file__).with_name(f"{name}.xml"))
    )
    path = tmp_path / f"{name}.html"
    write_page(path, model, np.tile(model.qpos0, (2, 1)), 0.1)
    assert solid(browser.picture(path, "t=0&view=follow")).sum() > 5000
