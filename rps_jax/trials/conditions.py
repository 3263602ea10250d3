"""The paper's trials as they are asked for by name: under which conditions, of what, with what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from rps_jax import engines, errors
from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.engines import EngineName
from rps_jax.robot import skin as skins
from rps_jax.robot.robot import Robot
from rps_jax.robot.robot import named as named_robot
from rps_jax.robot.skin import SKINS, Skin, SkinName
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import paper
from rps_jax.world.physics import PHYSICS, Fidelity, PhysicsName, preset
from rps_jax.world.scene import FRICTION, Friction, Side

Which = str | Friction | tuple[float, float]  # a friction set, or coefficients ground, robot


@dataclass(frozen=True)
class Conditions:
    """What trials that are asked for one by one have in common."""

    engine: EngineName = "mjx"
    physics: PhysicsName = "default"
    fidelity: Fidelity = "standard"
    timestep: float | None = None  # [s] None: that of the physics
    control_period: float | None = None  # [s] likewise
    skin: SkinName | None = None  # None: ideal, or thin with the physics paper_gazebo
    skin_params: Mapping[str, float] = field(default_factory=dict)  # changes of the skin's
    mass: float | None = None  # [kg] of the object; None: its own
    gap: float = 0.02  # [m] between base and object at the start
    rear: Side = "near"  # where the nonuniform box's load stands
    robot: Robot | str = "ideal"  # or its name in `ROBOTS`, or a JSON file's
    horizon: float = 300.0  # [s] of the longest trial
    seed: int = 0  # of the skin's imperfections

    def __post_init__(self) -> None:
        """Raises InputError for names that are unknown."""
        for name, known in (("engine", engines.ENGINES), ("physics", PHYSICS), ("skin", SKINS)):
            if getattr(self, name) is not None:
                errors.check_name(name, getattr(self, name), known)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Conditions:
        """Conditions by their names.

        Raises:
          InputError: there is no such condition.
        """
        for name in given:
            errors.check_name("condition", name, [f.name for f in fields(cls)])
        return cls(**given)

    def setting(self) -> Setting:
        """What all trials share.

        Raises:
          InputError: a condition is not allowed, or not on this machine.
        """
        engine = engines.get(self.engine)
        engine.check()
        engine.check_robot(named_robot(self.robot))
        steps = {"timestep": self.timestep, "control_period": self.control_period}
        physics = replace(
            preset(self.physics, self.fidelity), **{k: v for k, v in steps.items() if v is not None}
        )
        return Setting(physics, Rules(horizon=self.horizon), self.seed, self.engine)

    def sensor(self) -> Skin:
        """The skin."""
        name: Any = self.skin or paper.SKIN[self.physics]
        usual: Any = SKINS[name]
        for changed in self.skin_params:
            errors.check_name("skin-params", changed, skins.own(usual))
        return usual._replace(**self.skin_params)

    def case(
        self, object: str, friction: Which, target: tuple[float, float], params: Params
    ) -> Case:
        """One trial.

        Raises:
          InputError: it is not possible.
        """
        return Case(
            object,
            friction_of(friction),
            target,
            params,
            mass=self.mass,
            skin=self.sensor(),
            gap=self.gap,
            rear=self.rear,
            robot=named_robot(self.robot),
        )


def friction_of(which: Which) -> Friction:
    """Coefficients of a friction set by its name, or as `ground,robot`.

    Raises:
      InputError: they are not such.
    """
    if not isinstance(which, str):
        return Friction(*which)
    if "," not in which:
        return FRICTION[errors.check_name("friction set", which, FRICTION)]
    parts = which.split(",")
    if len(parts) != 2:
        raise errors.InputError(f"friction '{which}' is not allowed: write S1, S2 or ground,robot.")
    ground, robot = (
        errors.check_finite(f"friction {name}", value, above=0, at_most=10)
        for name, value in zip(("ground", "robot"), parts, strict=True)
    )
    return Friction(ground, robot)


def label_of(friction: Which) -> str:
    """A friction set's name, or its coefficients."""
    return friction if isinstance(friction, str) else ",".join(f"{value:g}" for value in friction)


def arms_of(asked: Sequence[str] | Mapping[str, Params]) -> dict[str, Params]:
    """Strategies by their names (or as `my_law.py:MyParams`), or parameters that have names.

    Raises:
      InputError: none is asked for, one twice, or one that is unknown.
    """
    if isinstance(asked, Mapping):
        arms = dict(asked)
    else:
        errors.check_each_once("strategies", asked)
        arms = dict(map(strategies.named, asked))
    if not arms:
        raise errors.InputError(f"strategies = {asked} is not allowed: name at least one.")
    for params in arms.values():
        strategies.of(params).check(params)
    return arms
