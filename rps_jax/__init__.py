"""The Reactive Pushing Strategy as a pure function, and thousands of MJX worlds to try it in.

Importing this package sets no flags, writes no file, prints nothing and touches no device: its
names are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rps_jax.control.law import Details, Observation, RPSParams, RPSState, Twist, step
    from rps_jax.control.strategies import Strategy, register_strategy
    from rps_jax.errors import InputError
    from rps_jax.geometry.footprint import Footprint
    from rps_jax.robot.skin import CapacitiveSkin, IdealSkin
    from rps_jax.trials.env import PushEnv
    from rps_jax.trials.pushes import Case, follow, run
    from rps_jax.trials.setting import Setting
    from rps_jax.trials.trial import Outcome, Rules
    from rps_jax.world.domain import DOMAINS, Domain
    from rps_jax.world.objects import OBJECTS, register_object
    from rps_jax.world.physics import PHYSICS, Physics
    from rps_jax.world.scene import FRICTION, Friction

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
    "world.domain": ("DOMAINS", "Domain"),
    "trials.env": ("PushEnv",),
    "errors": ("InputError",),
    "geometry.footprint": ("Footprint",),
    "control.law": ("Details", "Observation", "RPSParams", "RPSState", "Twist", "step"),
    "world.objects": ("OBJECTS", "register_object"),
    "world.physics": ("PHYSICS", "Physics"),
    "world.scene": ("FRICTION", "Friction"),
    "robot.skin": ("CapacitiveSkin", "IdealSkin"),
    "trials.batch": ("Setting",),
    "control.strategies": ("Strategy", "register_strategy"),
    "trials.pushes": ("Case", "follow", "run"),
    "trials.trial": ("Outcome", "Rules"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"rps_jax.{_HOME[name]}"), name)
    raise AttributeError(f"module 'rps_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
