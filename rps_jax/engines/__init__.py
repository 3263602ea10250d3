"""Engines, which step worlds. Each is one object, `ENGINE` of the module of its name.

A new engine is one file in this folder and one name below.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Literal, get_args

from rps_jax import errors

if TYPE_CHECKING:
    from rps_jax.engines.base import Engine

EngineName = Literal["mjx", "fused", "mujoco", "quasistatic"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)


def get(name: str) -> Engine:
    """Return the engine of a name, or raise InputError.

    Examples:
      >>> get("quasistatic").name
      'quasistatic'
    """
    errors.check_name("engine", name, ENGINES)
    return importlib.import_module(f"{__name__}.{name}").ENGINE
