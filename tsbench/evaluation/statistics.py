"""What several training seeds say together (Agarwal et al. 2021, arXiv 2108.13264).

Scores come as one sample for each task: the scores of its training seeds. Below `RANKED_SEEDS`
seeds a task there is no interval, only dots: a 95 % percentile bootstrap of three covers 74 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap, mannwhitneyu, trim_mean

RANKED_SEEDS = 10
RESAMPLES = 10_000
LEVEL = 0.95


@dataclass(frozen=True)
class Aggregate:
    """Attributes:
    iqm: interquartile mean over all runs of all tasks.
    interval: 95 % stratified bootstrap interval of it, or None below `RANKED_SEEDS` seeds.
    seeds: of each task, exactly those that were run.
    scores: of those, in the same order.
    """

    iqm: float
    interval: tuple[float, float] | None
    seeds: dict[str, tuple[int, ...]]
    scores: dict[str, tuple[float, ...]]


def aggregate(scores: Mapping[str, Mapping[int, float]]) -> Aggregate:
    """
    Args:
        scores: by task and training seed.

    Raises:
        ValueError: there are no scores, or not of every task.
    """
    seeds = {task: tuple(sorted(runs)) for task, runs in scores.items()}
    columns = {task: tuple(scores[task][seed] for seed in seeds[task]) for task in scores}
    samples = [np.array(column) for column in columns.values()]
    return Aggregate(iqm(samples), iqm_interval(samples), seeds, columns)


def iqm(samples: Sequence[np.ndarray]) -> float:
    """Interquartile mean: the mean of all runs without the lowest and the highest quarter.

    Where a quarter is no whole number of runs, fewer are left out.

    Raises:
        ValueError: a task has no runs.
    """
    return float(_iqm(*_checked(samples)))


def _iqm(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    together: np.ndarray = trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)
    return together


def iqm_interval(samples: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the interquartile mean, stratified: the runs of each
    task are drawn among themselves. None where a task has fewer than `RANKED_SEEDS` runs.

    Raises:
        ValueError: a task has no runs.
    """
    if min(len(sample) for sample in _checked(samples)) < RANKED_SEEDS:
        return None
    found = bootstrap(
        tuple(samples),
        _iqm,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(found.low), float(found.high)


def performance_profile(samples: Sequence[np.ndarray], thresholds: np.ndarray) -> np.ndarray:
    """Share of runs that score more than each threshold, every task with equal weight.

    Raises:
        ValueError: a task has no runs.
    """
    shares = [(sample[:, None] > thresholds).mean(axis=0) for sample in _checked(samples)]
    profile: np.ndarray = np.mean(shares, axis=0)
    return profile


def probability_of_improvement(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> float:
    """How probably a run of the first method beats one of the second on a task drawn at random;
    a tie counts by half.

    Args:
        first: one sample for each task.
        second: the same of the other method, in the same order of tasks.

    Raises:
        ValueError: a task has no runs, or the tasks are not the same in number.
    """
    pairs = zip(_checked(first), _checked(second), strict=True)
    return float(np.mean([mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in pairs]))


def _checked(samples: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    if not samples or min(len(sample) for sample in samples) == 0:
        raise ValueError("there must be scores of every task")
    return samples
