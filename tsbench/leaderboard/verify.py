"""Verification: what is found out about an entry from its files alone, with the code of today.

Every state includes those before it, but *re-trained*, which can be reached without *hidden-seed*:

- *submitted*: the files are whole and belong together (`submission.read_entry`);
- *replayed*: the kept actions earn the kept rewards again, which takes seconds;
- *re-scored*: the policy's score by the whole protocol is what the entry claims, bit for bit on
  the same kind of machine, within the protocol's tolerance on another;
- *hidden-seed*: the policy is as good from starts that nobody could know, drawn from a seed of
  which only the hash was published before;
- *re-trained*: the recorded command makes as good a policy again.

An entry that a maintainer takes back is *retracted*. States are kept beside the entries, in
`verdicts/` of the board, where no submission can write.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from tsbench.core.errors import TsbenchError, os_errors, plain_line, quoted
from tsbench.core.files import read_file, read_json, write_whole
from tsbench.core.typed import typed
from tsbench.evaluation.evaluate import evaluate, solved_rewards
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import PROTOCOLS
from tsbench.evaluation.replay import compare, incomparable, replay
from tsbench.evaluation.score import Score
from tsbench.leaderboard import recipe
from tsbench.leaderboard.kept import folders
from tsbench.leaderboard.submission import Claim, Entry, Kept, read_entry, read_manifest
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import RunConfig

STATES = ("submitted", "replayed", "re-scored", "hidden-seed", "re-trained")
RETRACTED = "retracted"
# What a state leaves unproved, for readers. No state proves what nobody can see from files.
UNPROVED = (
    "hardware, seconds, learning curves, tuning trials, and which seeds were trained but not kept"
)
CLAIMS = {
    "submitted": f"every figure, the command, seeds, settings and steps, {UNPROVED}",
    "replayed": "every figure but those of the nominal episode, "
    f"the command, seeds, settings and steps, {UNPROVED}",
    "re-scored": f"that the command, seed, settings and steps made this policy, {UNPROVED}",
    "hidden-seed": f"that the command, seed, settings and steps made this policy, {UNPROVED}",
    "re-trained": UNPROVED,
}
MAX_VERDICT = 512 * 2**10  # bytes
SEED_DIGITS = 32  # hexadecimal: a hash of fewer could be searched for
# Standard errors by which a score on the hidden seed may lie below that on the published one. A
# policy that is equally good from both is refused once in 200 times.
HIDDEN_ERRORS = 2.576
FAILED = "FAILED: not "  # begins a reason, before the state that was not reached
RETRAINED = 0.1  # share of the claimed solved_reward that a policy trained again may lack


@dataclass(frozen=True)
class Figure:
    """Attributes:
    seed: of the training.
    name: of the figure.
    claimed: by the entry.
    verified: here, or None if it was not made again.
    """

    seed: int
    name: str
    claimed: float
    verified: float | None


@dataclass(frozen=True)
class Verdict:
    """Attributes:
    entry: PROTOCOL/TASK/ENTRY, or the directory where no entry could be read.
    digest: of its manifest.
    state: the last one reached, of `STATES`, or retracted; "" if the entry was refused.
    passed: whether nothing that was asked failed.
    reasons: what was found, in sentences, with what was not found out and why.
    figures: claimed and verified.
    seconds: that it took.
    """

    entry: str
    digest: str
    state: str
    passed: bool
    reasons: tuple[str, ...]
    figures: tuple[Figure, ...]
    seconds: float


@dataclass(frozen=True)
class Asked:
    """What is to be found out.

    Attributes:
        rescore: whether the score is made again; the kept actions are replayed in any case.
        hidden: the hidden seed, or None.
        train: trains by a configuration in its directory, or None if nothing is trained again.
        threads: for the physics, None for all cores.
    """

    rescore: bool = True
    hidden: int | None = None
    train: Callable[[RunConfig], object] | None = None
    threads: int | None = None


Tell = Callable[[str], None]  # is told what is being done


def verify(path: Path, asked: Asked, tell: Tell = lambda line: None) -> Verdict:
    """Verifies an entry.

    Args:
        path: its directory.
        asked: what to find out.
        tell: takes a line before each part that takes long.

    Returns:
        The verdict. An entry that cannot be read is refused in one.
    """
    began = time.perf_counter()
    try:
        entry = read_entry(path)
    except TsbenchError as error:
        seconds = round(time.perf_counter() - began, 3)
        return Verdict(str(path), "", "", False, (f"refused: {error}",), (), seconds)
    findings = _Findings(entry)
    _verify(entry, asked, findings, tell)
    return findings.verdict(round(time.perf_counter() - began, 3))


class _Findings:
    """What was found about an entry so far."""

    def __init__(self, entry: Entry) -> None:
        self.entry = entry
        self.state = STATES[0]
        self.passed = True
        self.reasons = list(_notes(entry))
        self.verified: dict[int, Score] = {}
        self.figures: list[Figure] = []

    def reached(self, state: str, reason: str) -> None:
        if self.passed:
            self.state = state
        self.reasons.append(f"{state}: {reason}")

    def failed(self, state: str, reason: str) -> None:
        self.passed = False
        self.reasons.append(f"{FAILED}{state}: {reason}")

    def verdict(self, seconds: float) -> Verdict:
        figures = [
            Figure(
                kept.training.seed,
                each.name,
                getattr(kept.training.claimed, each.name),
                getattr(Claim.of(self.verified[kept.training.seed]), each.name)
                if kept.training.seed in self.verified
                else None,
            )
            for kept in self.entry.kept
            for each in fields(Claim)
        ]
        return Verdict(
            entry=self.entry.name,
            digest=self.entry.manifest.digest,
            state=self.state,
            passed=self.passed,
            reasons=tuple(self.reasons),
            figures=(*figures, *self.figures),
            seconds=seconds,
        )


def _notes(entry: Entry) -> Iterator[str]:
    """What a reader should know about an entry, beside its score."""
    said = entry.manifest.described
    for name in ("hardware", "tuning_trials"):
        if getattr(said, name) is None:
            yield f"not said: {name.replace('_', ' ')}"
    kept = {training.seed for training in entry.manifest.trainings}
    if left := sorted(set(said.seeds_trained) - kept):
        yield f"not kept: the trainings with seeds {', '.join(map(str, left))}"
    for one in entry.kept:
        yield from one.remarks
        if remark := recipe.remark(one.run):
            yield f"{one.run.path.name}: {remark}"


def _verify(entry: Entry, asked: Asked, findings: _Findings, tell: Tell) -> None:
    tiers: list[tuple[str, _Tier, bool]] = [
        ("replayed", _replay, True),
        ("re-scored", _rescore, asked.rescore),
        ("hidden-seed", _hidden, asked.hidden is not None),
        ("re-trained", _retrain, asked.train is not None),
    ]
    for state, tier, wanted in tiers:
        words = []
        for kept in entry.kept if wanted else ():
            tell(f"{entry.name}, seed {kept.training.seed}: is it {state}?")
            try:
                holds, said = tier(kept, asked, findings)
            except TsbenchError as error:  # such as a policy whose actions overflow
                holds, said = False, f"broke off: {error}"
            words.append(f"{kept.run.path.name} {said}")
            if not holds:
                findings.failed(state, words[-1])
        if not findings.passed:
            return
        if words:
            findings.reached(state, "; ".join(words))


# Whether a training holds, and what was seen, in words.
_Tier = Callable[[Kept, Asked, _Findings], tuple[bool, str]]


def _replay(kept: Kept, asked: Asked, findings: _Findings) -> tuple[bool, str]:
    score = kept.record.score
    here = Origin.here(kept.task, score.origin.protocol, kept.policy)
    if words := incomparable(score.origin, here):
        return False, f"was made with {words}"
    log = kept.run.actions(kept.task)
    assert log is not None
    if not replay(kept.task, score, log):
        return False, "earns other rewards with the kept actions"
    return True, f"earns the same rewards with the kept actions of {log.rewards.shape[1]} episodes"


def _rescore(kept: Kept, asked: Asked, findings: _Findings) -> tuple[bool, str]:
    before, log = kept.record.score, kept.run.actions(kept.task)
    protocol = before.origin.protocol
    again = evaluate(kept.policy, kept.task, protocol=protocol, threads=asked.threads)
    findings.verified[kept.training.seed] = again
    comparison = compare(before, again, kept.task, log)
    return comparison.agrees is True, f"was {comparison.words}"


def _hidden(kept: Kept, asked: Asked, findings: _Findings) -> tuple[bool, str]:
    """Compares means of as many episodes each, by Welch's standard error of their difference."""
    assert asked.hidden is not None
    protocol = kept.record.score.origin.protocol
    known, unknown = (
        solved_rewards(kept.policy, kept.task, each, asked.threads)
        for each in (protocol, replace(protocol, seed=asked.hidden))
    )
    claimed, found = kept.training.claimed.solved_reward, float(unknown.mean())
    seed = kept.training.seed
    findings.figures.append(Figure(seed, "solved_reward from hidden starts", claimed, found))
    error = float(np.sqrt((known.var(ddof=1) + unknown.var(ddof=1)) / len(known)))
    allowed = HIDDEN_ERRORS * error
    words = (
        f"claims a solved_reward of {claimed:.4g} and earns {found:.4g} from hidden starts; "
        f"it may earn {allowed:.2g} less by chance"
    )
    return claimed - found <= allowed, words


def _retrain(kept: Kept, asked: Asked, findings: _Findings) -> tuple[bool, str]:
    if not kept.run.config_file.exists():
        return False, "was not trained by tsbench, so there is no configuration to repeat"
    assert asked.train is not None
    with tempfile.TemporaryDirectory(prefix="tsbench-retrain-") as folder:
        place = f"{folder}/run"
        # Loggers and checkpoints are its author's: they change no result, and a logger writes into
        # the account of whoever verifies.
        asked.train(
            replace(
                kept.run.config(),
                directory=place,
                threads=asked.threads,
                loggers=(),
                checkpoint=RunConfig.checkpoint,
            )
        )
        run = RunDirectory(Path(place))
        same = run.policy().sha256 == kept.policy.sha256
        found = run.record().score.solved_reward
    claimed = kept.training.claimed.solved_reward
    seed = kept.training.seed
    findings.figures.append(Figure(seed, "solved_reward trained again", claimed, found))
    if same:
        return True, "was trained again to the same bits"
    words = f"claims a solved_reward of {claimed:.4g}, trained again {found:.4g} (other bits)"
    return found >= (1.0 - RETRAINED) * claimed, words


# The hidden seed


def hidden_seed(file: Path, board: Path) -> int:
    """The seed in a file of which the board has published the hash.

    Raises:
        TsbenchError: the board has published none, the file is another one, or the seed in it is
            short enough to be searched for.
    """
    published = board / "hidden-seed.sha256"
    said = read_file(published, 1024, "published hash of a seed").decode(errors="replace").split()
    content = read_file(file, 1024, "seed")
    if hashlib.sha256(content).hexdigest() != (said[0] if said else ""):
        raise TsbenchError(f"{file} is not the seed whose hash is published in {published}")
    text = content.decode(errors="replace").strip()
    if not re.fullmatch(rf"[0-9a-f]{{{SEED_DIGITS},64}}", text):
        raise TsbenchError(f"{file} must hold {SEED_DIGITS} to 64 hexadecimal digits")
    return int(text, 16)


# The verdicts that a board keeps


def recorded(board: Path, entry: Path) -> Verdict | None:
    """What the board says of an entry, if it speaks of these files. None if it does not, or if the
    entry has no manifest that can be read.

    Raises:
        TsbenchError: the verdict is damaged.
    """
    path = place(board, entry)
    if not path.exists():
        return None
    content = read_json(path, MAX_VERDICT, "verdict")
    try:
        verdict: Verdict = typed(Verdict, content, "")
    except TsbenchError as error:
        raise TsbenchError(f"damaged verdict {path}: {error}") from None
    if verdict.state not in (*STATES, RETRACTED):
        raise TsbenchError(f"damaged verdict {path}: there is no state {quoted(verdict.state)}")
    try:
        same = read_manifest(entry).digest == verdict.digest
    except TsbenchError:
        return None
    return verdict if same else None


def is_retracted(board: Path, entry: Path) -> bool:
    """Whether the board has taken these files of an entry back.

    Raises:
        TsbenchError: the verdict is damaged.
    """
    verdict = recorded(board, entry)
    return verdict is not None and verdict.state == RETRACTED


def check_lies_on(board: Path, entry: Path) -> None:
    """Checks that a board's verdicts can be about an entry.

    Raises:
        TsbenchError: the entry lies elsewhere than on the board.
    """
    if entry.resolve().parents[2:3] != (board.resolve(),):
        raise TsbenchError(
            f"{entry} does not lie in {board}/v1/TASK, and a board keeps verdicts on its own "
            "entries alone: --board names another"
        )


def record(board: Path, entry: Path, verdict: Verdict) -> Path | None:
    """Writes what the board says of an entry from now on. What it said of the same files stays, and
    nothing is written, unless the verdict is a higher state or one that did not pass. After a
    failure a higher state is one that has passed what failed.

    Returns:
        The file that was written, or None.

    Raises:
        TsbenchError: the file cannot be written, or holds a damaged verdict.
    """
    before = recorded(board, entry)
    if before is not None and not _replaces(verdict, before):
        return None
    path = place(board, entry)
    with os_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, (json.dumps(asdict(verdict), indent=1) + "\n").encode())
    return path


def _replaces(verdict: Verdict, before: Verdict) -> bool:
    if RETRACTED in (verdict.state, before.state):
        return verdict.state == RETRACTED
    if not verdict.passed:
        return True
    failed = {
        one.removeprefix(FAILED).partition(":")[0]
        for one in before.reasons
        if one.startswith(FAILED)
    }
    reached = {one.partition(":")[0] for one in verdict.reasons}
    return failed <= reached and STATES.index(verdict.state) > STATES.index(before.state)


def retracted(path: Path, reason: str) -> Verdict:
    """The verdict on an entry that is taken back.

    Raises:
        TsbenchError: there is no such entry, or the reason says nothing.
    """
    if not reason.strip():
        raise TsbenchError("a verdict that takes an entry back needs a reason")
    entry = read_entry(path)
    reasons = (plain_line(f"retracted: {reason}"),)
    return Verdict(entry.name, entry.manifest.digest, RETRACTED, False, reasons, (), 0.0)


def place(board: Path, entry: Path) -> Path:
    """The file of a board's verdict on an entry."""
    where = entry.resolve()
    name = f"{where.name}.json"
    return board / "verdicts" / where.parent.parent.name / where.parent.name / name


def entries(board: Path) -> list[Path]:
    """The directories of all entries of a board, sorted: those of PROTOCOL/TASK/ENTRY."""
    found = []
    for protocol in PROTOCOLS:
        for task in folders(board / protocol):
            found += folders(task)
    return found


# Pull requests


def comment(verdicts: Sequence[Verdict], faults: Sequence[str]) -> str:
    """Markdown for a pull request: claimed, verified, difference, and the reasons."""
    lines = ["## Leaderboard: what the verifier of `main` found", ""]
    if faults:
        lines += ["**Not verified.**", "", *(f"- {as_markdown(fault)}" for fault in faults)]
    for verdict in verdicts:
        state = f"{verdict.state or 'refused'}, {'passed' if verdict.passed else '**failed**'}"
        lines += [
            "",
            f"### {as_markdown(verdict.entry)}: {state} ({verdict.seconds:.0f} s)",
            "",
            "| seed | figure | claimed | verified | difference |",
            "|---|---|---|---|---|",
        ]
        for one in verdict.figures:
            verified, difference = "-", "-"
            if one.verified is not None:
                verified, difference = f"{one.verified:.6g}", f"{one.verified - one.claimed:+.2g}"
            lines.append(
                f"| {one.seed} | {one.name} | {one.claimed:.6g} | {verified} | {difference} |"
            )
        lines += ["", *(f"- {as_markdown(reason)}" for reason in verdict.reasons)]
    return "\n".join(lines)[:60_000] + "\n"


def as_markdown(text: str) -> str:
    """Text of a submission as Markdown that is nothing but text: no link, mention or markup."""
    return re.sub(r"([^\w\s.,;:()/%+-])", lambda found: f"&#{ord(found[1])};", plain_line(text))
