"""The robot: what keeps a base from following a twist exactly, and robots that exist.

A limit that is None does not exist, and costs nothing: `Robot()` follows every twist at once, with
any force.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry.solid import GRAVITY
from rps_jax.record import files
from rps_jax.robot.skin import HALF_LENGTH, HALF_WIDTH

ARM = math.hypot(HALF_LENGTH, HALF_WIDTH)  # [m] from the middle of the base to its wheels


@dataclass(frozen=True)
class Robot:
    """A base that moves in all directions, and its limits. A pytree whose numbers may be batched.

    Twists and limits are in the robot frame, x forward and y left.
    """

    mass: Any = 130.0  # () [kg] of the whole robot; it matters to a base with a limited force
    v_max: Any = None  # () [m/s] greatest speed, in any direction
    omega_max: Any = None  # () [rad/s] greatest turning rate
    lag: Any = None  # () [s] time constant with which the base follows a twist
    # (2,) [m/s^2, rad/s^2] greatest change of the velocity in a second
    acceleration_max: Any = None
    force_max: Any = None  # () [N] of the drive, in any direction
    torque_max: Any = None  # () [N m] of the drive about the vertical
    traction: Any = None  # () [1] friction coefficient of the wheels, which bounds force and torque
    resistance: Any = None  # () [1] of rolling, over the weight: a force that the drive spends
    slip: Any = None  # () [1] share of the velocity that the wheels lose

    @property
    def driven(self) -> bool:
        """Whether the base is a body that contact can slow and stop."""
        return any(x is not None for x in (self.force_max, self.torque_max, self.traction))

    @property
    def ideal(self) -> bool:
        """Whether every twist is followed at once, with any force."""
        return all(getattr(self, name) is None for name in LIMITS)

    @property
    def inertia(self) -> Any:
        """Moment of inertia () [kg m^2] about the vertical, as of a plate of the base's outline."""
        return self.mass * (HALF_LENGTH**2 + HALF_WIDTH**2) / 3

    @property
    def push_max(self) -> Any:
        """The greatest force () [N] on an object; None without a limit.

        The wheels give at most the drive's force and what their traction holds, and rolling takes
        its part of it.
        """
        weight = self.mass * GRAVITY
        bounds = [] if self.force_max is None else [self.force_max]
        if self.traction is not None:
            bounds.append(self.traction * weight)
        if not bounds:
            return None
        least = bounds[0] if len(bounds) == 1 else _least(*bounds)
        return least if self.resistance is None else least - self.resistance * weight

    @property
    def turn_max(self) -> Any:
        """The greatest torque () [N m] about the vertical; None without a limit.

        The wheels stand at the corners of the base's outline and share the force.
        """
        bounds = [] if self.torque_max is None else [self.torque_max]
        if (force := self.push_max) is not None:
            bounds.append(force * ARM)
        if not bounds:
            return None
        return bounds[0] if len(bounds) == 1 else _least(*bounds)

    @property
    def body(self) -> Robot:
        """What a physics step needs of it: without the limits of where it aims."""
        return dataclasses.replace(self, **dict.fromkeys(_OF_THE_AIM))

    def check(self) -> None:
        """Raises InputError for numbers that no robot has; each is one number, or None."""
        errors.check_finite("robot mass", self.mass, above=0, at_most=1e4, unit="kg")
        for name, (least, most, unit) in _ALLOWED.items():
            value = getattr(self, name)
            if value is not None:
                for one in np.atleast_1d(np.asarray(value, object)):
                    errors.check_finite(
                        f"robot {name}", one, at_least=least, at_most=most, unit=unit
                    )
        if self.acceleration_max is not None and np.size(self.acceleration_max) != 2:
            raise InputError(
                f"robot acceleration_max = {self.acceleration_max} is not allowed: give two "
                "numbers, [m/s^2, rad/s^2]."
            )
        if self.push_max is not None and self.push_max <= 0:
            raise InputError(
                f"robot force_max = {self.force_max} N and traction = {self.traction} are not "
                "allowed: rolling takes "
                f"{(self.resistance or 0) * self.mass * GRAVITY:.0f} N, which leaves nothing to "
                "push with."
            )


def _least(a: Any, b: Any) -> Any:
    """The lesser of two numbers, on the host or traced."""
    return (
        jnp.minimum(a, b)
        if isinstance(a, jax.Array) or isinstance(b, jax.Array)
        else np.minimum(a, b)
    )


_FIELDS = [field.name for field in dataclasses.fields(Robot)]
_OF_THE_AIM = ("v_max", "omega_max", "lag", "acceleration_max", "slip")
LIMITS = tuple(name for name in _FIELDS if name not in ("mass", "resistance"))
jax.tree_util.register_dataclass(Robot, data_fields=_FIELDS, meta_fields=[])
_LEAST = 1e-3  # of what would else bring the base to a stop
_ALLOWED = {
    "v_max": (_LEAST, 10, "m/s"),
    "omega_max": (_LEAST, 20, "rad/s"),
    "lag": (0, 5, "s"),
    "acceleration_max": (_LEAST, 100, "1"),
    "force_max": (0, 1e5, "N"),
    "torque_max": (_LEAST, 1e5, "N m"),
    "traction": (_LEAST, 5, "1"),
    "resistance": (0, 1, "1"),
    "slip": (0, 0.5, "1"),
}


# From data sheets and the makers' robot descriptions, as far as these say.
ROBOTS: dict[str, Robot] = {
    # Every twist is followed at once: as the paper's simulation has it.
    "ideal": Robot(),
    # The paper's: a Robotnik SUMMIT-XL STEEL with a UR16e arm. Robotnik's `summit_xl_common` gives
    # 125 kg (summit_xls_base.urdf.xacro), 2.5 m/s^2 and 3.2 rad/s^2 (base_local_planner_params);
    # the arm's sheet 33 kg. Traction of the rollers and rolling are our choice.
    "kairos": Robot(
        mass=158.0, v_max=3.0, acceleration_max=(2.5, 3.2), traction=0.5, resistance=0.03
    ),
    # Clearpath Ridgeback, mecanum wheels: 195 kg is the sum over ridgeback.urdf.xacro, speeds and
    # accelerations are those of ridgeback_control/config/control.yaml.
    "ridgeback": Robot(
        mass=195.0,
        v_max=1.1,
        omega_max=2.0,
        acceleration_max=(2.5, 1.0),
        traction=0.5,
        resistance=0.03,
    ),
    # Neobotix MPO-500, mecanum wheels; its hardware documentation gives 0.9 m/s, 2.4 m/s^2, and of
    # each of four motors 1.91 N m at most, geared 25:1, on wheels of 254 mm: 1504 N. It gives no
    # mass, which is our choice; so is the turn, which keeps the wheels at 2.4 m/s^2.
    "mpo_500": Robot(
        mass=130.0,
        v_max=0.9,
        acceleration_max=(2.4, 2.4 / ARM),
        force_max=1504.0,
        traction=0.5,
        resistance=0.03,
    ),
}


def named(robot: Robot | str | Mapping[str, Any]) -> Robot:
    """A robot by its name in `ROBOTS`, from a JSON file of numbers, or from names with numbers.

    Raises:
      InputError: no robot has this name, or the numbers are of none.
    """
    if isinstance(robot, str):
        if not robot.endswith(".json"):
            return ROBOTS[errors.check_name("robot", robot, ROBOTS)]
        robot = files.read_json(Path(robot))
    if isinstance(robot, Mapping):
        for name in robot:
            errors.check_name("robot quantity", name, _FIELDS)
        robot = Robot(**{k: tuple(v) if isinstance(v, list) else v for k, v in robot.items()})
    robot.check()
    return robot
