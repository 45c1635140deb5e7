"""The layout of all pages on screens and phones, and what they say to readers who cannot see it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tsbench import tasks
from tsbench.core.files import write_new
from tsbench.leaderboard.page import write_site
from tsbench.leaderboard.submission import Manifest
from tsbench.runs.directory import RunDirectory
from tsbench.viewer import page, report
from tsbench.viewer.show import Show
from tsbench.viewer.subject import pair, subject

if TYPE_CHECKING:
    from tests.viewer.conftest import Browser

MakeRun = Callable[..., Path]

pytestmark = pytest.mark.browser

WINDOW, PHONE, ON_ITS_SIDE = (1280, 900), (390, 844), (844, 390)
SCREENS = (WINDOW, PHONE, ON_ITS_SIDE)
BOARD = Path(__file__).parents[2] / "leaderboards"
HTML, URL = "<script>alert(1)</script>", f"https://example.org/?{'a=1&b=2' * 20}'\"><b>"

BOXES = """(() => {
  const boxes = (selector) => [...document.querySelectorAll(selector)]
    .filter((element) => !element.hidden && element.getClientRects().length)
    .map((element) => {
      const {left, top, right, bottom} = element.getBoundingClientRect();
      return [element.id || element.textContent || element.tagName, left, top, right, bottom];
    });
  const card = document.getElementById("card");
  return {
    screen: ["screen", 0, 0, innerWidth, document.documentElement.scrollHeight],
    over: document.documentElement.scrollWidth - innerWidth,
    below: document.documentElement.scrollHeight - innerHeight,
    cut: [card.scrollHeight - card.clientHeight, card.scrollWidth - card.clientWidth],
    regions: boxes("#stage, #card, #bottom"),
    controls: boxes("#bar > *, #push > *"),
    over_picture: boxes(".label, #lens"),
  };
})()"""

# Where the robots and the places are on the screen, over the whole show.
PLACES = """(() => {
  const {left, top} = stage.getBoundingClientRect();
  const found = [];
  const add = (name, {x, y}) => found.push([name, left + x, top + y, left + x, top + y]);
  for (let time = 0; time < page.duration; time += page.duration / 25) {
    seek(time);
    for (const actor of page.actors) {
      add(`${actor.text} at ${time}`,
          onScreen(node(actor.base).getWorldPosition(new THREE.Vector3())));
    }
  }
  for (const {text, position, faint} of page.labels) {
    if (!faint) add(text, onScreen(vector(position)));
  }
  return found;
})()"""

# Every element with text of its own: the ratio of contrast between the text and what is behind it.
CONTRASTS = """(() => {
  const part = (value) => value <= 0.03928 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const colour = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([red, green, blue]) =>
    0.2126 * part(red / 255) + 0.7152 * part(green / 255) + 0.0722 * part(blue / 255);
  const behind = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const found = colour(getComputedStyle(one).backgroundColor);
      if (found.length < 4 || found[3] > 0.8) return found;
    }
    return [255, 255, 255];
  };
  return [...document.querySelectorAll("body *:not(script, style, option, i, title, desc)")]
    .filter((one) => [...one.childNodes].some((n) => n.nodeType === 3 && n.data.trim())
                     && one.getClientRects().length && !one.closest("#labels, #lens"))
    .map((one) => {
      const style = getComputedStyle(one);
      const text = one.closest("svg") ? style.fill : style.color;
      const [a, b] = [light(colour(text)), light(behind(one))].sort((x, y) => y - x);
      return [one.textContent.trim().slice(0, 40), (a + 0.05) / (b + 0.05)];
    });
})()"""

Box = tuple[str, float, float, float, float]  # name; left, top, right, bottom in pixels


def inside(box: Box, outer: Box) -> bool:
    return all(a >= b - 0.6 for a, b in zip(box[1:3], outer[1:3], strict=True)) and all(
        a <= b + 0.6 for a, b in zip(box[3:], outer[3:], strict=True)
    )


def overlapping(boxes: list[Box]) -> list[tuple[str, str]]:
    """Pairs of names of boxes that share more than an edge."""
    return [
        (a[0], b[0])
        for number, a in enumerate(boxes)
        for b in boxes[:number]
        if a[1] < b[3] - 0.6 and b[1] < a[3] - 0.6 and a[2] < b[4] - 0.6 and b[2] < a[4] - 0.6
    ]


def write(path: Path, show: Show, *, served: bool = False) -> str:
    write_new(path, page.render(show, served=served).encode())
    return path.as_uri()


def check_view(browser: Browser, url: str, name: str) -> None:
    """Checks the page on all screens: nothing is covered, nothing is cut."""
    for screen in SCREENS:
        with browser.open(f"{url}#t=0", screen):
            for address in ("t=0", "t=1.1", "t=99"):
                browser.go(address)
                check_boxes(browser.ask(BOXES), screen)
            browser.screenshot(f"{name}_{screen[0]}")
            found: dict[str, Any] = browser.ask(BOXES)
            places: list[Box] = browser.ask(PLACES)
        (stage,) = (box for box in found["regions"] if box[0] == "stage")
        for place in places:
            assert inside(place, stage), place
            for box in found["over_picture"]:
                assert box[0] != "lens" or not inside(place, box), place


def check_boxes(found: dict[str, Any], screen: tuple[int, int]) -> None:
    """Checks what `BOXES` has found on a screen."""
    regions = {box[0]: box for box in found["regions"]}
    assert set(regions) == {"stage", "card", "bottom"}
    assert found["over"] <= 0
    assert not overlapping(found["regions"])
    assert not overlapping(found["controls"])
    for box in [*found["regions"], *found["controls"]]:
        assert inside(box, found["screen"]), box
    stage = regions["stage"]
    assert stage[4] - stage[2] >= (240 if screen == PHONE else 160)
    for box in found["over_picture"]:
        assert inside(box, stage), box
    assert not overlapping(found["over_picture"]), screen
    if screen != PHONE:
        assert found["below"] <= 0, screen
    if screen == WINDOW:
        assert max(found["cut"]) <= 0


@pytest.mark.parametrize("name", tasks.names())
def test_nothing_is_covered_or_cut(browser: Browser, make_run: MakeRun, name: str) -> None:
    run = make_run(name, 0.7)
    check_view(browser, write(run / "page.html", subject(str(run)).show()), name)


def test_nor_beside_another_run_or_under_a_push(browser: Browser, make_run: MakeRun) -> None:
    runs = [str(make_run("laikago_walk", directory=one)) for one in ("one", "other")]
    path = Path(runs[0])
    check_view(browser, write(path / "pair.html", pair(runs), served=True), "pair")
    pushed = subject(runs[0]).show("400N@0.5s:60")
    check_view(browser, write(path / "push.html", pushed, served=True), "push")


def test_nor_with_long_names(browser: Browser, make_run: MakeRun) -> None:
    """Names without a gap, and nothing to draw below the picture."""
    shown = subject(str(make_run("rocket_obstacles", 0.7))).show()
    actors = [replace(actor, name=actor.name * 3) for actor in shown.actors]
    long = replace(shown, title="task_" * 30, actors=actors, timeline=(), props=())
    check_view(browser, write(Path(make_run("rocket_navigation", directory="b")) / "p.html", long),
               "long")  # fmt: skip


@pytest.mark.parametrize("name", ["laikago_trot", "rocket_navigation"])
def test_a_report_fits_the_screen(browser: Browser, make_run: MakeRun, name: str) -> None:
    run = make_run(name, 0.7)
    path = run / "report.html"
    write_new(path, report.render(RunDirectory(run)).encode())
    charts = """[...document.querySelectorAll(".chart svg")].filter((one) => one.clientWidth)
      .map((one) => { const {left, right, width} = one.getBoundingClientRect();
                      return [left, right, width, one.viewBox.baseVal.width]; })"""
    for screen in SCREENS:
        with browser.open(path.as_uri(), screen):
            assert browser.ask("document.documentElement.scrollWidth - innerWidth") <= 0
            found = browser.ask(charts)
            cells = browser.ask("""[...document.querySelectorAll("td, th, p, h1, h2, code")]
              .map((one) => { const {left, right} = one.getBoundingClientRect();
                              return [one.textContent, left, 0, right, 0]; })""")
            browser.screenshot(f"report_{name}_{screen[0]}")
        for cell in cells:
            assert inside(cell, ("screen", 0, 0, screen[0], 0)), cell
        columns = {round(left) for left, *_ in found}
        assert len(columns) == 1 if screen == PHONE else len(columns) > 1
        for left, right, width, drawn in found:
            assert left >= 0
            assert right <= screen[0]
            assert width / (drawn * 4 / 3) > 0.68  # of the size at which its text is 9 points


def contrasts(browser: Browser) -> list[tuple[str, float]]:
    found = browser.ask(CONTRASTS)
    assert len(found) > 10
    return [(text, ratio) for text, ratio in found if ratio < 4.5]


def check_contrasts(browser: Browser, path: Path) -> None:
    """Checks text in both schemes by the ratio that WCAG 2 asks of it, 4.5."""
    for dark in (False, True):
        with browser.open(path.as_uri(), WINDOW, dark=dark):
            assert not contrasts(browser), path.name
            ground = browser.ask("getComputedStyle(document.body).backgroundColor")
            browser.screenshot(f"{path.stem}_{'dark' if dark else 'light'}")
        assert (int(re.findall(r"\d+", ground)[0]) < 100) == dark


def test_text_can_be_read_in_both_schemes(browser: Browser, make_run: MakeRun) -> None:
    run = make_run("laikago_trot")
    shown = subject(str(run)).show("100N@0.5s:+y")
    write(run / "page.html", shown, served=True)
    write_new(run / "report.html", report.render(RunDirectory(run)).encode())
    for name in ("page.html", "report.html"):
        check_contrasts(browser, run / name)


def test_the_leaderboard_can_be_read_on_every_screen(browser: Browser, tmp_path: Path) -> None:
    """With the kept entries, and one whose texts are long or HTML. On a phone on its side tables
    may scroll within their frames."""
    board, site, long = tmp_path / "board", tmp_path / "site", f"long{'_name' * 12}"
    task = next((BOARD / "v1").glob("rocket*"))
    entry = shutil.copytree(task / "twostage", board / "v1" / task.name / long)
    manifest = Manifest.decode((entry / "manifest.json").read_bytes())
    described = replace(
        manifest.described, entry=long, authors=(HTML, long), hardware=HTML * 4, url=URL
    )
    (entry / "manifest.json").write_bytes(replace(manifest, described=described).encode())
    for kept, folder in ((BOARD, site / "kept"), (board, site / "long")):
        write_site(kept, folder, None, lambda line: None)
    check_contrasts(browser, site / "kept" / "index.html")
    pages = [*site.glob("*/index.html"), *site.glob("long/*/*/index.html")]
    assert len(pages) == 3
    pages += sorted((site / "kept").glob("*/*/index.html"))[:3]
    for path, screen in product(pages, SCREENS):
        with browser.open(path.as_uri(), screen):
            assert browser.ask("document.documentElement.scrollWidth - innerWidth") <= 0, path
            cut = """[...document.querySelectorAll(".wide")]
              .map((one) => one.scrollWidth - one.clientWidth)"""
            assert screen == ON_ITS_SIDE or max(browser.ask(cut)) <= 0
            browser.screenshot(f"site_{path.parent.name[:20]}_{screen[0]}")


def test_the_address_of_a_report_opens_a_moment(browser: Browser, make_run: MakeRun) -> None:
    run = make_run("rocket_navigation", 0.7)
    path = run / "report.html"
    write_new(path, report.render(RunDirectory(run)).encode())
    shown = """new Promise((done) => {
      const view = document.getElementById("view").contentDocument;
      const look = () => {
        const {textContent} = view.getElementById("clock") || {};
        if (textContent?.startsWith("%s /")) done(view.getElementById("view").value);
        else requestAnimationFrame(look);
      };
      look();
    })"""
    with browser.open(f"{path.as_uri()}#t=1.5"):
        assert browser.ask(shown % "1.50") == "overview"
        browser.ask("location.hash = '#t=0.25&view=follow'")
        assert browser.ask(shown % "0.25") == "follow"


def test_pictures_have_a_text(browser: Browser, make_run: MakeRun) -> None:
    run = make_run("laikago_walk")
    path = run / "report.html"
    write_new(path, report.render(RunDirectory(run)).encode())
    texts = """[...document.querySelectorAll("svg")].map((one) => [
      one.getAttribute("role"),
      ...one.getAttribute("aria-labelledby").split(" ")
        .map((id) => document.querySelectorAll("#" + id))
        .map((found) => found.length === 1 && one.contains(found[0]) && found[0].textContent)])"""
    with browser.open(path.as_uri()):
        found = browser.ask(texts)
        view = browser.ask("""[...document.getElementById("view").contentDocument
          .querySelectorAll("[role=img]")].map((one) => one.ariaLabel)""")
    assert len(found) == 2 + 5 + 12 + 4 + 1
    titles = [title for _, title, _ in found]
    assert {role for role, _, _ in found} == {"img"}
    assert len(set(titles)) >= len(titles) - 1  # the contacts are drawn for two widths
    assert all(text and re.search(r"\d", text) for _, _, text in found)
    picture, timeline = view
    assert picture.startswith(
        "laikago_walk, twostage, seed 0, budget smoke in 3-D. The plan starts"
    )
    assert timeline.startswith("over time: FR foot stands")
