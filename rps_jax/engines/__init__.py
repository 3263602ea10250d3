"""Engines, which step worlds: those of this folder, and registered ones.

Each engine of the package is one object, `ENGINE` of the module of its name.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Literal, get_args

from rps_jax import errors

if TYPE_CHECKING:
    from rps_jax.engines.base import Engine

EngineName = Literal["mjx", "fused", "mujoco", "quasistatic"]  # of the package
_PACKAGE: tuple[EngineName, ...] = get_args(EngineName)
_REGISTERED: dict[str, Engine] = {}


def names() -> tuple[str, ...]:
    """Return the names of all engines."""
    return (*_PACKAGE, *_REGISTERED)


def get(name: str) -> Engine:
    """Return the engine of a name, or raise InputError.

    Examples:
      >>> get("quasistatic").name
      'quasistatic'
    """
    errors.check_name("engine", name, names())
    if name in _REGISTERED:
        return _REGISTERED[name]
    return importlib.import_module(f"{__name__}.{name}").ENGINE


def register_engine(engine: Engine) -> None:
    """Register a custom engine, to be selected by its `name`; it replaces one of this name.

    Raises:
      InputError: it is no `engines.base.Engine`, or its name is an engine of this package.

    Examples:
      >>> from rps_jax import register_engine
      >>> from rps_jax.engines.quasistatic import QuasistaticEngine
      >>> class Planar(QuasistaticEngine):
      ...     name = "planar"
      >>> register_engine(Planar())
      >>> get("planar").name
      'planar'
    """
    from rps_jax.engines.base import Engine

    if not isinstance(engine, Engine):
        raise errors.not_allowed("engine", repr(engine), "give an object of a subclass of Engine")
    if engine.name in _PACKAGE:
        rule = f"the package has the engines {', '.join(_PACKAGE)}"
        raise errors.not_allowed("name of an engine", engine.name, rule)
    _REGISTERED[engine.name] = engine
