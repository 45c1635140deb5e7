"""Policies whose actions overflow only where few look: under a push, or in changed physics."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import cli, tasks
from tsbench.core.files import encode_json
from tsbench.core.policy import ENCODINGS, Policy
from tsbench.core.state import Start
from tsbench.evaluation import protocol as protocols
from tsbench.evaluation.protocol import PROTOCOLS, SMOKE, Condition, perturbed_starts
from tsbench.evaluation.robustness import robustness
from tsbench.leaderboard import submission
from tsbench.sim.episodes import play
from tsbench.sim.physics import Physics

BOARD = Path(__file__).parents[2] / "leaderboards"
TASK = "rocket_navigation"
QUICK = replace(SMOKE, name="quick", ranked=True)
ENTRY = Path("board/quick") / TASK / "mine"
WHO = ["--name", "mine", "--author", "A. Person", "--licence", "MIT", "--board", "board"]
TOLD = ["--seeds", "5", "--steps", "256", "--seconds", "1.5", "--command", "python train.py"]


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A protocol that takes seconds, and by whose scores entries are made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PROTOCOLS, "quick", QUICK)
    monkeypatch.setattr(protocols, "V1", QUICK)


@pytest.fixture(scope="module")
def sound() -> Policy:
    """A policy that solves the task."""
    return Policy.load(min(BOARD.glob(f"v1/{TASK}/twostage/seed*")))


@pytest.fixture(scope="module")
def met(sound: Policy) -> dict[str, np.ndarray]:
    """The observations that it meets, by the part of the protocol, each of shape (n, o)."""
    task = tasks.make(TASK)
    found: dict[str, list[np.ndarray]] = {"calm": [], "changed": [], "pushed": []}

    def spying(part: str) -> Any:
        def act(observation: np.ndarray) -> np.ndarray:
            found[part].append(observation)
            return sound(observation)

        return act

    own = task.start(np.random.default_rng(0), 1)
    starts = Start.joined([own, perturbed_starts(task, QUICK)])
    for part, condition in [
        ("calm", Condition("none")),
        *(("changed", condition) for condition in QUICK.conditions),
    ]:
        count = len(starts.time)
        physics: Physics[Any] = Physics(task, count, threads=1, change=condition.change)
        begin = physics.place(np.arange(count), starts)
        play(task, physics, spying(part), count, begin=begin, delay=condition.delay)
    robustness(spying("pushed"), task, QUICK, threads=1)
    return {part: np.concatenate(observations) for part, observations in found.items()}


def overflowing(sound: Policy, usual: np.ndarray, unusual: np.ndarray) -> Policy:
    """The same policy with hidden units that add nothing to its actions where all observations lie
    among the usual ones, and infinity minus infinity where one of the unusual ones stands out."""
    usual, unusual = (
        (ENCODINGS[sound.info.encoding](np.asarray(some, np.float32)) - sound.mean) / sound.scale
        for some in (usual, unusual)
    )
    gaps = np.stack(
        [unusual.max(axis=0) - usual.max(axis=0), usual.min(axis=0) - unusual.min(axis=0)]
    )
    side, place = np.unravel_index(np.argmax(gaps), gaps.shape)
    sign, gap = (1.0, -1.0)[side], gaps[side, place]
    assert gap > 0.0
    # elu(steep (x - threshold)) is -1 among the usual observations; its sum with 1 is then 0.
    steep, huge = 60.0 / gap, np.float32(1e38)
    threshold = (sign * usual[:, place]).max() + gap / 2.0
    first, second, last = (np.array(weight) for weight in sound.weights)
    row = np.zeros((1, first.shape[1]), np.float32)
    row[0, place] = sign * steep
    wide = np.zeros((2, second.shape[1] + 1), np.float32)
    wide[:, -1] = huge
    weights = (
        np.concatenate([first, row]),
        np.concatenate([np.pad(second, ((0, 0), (0, 1))), wide]),
        np.pad(last, ((0, 0), (0, 2))),
    )
    weights[2][:, -2:] = (1.0, -1.0)
    one, two, three = sound.biases
    biases = (
        np.append(one, np.float32(-steep * threshold)),
        np.append(two, [huge, huge]).astype(np.float32),
        three,
    )
    sizes = sound.info.layers
    layers = (sizes[0], sizes[1] + 1, sizes[2] + 2, sizes[3])
    return replace(sound, info=replace(sound.info, layers=layers), weights=weights, biases=biases)


@pytest.fixture(params=["changed", "pushed"])
def spoiled(request: pytest.FixtureRequest, sound: Policy, met: dict[str, np.ndarray]) -> Policy:
    parts = ["calm", "changed", "pushed"]
    before = parts[: parts.index(request.param)]
    usual = np.concatenate([met[part] for part in before])
    policy = overflowing(sound, usual, met[request.param])
    np.testing.assert_allclose(policy(met["calm"]), sound(met["calm"]), atol=1e-5)
    assert np.isnan(policy(met[request.param])).any()
    return policy


def said_of(policy: str) -> str:
    part = {"changed": r"mass x 0\.8|latency 2 control steps", "pushed": "pushed"}[policy]
    return rf"action of environment \d+ is not finite at step \d+ of its episode \(({part})\)"


def assert_refused(capsys: pytest.CaptureFixture[str], said: str) -> None:
    """In one line, beside which nothing is written."""
    written = capsys.readouterr()
    assert not written.out
    assert re.fullmatch(rf"tsbench: {said}\n", written.err), written.err


def test_no_score_is_made_of_it(
    spoiled: Policy, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    said = said_of(request.node.callspec.params["spoiled"])
    Path("theirs").mkdir()
    spoiled.save("theirs")
    words = ["evaluate", "theirs", "--protocol", "quick", "--threads", "1", "--json", "score.json"]
    assert cli.main(words) == 2
    assert not Path("score.json").exists()
    assert_refused(capsys, said)
    assert cli.main(["submit", "theirs", *WHO, *TOLD, "--threads", "1"]) == 2
    assert_refused(capsys, said)
    assert not Path("board").exists()


def test_an_entry_with_the_score_of_another_policy_fails(
    sound: Policy,
    spoiled: Policy,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The kept actions are those of a sound policy, so they earn what they did."""
    said = said_of(request.node.callspec.params["spoiled"])
    Path("theirs").mkdir()
    sound.save("theirs")
    assert cli.main(["submit", "theirs", *WHO, *TOLD, "--threads", "1"]) == 0
    run = ENTRY / "seed5"
    spoiled.save(run)
    content = json.loads((run / "score.json").read_text())
    content["score"]["origin"]["policy"] = spoiled.sha256
    (run / "score.json").write_bytes(encode_json(content))
    manifest = submission.read_manifest(ENTRY)
    files = {name: submission.hash_of((ENTRY / name).read_bytes()) for name in manifest.files}
    (ENTRY / "manifest.json").write_bytes(replace(manifest, files=files).encode())
    capsys.readouterr()
    assert cli.main(["verify", str(ENTRY), "--quick"]) == 0
    assert cli.main(["verify", str(ENTRY), "--threads", "1"]) == 1
    told = capsys.readouterr().out
    assert re.search(rf"FAILED: not re-scored: seed5 broke off: {said}\n", told), told
    shutil.move(run, "forged")
    shutil.rmtree("board")
    assert cli.main(["submit", "forged", *WHO, *TOLD, "--check", "--threads", "1"]) == 1
    assert re.search(rf"FAILED: not re-scored: seed5 broke off: {said}\n", capsys.readouterr().out)
