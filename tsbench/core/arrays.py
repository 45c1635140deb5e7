"""Helpers for functions that run on arrays of any library: numpy here, torch on a GPU.

Tasks are pure functions on the array API standard. Their constants must have the library, data
type and device of the arrays that they are combined with.
"""

from __future__ import annotations

import weakref
from functools import lru_cache
from typing import Any

import array_api_compat
import numpy as np

Array = Any  # an array of any library that follows the array API standard


def array_namespace(array: Array) -> Any:
    """The array API functions of the library that made `array`.

    numpy implements the standard itself and is returned directly. array_api_compat needs 12 us for
    the look-up, and its `clip` takes 49 us where numpy's takes 6 us. For some dozens of rockets
    this overhead is a third of a step.
    """
    if type(array) is np.ndarray:
        return np
    return array_api_compat.array_namespace(array)


def like(array: Array, constants: np.ndarray | tuple[Any, ...]) -> Array:
    """Constants as an array in the library and on the device of `array`, shape as `constants`.
    Floats get the data type of `array`; integers stay integers and booleans stay booleans.

    Outside numpy the copy is cached, so that a constant is sent to a device only once.

    Args:
        array: floating-point numbers.
        constants: a numpy array, which must not be changed afterwards, or a tuple of floats.
    """
    if isinstance(constants, tuple):
        if type(array) is np.ndarray:
            return np.asarray(constants, array.dtype)
        return _tuple_at(constants, *_place(array))
    if type(array) is np.ndarray:
        is_float = constants.dtype.kind == "f"
        return constants.astype(array.dtype, copy=False) if is_float else constants
    return _array_at(constants, *_place(array))


def _place(array: Array) -> tuple[Any, Any, Any]:
    return array_api_compat.array_namespace(array), array.dtype, array_api_compat.device(array)


def filled(array: Array, shape: tuple[int, ...], value: float = 0.0) -> Array:
    """An array of shape `shape` filled with `value`, of the library, data type and device of
    `array`."""
    if type(array) is np.ndarray:
        return np.full(shape, value, array.dtype)
    xp, dtype, device = _place(array)
    return xp.full(shape, value, dtype=dtype, device=device)


def norm(vectors: Array) -> Array:
    """Euclidean norms of `vectors` over the last axis, which has a few components; shape (...,).

    numpy's own needs 9 us for some hundreds of vectors and this one 4 us. The squares are
    added in the same order, so that the results have the same bits for fewer than 8 components.
    """
    if type(vectors) is not np.ndarray:
        return array_namespace(vectors).linalg.vector_norm(vectors, axis=-1)
    squares = vectors * vectors
    total = squares[..., 0]
    for component in range(1, squares.shape[-1]):
        total = total + squares[..., component]
    return np.sqrt(total)


def step_of(time: Array, timestep: float) -> Array:
    """The number of the time step nearest to each time in seconds, integers, shape as `time`.

    Times are sums of time steps, so rounding errors leave them slightly off the exact multiple.
    """
    xp = array_namespace(time)
    return xp.astype(xp.round(time / timestep), xp.int64)


@lru_cache(maxsize=1024)
def _tuple_at(constants: tuple[Any, ...], xp: Any, dtype: Any, device: Any) -> Array:
    return xp.asarray(constants, dtype=dtype, device=device)


# Copies of numpy arrays, kept while the originals live. Keys: identity of the original; library,
# data type and device of the copy.
_copies: dict[tuple[Any, ...], Array] = {}


def _array_at(constants: np.ndarray, *place: Any) -> Array:
    key = (id(constants), *place)
    if key not in _copies:
        xp, dtype, device = place
        kind = {"f": dtype, "b": xp.bool}.get(constants.dtype.kind, xp.int64)
        _copies[key] = xp.asarray(constants.tolist(), dtype=kind, device=device)
        weakref.finalize(constants, _copies.pop, key, None)
    return _copies[key]
