"""Entries: one method on one task, from one or more training seeds, as data with a manifest.

An entry is a directory `v1/TASK/ENTRY/` of a board (`leaderboards/` in the repository):

    manifest.json            who, what, how, at what cost; and the hash of every other file
    seedN/                   one for each training that is kept, N its seed
        policy.json, policy.safetensors      the policy
        score.json, actions.npz              its score, and actions to replay the physics from
        config.yaml, versions.json           how it was trained, if tsbench trained it
        plan.npz, reference.npz, roadmap.npz     what was planned, if its method plans
        metrics.jsonl                        learning curves (`directory.thin_metrics`)

The manifest is written in one way only (`Manifest.encode`) and holds a hash of itself, so that a
change of any byte of an entry is noticed. That is no signature: whoever changes a file can write
another manifest. It makes an entry one thing that can be named, compared and judged.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from tsbench import tasks
from tsbench.core import motion, policy
from tsbench.core.errors import TsbenchError, os_errors, quoted
from tsbench.core.files import check_new, parse_json, read_file, write_json, write_new
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.core.typed import typed
from tsbench.evaluation.evaluate import check_fit
from tsbench.evaluation.protocol import PROTOCOLS, Protocol
from tsbench.evaluation.replay import contradictions
from tsbench.evaluation.score import Score
from tsbench.leaderboard import coherence
from tsbench.runs import directory
from tsbench.runs.directory import Record, RunDirectory, Stage
from tsbench.runs.schema import SEEDS

SCHEMA = 1  # of the manifest
MANIFEST = "manifest.json"

# The files of a training, with the bytes that each may have.
NEEDED = {
    "policy.json": policy.MAX_INFO,
    "policy.safetensors": policy.MAX_FILE,
    "score.json": directory.MAX_SCORE,
    "actions.npz": motion.MAX_FILE,
}
OPTIONAL = {
    "config.yaml": directory.MAX_CONFIG,
    "versions.json": directory.MAX_VERSIONS,
    "plan.npz": motion.MAX_FILE,
    "reference.npz": motion.MAX_FILE,
    "roadmap.npz": motion.MAX_FILE,
    directory.METRICS: directory.MAX_CURVES,
}
LIMITS = {**NEEDED, **OPTIONAL}
MAX_MANIFEST = 512 * 2**10  # bytes
MAX_TRAININGS = 100
MAX_ENTRY = 128 * 2**20  # bytes of all files together
MAX_TEXT = 4000  # characters of a text in the manifest; a recipe may be a long command
MAX_COUNT = 2**53  # steps
MADE = "an entry is what tsbench submit has made of runs, unchanged"

_NAME = re.compile(r"[a-z0-9][a-z0-9_.+-]{0,63}")
FILE = re.compile(rf"seed(0|[1-9][0-9]{{0,9}})/({'|'.join(map(re.escape, LIMITS))})")
_HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Claim:
    """The figures of a score by which entries are compared, under the names that the score has."""

    solved_reward: float
    normalized_reward: float
    success: float
    against_plan: float
    survival_100N: float  # noqa: N815  newtons
    recovery_100N: float  # noqa: N815
    survival_impulse_50: float
    recovery_impulse_50: float

    @classmethod
    def of(cls, score: Score) -> Claim:
        values = {**vars(score.robustness), **vars(score)}
        return cls(**{each.name: values[each.name] for each in fields(cls)})


@dataclass(frozen=True)
class Training:
    """Attributes:
    seed: of the training.
    command: that made it, in words.
    code: git commit of the code that trained it, "+" after it where files were changed; or None.
    steps: environment steps of all stages.
    physics_substeps: physics steps within those.
    seconds: wall-clock time of all stages.
    versions: of the packages that trained it, None for those that were not there.
    claimed: figures of its score.
    """

    seed: int
    command: str
    code: str | None
    steps: int
    physics_substeps: int
    seconds: float
    versions: dict[str, str | None]
    claimed: Claim

    def __post_init__(self) -> None:
        if not 0 <= self.seed < SEEDS:
            raise ValueError(f"seed must lie between 0 and {SEEDS - 1}, not {self.seed}")
        for name in ("steps", "physics_substeps", "seconds"):
            if not 0 <= getattr(self, name) < MAX_COUNT:
                raise ValueError(f"{name} must lie between 0 and 2**53, not {getattr(self, name)}")
        _check_texts(command=self.command, code=self.code, **self.versions)

    @property
    def folder(self) -> str:
        return f"seed{self.seed}"


@dataclass(frozen=True)
class Described:
    """What only its authors can say about an entry.

    Attributes:
        entry: the entry's name, which is that of its directory.
        authors: their names.
        licence: of the files, such as MIT or CC-BY-4.0.
        url: where the method is described, or None.
        hardware: that trained it, or None.
        tuning_trials: choices of settings that were tried before, or None if nobody knows.
        seeds_trained: the seeds of all trainings with these settings, kept or not.
    """

    entry: str
    authors: tuple[str, ...]
    licence: str
    url: str | None = None
    hardware: str | None = None
    tuning_trials: int | None = None
    seeds_trained: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.entry):
            what = "up to 64 lower-case letters, digits and any of _ . + -"
            raise ValueError(f"entry must be a name of {what}, not {quoted(self.entry)}")
        if not 1 <= len(self.authors) <= 100:
            raise ValueError("authors must be 1 to 100 names")
        for author in self.authors:
            _check_texts(authors=author)
        _check_texts(licence=self.licence, url=self.url, hardware=self.hardware)
        if self.url is not None and not re.match(r"https?://", self.url):
            raise ValueError("url must begin with https:// or http://")
        if self.tuning_trials is not None and not 0 <= self.tuning_trials < MAX_COUNT:
            raise ValueError("tuning_trials must be a count")
        if len(set(self.seeds_trained)) < len(self.seeds_trained):
            raise ValueError("seeds_trained names a seed twice")
        if not all(0 <= seed < SEEDS for seed in self.seeds_trained):
            raise ValueError(f"seeds_trained must lie between 0 and {SEEDS - 1}")


@dataclass(frozen=True)
class FileHash:
    """Attributes:
    bytes: size of the file.
    sha256: hash of its content.
    """

    bytes: int
    sha256: str

    def __post_init__(self) -> None:
        if not _HASH.fullmatch(self.sha256):
            raise ValueError("sha256 must be 64 hexadecimal digits")


@dataclass(frozen=True)
class Manifest:
    """The content of `manifest.json`.

    Attributes:
        schema: version of this format.
        described: what the authors say.
        task: name of the task.
        task_version: version of the task.
        protocol: name of the protocol of the scores.
        method: name of the method.
        budget: name of the budget.
        trainings: that are kept, by rising seed.
        files: all files but the manifest, by their path in the entry.
        digest: hash of this manifest with an empty digest.
    """

    schema: int
    described: Described
    task: str
    task_version: int
    protocol: str
    method: str
    budget: str
    trainings: tuple[Training, ...]
    files: dict[str, FileHash]
    digest: str = ""

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise ValueError(f"schema is {self.schema}; this tsbench reads {SCHEMA}")
        _check_texts(task=self.task, protocol=self.protocol, method=self.method, budget=self.budget)
        seeds = [training.seed for training in self.trainings]
        if not 1 <= len(seeds) <= MAX_TRAININGS or seeds != sorted(set(seeds)):
            raise ValueError(f"trainings must be 1 to {MAX_TRAININGS}, by rising seed")
        if lacking := sorted(set(seeds) - set(self.described.seeds_trained)):
            raise ValueError(
                f"described.seeds_trained lacks the kept seed {lacking[0]}: say --trained"
            )
        folders = {training.folder for training in self.trainings}
        for path in self.files:
            if not FILE.fullmatch(path) or path.partition("/")[0] not in folders:
                raise ValueError(f"files names {quoted(path)}, which no entry has")
        for folder in folders:
            for name in NEEDED:
                if f"{folder}/{name}" not in self.files:
                    raise ValueError(f"files lacks {folder}/{name}")

    def signed(self) -> Manifest:
        """The same with its digest."""
        blank = replace(self, digest="")
        return replace(self, digest=hashlib.sha256(blank._written()).hexdigest())

    def _written(self) -> bytes:
        return (json.dumps(asdict(self), indent=1) + "\n").encode()

    def encode(self) -> bytes:
        """The bytes of `manifest.json`."""
        return self.signed()._written()

    @classmethod
    def decode(cls, content: bytes) -> Manifest:
        """
        Raises:
            ValueError: the content is not what `encode` writes, to the byte.
        """
        values = parse_json(content)
        try:
            manifest: Manifest = typed(cls, values, "")
        except TsbenchError as error:
            raise ValueError(str(error)) from None
        if manifest.encode() != content:
            raise ValueError(f"its digest or its form is another: {MADE}")
        return manifest


def _check_texts(**texts: str | None) -> None:
    for name, text in texts.items():
        if text is None:
            continue
        if not (text.strip() and len(text) <= MAX_TEXT and text.isprintable()):
            raise ValueError(f"{name} must be one line of 1 to {MAX_TEXT} characters")


@dataclass(frozen=True)
class Kept:
    """A training of an entry, with the content of its files.

    Attributes:
        training: what the manifest says of it.
        run: its directory.
        record: the content of `score.json`.
        policy: the policy.
        task: the task.
        remarks: what a reader should know about it, in sentences.
    """

    training: Training
    run: RunDirectory
    record: Record
    policy: Policy
    task: Task[Any]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Entry:
    """An entry whose files were looked at and belong together; what is in them is claimed."""

    path: Path
    manifest: Manifest
    kept: tuple[Kept, ...]

    @property
    def name(self) -> str:
        return f"{self.manifest.protocol}/{self.manifest.task}/{self.manifest.described.entry}"


def read_manifest(path: Path) -> Manifest:
    """The manifest of an entry alone, whose files are not looked at.

    Raises:
        TsbenchError: it is missing or damaged.
    """
    content = read_file(path / MANIFEST, MAX_MANIFEST, "manifest")
    try:
        return Manifest.decode(content)
    except ValueError as error:
        raise TsbenchError(f"damaged manifest {path / MANIFEST}: {error}") from None


def read_entry(path: Path) -> Entry:
    """Reads an entry, and checks all that can be checked without playing an episode.

    Nothing outside of the directory is read and nothing in it is executed. The number, names, kinds
    and sizes of the files are checked before a file is opened.

    Raises:
        TsbenchError: a file is missing, unknown, damaged, too large or changed, or the files do not
            belong together. The message names the file.
    """
    found = _files(path)
    manifest = read_manifest(path)
    _check_place(path, manifest)
    for name in sorted(found ^ set(manifest.files)):
        missing = name in manifest.files
        raise TsbenchError(
            f"{path / name} is {'missing' if missing else 'not in the manifest'}: {MADE}"
        )
    for name, said in manifest.files.items():
        data = read_file(path / name, LIMITS[name.partition("/")[2]])
        if hash_of(data) != said:
            raise TsbenchError(
                f"{path / name} differs from the file that the manifest names: {MADE}"
            )
    kept = (
        _read_training(RunDirectory(path / training.folder), training, manifest)
        for training in manifest.trainings
    )
    return Entry(path, manifest, tuple(kept))


def _files(path: Path) -> set[str]:
    """The paths of an entry's files, without the manifest. Directories are listed no further than
    an entry can reach.

    Raises:
        TsbenchError: there is no such directory, or something in it that no entry has.
    """
    if path.is_symlink():
        raise TsbenchError(f"{path} is a link: name the entry itself")
    if not path.is_dir():
        raise TsbenchError(f"no entry {path}")
    if not os.path.lexists(path / MANIFEST):
        raise TsbenchError(f"{path} is no entry, it has no {MANIFEST}: {MADE}")
    found, total = set(), 0
    for folder, name in _listed(path):
        place = path / folder / name
        status = place.lstat()
        if not place.is_file() or place.is_symlink():
            raise TsbenchError(f"{place} is not a regular file")
        inside = f"{folder}/{name}" if folder else name
        limit = MAX_MANIFEST if inside == MANIFEST else LIMITS.get(name, 0)
        if inside != MANIFEST and not FILE.fullmatch(inside):
            raise TsbenchError(f"{place} is no file of an entry: remove it")
        if status.st_size > limit:
            raise TsbenchError(f"{place} is larger than the {limit:,} bytes that are allowed")
        total += status.st_size
        if total > MAX_ENTRY:
            raise TsbenchError(f"{path} is larger than the {MAX_ENTRY:,} bytes that are allowed")
        if inside != MANIFEST:
            found.add(inside)
    return found


def _listed(path: Path) -> Iterator[tuple[str, str]]:
    """Folder and name of everything in an entry that is no folder of a training."""
    for entry in _scan(path, MAX_TRAININGS + 1):
        if entry.is_dir(follow_symlinks=False):
            inner = list(_scan(Path(entry.path), len(LIMITS)))
            if not inner:
                raise TsbenchError(f"{entry.path} is empty")
            yield from ((entry.name, one.name) for one in inner)
        else:
            yield "", entry.name


def _scan(folder: Path, most: int) -> Iterator[os.DirEntry[str]]:
    with os_errors(folder), os.scandir(folder) as entries:
        for count, entry in enumerate(entries):
            if count >= most:
                raise TsbenchError(f"{folder} holds more than {most} files")
            yield entry


def hash_of(data: bytes) -> FileHash:
    return FileHash(len(data), hashlib.sha256(data).hexdigest())


def _check_place(path: Path, manifest: Manifest) -> None:
    """
    Raises:
        TsbenchError: the entry lies elsewhere than its manifest says, or is for an unknown task or
            protocol.
    """
    where = path.absolute()
    if (where.parent.name, where.name) != (manifest.task, manifest.described.entry):
        place = f"{manifest.task}/{manifest.described.entry}"
        raise TsbenchError(
            f"{path} holds the entry {place}: move it there, or submit its runs by another name"
        )
    protocol = PROTOCOLS.get(manifest.protocol)
    if protocol is None or not protocol.ranked:
        name = quoted(manifest.protocol)
        raise TsbenchError(f"{path / MANIFEST}: no score by protocol {name} can be an entry")
    if manifest.task not in tasks.names():
        raise TsbenchError(f"{path / MANIFEST}: there is no task {quoted(manifest.task)} here")


def _read_training(run: RunDirectory, training: Training, manifest: Manifest) -> Kept:
    """
    Raises:
        TsbenchError: a file is damaged, or the files and the manifest do not belong together.
    """
    trained, record = run.policy(), run.record()
    task = run.task(trained.info.task)
    if not tasks.standard(task) or not record.standard:
        raise TsbenchError(f"{run.path} was made with changed constants: it cannot be an entry")
    _check_agreement(run, training, manifest, record, trained)
    try:
        check_fit(trained, task)
    except TsbenchError as error:
        raise TsbenchError(f"{run.policy_info_file}: {error}") from None
    origin = record.score.origin
    if origin.protocol != PROTOCOLS.get(origin.protocol.name):
        raise TsbenchError(
            f"{run.score_file}: a score with another seed or other numbers than protocol "
            f"{origin.protocol.name} has cannot be an entry"
        )
    if wrong := contradictions(record.score, task):
        raise TsbenchError(f"{run.score_file} contradicts itself: {'; '.join(wrong)}")
    coherence.check(run, record, task)
    if run.has_metrics and directory.thin_metrics(run.metrics_file) != read_file(
        run.metrics_file, directory.MAX_CURVES
    ):
        raise TsbenchError(f"{run.metrics_file} holds more than the learning curves")
    log = run.actions(task)
    wanted = (task.horizon, 1 + origin.protocol.logged, task.action_size)
    if log is None or log.actions.shape != wanted:
        raise TsbenchError(f"{run.actions_file} does not hold the episodes of the protocol")
    return Kept(training, run, record, trained, task, tuple(_remarks(run, task)))


def _check_agreement(
    run: RunDirectory, training: Training, manifest: Manifest, record: Record, trained: Policy
) -> None:
    info, score = trained.info, record.score
    versions = run.versions() if run.versions_file.exists() else {}
    said: list[tuple[str, Sequence[object]]] = [
        ("task", [manifest.task, info.task, record.task, score.origin.task]),
        (
            "version of the task",
            [
                manifest.task_version,
                info.task_version,
                record.task_version,
                score.origin.task_version,
            ],
        ),
        ("protocol", [manifest.protocol, score.protocol, score.origin.protocol.name]),
        ("method", [manifest.method, info.method, record.method]),
        ("budget", [manifest.budget, record.budget]),
        ("seed", [training.seed, record.seed]),
        ("policy", [info.sha256, score.origin.policy]),
        ("score", [training.claimed, Claim.of(score)]),
        ("cost", [cost(training), cost_of(record)]),
    ]
    if versions:
        said += [
            ("versions", [training.versions, _packages(versions)]),
            ("commit", [training.code, versions.get("commit")]),
        ]
    config = run.config() if run.config_file.exists() else None
    if config is not None:
        said += [
            ("task", [manifest.task, config.task.name]),
            ("method", [manifest.method, config.method["name"]]),
            ("seed", [training.seed, config.seed]),
            ("budget", [manifest.budget, config.budget]),
            ("command", [training.command, run.command]),
        ]
    for what, values in said:
        if any(value != values[0] for value in values):
            told = dict.fromkeys(quoted(one) for one in values if isinstance(one, (str, int)))
            which = f" ({', '.join(told)})" if told else ""
            raise TsbenchError(
                f"{run.path} mixes several runs: its files disagree on the {what}{which}"
            )


def cost(training: Training) -> tuple[int, int, float]:
    return training.steps, training.physics_substeps, training.seconds


def cost_of(record: Record) -> tuple[int, int, float]:
    """Environment steps, physics steps and seconds of all stages."""
    stages = record.stages
    return (
        sum(stage.steps for stage in stages),
        sum(stage.physics_substeps for stage in stages),
        round(sum(stage.seconds for stage in stages), 3),
    )


def _remarks(run: RunDirectory, task: Task[Any]) -> Iterator[str]:
    """
    Raises:
        TsbenchError: plan, reference motion or roadmap is damaged or does not fit the task.
    """
    run.roadmap(task)
    plan, reference = run.plan(task), run.reference(task)
    if plan is None or reference is None:
        for lone, lacking in ((plan, run.reference_file), (reference, run.plan_file)):
            if lone is not None:
                yield f"{run.path.name}: nobody can audit the {lone.kind} without {lacking.name}"
        return
    failures = plannable(task).audit(plan, reference).failures
    if failures:
        words = "; ".join(map(str, failures))
        yield f"{run.path.name}: the plan fails its audit ({words})"


# Packing


@dataclass(frozen=True)
class Told:
    """What is told of trainings that tsbench did not make, whose directories do not say it.

    Attributes:
        seeds: one for each directory.
        command: that made them, in words.
        steps: environment steps of each.
        seconds: wall-clock time of each.
        code: git commit of the code that trained them, or None.
        budget: its name.
    """

    seeds: tuple[int, ...]
    command: str
    steps: int
    seconds: float
    code: str | None = None
    budget: str = "own"


Scorer = Callable[[Policy, Task[Any]], Score]


def pack(
    runs: Sequence[Path],
    described: Described,
    board: Path,
    protocol: Protocol,
    *,
    told: Told | None = None,
    score: Scorer,
    rescore: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> Path:
    """Packs runs into an entry outside of the board, and checks the packed files (`read_entry`).

    Args:
        runs: directories, of runs or of exported policies.
        described: what the authors say; without `seeds_trained`, all seeds trained are the packed
            ones.
        board: that the entry is for. It is made in a new hidden folder there, or in the nearest
            folder above a board that does not exist yet.
        protocol: of the scores.
        told: of trainings that tsbench did not make.
        score: makes the score of a policy that has none by the protocol.
        rescore: whether every score is made again.
        tell: is given a line for each score by another protocol, which is made again.

    Returns:
        The directory of the entry, which `place` moves to the board, `discard` removes.

    Raises:
        TsbenchError: a run cannot be a part of an entry, or the runs cannot make one.
    """
    with os_errors(board):
        # A board that there is not yet is made with its first entry.
        there = next(one for one in (board, *board.absolute().parents) if os.path.lexists(one))
        if not there.is_dir():
            raise TsbenchError(f"{there} is no folder, so no board can be made there")
        try:
            folder = Path(tempfile.mkdtemp(prefix=".submit-", dir=there))
        except OSError as error:
            raise TsbenchError(f"{there}: {error.strerror}") from None
    copies: dict[Path, Path] = {}
    try:
        with os_errors(folder):
            parts = []
            for i, run in enumerate(runs):
                copies[folder / str(i)] = run
                part = _pack_run(
                    RunDirectory(run), folder / str(i), protocol, told, i, score, rescore, tell
                )
                parts.append(part)
                record = part[1]
                copies[folder / record.task / described.entry / f"seed{record.seed}"] = run
            return _pack_entry(parts, described, folder, protocol, told)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, TsbenchError):
            raise TsbenchError(_naming(copies, str(error))) from None
        raise


def _naming(copies: Mapping[Path, Path], text: str) -> str:
    """The text with the runs in the place of their copies, which are gone when it is read."""
    for copy, run in copies.items():
        text = re.sub(rf"{re.escape(str(copy))}(?!\w)", str(run).replace("\\", r"\\"), text)
    return text


def discard(entry: Path) -> None:
    """Removes what `pack` has made."""
    shutil.rmtree(entry.parent.parent, ignore_errors=True)


def home(entry: Path, board: Path, protocol: Protocol, runs: Sequence[Path]) -> Path:
    """The place on the board of an entry that `pack` made.

    Raises:
        TsbenchError: there is another entry in that place, or the runs lie there and are not what
            an entry keeps of them.
    """
    place = board / protocol.name / entry.parent.name / entry.name
    with os_errors(place):
        if not _lie_in(place, entry, runs):
            check_new(place, "give another --name", parents=True)
            return place
        check_new(place / MANIFEST)
        for name in read_manifest(entry).files:
            if (place / name).read_bytes() != (entry / name).read_bytes():
                reason = "is not what an entry keeps of it: submit the run from elsewhere"
                raise TsbenchError(f"{place / name} {reason}")
    return place


def place(entry: Path, board: Path, protocol: Protocol, runs: Sequence[Path]) -> Path:
    """Moves an entry that `pack` made to its place on the board.

    Runs that lie in that place already (`seedN`) stay as they are, and get the manifest.

    Raises:
        TsbenchError: as `home`.
    """
    there = home(entry, board, protocol, runs)
    with os_errors(there):
        if _lie_in(there, entry, runs):
            write_new(there / MANIFEST, (entry / MANIFEST).read_bytes())
        else:
            there.parent.mkdir(parents=True, exist_ok=True)
            entry.rename(there)
    discard(entry)
    return there


def _lie_in(place: Path, entry: Path, runs: Sequence[Path]) -> bool:
    """Whether the runs are the directories of an entry's trainings in that place already."""
    folders = {(place / one.name).resolve() for one in entry.iterdir() if one.is_dir()}
    return place.is_dir() and {run.resolve() for run in runs} == folders


def _pack_run(
    run: RunDirectory,
    folder: Path,
    protocol: Protocol,
    told: Told | None,
    number: int,
    score: Scorer,
    rescore: bool,
    tell: Callable[[str], None],
) -> tuple[Path, Record]:
    """Copies a run's files, reading each of them once, and makes its score if it has none."""
    if not run.policy_info_file.exists():
        raise TsbenchError(_without_policy(run))
    folder.mkdir()
    for name, limit in LIMITS.items():
        path = run.path / name
        if name != directory.METRICS and (path.exists() or path.is_symlink()):
            (folder / name).write_bytes(read_file(path, limit))
    if run.has_metrics and (curves := directory.thin_metrics(run.metrics_file)):
        (folder / directory.METRICS).write_bytes(curves)
    copy = RunDirectory(folder)
    before = copy.record() if copy.finished else None
    if before is None and told is None:
        if run.unfinished:
            raise TsbenchError(run.unfinished)
        raise TsbenchError(
            f"{run.path} has no {run.score_file.name}: of a policy that tsbench did not train "
            "say --seeds, --steps, --seconds and --command"
        )
    if before is not None:
        coherence.check_budget(copy, before)
    if before is not None and before.score.protocol == protocol.name and not rescore:
        if not copy.actions_file.exists():
            raise TsbenchError(
                f"{run.path} has no {run.actions_file.name}: --rescore makes it, with the score"
            )
        return folder, before
    if before is not None and before.score.protocol != protocol.name:
        by = f"its score is by the protocol {before.score.protocol}"
        tell(f"{run.path}: {by}, so it is scored again by {protocol.name}")
    trained = copy.policy()
    task = copy.task(trained.info.task)
    made = score(trained, task)
    assert made.log is not None
    if before is None:
        assert told is not None
        before = _record(told, number, trained, task, made)
    for path in (copy.score_file, copy.actions_file):
        path.unlink(missing_ok=True)
    made.log.save(copy.actions_file)
    record = replace(before, score=made)
    write_json(copy.score_file, record.as_dict())
    return folder, record


def _without_policy(run: RunDirectory) -> str:
    """Why a directory is no part of an entry, and what to name instead."""
    place, lacking = run.path, f"{run.path} holds no policy (no {run.policy_info_file.name})"
    if not place.is_dir():
        return f"no run directory {place}"
    if run.unfinished:
        return run.unfinished
    if any(place.glob("seed*/policy.json")):
        return f"{lacking}: name the trainings in it, {place / 'seed*'}"
    if run.actions_file.exists():
        return f"{lacking}; an action log alone is no entry: it cannot be scored from other starts"
    return lacking


def _record(told: Told, number: int, trained: Policy, task: Task[Any], made: Score) -> Record:
    model = task.spec().compile()
    substeps = told.steps * round(task.timestep / model.opt.timestep)
    stage = Stage("train", told.steps, told.steps, substeps, seconds=told.seconds)
    return Record(
        task=task.name,
        task_version=task.version,
        standard=tasks.standard(task),
        method=trained.info.method,
        seed=told.seeds[number],
        budget=told.budget,
        score=made,
        stages=(stage,),
    )


def _pack_entry(
    parts: Sequence[tuple[Path, Record]],
    described: Described,
    folder: Path,
    protocol: Protocol,
    told: Told | None,
) -> Path:
    first = parts[0][1]
    for name in ("task", "method", "budget", "task_version"):
        values = sorted({str(getattr(record, name)) for _, record in parts})
        if len(values) > 1:
            found = f"{name}: {', '.join(values)}"
            raise TsbenchError(
                f"the runs are of more than one {found}; each is an entry of its own"
            )
    seeds = [record.seed for _, record in parts]
    if len(set(seeds)) < len(seeds):
        twice = next(seed for seed in seeds if seeds.count(seed) > 1)
        raise TsbenchError(
            f"two of the runs have the same seed, {twice}: an entry keeps one training of each"
        )
    entry = folder / first.task / described.entry
    entry.mkdir(parents=True)
    files: dict[str, FileHash] = {}
    trainings = []
    for source, record in sorted(parts, key=lambda part: part[1].seed):
        training = _training(RunDirectory(source), record, told)
        source.rename(entry / training.folder)
        trainings.append(training)
        for path in sorted((entry / training.folder).iterdir()):
            files[f"{training.folder}/{path.name}"] = hash_of(path.read_bytes())
    try:
        manifest = Manifest(
            schema=SCHEMA,
            described=replace(
                described, seeds_trained=described.seeds_trained or tuple(sorted(seeds))
            ),
            task=first.task,
            task_version=first.task_version,
            protocol=protocol.name,
            method=first.method,
            budget=first.budget,
            trainings=tuple(trainings),
            files=files,
        )
    except ValueError as error:
        raise TsbenchError(f"no entry can be made: {error}") from None
    write_new(entry / MANIFEST, manifest.encode())
    read_entry(entry)
    return entry


def _training(run: RunDirectory, record: Record, told: Told | None) -> Training:
    versions: dict[str, Any] = run.versions() if run.versions_file.exists() else {}
    steps, substeps, seconds = cost_of(record)
    command = run.command if run.config_file.exists() else told.command if told else "unknown"
    try:
        return Training(
            seed=record.seed,
            command=command,
            code=versions.get("commit") if versions else told.code if told else None,
            steps=steps,
            physics_substeps=substeps,
            seconds=seconds,
            versions=_packages(versions) or dict(record.score.origin.packages),
            claimed=Claim.of(record.score),
        )
    except ValueError as error:
        raise TsbenchError(f"{run.path}: {error}") from None


def _packages(versions: dict[str, Any]) -> dict[str, str | None]:
    """The versions of Python and packages in the content of `versions.json`."""
    packages = versions.get("packages")
    if not isinstance(packages, dict):
        return {}
    return {"python": versions.get("python"), **packages}
