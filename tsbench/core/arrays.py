"""What functions need to run on arrays of any library: numpy here, torch on a GPU.

Tasks are pure functions on the array API standard. Their constants have to follow the arrays that
they meet: into the same library, data type and device.
"""

from __future__ import annotations

import weakref
from functools import lru_cache
from typing import Any

import array_api_compat
import numpy as np

Array = Any  # an array of any library that follows the array API standard


def array_namespace(array: Array) -> Any:
    """The functions of the array API standard, of the library that made `array`.

    numpy keeps the standard itself. array_api_compat takes 12 us to say so, and its clip, for
    instance, 49 us instead of 6: with some dozens of rockets that was a third of a step.
    """
    if type(array) is np.ndarray:
        return np
    return array_api_compat.array_namespace(array)


def like(array: Array, constants: np.ndarray | tuple[Any, ...]) -> Array:
    """Constants as `array` is: of its library, on its device, and floating-point numbers of its
    data type. Integers and booleans stay what they are.

    Outside of numpy the copy is kept, so that a constant crosses to a device once.

    Args:
        array: of floating-point numbers.
        constants: numpy's array, not to be changed afterwards, or a tuple of floats.
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
    """An array as `array` is, of another shape, with one value everywhere."""
    if type(array) is np.ndarray:
        return np.full(shape, value, array.dtype)
    xp, dtype, device = _place(array)
    return xp.full(shape, value, dtype=dtype, device=device)


def step_of(time: Array, timestep: float) -> Array:
    """The number of the time step that lies at each time, an integer, shape as `time`.

    Times are sums of time steps, so that rounding leaves them a little beside.
    """
    xp = array_namespace(time)
    return xp.astype(xp.round(time / timestep), xp.int64)


@lru_cache(maxsize=1024)
def _tuple_at(constants: tuple[Any, ...], xp: Any, dtype: Any, device: Any) -> Array:
    return xp.asarray(constants, dtype=dtype, device=device)


# Copies of numpy's arrays, for as long as those live: by their identity, library, type and device.
_copies: dict[tuple[Any, ...], Array] = {}


def _array_at(constants: np.ndarray, *place: Any) -> Array:
    key = (id(constants), *place)
    if key not in _copies:
        xp, dtype, device = place
        kind = {"f": dtype, "b": xp.bool}.get(constants.dtype.kind, xp.int64)
        _copies[key] = xp.asarray(constants.tolist(), dtype=kind, device=device)
        weakref.finalize(constants, _copies.pop, key, None)
    return _copies[key]
