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
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
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
from tsbench.leaderboard.kept import MANIFEST
from tsbench.leaderboard.kept import entries as kept_entries
from tsbench.runs import directory
from tsbench.runs.directory import Record, RunDirectory, Stage
from tsbench.runs.schema import SEEDS

SCHEMA = 1  # of the manifest

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
ALIKE = ("task", "method", "budget", "task_version")  # what all runs of an entry share
FOREIGN = "--seeds, --steps, --seconds and --command"  # what is told of others' trainings
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
        _check_counts(
            steps=self.steps, physics_substeps=self.physics_substeps, seconds=self.seconds
        )
        _check_texts(command=self.command, code=self.code)
        _check_texts(**self.versions)

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
        _check_seeds([training.seed for training in self.trainings], self.described)
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


def _check_seeds(seeds: Sequence[int], described: Described) -> None:
    if not 1 <= len(seeds) <= MAX_TRAININGS or list(seeds) != sorted(set(seeds)):
        raise ValueError(f"trainings must be 1 to {MAX_TRAININGS}, by rising seed")
    if lacking := sorted(set(seeds) - set(described.seeds_trained)):
        raise ValueError(f"described.seeds_trained lacks the kept seed {lacking[0]}: say --trained")


def _check_counts(**counts: float) -> None:
    for name, value in counts.items():
        if not 0 <= value < MAX_COUNT:
            raise ValueError(f"{name} must lie between 0 and 2**53, not {value}")


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


def kept_manifests() -> dict[str, Manifest]:
    """The manifests of the kept entries, by TASK/ENTRY, but for those that cannot be read."""
    found = {}
    for name, path in kept_entries().items():
        with suppress(TsbenchError):
            found[name] = read_manifest(path)
    return found


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
        round(sum((stage.seconds for stage in stages), 0.0), 3),
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
    """What is told of trainings that tsbench did not make, where their directories do not say it.

    Attributes:
        seeds: one for each directory.
        command: that made them, in words.
        steps: environment steps of each that has no score.
        seconds: wall-clock time of each that has no score.
        code: git commit of the code that trained them, or None.
        budget: its name.
    """

    seeds: tuple[int, ...]
    command: str
    steps: int
    seconds: float
    code: str | None = None
    budget: str = "own"

    def __post_init__(self) -> None:
        _check_counts(steps=self.steps, seconds=self.seconds)
        _check_texts(command=self.command, code=self.code)


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

    What the files say is checked before the first score is made, which takes minutes.

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
                part = _copied(RunDirectory(run), folder / str(i), protocol, told, i, rescore)
                parts.append(part)
                copies[folder / part.task / described.entry / part.name] = run
            parts.sort(key=lambda part: part.seed)
            seeds = tuple(part.seed for part in parts)
            _check_parts(parts)
            described = replace(described, seeds_trained=described.seeds_trained or seeds)
            try:
                _check_seeds(seeds, described)
            except ValueError as error:
                raise TsbenchError(f"no entry can be made: {error}") from None
            entry = board / protocol.name / parts[0].task / described.entry
            _check_free(entry, [part.name for part in parts], runs)
            records = [_scored(part, protocol, score, tell) for part in parts]
            return _pack_entry(parts, records, described, folder, protocol)
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
    names = _trainings(entry)
    with os_errors(place):
        _check_free(place, names, runs)
        for name in read_manifest(entry).files if _lie_in(place, names, runs) else ():
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
        if _lie_in(there, _trainings(entry), runs):
            write_new(there / MANIFEST, (entry / MANIFEST).read_bytes())
        else:
            there.parent.mkdir(parents=True, exist_ok=True)
            entry.rename(there)
    discard(entry)
    return there


def _check_free(place: Path, names: Sequence[str], runs: Sequence[Path]) -> None:
    """
    Raises:
        TsbenchError: there is an entry in that place already.
    """
    if _lie_in(place, names, runs):
        check_new(place / MANIFEST)
    else:
        check_new(place, "give another --name", parents=True)


def _lie_in(place: Path, names: Sequence[str], runs: Sequence[Path]) -> bool:
    """Whether the runs are the trainings of those names in that place already."""
    folders = {(place / name).resolve() for name in names}
    return place.is_dir() and {run.resolve() for run in runs} == folders


def _trainings(entry: Path) -> list[str]:
    """The names of the directories of an entry that `pack` made."""
    return [one.name for one in entry.iterdir() if one.is_dir()]


@dataclass(frozen=True)
class _Part:
    """A run on its way into an entry.

    Attributes:
        run: its directory.
        copy: the copy of its files, of which the entry is made.
        before: the content of its `score.json`, or None if it has none.
        told: what is told of it if it has none.
        keeps: whether its score stays as it is.
        task: name of the task, as `method` and `budget` are.
        task_version: version of the task.
        command: that made it, in words.
        code: git commit of the code that trained it, or None.
    """

    run: Path
    copy: RunDirectory
    before: Record | None
    told: Told | None
    keeps: bool
    task: str
    task_version: int
    method: str
    budget: str
    seed: int
    command: str
    code: str | None

    @property
    def name(self) -> str:
        """Of its directory in the entry."""
        return f"seed{self.seed}"


def _copied(
    run: RunDirectory,
    folder: Path,
    protocol: Protocol,
    told: Told | None,
    number: int,
    rescore: bool,
) -> _Part:
    """Copies a run's files, reading each of them once."""
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
            f"say {FOREIGN}"
        )
    keeps = before is not None and before.score.protocol == protocol.name and not rescore
    if before is not None:
        coherence.check_budget(copy, before)
    if keeps and not copy.actions_file.exists():
        raise TsbenchError(
            f"{run.path} has no {run.actions_file.name}: --rescore makes it, with the score"
        )
    if before is not None:
        values: dict[str, Any] = {name: getattr(before, name) for name in ALIKE}
        seed = before.seed
        if told is not None and told.seeds[number] != seed:
            raise TsbenchError(
                f"{run.score_file} says seed {seed}, --seeds says {told.seeds[number]}"
            )
    else:
        assert told is not None
        info, seed = copy.policy().info, told.seeds[number]
        values = {name: getattr(info, name) for name in ALIKE if name != "budget"}
        values["budget"] = told.budget
    command, code = _recipe(run, seed, told)
    if copy.versions_file.exists():
        code = copy.versions().get("commit")
    return _Part(
        run.path, copy, before, told, keeps, **values, seed=seed, command=command, code=code
    )


def _recipe(run: RunDirectory, seed: int, told: Told | None) -> tuple[str, str | None]:
    """The command that made a run, and the commit of its code: as its configuration says, as the
    manifest of the entry says in which it lies, or as told."""
    if run.begun:
        return run.command, None
    entry = run.path.resolve().parent
    if (entry / MANIFEST).exists():
        for training in read_manifest(entry).trainings:
            if (training.folder, training.seed) == (run.path.resolve().name, seed):
                return training.command, training.code
    if told is None:
        raise TsbenchError(
            f"{run.path} has no {run.config_file.name}, so nothing says what trained it: say "
            f"{FOREIGN}"
        )
    return told.command, told.code


def _check_parts(parts: Sequence[_Part]) -> None:
    """
    Raises:
        TsbenchError: the runs, by rising seed, cannot be one entry.
    """
    for name in ALIKE:
        values = sorted({str(getattr(part, name)) for part in parts})
        if len(values) > 1:
            found = f"{name}: {', '.join(values)}"
            raise TsbenchError(
                f"the runs are of more than one {found}; each is an entry of its own"
            )
    for one, other in pairwise(parts):
        if one.seed == other.seed:
            raise TsbenchError(
                f"two of the runs have the same seed, {one.seed}: an entry keeps one training of "
                "each"
            )


def _scored(part: _Part, protocol: Protocol, score: Scorer, tell: Callable[[str], None]) -> Record:
    """The record of a run, whose score is made if it has none by the protocol."""
    before, copy = part.before, part.copy
    if before is not None and part.keeps:
        return before
    if before is not None and before.score.protocol != protocol.name:
        by = f"its score is by the protocol {before.score.protocol}"
        tell(f"{part.run}: {by}, so it is scored again by {protocol.name}")
    trained = copy.policy()
    task = copy.task(trained.info.task)
    made = score(trained, task)
    assert made.log is not None
    if before is None:
        before = _record(part, task, made)
    for path in (copy.score_file, copy.actions_file):
        path.unlink(missing_ok=True)
    made.log.save(copy.actions_file)
    record = replace(before, score=made)
    write_json(copy.score_file, record.as_dict())
    return record


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


def _record(part: _Part, task: Task[Any], made: Score) -> Record:
    told = part.told
    assert told is not None
    substeps = told.steps * task.substeps
    stage = Stage("train", told.steps, told.steps, substeps, seconds=told.seconds)
    return Record(
        task=task.name,
        task_version=task.version,
        standard=tasks.standard(task),
        method=part.method,
        seed=part.seed,
        budget=part.budget,
        score=made,
        stages=(stage,),
    )


def _pack_entry(
    parts: Sequence[_Part],
    records: Sequence[Record],
    described: Described,
    folder: Path,
    protocol: Protocol,
) -> Path:
    first = parts[0]
    entry = folder / first.task / described.entry
    entry.mkdir(parents=True)
    files: dict[str, FileHash] = {}
    trainings = []
    for part, record in zip(parts, records, strict=True):
        training = _training(part, record)
        part.copy.path.rename(entry / training.folder)
        trainings.append(training)
        for path in sorted((entry / training.folder).iterdir()):
            files[f"{training.folder}/{path.name}"] = hash_of(path.read_bytes())
    try:
        manifest = Manifest(
            schema=SCHEMA,
            described=described,
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


def _training(part: _Part, record: Record) -> Training:
    run = part.copy
    versions: dict[str, Any] = run.versions() if run.versions_file.exists() else {}
    steps, substeps, seconds = cost_of(record)
    try:
        return Training(
            seed=record.seed,
            command=part.command,
            code=part.code,
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
