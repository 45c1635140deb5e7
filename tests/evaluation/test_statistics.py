"""Statistics over training seeds, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import trim_mean, ttest_rel

from tsbench.evaluation.statistics import (
    aggregate,
    compared,
    holm,
    iqm,
    iqm_interval,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    standing,
)


def samples(*lists: list[float]) -> list[np.ndarray]:
    return [np.array(values, float) for values in lists]


def test_iqm_by_hand() -> None:
    assert iqm(samples([1, 2, 3, 4])) == 2.5  # without 1 and 4
    assert iqm(samples([100, 0, 2, 3, 4, 5, 6, -50])) == 3.5  # without 100, 6, 0, -50
    assert iqm(samples([1, 2], [3, 100])) == 2.5  # all runs of all tasks together
    # A quarter of three runs is three quarters of one: 1 and 6 count by a quarter each.
    assert iqm(samples([1, 2, 6])) == pytest.approx((0.25 * 1 + 2 + 0.25 * 6) / 1.5)


def test_every_task_has_the_same_weight() -> None:
    """However many runs it has."""
    assert iqm([np.zeros(10), np.ones(30)]) == 0.5
    assert iqm([np.zeros(30), np.ones(10)]) == 0.5
    # Of the weight 0, 0, 0, 0 | 1 | 3 in shares 1/12 x 4 | 1/3 | 1/3: what lies between a quarter
    # and three quarters is 1/12 of 0, all of 1, 1/12 of 3.
    assert iqm(samples([0, 0, 0, 0], [1], [3])) == pytest.approx((1 / 3 + 3 / 12) / 0.5)
    runs = np.random.default_rng(0).normal(size=(3, 8))
    assert iqm(list(runs)) == pytest.approx(trim_mean(runs.ravel(), 0.25))
    assert iqm([runs[0], np.tile(runs[1], 5)]) == pytest.approx(iqm([runs[0], runs[1]]))


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
    assert found.standing == "provisional"
    assert found.iqm == pytest.approx((0.2 + 0.3 + 0.5 + 0.6) / 4)  # without 0.1 and 0.7
    ranked = aggregate({"walk": {seed: seed / 10 for seed in range(10)}})
    assert ranked.interval is not None
    assert ranked.standing == "ranked"


def test_standing() -> None:
    def of(*runs: int) -> str:
        return standing([np.zeros(count) for count in runs])

    assert of(10) == of(10, 30) == "ranked"
    assert of(9, 10) == of(3) == "provisional"
    assert of(2, 10) == of(1) == "too few"


# Differences between methods


def by_seed(*values: float) -> dict[str, dict[int, float]]:
    return {"task": dict(enumerate(values))}


def test_paired_differences_by_hand() -> None:
    """Five pairs, of which all go one way: 2 of the 32 ways to sign them lie as far from zero."""
    first, second = by_seed(5, 4, 3, 2, 1), by_seed(4, 2, 0, -2, -4)
    found = paired_difference(first, second)
    assert found.mean == 3.0  # of 1, 2, 3, 4, 5
    assert found.p_value == pytest.approx(2 / 32)
    assert found.interval is None  # five seeds
    back = paired_difference(second, first)
    assert (back.mean, back.p_value) == (-3.0, found.p_value)
    assert paired_difference(first, first).p_value == 1.0
    assert paired_difference(by_seed(3), by_seed(1)).p_value == 1.0  # one pair, either way round
    # Two tasks with equal weight: means of 3 over 5 seeds, and of -1 over 1.
    two = paired_difference({**first, "more": {7: 0.0}}, {**second, "more": {7: 1.0}})
    assert two.mean == 1.0


def test_paired_differences_against_scipy() -> None:
    """One task: the sign-flip test is close to the t test of the differences, and so is the
    interval to the normal one."""
    rng = np.random.default_rng(3)
    first = {"task": dict(enumerate(rng.normal(0.5, 1.0, 40)))}
    second = {"task": dict(enumerate(rng.normal(0.0, 1.0, 40)))}
    found = paired_difference(first, second)
    assert found == paired_difference(first, second)  # repeats
    one, two = (np.array([*runs["task"].values()]) for runs in (first, second))
    t_test = ttest_rel(one, two)
    assert found.p_value == pytest.approx(t_test.pvalue, abs=0.01)
    assert found.interval is not None
    assert found.interval == pytest.approx([*t_test.confidence_interval(0.95)], abs=0.06)


def test_pairs_need_the_same_tasks_and_seeds() -> None:
    with pytest.raises(ValueError, match="the same tasks"):
        paired_difference(by_seed(1, 2), {"other": {0: 1.0, 1: 2.0}})
    with pytest.raises(ValueError, match="the same seeds of task"):
        paired_difference(by_seed(1, 2), by_seed(1, 2, 3))
    with pytest.raises(ValueError, match="scores of every task"):
        paired_difference({}, {})


def test_holm_by_hand() -> None:
    """R's p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")."""
    given = {"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.005}
    assert holm(given) == pytest.approx({"a": 0.03, "b": 0.06, "c": 0.06, "d": 0.02})
    assert list(holm(given)) == list(given)
    assert holm({"a": 0.7, "b": 0.6}) == {"a": 1.0, "b": 1.0}
    assert holm({"alone": 0.04}) == {"alone": 0.04}
    assert holm({}) == {}


def test_a_method_against_a_table() -> None:
    """Both others are worse in all of five pairs: 1/16 each, doubled by Holm."""
    table = {"best": by_seed(5, 5, 5, 5, 5), "a": by_seed(4, 3, 2, 1, 0), "b": by_seed(*range(5))}
    found = compared("best", table)
    assert {name: one.mean for name, one in found.items()} == {"a": 3.0, "b": 3.0}
    assert found["a"].p_value == found["b"].p_value == pytest.approx(2 * 2 / 32)


@pytest.mark.parametrize("nothing", [{}, {"walk": {}}, {"walk": {0: 1.0}, "trot": {}}])
def test_no_scores(nothing: dict[str, dict[int, float]]) -> None:
    with pytest.raises(ValueError, match="scores of every task"):
        aggregate(nothing)
