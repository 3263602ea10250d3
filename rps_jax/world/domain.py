"""Domains: the ranges from which random worlds are drawn (see `draws`), by name and as JSON."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.geometry.solid import SIDES, SUPPORTS
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.folder import describe_difference
from rps_jax.record.manifest import Stored
from rps_jax.record.options import check_fields, parse_changes
from rps_jax.robot.robot import LATENCIES, Robot, RobotLike, parse_robot
from rps_jax.spec import Named
from rps_jax.world import paper, scene, tasks
from rps_jax.world.objects import (
    FAMILIES,
    PAPER_OBJECTS,
    check_object,
    custom_solids,
    has_feet,
    is_on_pads,
    parse_object,
    text_of,
)
from rps_jax.world.quantity import (
    COLUMNS,
    Owner,
    Quantity,
    Range,
    check_ranges,
    check_unused,
    claim,
    declared,
    numbers_of,
    range_of,
)
from rps_jax.world.scene import FRICTION, Friction, Surroundings
from rps_jax.world.tasks import Task, TaskLike, parse_task
from rps_jax.world.tasks.reach import Reach


def robot_field(name: str) -> str:
    """Return the field of the robot that a drawn limit sets, as force_max of robot_force."""
    field = name.removeprefix("robot_")
    return field if hasattr(Robot, field) else f"{field}_max"


_POSITIVE = 1e-3
# Labels of the three draws of the velocity error.
VELOCITY_ERRORS = {
    "v_x_error": "error of v_x or left wheel",
    "v_y_error": "error of v_y",
    "omega_error": "error of omega or right wheel",
}


@dataclass(frozen=True)
class Domain:
    """Ranges of all quantities that differ between worlds.

    Worlds cycle through the `objects`. A domain with `frictions` or `targets` cycles through these,
    too, instead of drawing them: targets fastest, then frictions, then objects.

    A quantity is one field of this class. A quantity of the skin, of odometry or of the robot needs
    no other declaration.
    """

    # The object: a scene of `mjcf/`, a custom one by name or FILE.xml, or a random one of a family.
    objects: tuple[str, ...] = ("random_box", "random_cylinder", "random_prism")
    mass: Annotated[Range, Quantity("kg", "mass of the object", 0.1, 1e3)] = Range(3, 60, log=True)
    # Half width: the square root of half depth times half breadth.
    size: Annotated[Range, Quantity("m", "half width of the object", 0.03, 1)] = Range(0.1, 0.35)
    aspect: Annotated[Range, Quantity("1", "breadth over depth", 0.1, 10, reported=False)] = Range(
        0.5, 2.0, log=True
    )
    height: Annotated[Range, Quantity("m", "height of the object", 0.1, 2)] = Range(0.3, 0.8)
    # As a share of the way from the middle to the outline.
    com_offset: Annotated[Range, Quantity("1", "centre of mass off the middle", 0, 0.75)] = Range(
        0, 0.4
    )
    # Of the load that moves the centre of mass: a copy of the object, of equal height, with an
    # outline of this share of its width that touches the object's from inside. The rest is uniform.
    load_size: Annotated[Range, Quantity("1", "size of the load", 0.01, 0.9)] = Range(0.1, 0.25)
    # Three or four feet, at this share of the way from the centre of mass to the outline; None: it
    # stands on its corners or its rim.
    feet: Annotated[Range | None, Quantity("1", "feet, of the way to the outline", 0.1, 1)] = None
    # Pressure under objects without feet: 0 even, 1 along the rim, 2 at the corners, or between
    # for mixtures; also by name, as support=even. None: that of the physics.
    support: Annotated[Range | None, Quantity("1", "pressure: even, rim or corners", 0, 2)] = None
    friction_ground: Annotated[Range, Quantity("1", "friction object-ground", _POSITIVE, 10)] = (
        Range(0.1, 0.7)
    )
    friction_robot: Annotated[Range, Quantity("1", "friction object-robot", _POSITIVE, 10)] = Range(
        0.1, 0.8
    )
    frictions: tuple[Friction, ...] = ()
    # The floor; None: level and uniform. It falls in a direction of the world (None: in any).
    slope: Annotated[
        Range | None, Quantity("rad", "slope of the floor", 0, 0.105, owner="floor")
    ] = None
    slope_bearing: Annotated[
        Range | None, Quantity("rad", "downhill bearing", -math.pi, math.pi, owner="floor")
    ] = None
    # Factor of the object's friction with the ground beyond a line. The line is at right angles to
    # the direction from the base to the end of the trial, at this share of it (None: at any).
    boundary_factor: Annotated[
        Range | None,
        Quantity("1", "factor of friction at the boundary", 0.05, 20, owner="floor"),
    ] = None
    boundary: Annotated[
        Range | None, Quantity("1", "boundary, of the way", 0, 1, owner="floor", jumps=True)
    ] = None
    # The task: object and target at the start, in the frame of the base.
    lateral: Annotated[Range, Quantity("m", "lateral offset", -0.5, 0.5, owner="task")] = Range(
        -0.12, 0.12
    )
    yaw: Annotated[Range, Quantity("rad", "yaw of the object", -math.pi, math.pi, owner="task")] = (
        Range(-0.6, 0.6)
    )
    gap: Annotated[Range, Quantity("m", "gap at the start", 0, 1, owner="task")] = Range(0, 0.05)
    distance: Annotated[Range, Quantity("m", "distance of the target", 0.7, 20, owner="task")] = (
        Range(1, 3)
    )
    bearing: Annotated[
        Range, Quantity("rad", "bearing of the target", -math.pi, math.pi, owner="task")
    ] = Range(-math.pi, math.pi)
    targets: tuple[tuple[float, float], ...] = ()  # [m]
    # The skin: ideal, or 42 capacitive taxels with these imperfections.
    skin: str = "capacitive"
    # Of each raw reading, as a change of capacitance.
    noise: Annotated[Range, Quantity("1", "noise of the skin", 0, 1, owner="skin")] = Range(0, 0.05)
    gain_spread: Annotated[
        Range, Quantity("1", "spread of the taxels' gains", 0, 1, owner="skin")
    ] = Range(0, 0.1)
    dead_share: Annotated[Range, Quantity("1", "dead taxels", 0, 1, owner="skin", jumps=True)] = (
        Range(0, 0.05)
    )
    # None: the skin's default.
    foam: Annotated[Range | None, Quantity("m", "foam of the skin", 0.002, 0.05, owner="skin")] = (
        None
    )
    time_constant: Annotated[
        Range | None, Quantity("s", "time constant of the skin", _POSITIVE, 1, owner="skin")
    ] = None
    # The base: errors of its odometry and of the executed twist.
    pose_noise: Annotated[Range, Quantity("m", "noise of the position", 0, 1, owner="base")] = (
        Range(0, 0.005)
    )
    yaw_noise: Annotated[Range, Quantity("rad", "noise of the heading", 0, 1, owner="base")] = (
        Range(0, 0.01)
    )
    pose_latency: Annotated[
        Range, Quantity("s", "latency of the pose", 0, 1, owner="base", jumps=True)
    ] = Range(0, 0.1)
    command_delay: Annotated[
        Range, Quantity("s", "delay of the command", 0, 1, owner="base", jumps=True)
    ] = Range(0, 0.1)
    # Of each component of the command, constant in a trial and of either sign. The robot's limits
    # bound the wrong command; wheels lose their slip after the limits.
    velocity_error: Annotated[
        Range,
        Quantity(
            "1",
            "error of the velocity",
            -0.9,
            0.9,
            owner="base",
            numbers=tuple(VELOCITY_ERRORS),
            reported=False,
        ),
    ] = Range(-0.03, 0.03)
    # The robot and its drawn limits; None: the robot's own value.
    robot: Robot = Robot()
    robot_force: Annotated[
        Range | None, Quantity("N", "greatest force of the robot", 1, 1e5, owner="robot")
    ] = None
    robot_traction: Annotated[
        Range | None,
        Quantity("1", "traction of the robot's wheels", _POSITIVE, 5, owner="robot"),
    ] = None
    robot_lag: Annotated[Range | None, Quantity("s", "lag of the robot", 0, 5, owner="robot")] = (
        None
    )
    # Also of the wheels when turning.
    robot_acceleration: Annotated[
        Range | None,
        Quantity("m/s^2", "greatest acceleration of the robot", _POSITIVE, 100, owner="robot"),
    ] = None
    robot_slip: Annotated[
        Range | None, Quantity("1", "slip of the wheels", 0, 0.9, owner="robot")
    ] = None
    robot_slip_sideways: Annotated[
        Range | None, Quantity("1", "slip of the wheels sideways", 0, 0.9, owner="robot")
    ] = None
    robot_slip_yaw: Annotated[
        Range | None, Quantity("1", "slip of the wheels when turning", 0, 0.9, owner="robot")
    ] = None
    # What is asked of the law; the ranges of a path are the task's own.
    task: Task = Reach()
    # Ranges of registered quantities by name; as pairs, since a domain is hashable.
    custom: Mapping[str, Range] | tuple[tuple[str, Range], ...] = ()

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "custom", tuple(sorted(dict(self.custom).items())))
        except (TypeError, ValueError) as error:
            rule = f"give ranges by name, as {{'threshold': {Range.EXAMPLE}}}"
            raise errors.not_allowed("domain custom", self.custom, rule) from error
        check_fields(self, "domain ")
        object.__setattr__(self, "objects", tuple(map(parse_object, self.objects)))
        for name in self.objects:
            check_object("domain object", name, *RANDOM)
        errors.check_each_once("domain objects", self.objects)
        for friction in self.frictions:
            scene.check_contact(friction, None)
        errors.check_name("domain skin", self.skin, ("ideal", "capacitive"))
        if self.feet is not None and not set(self.objects) <= set(RANDOM):
            objects = f"{self.feet} with objects = {self.objects}"
            raise errors.not_allowed("domain feet", objects, "only random objects have drawn feet")
        if self.feet is not None and self.support is not None:
            raise errors.not_allowed("domain support", self.support, "leave it out, or feet")
        unused = {name: cause for name, cause in self.idle.items() if name in _DECLARED}
        check_unused(self, "domain ", unused, PERFECT, _HARDWARE, _HOSTILE)
        for name, interval in dict(self.custom).items():
            errors.check_name("registered quantity", name, REGISTERED)
            QUANTITIES[name].check_range(f"domain {name}", interval)
            if name in (idle := self.idle):
                rule = f"{idle[name]} no {name} to draw; leave it out"
                raise errors.not_allowed(f"domain {name}", f"{interval.low:g}", rule)
        for name, owner in _IMPLIED.items():
            if getattr(self, name) is not None and getattr(self, owner) is None:
                raise errors.not_allowed(f"domain {name}", getattr(self, name), f"give {owner} too")
        self.robot.check()
        if len(self.targets):
            self.task.check_target("domain targets", self.targets, "leave them out")
        for target in self.targets:
            scene.check_target(target, self.robot.shell)
            self.task.check_goal(target, self.robot.shell, self._widest)
        check_ranges(self, "domain ")
        offset, load = self.com_offset.high, self.load_size.high
        if offset + load > 1:
            rule = f"with com_offset up to {offset:g} its high is at most {1 - offset:g}"
            raise errors.not_allowed("domain load_size (high)", load, rule)
        reach = float(self.robot.arm)
        if self.task.HAS_TARGET and not self.targets and self.distance.low <= reach:
            rule = f"targets must lie outside the robot, which reaches {reach:.2f} m"
            raise errors.not_allowed("domain distance (low)", f"{self.distance.low:g} m", rule)
        self.task.check_room(self.robot.shell, self._widest)

    def _widest(self) -> float:
        """Return the greatest width of an object [m], along its axes."""
        ratio = math.sqrt(max(self.aspect.high, 1 / self.aspect.low))
        widths = [scene.width_of(name) for name in self.objects if name not in RANDOM]
        for name in set(self.objects) & set(RANDOM):
            widths.append(2 * self.size.high * (1 if name == "random_cylinder" else ratio))
        return max(widths)

    def range_of(self, name: str) -> Range | None:
        """Return the range of a quantity, of the domain itself or of its task; None: not drawn."""
        if name in REGISTERED:
            return dict(self.custom).get(name)
        interval = getattr(self if name in _DECLARED else self.task, name, None)
        if interval is None and name in _IMPLIED and getattr(self, _IMPLIED[name]) is not None:
            return Range(QUANTITIES[name].low, QUANTITIES[name].high)
        return interval

    def with_changes(self, changes: Mapping[str, Any]) -> "Domain":
        """Return the domain with other fields, or ranges of registered quantities."""
        fields_ = {"custom": self.custom, **changes}
        custom = dict(fields_["custom"])
        custom |= {name: fields_.pop(name) for name in REGISTERED & fields_.keys()}
        fields_["custom"] = {name: x for name, x in custom.items() if x is not None}
        return replace(self, **fields_)

    @property
    def surroundings(self) -> Surroundings:
        """Ranges of what surrounds the objects; None for what no world has."""
        walls = True if self.task.has_contact_walls else None
        return Surroundings(self.slope, self.boundary_factor, walls)

    @property
    def weakest(self) -> Robot:
        """Robot with the lowest drawn force and traction."""
        ranges = {"force_max": self.robot_force, "traction": self.robot_traction}
        return replace(self.robot, **{name: r.low for name, r in ranges.items() if r is not None})

    @property
    def combinations(self) -> int:
        """Number of combinations of objects, frictions and targets."""
        return math.prod(self.counts)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Number of objects, frictions and targets of the lists; 1 for an empty list."""
        return len(self.objects), max(1, len(self.frictions)), max(1, len(self.targets))

    def choices(self, index: ArrayLike) -> tuple[np.ndarray, ...]:
        """Return the positions in the lists of object, friction and target of worlds `index`."""
        return np.unravel_index(np.asarray(index) % self.combinations, self.counts)

    def object_of(self, index: ArrayLike) -> np.ndarray:
        """Return the position in `objects` of the objects of the worlds `index`."""
        return self.choices(index)[0]

    @property
    def idle(self) -> dict[str, str]:
        """Names of unused ranges, with what determines the quantity, as "its targets leave"."""
        task = f"its task {self.task.kind} leaves"
        unused = dict.fromkeys(sorted(self.task.idle), task)
        if not set(self.objects) & set(RANDOM):
            cause = f"its objects {', '.join(self.objects)} leave"
            unused |= dict.fromkeys(sorted(OBJECT_QUANTITIES), cause)
        if all(map(has_feet, self.objects)):
            unused["support"] = f"the feet of {', '.join(self.objects)} leave"
        if self.frictions:
            unused |= dict.fromkeys(("friction_ground", "friction_robot"), "its frictions leave")
        has_targets = len(self.targets) > 0
        if has_targets or not self.task.HAS_TARGET:
            cause = "its targets leave" if has_targets else task
            unused |= dict.fromkeys(("distance", "bearing"), cause)
        if self.skin == "ideal":
            unused |= dict.fromkeys(quantities_of("skin"), "its ideal skin leaves")
        return {name: x for name, x in unused.items() if self.range_of(name) is not None}

    @property
    def families(self) -> tuple[str, ...]:
        """Shape family of each of `objects`."""
        names = [(FAMILIES | RANDOM)[name] for name in self.objects]
        on_feet = (self.feet, self.support, self.boundary_factor) != (None, None, None)
        return tuple("prism" if on_feet and name == "box" else name for name in names)

    @property
    def has_pads(self) -> bool:
        """Whether objects stand on pads, or on feet with weights."""
        return self.support is not None or any(map(is_on_pads, self.objects))

    def family_of(self, index: int) -> str:
        """Return the shape family of the object of one world."""
        return self.families[int(self.object_of(index))]


RANDOM = {"random_box": "box", "random_cylinder": "cylinder", "random_prism": "prism"}
_DECLARED = declared(Domain)
REGISTERED: set[str] = set()  # names of custom quantities: see `registry`
# Quantities that another one requires; without a range, they are anywhere within their bounds.
_IMPLIED = {"slope_bearing": "slope", "boundary": "boundary_factor"}
QUANTITIES: dict[str, Quantity] = _DECLARED | tasks.QUANTITIES


def quantities_of(*owners: Owner) -> tuple[str, ...]:
    """Return the names of the quantities of some owners."""
    return tuple(name for name, quantity in QUANTITIES.items() if quantity.owner in owners)


# Quantities that only random objects draw.
OBJECT_QUANTITIES = {*quantities_of("object")} - {"support", "friction_ground", "friction_robot"}
# Columns of a table of worlds, with their labels.
LABELS: dict[str, str] = {
    **{name: quantity.about for name, quantity in QUANTITIES.items() if quantity.reported},
    "corners": "corners of the object",
    **VELOCITY_ERRORS,
}
# Random numbers of a world that belong to no range.
UNRANGED = (
    "com_bearing",
    "key_0",
    "key_1",
    "sides",
    "turn",
    *(f"corner_{i}" for i in range(SIDES)),
    "feet_number",
    "feet_turn",
)
claim("a domain", *(x.name for x in fields(Domain)), *VELOCITY_ERRORS)
claim("an object", *UNRANGED, "object", "corners")


def number_names() -> tuple[str, ...]:
    """Return the names of the random numbers of a world: the old ones by column, then by name."""
    current = {*numbers_of(QUANTITIES), *UNRANGED, *tasks.UNRANGED}
    return (*COLUMNS, *sorted(current - COLUMNS.keys()))


def unit_of(name: str) -> str:
    """Return the unit of a drawn quantity, or of a column of a table of worlds."""
    return QUANTITIES[name].unit if name in QUANTITIES else _UNITS.get(name, "1")


_UNITS = {"com_bearing": "rad"}  # of numbers that belong to no range


def _constant(value: float) -> Range:
    return Range(value, value)


_ERRORS = ("noise", "gain_spread", "dead_share", "lateral", "yaw", *quantities_of("base"))
PERFECT: dict[str, Any] = dict.fromkeys(_ERRORS, _constant(0))
_HARDWARE: dict[str, Any] = PERFECT | {
    "friction_ground": Range(paper.HARDWARE_GROUND[0], paper.HARDWARE_GROUND[-1]),
    "friction_robot": Range(paper.HARDWARE_ROBOT[0], paper.HARDWARE_ROBOT[-1]),
    "distance": _constant(2.1),
    "noise": _constant(0.05),
    "gain_spread": _constant(0.1),
}
_HOSTILE: dict[str, Any] = {
    "mass": Range(1, 100, log=True),
    "size": Range(0.06, 0.45),
    "aspect": Range(0.33, 3.0, log=True),
    "height": Range(0.2, 1.0),
    "com_offset": Range(0, 0.7),
    "friction_ground": Range(0.05, 1.0),
    "friction_robot": Range(0.05, 1.2),
    "lateral": Range(-0.25, 0.25),
    "yaw": Range(-math.pi, math.pi),
    "gap": Range(0, 0.1),
    "distance": Range(0.8, 4),
    "noise": Range(0, 0.1),
    "gain_spread": Range(0, 0.25),
    "dead_share": Range(0, 0.15),
    "pose_noise": Range(0, 0.02),
    "yaw_noise": Range(0, 0.03),
    "pose_latency": Range(0, 0.2),
    "command_delay": Range(0, 0.2),
    "velocity_error": Range(-0.1, 0.1),
}
DOMAINS = {
    "paper": Domain(
        objects=PAPER_OBJECTS,
        frictions=tuple(FRICTION.values()),
        targets=paper.TARGETS,
        gap=_constant(0.02),
        skin="ideal",
        **PERFECT,
    ),
    "hardware": Domain(objects=paper.HARDWARE_OBJECTS, gap=_constant(0.02), **_HARDWARE),
    "wide": Domain(),
    # The worlds of wide, and robots of limited force, traction, lag and acceleration.
    "real": Domain(
        robot_force=Range(150, 800),
        robot_traction=Range(0.3, 0.8),
        robot_lag=Range(0, 0.5),
        robot_acceleration=Range(0.1, 1.0),
    ),
    "prisms": Domain(objects=("random_prism",)),  # of wide, held out from tuning
    "hostile": Domain(**_HOSTILE),
}


def name_or_custom(item: object) -> str:
    """Return the name of a domain or a skin, or `custom` if it has none."""
    if isinstance(item, str):
        return item
    return next((name for name, domain in DOMAINS.items() if domain == item), "custom")


def task_attribute(domain: Domain) -> dict[str, str]:
    """Return the task of a domain as an attribute of results; nothing for `reach`."""
    return {} if domain.task == Reach() else {"task": str(domain.task)}


def task_in_words(domain: Domain) -> str:
    """Return the task of a domain for a report, after a comma, without its long fields."""
    text = re.sub("=[^,]{60,}", "=...", str(domain.task))
    return "" if domain.task == Reach() else f", task {text}"


STORED = Stored(
    lambda name, domain: {name: to_json(parse_domain(domain))},
    lambda name, entries, folder: from_json(dict(entries[name])),
    kinds=(str, Domain),
    label=name_or_custom,
)
# Or its text: see `parse_domain`.
DomainLike = Annotated[Domain | str, STORED, Named(lambda: DOMAINS)]


def parse_domain(
    domain: DomainLike, robot: RobotLike | None = None, task: TaskLike | None = None
) -> Domain:
    """Return a domain from its name, as wide, or from a JSON file of ranges.

    Changes may follow a name or a file, as `wide,mass=3:10,objects=random_box`. A `robot` replaces
    the domain's, except for its drawn limits; its latencies replace ranges. A `task` that has no
    single target replaces the domain's targets.

    Examples:
      >>> parse_domain("wide,mass=3:10").mass
      Range(low=3.0, high=10.0, log=True)
    """
    if task is not None:
        base, parsed = parse_domain(domain, robot), parse_task(task)
        return replace(base, task=parsed, targets=base.targets if parsed.HAS_TARGET else ())
    if robot is not None:
        base, parsed = parse_domain(domain), parse_robot(robot)
        known = {name: getattr(parsed, name) for name in LATENCIES}
        if base.skin == "ideal":
            del known["time_constant"]
        ranges = {name: _constant(x) for name, x in known.items() if x is not None}
        return replace(base, robot=parsed, **ranges)
    if isinstance(domain, Domain):
        return domain
    if not isinstance(domain, str):
        raise errors.not_allowed("domain", repr(domain), "give a text, as wide, or a Domain")
    head, changes = parse_changes("domain", domain)
    if files.suffix_of(head) == ".json":
        base = from_json(files.read_json(Path(head)))
    else:
        base = DOMAINS[errors.check_name("domain", head, DOMAINS, "FILE.json")]
    changed = base.with_changes(_from_json(changes, base))
    for name in changes:
        if name in changed.idle:  # and has the default
            rule = f"{changed.idle[name]} no {name} to draw; leave it out"
            raise errors.not_allowed("domain", domain, rule)
    return changed


def _names(values: object) -> tuple[str, ...]:
    names = [values] if isinstance(values, str) else values
    if not isinstance(names, list | tuple):
        raise TypeError("no names")
    return tuple(map(str, names))


# Readers of the JSON of fields that are no ranges, and their formats for the error.
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
    "support": (
        lambda x: range_of(None, SUPPORTS.get(x, x) if isinstance(x, str) else x),
        "even, rim or corners, or low and high, as [0, 2]",
    ),
    "skin": (str, "its name"),
    "custom": (
        lambda pairs: tuple((str(k), range_of(None, x)) for k, x in dict(pairs).items()),
        "ranges by name",
    ),
    "task": (parse_task, 'its name, as "path"'),
    "robot": (parse_robot, 'a robot\'s name or numbers, as {"force_max": 300}'),
}


def to_json(domain: Domain) -> JsonObject:
    """Return a domain as JSON, with the solids of custom objects; without the task `reach`."""
    record = asdict(domain) | {"objects": tuple(map(text_of, domain.objects))}
    record |= {name: tuple(interval) for name, interval in record.pop("custom")}
    if solids := custom_solids(domain.objects):
        record["solids"] = solids
    return record if domain.task != Reach() else {k: x for k, x in record.items() if k != "task"}


def from_json(values: JsonObject) -> Domain:
    """Return the domain of the JSON of `to_json`, or raise InputError."""
    ranges = dict(values)
    stored = ranges.pop("solids", None)
    domain = DOMAINS["wide"].with_changes(_from_json(ranges, DOMAINS["wide"]))
    if words := describe_difference(stored, stored and custom_solids(domain.objects)):
        raise errors.InputError(f"objects have changed since the run ({words}): restore the files.")
    return domain


def _from_json(values: Mapping[str, object], base: Domain) -> dict[str, Any]:
    """Return fields of a domain; a range without a scale has that of the `base` domain."""
    parsed = {}
    known = [f.name for f in fields(Domain)]
    for name, value in values.items():
        errors.check_name("domain quantity", name, [*known, *sorted(REGISTERED)])
        if value is None and name in QUANTITIES and getattr(Domain, name, None) is None:
            continue
        default = base.range_of(name)
        read, form = _FORMS.get(name, (None, "low and high, as [0.1, 0.5]"))
        try:
            parsed[name] = range_of(default, value) if read is None else read(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise errors.not_allowed(f"domain {name}", value, f"write {form}") from error
    return parsed
