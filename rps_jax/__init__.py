"""The Reactive Pushing Strategy as a pure function, and thousands of MuJoCo worlds to try it in.

Importing this package sets no flags, writes no file, prints nothing and touches no device: its
names are loaded when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rps_jax.analysis import figures as figures
    from rps_jax.analysis import statistics as statistics
    from rps_jax.analysis import tables as tables
    from rps_jax.analysis import video as video
    from rps_jax.control import law as law
    from rps_jax.control.guided import GuidedParams as GuidedParams
    from rps_jax.control.law import Details as Details
    from rps_jax.control.law import LoadedObservation as LoadedObservation
    from rps_jax.control.law import Observation as Observation
    from rps_jax.control.law import RPSParams as RPSParams
    from rps_jax.control.law import RPSState as RPSState
    from rps_jax.control.law import Temperatures as Temperatures
    from rps_jax.control.law import Twist as Twist
    from rps_jax.control.law import step as step
    from rps_jax.control.rivals.dipole import DipoleParams as DipoleParams
    from rps_jax.control.rivals.force_push import ForcePushParams as ForcePushParams
    from rps_jax.control.rivals.force_push_published import (
        PublishedForcePushParams as PublishedForcePushParams,
    )
    from rps_jax.control.rivals.pursuit import PursuitParams as PursuitParams
    from rps_jax.control.rps_plus import RPSPlusParams as RPSPlusParams
    from rps_jax.control.strategies import Strategy as Strategy
    from rps_jax.control.strategies import register_strategy as register_strategy
    from rps_jax.errors import InputError as InputError
    from rps_jax.geometry import footprint as footprint
    from rps_jax.geometry import planar as planar
    from rps_jax.geometry.footprint import Footprint as Footprint
    from rps_jax.robot.load_cell import LoadCell as LoadCell
    from rps_jax.robot.robot import ROBOTS as ROBOTS
    from rps_jax.robot.robot import Robot as Robot
    from rps_jax.robot.shell import Boards as Boards
    from rps_jax.robot.skin import CapacitiveSkin as CapacitiveSkin
    from rps_jax.robot.skin import IdealSkin as IdealSkin
    from rps_jax.robot.skin import SmoothSkin as SmoothSkin
    from rps_jax.runs.evaluate import evaluate as evaluate
    from rps_jax.runs.models import models as models
    from rps_jax.runs.push import Push as Push
    from rps_jax.runs.push import push as push
    from rps_jax.runs.push import replay as replay
    from rps_jax.runs.results import load as load
    from rps_jax.runs.sweep import sweep as sweep
    from rps_jax.studies.ceiling import Search as Search
    from rps_jax.studies.ceiling import ceiling as ceiling
    from rps_jax.studies.failures.attack import Hunt as Hunt
    from rps_jax.studies.failures.attack import attack as attack
    from rps_jax.studies.failures.gallery import gallery as gallery
    from rps_jax.studies.failures.rare import Splitting as Splitting
    from rps_jax.studies.failures.rare import rare as rare
    from rps_jax.studies.failures.regress import regress as regress
    from rps_jax.studies.failures.sobol import sensitivity as sensitivity
    from rps_jax.studies.ladder import ladder as ladder
    from rps_jax.studies.replication.table import table as table
    from rps_jax.trials.conditions import Conditions as Conditions
    from rps_jax.trials.env import PushEnv as PushEnv
    from rps_jax.trials.pushes import Case as Case
    from rps_jax.trials.setting import Progress as Progress
    from rps_jax.trials.setting import Setting as Setting
    from rps_jax.trials.setting import progress_bar as progress_bar
    from rps_jax.trials.trial import Outcome as Outcome
    from rps_jax.trials.trial import Rules as Rules
    from rps_jax.tuning import gradients as gradients
    from rps_jax.tuning.learn import Lessons as Lessons
    from rps_jax.tuning.learn import learn as learn
    from rps_jax.tuning.ppo import PPO as PPO
    from rps_jax.tuning.space import Space as Space
    from rps_jax.world import paper as paper
    from rps_jax.world.domain import DOMAINS as DOMAINS
    from rps_jax.world.domain import Domain as Domain
    from rps_jax.world.domain import Range as Range
    from rps_jax.world.objects import OBJECTS as OBJECTS
    from rps_jax.world.objects import register_object as register_object
    from rps_jax.world.physics import PHYSICS as PHYSICS
    from rps_jax.world.physics import Physics as Physics
    from rps_jax.world.points import points_of as points_of
    from rps_jax.world.points import worlds_at as worlds_at
    from rps_jax.world.scene import FRICTION as FRICTION
    from rps_jax.world.scene import Friction as Friction

__version__ = "0.2.0"

_HOMES = {
    "control.law": (
        *("Details", "LoadedObservation", "Observation", "RPSParams", "RPSState"),
        *("Temperatures", "Twist", "step"),
    ),
    "control.rivals.dipole": ("DipoleParams",),
    "control.rivals.force_push": ("ForcePushParams",),
    "control.guided": ("GuidedParams",),
    "control.rivals.force_push_published": ("PublishedForcePushParams",),
    "control.rivals.pursuit": ("PursuitParams",),
    "control.rps_plus": ("RPSPlusParams",),
    "control.strategies": ("Strategy", "register_strategy"),
    "errors": ("InputError",),
    "geometry.footprint": ("Footprint",),
    "robot.load_cell": ("LoadCell",),
    "robot.robot": ("ROBOTS", "Robot"),
    "robot.shell": ("Boards",),
    "robot.skin": ("CapacitiveSkin", "IdealSkin", "SmoothSkin"),
    "runs.evaluate": ("evaluate",),
    "runs.push": ("Push", "push", "replay"),
    "runs.results": ("load",),
    "runs.sweep": ("sweep",),
    "runs.models": ("models",),
    "studies.ceiling": ("Search", "ceiling"),
    "studies.failures.gallery": ("gallery",),
    "studies.failures.attack": ("Hunt", "attack"),
    "studies.failures.rare": ("Splitting", "rare"),
    "studies.failures.regress": ("regress",),
    "studies.failures.sobol": ("sensitivity",),
    "studies.ladder": ("ladder",),
    "studies.replication.table": ("table",),
    "trials.conditions": ("Conditions",),
    "trials.env": ("PushEnv",),
    "trials.pushes": ("Case",),
    "trials.setting": ("Progress", "Setting", "progress_bar"),
    "trials.trial": ("Outcome", "Rules"),
    "tuning.learn": ("Lessons", "learn"),
    "tuning.ppo": ("PPO",),
    "tuning.space": ("Space",),
    "world.domain": ("DOMAINS", "Domain", "Range"),
    "world.objects": ("OBJECTS", "register_object"),
    "world.physics": ("PHYSICS", "Physics"),
    "world.points": ("points_of", "worlds_at"),
    "world.scene": ("FRICTION", "Friction"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
# Modules for laws, pictures and analyses of one's own.
_MODULES = {
    "figures": "analysis.figures",
    "footprint": "geometry.footprint",
    "gradients": "tuning.gradients",
    "law": "control.law",
    "paper": "world.paper",
    "planar": "geometry.planar",
    "statistics": "analysis.statistics",
    "tables": "analysis.tables",
    "video": "analysis.video",
}
__all__ = sorted([*_HOME, *_MODULES])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"rps_jax.{_HOME[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"rps_jax.{_MODULES[name]}")
    raise AttributeError(f"module 'rps_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
