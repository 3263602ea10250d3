"""The Reactive Pushing Strategy as a pure function, and thousands of MuJoCo worlds to try it in.

The public names stand in `__init__.pyi`, in groups. Importing this package sets no flags,
writes no file, prints nothing and touches no device: a name is loaded when it is first used.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

__version__ = "0.5.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as", _STUB, re.M)}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]
_MODULES = ("errors", "laws", "physics", "questions", "worlds")  # with further public names


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'rps_jax' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
