"""The Reactive Pushing Strategy as a pure function, and thousands of MJX worlds to try it in.

Importing this package sets no flags, writes no file, prints nothing and touches no device: its
names are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rps_jax.domain import DOMAINS, Domain
    from rps_jax.env import PushEnv
    from rps_jax.errors import InputError
    from rps_jax.footprint import Footprint
    from rps_jax.law import Details, Observation, RPSParams, RPSState, Twist, step
    from rps_jax.objects import OBJECTS, register_object
    from rps_jax.physics import PHYSICS, Physics
    from rps_jax.scene import FRICTION, Friction
    from rps_jax.skin import CapacitiveSkin, IdealSkin
    from rps_jax.slots import Setting
    from rps_jax.strategies import Strategy, register_strategy
    from rps_jax.sweep import Case, follow, run
    from rps_jax.trial import Outcome, Rules

__version__ = "0.1.0"

__all__ = [
    "DOMAINS",
    "FRICTION",
    "OBJECTS",
    "PHYSICS",
    "CapacitiveSkin",
    "Case",
    "Details",
    "Domain",
    "Footprint",
    "Friction",
    "IdealSkin",
    "InputError",
    "Observation",
    "Outcome",
    "Physics",
    "PushEnv",
    "RPSParams",
    "RPSState",
    "Rules",
    "Setting",
    "Strategy",
    "Twist",
    "follow",
    "register_object",
    "register_strategy",
    "run",
    "step",
]

_MODULES = {
    "domain": ("DOMAINS", "Domain"),
    "env": ("PushEnv",),
    "errors": ("InputError",),
    "footprint": ("Footprint",),
    "law": ("Details", "Observation", "RPSParams", "RPSState", "Twist", "step"),
    "objects": ("OBJECTS", "register_object"),
    "physics": ("PHYSICS", "Physics"),
    "scene": ("FRICTION", "Friction"),
    "skin": ("CapacitiveSkin", "IdealSkin"),
    "slots": ("Setting",),
    "strategies": ("Strategy", "register_strategy"),
    "sweep": ("Case", "follow", "run"),
    "trial": ("Outcome", "Rules"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"rps_jax.{_HOME[name]}"), name)
    raise AttributeError(f"module 'rps_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
