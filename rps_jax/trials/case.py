"""Named cases: object, target, law, friction, skin and robot of one trial."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.laws import pose, unicycle
from rps_jax.control.registry import LawLike
from rps_jax.record.options import check_fields, option
from rps_jax.robot import robot as robots
from rps_jax.robot import skin as skins
from rps_jax.robot.robot import Robot, RobotLike
from rps_jax.robot.skin import Skin, SkinLike
from rps_jax.trials.trial import Shift
from rps_jax.world import objects, scene
from rps_jax.world.objects import ObjectLike
from rps_jax.world.scene import FRICTION, Friction, Side
from rps_jax.world.tasks import Task, TaskLike, parse_task
from rps_jax.world.tasks.base import heading_of

_TARGET = (-2.0, 0.0)  # [m] default
FrictionLike = str | Friction | tuple[float, float]  # a friction set, or coefficients ground, robot


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """Options of one trial or many trials besides object, friction, target and law."""

    mass: float | None = None
    """Mass of the object [kg]; by default that of the model."""
    skin: SkinLike | None = None
    """The skin: ideal is the paper's simulated contact sensor under foam, thin is one without foam,
    capacitive has 42 taxels, and hardware adds noise and unequal gains to these. Changes follow, as
    capacitive,foam=0.01. By default the physics chooses between ideal and thin."""
    gap: float = option(0.02, 0, 1, unit="m")
    """Distance between base and object at the start [m]; left open by the paper."""
    rear: Side = "near"
    """Side of the nonuniform box on which its load stands, seen from the robot; left open by the
    paper."""
    robot: RobotLike = "ideal"
    """The robot: its name, or a JSON file of its size, boards, drive and limits. Changes follow, as
    kairos,force_max=300. The robot `ideal` follows every twist at once, with any force."""


@dataclass(frozen=True)
class Case(TrialOptions):
    """Trial to run: everything that may differ between worlds.

    Raises:
      InputError: a name or value is not valid.
    """

    object: ObjectLike = "box"
    """Object to push: its name, or a custom MJCF file, FILE.xml, of an upright box or cylinder. For
    another convex outline the file has its corners, counter-clockwise from above [m], as
    <custom><numeric name="footprint" data="X Y X Y X Y"/></custom>. The seed draws sizes and mass
    of the closet from ranges that are guesses."""
    friction: FrictionLike = "S1"
    """Friction: a set of the paper's Table I (S1, S2), or coefficients GROUND,ROBOT."""
    target: tuple[float, float] = _TARGET
    """Target X Y [m] in the world, where the base starts at the origin."""
    law: LawLike | None = None
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json. By default rps, unicycle on a
    base that cannot move sideways, and pose or path_pose for a goal with a heading."""
    task: TaskLike = option("reach", kw_only=True)
    """The task: its name, or a file, as JSON of waypoints or of polygons, or a ROS map.yaml.
    Changes follow, as corridor,width=1.2. Ranges are drawn by the seed."""
    bearing: float = option(0.0, -6.3, 6.3, unit="rad", kw_only=True, hidden=True)
    """Rotation of the whole trial [rad]; only a friction pyramid makes a difference."""
    shift: Shift = option(Shift(), kw_only=True, hidden=True)
    """Scripted shift of the object during the push."""

    def __post_init__(self) -> None:
        check_fields(self)
        name = objects.parse_object(self.object)
        objects.check_object("object", name)
        registry.check_params(self.params)
        self.challenge.check_law(self.params)
        scene.check_contact(self.contact, self.mass)
        skins.parse_skin(self.skin or "ideal")
        errors.check_number("shift time", self.shift.time, at_least=0, unit="s")
        errors.check_vector("shift", self.shift.p_robot, at_least=-5, at_most=5, unit="m")
        scene.check_target(self.target, self.base.shell)
        self.challenge.check_room(self.base.shell, lambda: scene.width_of(name))
        if tuple(self.target) != _TARGET:
            self.challenge.check_target("target", self.target)
        if self.bearing:
            self.challenge.check_target("bearing", self.bearing)
        self.challenge.check_goal(self.target, self.base.shell, lambda: scene.width_of(name))

    @cached_property
    def object_name(self) -> str:
        """Name of the object."""
        return objects.parse_object(self.object)

    @property
    def named_law(self) -> LawLike:
        """The law, or that for the robot's drive and the task if none is named."""
        return suited_laws(self.base, self.challenge)[0] if self.law is None else self.law

    @cached_property
    def params(self) -> LawParams:
        """Parameters of the law."""
        return registry.resolve_law(self.named_law)[1]

    @cached_property
    def contact(self) -> Friction:
        """Coefficients of the two contacts."""
        return friction_of(self.friction)

    @cached_property
    def challenge(self) -> Task:
        """The task."""
        return parse_task(self.task)

    @cached_property
    def base(self) -> Robot:
        """The robot."""
        return robots.parse_robot(self.robot)

    @cached_property
    def sensor(self) -> Skin:
        """The skin on the robot."""
        return skins.mounted(self.skin or "ideal", self.base)

    @property
    def title(self) -> str:
        """Object and friction, in words."""
        return (
            f"{self.object_name.replace('_', ' ')}, friction ground {self.contact.ground:g}, "
            f"robot {self.contact.robot:g}"
        )


def suited_laws(
    robot: Robot, task: Task | None = None, laws: Sequence[str] = ("rps",)
) -> tuple[str, ...]:
    """Return those of some laws that suit a base and a task, or another law that does.

    Raises:
      InputError: no law of the package brings objects to a heading with this base.
    """
    if task is None or heading_of(task) is None:
        known = registry.laws_for(robot.drive)
        suited = tuple(x for x in laws if x in known) or (unicycle.PRESET_OF[robot.drive],)
    elif (name := pose.preset_of(robot)) is None:
        base = f"drive = {robot.drive}" if robot.radius is None else "a round base"
        rule = f"no law for {base} brings objects to a heading; name a custom law, or another robot"
        raise errors.not_allowed("task", task, rule)
    else:
        suited = (name if task.HAS_TARGET else f"path_{name}",)
    if task is not None:
        first, suited = suited[0], tuple(x for x in suited if not task.law_fault(registry.LAWS[x]))
        if not suited:
            task.check_law(registry.LAWS[first])
    return suited


def friction_of(friction: FrictionLike) -> Friction:
    """Return the coefficients of a friction set, by its name or as a text `ground,robot`.

    Raises:
      InputError: the text is not valid.
    """
    if isinstance(friction, str) and "," not in friction:
        return FRICTION[errors.check_name("friction set", friction, FRICTION, "GROUND,ROBOT")]
    values = friction.split(",") if isinstance(friction, str) else friction
    if not isinstance(values, tuple | list) or len(values) != 2:
        raise errors.not_allowed("friction", repr(friction), "write S1, S2 or ground,robot")
    ground, robot = (
        errors.check_finite(f"friction {name}", value, above=0, at_most=10, text=True)
        for name, value in zip(("ground", "robot"), values, strict=True)
    )
    return Friction(ground, robot)
