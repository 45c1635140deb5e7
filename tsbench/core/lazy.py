"""Modules that load slowly and are needed rarely, imported when they are first used."""

from __future__ import annotations

import importlib
from typing import Any


class Lazy:
    """Stands for a module, and imports it when one of its attributes is first asked for."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)
