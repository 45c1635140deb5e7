"""Checked conversion of plain YAML and JSON values to dataclasses."""

from __future__ import annotations

import types
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from tsbench.core.errors import TsbenchError, quoted, unknown


def typed(kind: Any, value: Any, path: str) -> Any:
    """Converts a plain value to a dataclass, container or scalar of type `kind`.

    Numbers are never rounded, and text is never read as a number. A whole number is a valid float.

    Args:
        kind: a type annotation: `bool`, `int`, `float`, `str`, `None`, `Any`, a dataclass,
            `Literal[...]`, `list[X]`, `tuple[X, ...]`, `dict[str, X]` or `Mapping[str, X]`, or a
            union of such, of which the first kind that the value fits counts.
        value: a value from YAML or JSON.
        path: the dotted key, for messages.

    Raises:
        TsbenchError: a key is missing or unknown, or a value has the wrong type or range.
    """
    if is_dataclass(kind) and isinstance(kind, type):
        given = typed_items(kind, value, path)
        for entry in fields(kind):
            if entry.name not in given and entry.default is entry.default_factory is MISSING:
                raise TsbenchError(f"{_join(path, entry.name)} is missing")
        try:
            return kind(**given)
        except ValueError as error:  # from __post_init__
            raise TsbenchError(_join(path, str(error))) from None
    if kind is Any:
        return value
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in _UNIONS:
        if value is None and type(None) in arguments:
            return None
        several = [argument for argument in arguments if argument is not type(None)]
        if len(several) == 1:
            return typed(several[0], value, path)
        for one in several:
            with suppress(TsbenchError):
                return typed(one, value, path)
    if origin is Literal and any(type(value) is type(a) and value == a for a in arguments):
        return value
    if origin in (dict, Mapping) and isinstance(value, Mapping):
        return {str(k): typed(arguments[1], v, _join(path, str(k))) for k, v in value.items()}
    if origin in (list, tuple) and isinstance(value, (list, tuple)):
        return origin(typed(arguments[0], v, f"{path}[{i}]") for i, v in enumerate(value))
    if kind is float and type(value) is int and abs(value) < 2**1023:
        return float(value)
    if type(value) is kind:
        return value
    raise TsbenchError(f"{path or 'the content'} must be {_words(kind)}, not {quoted(value)}")


def typed_items(kind: type, value: Any, path: str) -> dict[str, Any]:
    """Converts the given fields of a dataclass; missing ones are left out. See `typed`.

    Raises:
        TsbenchError: a key is unknown, or a value has the wrong type or range.
    """
    if not isinstance(value, Mapping):
        raise TsbenchError(f"{path or 'the content'} must be key: value pairs, not {quoted(value)}")
    hints = get_type_hints(kind)
    allowed = [entry.name for entry in fields(kind)]
    for name in value:
        if name not in allowed:
            raise unknown_key(path, str(name), allowed)
    return {str(n): typed(hints[str(n)], v, _join(path, str(n))) for n, v in value.items()}


def unknown_key(path: str, name: str, allowed: Iterable[str]) -> TsbenchError:
    """The error for a key that the mapping at `path` does not have."""
    return unknown(f"key in {path}" if path else "key", name, allowed)


def _words(kind: Any) -> str:
    """What a value has to be, in words."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin in _UNIONS:
        return " or ".join(map(_words, arguments))
    return _WORDS.get(kind) or _WORDS.get(origin) or str(kind)


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


_UNIONS = (Union, types.UnionType)
_WORDS = {
    type(None): "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    dict: "key: value pairs",
    Mapping: "key: value pairs",
    list: "a list",
    tuple: "a list",
}
