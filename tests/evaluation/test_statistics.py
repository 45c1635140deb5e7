"""Statistics over training seeds, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsbench.evaluation.statistics import (
    aggregate,
    iqm,
    iqm_interval,
    performance_profile,
    probability_of_improvement,
)


def samples(*lists: list[float]) -> list[np.ndarray]:
    return [np.array(values, float) for values in lists]


def test_iqm_by_hand() -> None:
    assert iqm(samples([1, 2, 3, 4])) == 2.5  # without 1 and 4
    assert iqm(samples([100, 0, 2, 3, 4, 5, 6, -50])) == 3.5  # without 100, 6, 0, -50
    assert iqm(samples([1, 2], [3, 100])) == 2.5  # all runs of all tasks together
    assert iqm(samples([1, 2, 6])) == 3.0  # a quarter of three is less than one run


def test_interval_needs_ten_seeds() -> None:
    rng = np.random.default_rng(0)
    ten, nine = rng.normal(size=10), rng.normal(size=9)
    assert iqm_interval([ten, nine]) is None
    assert iqm_interval([nine]) is None
    interval = iqm_interval([ten, ten + 1.0])
    assert interval is not None
    low, high = interval
    assert low < iqm([ten, ten + 1.0]) < high
    assert interval == iqm_interval([ten, ten + 1.0])  # repeats


def test_the_bootstrap_is_stratified() -> None:
    """Two tasks far apart, each without spread: drawn task by task, nothing ever varies."""
    interval = iqm_interval([np.zeros(10), np.full(10, 8.0)])
    assert interval == (4.0, 4.0)


def test_interval_against_the_normal_one() -> None:
    """Many runs of one task, normally distributed. The standard error of a 25 % trimmed mean of
    1000 is near 1.09 / sqrt(1000), its asymptotic variance being 1.19 / n."""
    sample = np.random.default_rng(1).normal(size=1000)
    interval = iqm_interval([sample])
    assert interval is not None
    half = 1.96 * np.sqrt(1.19 / 1000)
    assert interval[1] - interval[0] == pytest.approx(2.0 * half, rel=0.1)


def test_performance_profile_by_hand() -> None:
    thresholds = np.array([0.0, 0.5, 1.0])
    profile = performance_profile(samples([0.2, 0.4, 0.6, 1.0], [0.0, 0.9]), thresholds)
    # Task one: 4, 2, 0 of 4. Task two: 1, 1, 0 of 2.
    assert profile.tolist() == [0.75, 0.5, 0.0]


def test_probability_of_improvement_by_hand() -> None:
    first, second = samples([1, 3], [5, 5]), samples([2, 0, 3], [5])
    # Task one, six pairs: 1 beats 0; 3 beats 2 and 0 and ties with 3: 3.5. Task two: two ties.
    assert probability_of_improvement(first, second) == pytest.approx((3.5 / 6 + 0.5) / 2)
    assert probability_of_improvement(first, first) == 0.5
    with pytest.raises(ValueError, match="shorter"):
        probability_of_improvement(first, second[:1])


@given(arrays(float, st.integers(1, 30), elements=st.floats(-10, 10)), st.floats(-5, 5))
def test_properties(sample: np.ndarray, shift: float) -> None:
    middle = iqm([sample])
    assert sample.min() - 1e-9 <= middle <= sample.max() + 1e-9
    assert iqm([sample + shift]) == pytest.approx(middle + shift, abs=1e-9)
    better = probability_of_improvement([sample], [sample + shift])
    worse = probability_of_improvement([sample + shift], [sample])
    assert better + worse == pytest.approx(1.0)


def test_aggregate_keeps_every_seed() -> None:
    scores = {"walk": {3: 0.3, 1: 0.1, 2: 0.2}, "trot": {0: 0.5, 7: 0.6, 5: 0.7}}
    found = aggregate(scores)
    assert found.seeds == {"walk": (1, 2, 3), "trot": (0, 5, 7)}
    assert found.scores == {"walk": (0.1, 0.2, 0.3), "trot": (0.5, 0.7, 0.6)}
    assert found.interval is None
    assert found.iqm == pytest.approx((0.2 + 0.3 + 0.5 + 0.6) / 4)  # without 0.1 and 0.7
    ranked = aggregate({"walk": {seed: seed / 10 for seed in range(10)}})
    assert ranked.interval is not None


@pytest.mark.parametrize("nothing", [{}, {"walk": {}}, {"walk": {0: 1.0}, "trot": {}}])
def test_no_scores(nothing: dict[str, dict[int, float]]) -> None:
    with pytest.raises(ValueError, match="scores of every task"):
        aggregate(nothing)
