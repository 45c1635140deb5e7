"""Another processor's rounding, on this one.

Rounding differs between processors, and a training amplifies it: a recipe that works for five seeds
on one machine may fail on the next. Initial weights that differ by one millionth do to a training
here what another processor's rounding does to it there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from rsl_rl.models import MLPModel


@contextmanager
def perturbed(size: float) -> Iterator[None]:
    """Within it every new network begins with weights that differ by a relative `size`, always in
    the same way."""
    init = MLPModel.__init__

    def begin(self: MLPModel, *arguments: Any, **options: Any) -> None:
        init(self, *arguments, **options)
        rng = np.random.default_rng(0)
        for parameter in self.parameters():
            parameter.detach().numpy()[...] *= 1.0 + size * rng.normal(size=parameter.shape)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(MLPModel, "__init__", begin)
        yield
