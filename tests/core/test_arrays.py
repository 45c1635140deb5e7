"""Helpers on arrays: shorter computations with the bits of the longer ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tsbench.core.arrays import norm
from tsbench.planning.gait import Gait


@pytest.mark.parametrize("components", range(1, 8))
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_norm_has_the_bits_of_numpys(components: int, dtype: type) -> None:
    rng = np.random.default_rng(components)
    vectors: Any = rng.standard_normal((33, 4, components)).astype(dtype)
    for view in (vectors, vectors[::2], vectors[..., ::-1]):
        assert np.array_equal(norm(view), np.linalg.vector_norm(view, axis=-1))


def test_the_norm_of_torch_stays_there() -> None:
    assert norm(torch.tensor([[3.0, 4.0]])).tolist() == [5.0]


def test_a_phase_has_the_bits_of_the_remainder() -> None:
    gait = Gait(0.8, 0.75, (0.0, 0.5, 0.25, 0.75), 1.0, 1.0, 0.3)
    rng = np.random.default_rng(0)
    time = np.concatenate([0.02 * np.arange(1000), rng.uniform(-10.0, 100.0, 1000)])
    cycles = time[:, None] / gait.period + np.asarray(gait.phases) + 1e-9
    assert np.array_equal(gait.phase(time), cycles % 1.0)
