"""Statistics over training seeds (Agarwal et al. 2021, arXiv 2108.13264).

The scores of a task's training seeds are one sample. Every task has the same weight, whatever its
number of runs. A row is ranked, and has an interval, from `RANKED_SEEDS` seeds of each task on. The
reason is coverage: a 95 % percentile bootstrap of three seeds covers 74 %, of ten seeds 90 to 93 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # loads `scipy.stats` when it is used

RANKED_SEEDS = 10
PROVISIONAL_SEEDS = 3
RESAMPLES = 10_000
LEVEL = 0.95


@dataclass(frozen=True)
class Aggregate:
    """Attributes:
    iqm: interquartile mean over all runs, every task with equal weight.
    interval: 95 % stratified bootstrap interval of `iqm`, or None below `RANKED_SEEDS` seeds.
    standing: "ranked", "provisional" or "too few" (`standing`).
    seeds: the training seeds of each task that were run.
    scores: the scores of these seeds, in the same order.
    """

    iqm: float
    interval: tuple[float, float] | None
    standing: str
    seeds: dict[str, tuple[int, ...]]
    scores: dict[str, tuple[float, ...]]


def aggregate(scores: Mapping[str, Mapping[int, float]]) -> Aggregate:
    """Interquartile mean, interval and standing of a method.

    Args:
        scores: by task and training seed.

    Raises:
        ValueError: the mapping is empty, or a task has no scores.
    """
    seeds = {task: tuple(sorted(runs)) for task, runs in scores.items()}
    columns = {task: tuple(scores[task][seed] for seed in seeds[task]) for task in scores}
    samples = [np.array(column) for column in columns.values()]
    return Aggregate(
        iqm(samples), iqm_interval(samples), standing(samples), seeds=seeds, scores=columns
    )


def standing(samples: Sequence[np.ndarray]) -> str:
    """The standing of a row of scores.

    A row is "ranked" from `RANKED_SEEDS` training seeds of every task on, "provisional" from
    `PROVISIONAL_SEEDS` on (shown as dots without an interval), and otherwise has "too few".

    Raises:
        ValueError: a task has no runs.
    """
    fewest = min(len(sample) for sample in _checked(samples))
    if fewest >= RANKED_SEEDS:
        return "ranked"
    return "provisional" if fewest >= PROVISIONAL_SEEDS else "too few"


def iqm(samples: Sequence[np.ndarray]) -> float:
    """Interquartile mean: the mean of the middle half of all runs.

    All tasks have the same weight, which the runs of a task share equally. The runs of all tasks
    are sorted by score, and the mean is over the runs between a quarter and three quarters of the
    whole weight. A run across one of these borders counts with the part of its weight that lies
    inside. If all tasks have the same number of runs, and a quarter of all runs is a whole number,
    this is the 25 % trimmed mean.

    Raises:
        ValueError: a task has no runs.
    """
    return float(_iqm(*_checked(samples)))


def _iqm(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    runs = np.concatenate([np.moveaxis(sample, axis, -1) for sample in samples], axis=-1)
    # Weights are whole numbers, so that nothing is rounded at the borders.
    counts = [sample.shape[axis] for sample in samples]
    share = math.lcm(*counts)  # the weight of a task
    whole = share * len(samples)
    weights = np.concatenate([np.full(count, share // count) for count in counts])
    order = np.argsort(runs, axis=-1, kind="stable")
    end = np.cumsum(weights[order], axis=-1)
    begin = end - weights[order]
    inside = np.clip(np.minimum(end, 0.75 * whole) - np.maximum(begin, 0.25 * whole), 0.0, None)
    middle: np.ndarray = (np.take_along_axis(runs, order, axis=-1) * inside).sum(-1)
    return middle / inside.sum(-1)


def iqm_interval(samples: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the interquartile mean, stratified by task: the runs of
    each task are resampled separately. None if a task has fewer than `RANKED_SEEDS` runs.

    Raises:
        ValueError: a task has no runs.
    """
    if standing(samples) != "ranked":
        return None
    return _interval(samples, _iqm)


@dataclass(frozen=True)
class Difference:
    """Attributes:
    mean: mean difference of the first method's score minus the second's, over pairs of the same
        task and seed, every task with equal weight.
    interval: 95 % stratified bootstrap interval of `mean`, or None below `RANKED_SEEDS` pairs.
    p_value: of a two-sided sign-flip permutation test: the probability of a mean at least as far
        from zero if the sign of each difference were random.
    """

    mean: float
    interval: tuple[float, float] | None
    p_value: float


def paired_difference(
    first: Mapping[str, Mapping[int, float]],
    second: Mapping[str, Mapping[int, float]],
) -> Difference:
    """The difference of two methods' scores, over pairs of the same task and training seed.

    Args:
        first: scores of the first method by task and training seed.
        second: scores of the second method by task and training seed.

    Raises:
        ValueError: a mapping is empty, or the methods have different tasks or seeds.
    """
    if first.keys() != second.keys():
        raise ValueError("both must have scores of the same tasks")
    for task in first:
        if first[task].keys() != second[task].keys():
            raise ValueError(f"both must have scores of the same seeds of {task}")
    pairs = _checked(
        [
            np.array([first[task][run] - second[task][run] for run in sorted(first[task])])
            for task in sorted(first)
        ]
    )
    ranked = standing(pairs) == "ranked"
    shares = np.concatenate([sample / (len(sample) * len(pairs)) for sample in pairs])
    p_value = 1.0  # of a single pair, whose mean is as far from zero the other way round
    if len(shares) > 1:
        p_value = scipy.stats.permutation_test(
            (shares,),
            lambda signed, axis=-1: signed.sum(axis=axis),
            permutation_type="samples",
            vectorized=True,
            n_resamples=RESAMPLES,
            rng=np.random.default_rng(0),
        ).pvalue
    return Difference(
        mean=float(_mean(*pairs)),
        interval=_interval(pairs, _mean) if ranked else None,
        p_value=float(p_value),
    )


def _mean(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.mean([sample.mean(axis=axis) for sample in samples], axis=0)


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Adjusts the p-values of several comparisons in one table (Holm 1979).

    If a finding is a p-value below some level, the probability of any false finding in the table
    stays below that level.
    """
    adjusted: dict[str, float] = {}
    largest = 0.0
    for rank, (name, p_value) in enumerate(sorted(p_values.items(), key=lambda one: one[1])):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_value))
        adjusted[name] = largest
    return {name: adjusted[name] for name in p_values}


def compared(
    method: str, table: Mapping[str, Mapping[str, Mapping[int, float]]]
) -> dict[str, Difference]:
    """The difference of a method to every other method of a table, with p-values adjusted for the
    number of comparisons (`holm`).

    Args:
        method: name of the method.
        table: scores by method, task and training seed.

    Raises:
        ValueError: see `paired_difference`.
    """
    found = {
        name: paired_difference(table[method], scores)
        for name, scores in table.items()
        if name != method
    }
    adjusted = holm({name: difference.p_value for name, difference in found.items()})
    return {name: replace(difference, p_value=adjusted[name]) for name, difference in found.items()}


def _interval(samples: Sequence[np.ndarray], statistic: Any) -> tuple[float, float]:
    """Bootstrap interval of a statistic of one sample per task, each resampled separately."""
    found = scipy.stats.bootstrap(
        tuple(samples),
        statistic,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(0),
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
    """The probability that a run of the first method beats a run of the second on a random task. A
    tie counts as one half.

    Args:
        first: samples of the first method, one for each task.
        second: samples of the second method, in the same order of tasks.

    Raises:
        ValueError: a task has no runs, or the methods have different numbers of tasks.
    """
    pairs = zip(_checked(first), _checked(second), strict=True)
    return float(
        np.mean([scipy.stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in pairs])
    )


def _checked(samples: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    if not samples or min(len(sample) for sample in samples) == 0:
        raise ValueError("there must be scores of every task")
    return samples
