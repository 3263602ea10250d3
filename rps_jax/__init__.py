"""The Reactive Pushing Strategy as a pure function, and thousands of MuJoCo worlds to try it in.

The public names stand in `__init__.pyi`, in groups. Importing this package sets no flags,
writes no file, prints nothing and touches no device: a name is loaded when it is first used.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

__version__ = "0.4.0"


def _homes() -> dict[str, str]:
    """Modules of the public names, as `__init__.pyi` imports them."""
    tree = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    return {name.name: str(node.module) for node in imports for name in node.names}


_HOMES = _homes()
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'rps_jax' has no attribute '{name}'")
    home = importlib.import_module(_HOMES[name])
    if hasattr(home, name):
        return getattr(home, name)
    return importlib.import_module(f"{_HOMES[name]}.{name}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
