"""Domains: from which ranges random worlds are drawn (see `draws`), by name and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.robot.robot import Robot
from rps_jax.robot.robot import named as named_robot
from rps_jax.world import paper, scene
from rps_jax.world.objects import FAMILIES, OBJECTS, PAPER_OBJECTS
from rps_jax.world.scene import FRICTION, Friction


class Range(NamedTuple):
    """From where to where a quantity is drawn, evenly, or evenly in its logarithm."""

    low: float
    high: float
    log: bool = False

    def at(self, u: np.ndarray) -> np.ndarray:
        """The quantity at u in [0, 1)."""
        if self.log:
            return self.low * (self.high / self.low) ** u
        return self.low + u * (self.high - self.low)


def _only(value: float) -> Range:
    return Range(value, value)


@dataclass(frozen=True)
class Domain:
    """Ranges of all that differs between worlds.

    Worlds take the `objects` in turn. A domain with `frictions` or `targets` takes these in turn
    too, targets fastest, then friction, then objects, instead of drawing them.
    """

    # The object: a scene of `mjcf/` as it is, or a random one of a shape family.
    objects: tuple[str, ...] = ("random_box", "random_cylinder", "random_prism")
    mass: Range = Range(3, 60, log=True)  # [kg]
    size: Range = Range(0.1, 0.35)  # [m] half width, square root of half depth times half breadth
    aspect: Range = Range(0.5, 2.0, log=True)  # [1] breadth over depth
    height: Range = Range(0.3, 0.8)  # [m]
    com_offset: Range = Range(0, 0.4)  # [1] of the way from the middle to the outline
    friction_ground: Range = Range(0.1, 0.7)  # [1] object-ground
    friction_robot: Range = Range(0.1, 0.8)  # [1] object-robot
    frictions: tuple[Friction, ...] = ()
    # The task.
    lateral: Range = Range(-0.12, 0.12)  # [m] of the object's middle, left of the robot's axis
    yaw: Range = Range(-0.6, 0.6)  # [rad] of the object, counter-clockwise
    gap: Range = Range(0, 0.05)  # [m] between base and object
    distance: Range = Range(1, 3)  # [m] of the target from the start
    bearing: Range = Range(-math.pi, math.pi)  # [rad] of the target, counter-clockwise from ahead
    targets: tuple[tuple[float, float], ...] = ()  # [m]
    # The skin: ideal, or 42 capacitive taxels with these imperfections.
    skin: str = "capacitive"
    noise: Range = Range(0, 0.05)  # [1] of each raw reading, as a change of capacitance
    gain_spread: Range = Range(0, 0.1)  # [1] of the taxels' gains
    dead_share: Range = Range(0, 0.05)  # [1] probability that a taxel never answers
    # The base: where it believes it is, and how it does what it is told.
    pose_noise: Range = Range(0, 0.005)  # [m] of each position reading
    yaw_noise: Range = Range(0, 0.01)  # [rad] of each heading reading
    pose_latency: Range = Range(0, 0.1)  # [s] age of the pose that the law is told
    command_delay: Range = Range(0, 0.1)  # [s] until a twist is acted upon
    velocity_error: Range = Range(-0.03, 0.03)  # [1] of each component of the twist, all trial long
    # The robot, and what of it differs between worlds; None: as the robot has it.
    robot: Robot = Robot()
    robot_force: Range | None = None  # [N] of the drive, at most
    robot_traction: Range | None = None  # [1] of the wheels
    robot_lag: Range | None = None  # [s] with which a twist is followed
    robot_acceleration: Range | None = None  # [m/s^2] at most, of the wheels when turning, too

    def __post_init__(self) -> None:
        """Raises InputError for ranges that are empty or leave what is possible."""
        if not self.objects:
            raise InputError("domain objects = () is not allowed: name at least one.")
        for name in self.objects:
            errors.check_name("domain object", name, (*RANDOM, *OBJECTS))
        if len(set(self.objects)) < len(self.objects):
            raise InputError(f"domain objects = {self.objects} is not allowed: name each once.")
        for friction in self.frictions:
            scene.check(friction, None)
        errors.check_name("domain skin", self.skin, ("ideal", "capacitive"))
        self.robot.check()
        for target in self.targets:
            scene.check_target(target, self.robot.shell)
        for name, (least, most, unit) in ALLOWED.items():
            if (given := getattr(self, name)) is None:
                continue
            if not isinstance(given, Range):
                raise InputError(
                    f"domain {name} = {given!r} is not allowed: give a Range, as Range(3, 10)."
                )
            low, high, log = given
            for side, value in (("low", low), ("high", high)):
                errors.check_finite(
                    f"domain {name} ({side})", value, at_least=least, at_most=most, unit=unit
                )
            if low > high or (log and low <= 0):
                raise InputError(
                    f"domain {name} = {low:g} to {high:g} is not allowed: low must not exceed high"
                    f"{', and be above 0' if log else ''}."
                )
        reach = math.hypot(*self.robot.shell.half)
        if not self.targets and self.distance.low <= reach:
            raise InputError(
                f"domain distance (low) = {self.distance.low:g} m is not allowed: targets must lie "
                f"outside the robot, which reaches {reach:.2f} m."
            )

    @property
    def weakest(self) -> Robot:
        """The robot with the least force and traction of what is drawn of it."""
        drawn = {"force_max": self.robot_force, "traction": self.robot_traction}
        return replace(self.robot, **{of: r.low for of, r in drawn.items() if r is not None})

    @property
    def combinations(self) -> int:
        """How many indices see every combination of objects, frictions and targets once."""
        return len(self.objects) * max(1, len(self.frictions)) * max(1, len(self.targets))

    def object_of(self, index: np.ndarray) -> np.ndarray:
        """Which of `objects` the worlds `index` have."""
        return index // (self.combinations // len(self.objects)) % len(self.objects)

    @property
    def idle(self) -> frozenset[str]:
        """Ranges of which nothing is drawn, since something else says what they would."""
        found = set()
        if not set(self.objects) & set(RANDOM):
            found |= {"mass", "size", "aspect", "height", "com_offset"}
        if self.frictions:
            found |= {"friction_ground", "friction_robot"}
        if self.targets:
            found |= {"distance", "bearing"}
        if self.skin == "ideal":
            found |= set(OF_TAXELS)
        return frozenset(found)

    @property
    def families(self) -> tuple[str, ...]:
        """The shape family of each of `objects`."""
        return tuple(RANDOM.get(name) or FAMILIES[name] for name in self.objects)

    def family_of(self, index: int) -> str:
        """The shape family of one world's object."""
        return self.families[int(self.object_of(np.asarray(index)))]


RANDOM = {"random_box": "box", "random_cylinder": "cylinder", "random_prism": "prism"}
OF_THE_BASE = ("pose_noise", "yaw_noise", "pose_latency", "command_delay", "velocity_error")
# Ranges of the robot's limits, and which they are.
OF_THE_ROBOT = {
    "robot_force": "force_max",
    "robot_traction": "traction",
    "robot_lag": "lag",
    "robot_acceleration": "acceleration_max",
}
_POSITIVE = 1e-3
# What a range must not leave.
ALLOWED = {
    "mass": (0.1, 1e3, "kg"),
    "size": (0.03, 1.0, "m"),
    "aspect": (0.1, 10, "1"),
    "height": (0.1, 2.0, "m"),
    "com_offset": (0, 0.75, "1"),
    "friction_ground": (_POSITIVE, 10, "1"),
    "friction_robot": (_POSITIVE, 10, "1"),
    "lateral": (-0.5, 0.5, "m"),
    "yaw": (-math.pi, math.pi, "rad"),
    "gap": (0, 1, "m"),
    "distance": (0.7, 20, "m"),
    "bearing": (-math.pi, math.pi, "rad"),
    "noise": (0, 1, "1"),
    "gain_spread": (0, 1, "1"),
    "dead_share": (0, 1, "1"),
    "pose_noise": (0, 1, "m"),
    "yaw_noise": (0, 1, "rad"),
    "pose_latency": (0, 1, "s"),
    "command_delay": (0, 1, "s"),
    "velocity_error": (-0.9, 0.9, "1"),
    "robot_force": (1, 1e5, "N"),
    "robot_traction": (_POSITIVE, 5, "1"),
    "robot_lag": (0, 5, "s"),
    "robot_acceleration": (_POSITIVE, 100, "m/s^2"),
}
RANGES = tuple(ALLOWED)
UNITS = {
    **dict.fromkeys(("lateral", "gap", "pose_noise"), "m"),
    **dict.fromkeys(("yaw", "yaw_noise"), "rad"),
    **dict.fromkeys(("noise", "gain_spread", "dead_share"), "1"),
    **dict.fromkeys(("pose_latency", "command_delay"), "s"),
}
PERFECT: dict[str, Any] = {
    **dict.fromkeys(
        ("noise", "gain_spread", "dead_share", "pose_noise", "yaw_noise", "pose_latency"), _only(0)
    ),
    **dict.fromkeys(("command_delay", "velocity_error", "lateral", "yaw"), _only(0)),
}
_HARDWARE: dict[str, Any] = PERFECT | {"noise": _only(0.05), "gain_spread": _only(0.1)}
DOMAINS = {
    "paper": Domain(
        objects=PAPER_OBJECTS,
        frictions=tuple(FRICTION.values()),
        targets=paper.TARGETS,
        gap=_only(0.02),
        skin="ideal",
        **PERFECT,
    ),
    "hardware": Domain(
        objects=paper.HARDWARE_OBJECTS,
        friction_ground=Range(paper.HARDWARE_GROUND[0], paper.HARDWARE_GROUND[-1]),
        friction_robot=Range(paper.HARDWARE_ROBOT[0], paper.HARDWARE_ROBOT[-1]),
        gap=_only(0.02),
        distance=_only(2.1),
        **_HARDWARE,
    ),
    "wide": Domain(),
    # The worlds of wide, and robots of limited force, traction, lag and acceleration.
    "real": Domain(
        robot_force=Range(150, 800),
        robot_traction=Range(0.3, 0.8),
        robot_lag=Range(0, 0.5),
        robot_acceleration=Range(0.1, 1.0),
    ),
    "prisms": Domain(objects=("random_prism",)),  # of wide, held out from tuning
    "hostile": Domain(
        mass=Range(1, 100, log=True),
        size=Range(0.06, 0.45),
        aspect=Range(0.33, 3.0, log=True),
        height=Range(0.2, 1.0),
        com_offset=Range(0, 0.7),
        friction_ground=Range(0.05, 1.0),
        friction_robot=Range(0.05, 1.2),
        lateral=Range(-0.25, 0.25),
        yaw=Range(-math.pi, math.pi),
        gap=Range(0, 0.1),
        distance=Range(0.8, 4),
        noise=Range(0, 0.1),
        gain_spread=Range(0, 0.25),
        dead_share=Range(0, 0.15),
        pose_noise=Range(0, 0.02),
        yaw_noise=Range(0, 0.03),
        pose_latency=Range(0, 0.2),
        command_delay=Range(0, 0.2),
        velocity_error=Range(-0.1, 0.1),
    ),
}


OF_TAXELS = ("noise", "gain_spread", "dead_share")  # which an ideal skin has not


def named(domain: Domain | str, robot: Robot | str | None = None) -> Domain:
    """A domain by its name in `DOMAINS`, or from a JSON file of ranges; a domain is itself.

    With a robot, its worlds have that one, but for what the domain draws of it.

    Raises:
      InputError: no domain has this name, or the file is no domain.
    """
    if robot is not None:
        return replace(named(domain), robot=named_robot(robot))
    if isinstance(domain, Domain):
        return domain
    if domain.endswith(".json"):
        return from_json(files.read_json(Path(domain)))
    return DOMAINS[errors.check_name("domain", domain, DOMAINS)]


def _names(values: list[str]) -> tuple[str, ...]:
    if isinstance(values, str):
        raise TypeError("one name, not a list")
    return tuple(values)


def _range(name: str, values: Any) -> Range:
    if not isinstance(values, list | tuple):
        raise TypeError("no list")
    low, high, *log = values
    if len(log) > 1 or not all(isinstance(one, bool) for one in log):
        raise ValueError("more than low, high, and whether evenly in the logarithm")
    usual = getattr(DOMAINS["wide"], name)
    return Range(float(low), float(high), *(log or [usual is not None and usual.log]))


# How JSON has what is not a range.
_FORMS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "objects": (_names, 'names, as ["random_box"]'),
    "frictions": (
        lambda pairs: tuple(Friction(*map(float, pair)) for pair in pairs),
        "pairs of ground and robot, as [[0.3, 0.35]]",
    ),
    "targets": (
        lambda pairs: tuple((float(x), float(y)) for x, y in pairs),
        "pairs of x and y [m], as [[2, 0]]",
    ),
    "skin": (str, "its name"),
    "robot": (named_robot, 'a robot\'s name or numbers, as {"force_max": 300}'),
}


def from_json(values: dict[str, Any]) -> Domain:
    """The domain that was written as JSON by `dataclasses.asdict`.

    Raises:
      InputError: a name or a value is not of a domain.
    """
    given = {}
    known = {f.name: f for f in fields(Domain)}
    for name, value in values.items():
        errors.check_name("domain quantity", name, known)
        if value is None and name in OF_THE_ROBOT:
            continue
        read, form = _FORMS.get(name, (partial(_range, name), "low and high, as [0.1, 0.5]"))
        try:
            given[name] = read(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"domain {name} = {value} is not allowed: write {form}.") from error
    return Domain(**given)
