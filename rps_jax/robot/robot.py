"""The robot: its size, the boards of its skin, its limits, and presets.

A limit of None is absent and costs nothing: `Robot()` follows every twist at once, with any force.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry.solid import GRAVITY
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.options import check_fields, parse_changes
from rps_jax.robot.shell import BOARDS, HALF_LENGTH, HALF_WIDTH, Boards, Shell
from rps_jax.spec import Named, Spec

# A number or an array of a batch, on the host or traced. `Any`: NumPy's, JAX's and Python's numbers
# have no common type with arithmetic.
Number: TypeAlias = Any
_POSITIVE = 1e-3  # lower bound of limits that would stop the base


DriveKind = Literal["omni", "differential", "car"]


@dataclass(frozen=True)
class Robot:
    """A base, its drive and its limits. A pytree whose numbers may be batched.

    Twists and limits are in the robot frame, x forward and y left. A base with another drive than
    `omni` has an axle that cannot move sideways: see `robot.base`.
    """

    half_length: Annotated[Number, Spec("m", "half length of the base")] = HALF_LENGTH  # ()
    half_width: Annotated[Number, Spec("m", "half width of the base")] = HALF_WIDTH  # ()
    boards: tuple[Boards, ...] = BOARDS  # of the skin
    # Used if the force is limited.
    mass: Annotated[Number, Spec("kg", "mass of the whole robot", gt=0, le=1e4)] = 130.0  # ()
    # (2,): forward and sideways
    v_max: Annotated[Number, Spec("m/s", "greatest speed in any direction", _POSITIVE, 10)] = (
        None  # () or (2,)
    )
    omega_max: Annotated[Number, Spec("rad/s", "greatest turning rate", _POSITIVE, 20)] = None
    lag: Annotated[Number, Spec("s", "time constant with which it follows a twist", 0, 5)] = (
        None  # ()
    )
    acceleration_max: Annotated[
        Number, Spec("m/s^2, rad/s^2", "greatest accelerations", _POSITIVE, 100)
    ] = None  # (2,)
    force_max: Annotated[
        Number, Spec("N", "greatest force of the drive, in any direction", 0, 1e5)
    ] = None  # ()
    torque_max: Annotated[
        Number, Spec("N m", "greatest torque about the vertical", _POSITIVE, 1e5)
    ] = None  # ()
    # Used if the force is limited.
    bandwidth: Annotated[
        Number, Spec("Hz", "bandwidth of the drive's velocity servo", 0.1, 100)
    ] = 5.0  # ()
    # It bounds force and torque.
    traction: Annotated[Number, Spec("1", "friction coefficient of the wheels", _POSITIVE, 5)] = (
        None  # ()
    )
    resistance: Annotated[Number, Spec("1", "rolling resistance over the weight", 0, 1)] = (
        None  # ()
    )
    slip: Annotated[Number, Spec("1", "share of the velocity that the wheels lose", 0, 0.9)] = (
        None  # ()
    )
    # Rollers lose more of these; None: equal to `slip`.
    slip_sideways: Annotated[Number, Spec("1", "share of v_y that is lost", 0, 0.9)] = None
    slip_yaw: Annotated[Number, Spec("1", "share of omega that is lost", 0, 0.9)] = None
    # In place of half length and half width; None: a rectangle.
    radius: Annotated[Number, Spec("m", "radius of a round base", 0.1, 2)] = None  # ()
    drive: DriveKind = "omni"  # static
    # None: 0
    axle: Annotated[
        Number, Spec("m", "wheels that cannot move sideways, behind the middle", -2, 2)
    ] = None  # ()
    turning_radius: Annotated[
        Number, Spec("m", "least turning radius of a car's axle", _POSITIVE, 20)
    ] = None  # ()
    # None: the width of the base.
    track: Annotated[Number, Spec("m", "distance between left and right wheel", gt=0, le=4)] = (
        None  # ()
    )
    wheel_speed_max: Annotated[
        Number, Spec("m/s", "greatest speed of a wheel's rim", _POSITIVE, 20)
    ] = None  # ()
    wheel_acceleration_max: Annotated[
        Number, Spec("m/s^2", "greatest acceleration of a wheel's rim", _POSITIVE, 100)
    ] = None  # ()
    # Of software; None: those of the physics and of the domain.
    period: Annotated[Number, Spec("s", "control period", gt=0, le=1)] = None  # () static
    pose_latency: Annotated[Number, Spec("s", "age of the pose that laws observe", 0, 1)] = (
        None  # ()
    )
    command_delay: Annotated[
        Number, Spec("s", "time between a command and its execution", 0, 1)
    ] = None  # ()
    time_constant: Annotated[Number, Spec("s", "time constant of the skin", _POSITIVE, 1)] = (
        None  # ()
    )

    @property
    def half_track(self) -> Number:
        """Half of the distance () [m] between the left and the right wheel of an axle."""
        return self.sizes[-1] if self.track is None else self.track / 2

    @property
    def axle_behind(self) -> Number:
        """Position () [m] of the axle behind the middle of the base."""
        return 0.0 if self.axle is None else self.axle

    def twist_of_middle(self, twist: np.ndarray) -> np.ndarray:
        """Return twists (N, 3) of the axle or of the middle as those of the base's middle.

        With an axle, v_y of the middle is that of its turn about the axle.
        """
        if self.drive == "omni":
            return twist
        return np.stack([twist[:, 0], self.axle_behind * twist[:, 2], twist[:, 2]], axis=-1)

    @classmethod
    def parse(cls, robot: RobotLike) -> Robot:
        """Return a robot by its name, file or text of changes: see `parse_robot`."""
        return parse_robot(robot)

    @property
    def driven(self) -> bool:
        """Whether the force is limited, so that contact can slow and stop the base."""
        return any(x is not None for x in (self.force_max, self.torque_max, self.traction))

    @property
    def ideal(self) -> bool:
        """Whether the base has no limits: it follows every twist at once, with any force."""
        return self.drive == "omni" and all(getattr(self, x) is None for x in (*LIMITS, "period"))

    @property
    def inertia(self) -> Number:
        """Moment of inertia () [kg m^2] about the vertical, of a plate with the base's outline."""
        return self.mass * self._square / (3 if self.radius is None else 2)

    @property
    def arm(self) -> Number:
        """Distance () [m] from the middle to the wheels, at the rim or the corners, or the axle."""
        if self.drive == "differential":
            return self.half_track
        square = self._square
        return jnp.sqrt(square) if isinstance(square, jax.Array) else np.sqrt(square)

    @property
    def _square(self) -> Number:
        return reduce(operator.add, (size**2 for size in self.sizes))

    @property
    def sizes(self) -> tuple[Number, ...]:
        """Half length and half width () [m], or the radius of a round base alone."""
        return (self.half_length, self.half_width) if self.radius is None else (self.radius,)

    @property
    def shell(self) -> Shell:
        """Outline and boards, of robots on the host."""
        return Shell.of(self.boards, *self.sizes)

    @property
    def push_max(self) -> Number:
        """Maximum force () [N] on an object; None without a limit.

        The drive's force and the traction bound the force of the wheels; rolling resistance reduces
        it.
        """
        weight = self.mass * GRAVITY
        limit = _minimum(self.force_max, None if self.traction is None else self.traction * weight)
        if limit is None or self.resistance is None:
            return limit
        return limit - self.resistance * weight

    @property
    def turn_max(self) -> Number:
        """Maximum torque () [N m] about the vertical; None without a limit.

        The wheels share the force.
        """
        force = self.push_max
        return _minimum(self.torque_max, None if force is None else force * self.arm)

    @property
    def body(self) -> Robot:
        """The fields that a physics step needs: without the skin and the limits of the aim."""
        return dataclasses.replace(self, boards=(), period=None, **dict.fromkeys(_AIM_LIMITS))

    def check(self) -> None:
        """Raise InputError for numbers that no robot has; each is one number, or None."""
        check_fields(self, "robot ")
        for name in [field for field in _FIELDS if field not in ("boards", "drive")]:
            shapes, form = _SHAPES.get(name, (((),), "one number"))
            if (value := getattr(self, name)) is not None and np.shape(value) not in shapes:
                raise errors.not_allowed(f"robot {name}", value, f"give {form}")
        half = self.half_length, self.half_width
        if self.radius is not None and half != (HALF_LENGTH, HALF_WIDTH):
            sizes = f"{self.radius:g} m with half_length, half_width = {half[0]:g}, {half[1]:g} m"
            rule = "a base is round or a rectangle: leave out radius, or the half sizes"
            raise errors.not_allowed("robot radius", sizes, rule)
        Shell(self.half_length, self.half_width, self.boards, radius=self.radius).check()
        self._check_drive()
        if self.push_max is not None and self.push_max <= 0:
            rolling = (self.resistance or 0) * self.mass * GRAVITY
            rule = f"rolling resistance takes {rolling:.0f} N, so that no force is left to push"
            limits = f"{self.force_max} N and robot traction = {self.traction}"
            raise errors.not_allowed("robot force_max", limits, rule)

    def _check_drive(self) -> None:
        """Raise InputError for numbers of wheels that do not belong to the drive."""
        wheels = {name: getattr(self, name) for name in _WHEELS}
        for name, value in wheels.items():
            if value is not None and self.drive == "omni":
                rule = "it is of an axle: choose drive = differential or car, or leave it out"
                raise errors.not_allowed(f"robot {name}", f"{value:g}", rule)
        if (self.turning_radius is None) == (self.drive == "car"):
            rule = "a car needs one, as turning_radius=0.5 [m]"
            if self.drive != "car":
                rule = "other bases than those with drive = car turn on the spot: leave it out"
            raise errors.not_allowed("robot turning_radius", self.turning_radius, rule)
        if abs(self.axle_behind) > self.sizes[0]:
            rule = f"it lies outside the base, which ends at {self.sizes[0]:g} m"
            raise errors.not_allowed("robot axle", f"{self.axle_behind:g} m", rule)
        if self.drive != "omni" and self.slip_sideways is not None:
            rule = f"the axle of a {self.drive} drive does not move sideways: leave it out"
            raise errors.not_allowed("robot slip_sideways", f"{self.slip_sideways:g}", rule)


def _minimum(a: Number, b: Number) -> Number:
    """Return the minimum of two numbers, on the host or traced, of which each may be None."""
    if a is None or b is None:
        return b if a is None else a
    xp = jnp if isinstance(a, jax.Array) or isinstance(b, jax.Array) else np
    return xp.minimum(a, b)


_SHAPES = {  # allowed shapes of limits that are no single number
    "v_max": (((), (1,), (2,)), "one number, or two, forward and sideways [m/s]"),
    "acceleration_max": (((2,),), "two numbers, [m/s^2, rad/s^2]"),
}
_FIELDS = [field.name for field in dataclasses.fields(Robot)]
_SLIPS = ("slip", "slip_sideways", "slip_yaw")
_WHEELS = ("axle", "turning_radius", "track", "wheel_speed_max", "wheel_acceleration_max")
LATENCIES = ("pose_latency", "command_delay", "time_constant")  # also names of a domain's ranges
_AIM_LIMITS = ("v_max", "omega_max", "lag", "acceleration_max", *_SLIPS, *_WHEELS[3:], *LATENCIES)
_BODY = ("half_length", "half_width", "radius", "boards", "mass", "bandwidth", "resistance")
_META = ["drive", "period"]
_STATIC = (*_BODY, *_META, *_WHEELS, *LATENCIES)
LIMITS = tuple(name for name in _FIELDS if name not in _STATIC)
_DATA = [name for name in _FIELDS if name not in _META]
jax.tree_util.register_dataclass(Robot, data_fields=_DATA, meta_fields=_META)


def _covered(half_length: float, half_width: float, mass: float, **limits: Any) -> Robot:
    """Return a robot of this outline with about the paper's boards, centred on each side.

    Those of a base that cannot move sideways are stretched over the whole side. With a gap of 25 mm
    at its corners, `turtlebot4` pushes objects away that it does not feel.
    """
    pitch = 2 * HALF_WIDTH / 12  # of the paper's taxels
    side, front = (int(2 * half / (3 * pitch) + 1e-6) for half in (half_length, half_width))
    used = None if "drive" in limits else pitch
    sides = Boards("left", side, used), Boards("front", front, used), Boards("right", side, used)
    return Robot(half_length, half_width, sides, mass, **limits)


_ROLLERS: dict[str, Any] = {"traction": 0.5, "resistance": 0.03}  # of mecanum wheels: our choice
# Of the MPO-500: four motors of 1.91 N m at most, geared 25:1, on wheels of 254 mm.
_GEARED_MOTORS = {"force_max": 1504.0, "torque_max": 558.0} | _ROLLERS
# From data sheets and the makers' robot descriptions, where these give a number. None of these has
# a skin: they get about the paper's boards.
ROBOTS: dict[str, Robot] = {
    # Follows every twist at once, as in the paper's simulation.
    "ideal": Robot(),
    # As wide as the paper's, to compare shapes. Krivic and Piater (2019), whose APS the paper
    # compares with, pushed with a round base.
    "round": Robot(radius=HALF_WIDTH),
    # Loses shares of v_x, v_y and omega: the posterior medians, given the paper's hardware results
    # and its other numbers (`sweeps/paper_reading`). The paper does not measure them.
    "slipping": Robot(slip=0.095, slip_sideways=0.18, slip_yaw=0.42),
    # The paper's: a Robotnik SUMMIT-XL STEEL with a UR16e arm. Robotnik's `summit_xl_common` gives
    # 125 kg (summit_xls_base.urdf.xacro), 2.5 m/s^2 and 3.2 rad/s^2 (base_local_planner_params);
    # the arm's sheet 33 kg.
    "kairos": Robot(mass=158.0, v_max=3.0, acceleration_max=(2.5, 3.2), **_ROLLERS),
    # Clearpath Ridgeback, mecanum wheels: outline and 195 kg, the sum, are those of
    # ridgeback.urdf.xacro, speeds and accelerations of ridgeback_control/config/control.yaml.
    "ridgeback": _covered(
        0.48, 0.3965, 195.0, v_max=1.1, omega_max=2.0, acceleration_max=(2.5, 1.0), **_ROLLERS
    ),
    # Neobotix MPO-500, mecanum wheels; its hardware documentation gives 988 by 662 mm, 0.9 m/s,
    # 2.4 m/s^2, and wheels at 250 and 274 mm from the middle. It gives no mass, which is our
    # choice; the turn is what keeps the wheels at 2.4 m/s^2.
    "mpo_500": _covered(
        0.494, 0.331, 130.0, v_max=0.9, acceleration_max=(2.4, 6.47), **_GEARED_MOTORS
    ),
    # Bases that cannot move sideways. No source gives the friction of their wheels, so that their
    # force has no limit: append ,traction=0.6, for example.
    # TurtleBot 4, with a flat plate 0.30 m wide before its round body, which is our choice. Create
    # 3: wheels 233 mm apart (create3.urdf.xacro). Not checked against the manuals: 341 mm, 3.945
    # kg, 0.31 m/s (safe mode), 1.9 rad/s, and 0.9 m/s^2.
    "turtlebot4": _covered(
        0.1705,
        0.15,
        3.945,
        drive="differential",
        track=0.233,
        v_max=0.31,
        omega_max=1.9,
        wheel_acceleration_max=0.9,
    ),
    # Clearpath Jackal: jackal_control/config/control.yaml gives speeds, accelerations, and the
    # factor 1.5 by which skidding widens its track of 0.3756 m (jackal.urdf.xacro). Not checked
    # against the manual: 508 by 430 mm and 17 kg.
    "jackal": _covered(
        0.254,
        0.215,
        17.0,
        drive="differential",
        track=0.5634,
        v_max=2.0,
        omega_max=4.0,
        acceleration_max=(20.0, 25.0),
    ),
    # Clearpath Husky A200: husky_control/config/control.yaml, with the factor 1.875 for its track
    # of 0.5708 m. Not checked against the data sheet: 990 by 670 mm, 50 kg and 1 m/s.
    "husky": _covered(
        0.495,
        0.335,
        50.0,
        drive="differential",
        track=1.0703,
        v_max=1.0,
        omega_max=2.0,
        acceleration_max=(3.0, 6.0),
    ),
    # MiR100. Not checked against the data sheet: 890 by 580 mm, 70 kg and 1.5 m/s. Accelerations,
    # track and axle are unknown: no limit, the width and the middle.
    "mir100": _covered(0.445, 0.29, 70.0, drive="differential", v_max=1.5),
    # Pioneer 3-DX. Not checked against the data sheet: 455 by 381 mm, 9 kg, 1.2 m/s and 300 degrees
    # per second, and a swing radius of 267 mm behind the axle, which is that far from the rear. The
    # track is unknown: the width.
    "pioneer_3dx": _covered(
        0.2275,
        0.1905,
        9.0,
        drive="differential",
        axle=-0.0395,
        v_max=1.2,
        omega_max=5.24,
    ),
    # A racing car of 1:10: sizes, mass and acceleration of f1tenth_gym; its axles are 0.3302 m
    # apart and steer by 0.4189 rad, which gives the turning radius. That they lie evenly about the
    # middle is our choice. The track is unknown.
    "f1tenth": _covered(
        0.29,
        0.155,
        3.74,
        drive="car",
        axle=0.1651,
        turning_radius=0.742,
        wheel_acceleration_max=9.51,
    ),
}


# Or its text: see `parse_robot`.
RobotLike = Annotated[Robot | str | Mapping[str, Any], Named(lambda: ROBOTS)]


def parse_robot(robot: RobotLike) -> Robot:
    """Return a robot from a name, as kairos, a JSON file, or a mapping of names to numbers.

    Changes may follow a name or a file, as `kairos,force_max=300`.
    """
    if isinstance(robot, str):
        head, changes = parse_changes("robot", robot)
        if files.suffix_of(head) == ".json":
            robot = files.read_json(Path(head)) | changes
        else:
            preset = ROBOTS[errors.check_name("robot", head, ROBOTS, "FILE.json")]
            robot = {name: getattr(preset, name) for name in _FIELDS} | changes
    if isinstance(robot, Mapping):
        for name in robot:
            errors.check_name("robot quantity", name, _FIELDS)
        values: JsonObject = {
            k: tuple(v) if isinstance(v, list | tuple) else v for k, v in robot.items()
        }
        if "boards" in values:
            values["boards"] = _parse_boards(values["boards"])
        robot = Robot(**values)
    if not isinstance(robot, Robot):
        rule = 'give a name or a file as a text, or numbers by name, as {"force_max": 300}'
        raise errors.not_allowed("robot", repr(robot), rule)
    robot.check()
    return robot


def _parse_boards(rows: object) -> tuple[Boards, ...]:
    """Return rows of boards from mappings of names to numbers."""
    boards = []
    for row in rows if isinstance(rows, tuple) else (rows,):
        if isinstance(row, Mapping) and {"side", "count"} <= set(row):
            for name in row:
                errors.check_name("robot boards' quantity", name, Boards.__dataclass_fields__)
            row = Boards(**row)
        if not isinstance(row, Boards):
            rule = 'write each row as {"side": "front", "count": 4, "pitch": 0.048}'
            raise errors.not_allowed("robot boards", row, rule)
        boards.append(row)
    return tuple(boards)
