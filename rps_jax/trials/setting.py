"""Setting of all trials of a run: engine, physics, rules and seed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Literal, get_args

from rps_jax import engines, errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.validation import check_law
from rps_jax.engines.base import Engine
from rps_jax.record import options
from rps_jax.record.files import JsonObject
from rps_jax.robot.robot import Robot
from rps_jax.spec import Named
from rps_jax.trials.trial import Rules
from rps_jax.world import physics as physics_
from rps_jax.world.domain import Domain
from rps_jax.world.physics import Fidelity, Physics

Split = Literal["tune", "validate", "test"]


def seed_of(seed: int, split: Split) -> int:
    """Return the seed of the worlds of one split: those of one seed have no world of another.

    Those for tuning and validation lie above all seeds of sweeps, so no sweep meets them. Test
    worlds are those of a sweep with another seed. The worlds of a domain that draws little, such as
    `paper`, depend little on the seed.

    Raises:
      InputError: the split is unknown.
    """
    index = get_args(Split).index(errors.check_name("split", split, get_args(Split)))
    return 3 * seed + 2 if split == "test" else seed + 2 ** (34 + index)


class PhysicsField:
    """Field that accepts a physics or its text, and returns the physics.

    Texts are those of `world.physics.parse_physics`, of the fidelity of the same object.
    """

    def __get__(self, instance: Setting | None, owner: type | None = None) -> Physics:
        if instance is None:
            return "default"  # pyright: ignore[reportReturnType]  # of the dataclass's field
        return physics_.parse_physics(instance.__dict__["physics"], instance.fidelity)

    def __set__(self, instance: Setting, value: str | Physics) -> None:
        instance.__dict__["physics"] = value


@dataclass(frozen=True)
class Setting:
    """Setting of all trials of a run.

    Raises:
      InputError: an engine, physics, rules or seed that are not valid, or not together.
    """

    engine: Annotated[str, Named(engines.names, closed=True)] = "fused"
    """What steps the worlds: mjx (MuJoCo's equations in JAX), fused (the same equations,
    specialised to these scenes: the fastest, with exact derivatives), mujoco (C MuJoCo, on all
    cores) or quasistatic (planar, without inertia; its derivatives are those of that model)."""
    physics: PhysicsField = PhysicsField()
    """How friction is modelled: default is isotropic Coulomb friction; paper_gazebo is a friction
    pyramid, as in the paper's simulator. Changes follow, as default,timestep=0.005,
    default,control_period=0.05 [s], or default,support=even or rim: the pressure under objects."""
    fidelity: Fidelity = "standard"
    """How finely the physics is solved: reference is converged and meant for the engine mujoco,
    standard (steps of 10 ms) is for results, and fast (20 ms) has 2 to 3 times its error, since
    MuJoCo softens contacts whose time constant is below two steps."""
    rules: Rules = Rules()
    seed: int = options.option(0, 0, 2**32 - 1)
    """Seed of random worlds, and of the imperfections of skins."""
    split: Split | None = options.option(None, hidden=True)
    """Use of the random worlds: tune, validate or test; by default the worlds of a sweep."""

    def __post_init__(self) -> None:
        options.check_fields(self)
        object.__setattr__(self, "seed", int(self.seed))  # those of NumPy overflow
        self.rules.check()
        if self.physics.cone != "elliptic":  # all engines have this one: import no engine
            self.simulator.check_physics(self.physics)

    def with_robot(self, robot: Robot) -> Setting:
        """Return the setting with the control period of a robot, if it has one.

        Raises:
          InputError: the physics has another one, which is not the default.
        """
        if robot.period in (None, self.physics.control_period):
            return self
        if self.physics.control_period != Physics().control_period:
            rule = f"the period of the robot is {robot.period:g} s: leave it out"
            period = f"{self.physics.control_period:g} s"
            raise errors.not_allowed("control_period", period, rule)
        return replace(self, physics=replace(self.physics, control_period=robot.period))

    @property
    def simulator(self) -> Engine:
        """The engine itself."""
        return engines.get(self.engine)

    @property
    def world_seed(self) -> int:
        """Seed of the random worlds of the split."""
        return self.seed if self.split is None else seed_of(self.seed, self.split)

    @property
    def attributes(self) -> dict[str, str | int]:
        """Attributes of results: seed, engine, and the split if there is one."""
        split = {} if self.split is None else {"split": self.split}
        return {"seed": self.seed, "engine": self.engine} | split

    def check_here(self, robot: Robot, laws: Iterable[LawParams] = ()) -> None:
        """Raise InputError unless the engine can step such a robot with these laws."""
        if self.with_robot(robot) is not self:
            rule = f"the period of the robot is {robot.period:g} s: use setting.with_robot(robot)"
            raise errors.not_allowed("control_period", f"{self.physics.control_period:g} s", rule)
        self.simulator.check_robot(robot)
        for params in laws:
            law = registry.law_of(params)
            registry.check_drive(params, robot.drive)
            self.simulator.check_senses(law.senses)
            if law.senses in ("taxels", "ends"):
                check_law(law, params, robot.shell.count)

    def check_domain(self, domain: Domain, laws: Iterable[LawParams] = ()) -> None:
        """Raise InputError unless the engine can step the worlds of a domain with these laws."""
        self.simulator.check_surroundings(domain.surroundings)
        self.simulator.check_pads(domain.has_pads, self.physics)
        self.check_here(domain.weakest, laws)
        for params in laws:
            domain.task.check_law(params)

    def to_json(self) -> JsonObject:
        """Return the setting as manifests have it; `from_json` reads it."""
        rules = registry.leaves_to_json(self.rules)
        physics = asdict(self.physics)
        if physics["support"] == "corners":  # as records without a support
            del physics["support"]
        return {"physics": physics, "rules": rules} | self.attributes

    @classmethod
    def from_json(cls, record: JsonObject) -> Setting:
        """Return the setting of a record with the fields of `to_json`."""
        physics, rules = Physics(**record["physics"]), Rules(**record["rules"])
        seed, split = record["seed"], record.get("split")
        return cls(record["engine"], physics, rules=rules, seed=seed, split=split)
