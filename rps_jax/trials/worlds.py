"""Worlds of trials: from solids, draws and candidates, and the jobs that run them.

A `WorldBatch` has some worlds with law parameters; a `Job` has those that one program can step.
`Candidates` are law parameters with leaves (P, ...) in random worlds. A probe is one candidate at
given points: `Candidates(params, [domain], 0, np.arange(n), points)`. A planner sets `per_world`
and gives leaves (P, W, ...), its own parameters for each world.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams, Memory
from rps_jax.geometry import solid
from rps_jax.geometry.arrays import Entries, Pytree
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot.base import Odometry
from rps_jax.robot.skin import CapacitiveSkin, IdealSkin
from rps_jax.trials.progress import ProgressCallback
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome, Shift, World
from rps_jax.world import objects, scene
from rps_jax.world import points as points_
from rps_jax.world.domain import RANDOM, Domain, Owner, Range, quantities_of
from rps_jax.world.draws import Draw
from rps_jax.world.physics import Physics
from rps_jax.world.points import Points
from rps_jax.world.scene import JOINTS, Friction, Scene, WorldInputs

Tree = TypeVar("Tree")  # a pytree
Inputs = tuple[World, LawParams]
Collect = Callable[[np.ndarray, Outcome], object]  # indices (m,) of trials and their outcomes


class BatchSize(TypedDict, total=False):
    """Resources of functions that run trials."""

    slots: int | None  # worlds that one worker steps at once on each device of the host
    workers: int | None  # host threads for each device


class BatchOptions(BatchSize, total=False):
    """Keyword arguments of functions that run trials."""

    callback: ProgressCallback


def rows(tree: Tree, index: Entries) -> Tree:
    """Return the rows `index` of every leaf; an index is whatever arrays take."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


class WorldBatch(NamedTuple):
    """Worlds and law parameters of some trials of a job."""

    indices: np.ndarray  # (n,) indices of the trials in the run
    worlds: World  # leaves (n, ...), on the host
    stage: Pytree  # a `Stage`, or the models of an engine outside of JAX
    params: Pytree = ()  # `LawParams` with leaves (n, ...), on the host; () if not yet known

    def with_params(self, params: LawParams) -> WorldBatch:
        """Return the trials with the same law parameters in every world."""
        count, dtype = self.indices.size, jnp.result_type(float)
        same = jax.tree.map(lambda x: np.full((count, *np.shape(x)), x, dtype), params)
        return self._replace(params=same)

    @property
    def law(self) -> Law:
        """Law of the parameters."""
        return registry.law_of(self.params)

    @property
    def inputs(self) -> Inputs:
        """Inputs of the program, which differ from trial to trial."""
        return self.worlds, self.params

    def split(self, count: int) -> tuple[WorldBatch, WorldBatch | None]:
        """Return the first `count` trials, and the rest if there is one."""
        arrays = self._replace(stage=None)
        parts = slice(count), slice(count, None)
        first, rest = (rows(arrays, part)._replace(stage=self.stage) for part in parts)
        return first, rest if rest.indices.size else None


def memory_of(params: LawParams, state: Pytree) -> Memory:
    """Return what the law with a state remembers, for pictures."""
    law = registry.law_of(params)
    return Memory() if law.memory is None else law.memory(state)


class Job(NamedTuple):
    """Trials that one compiled program can step."""

    program: Hashable  # key of the program; jobs with equal keys can be joined
    num_trials: int  # at most; there are no more slots than that
    batches: Iterable[WorldBatch]  # of one law, and of one stage if JAX traces the engine


# --- builders ----------------------------------------------------------------------------------


def build(indices: np.ndarray, inputs: WorldInputs, setting: Setting, **fields: Any) -> WorldBatch:
    """Return worlds of one shape family, staged for the engine: on the host, without parameters.

    Args:
      indices: (n,) of the trials.
      inputs: of all engines.
      setting: engine and physics.
      fields: of `World`, (n, ...) each, beside those that follow from solids and robots.

    Raises:
      InputError: the engine cannot step such a robot, or such surroundings.
    """
    engine, dtype = setting.simulator, jnp.result_type(float)
    engine.check_robot(inputs.robots)
    inputs = inputs.supported
    engine.check_pads(inputs.solids.pads is not None, setting.physics)
    added = getattr(fields.get("task"), "surroundings", None) or {}
    inputs = inputs._replace(surroundings=inputs.surroundings._replace(**added))
    engine.check_surroundings(inputs.surroundings)
    friction = inputs.surroundings.friction_wall
    if friction is not None and setting.physics.cone == "pyramidal" and min(friction) < 0.01:
        rule = "a friction pyramid needs at least 0.01; choose physics=default"
        raise errors.not_allowed("task friction_wall", f"{min(friction):g}", rule)
    stage, staged = engine.stage(inputs)
    outline: Pytree = inputs.solids.vertices, inputs.solids.radius
    robot = None if inputs.robots.ideal else inputs.robots
    world = World(fields=staged, footprint=Footprint(*outline), robot=robot, **fields)
    narrow = jax.tree.map(lambda x: x if x.dtype == np.uint32 else x.astype(dtype), world)
    return WorldBatch(indices, narrow, stage)


def drawn_worlds(
    domain: Domain, drawn: Draw, setting: Setting, remembered: int | None = None
) -> WorldBatch:
    """Return the worlds of a draw, on the host, without law parameters.

    Their odometry remembers as many control steps as the domain needs, or `remembered`.
    """
    count = drawn.indices.size
    if remembered is None:
        remembered = remembered_steps(domain, setting.physics.control_period)
    odometry = _drawn(drawn, "base") | {"velocity_error": drawn.velocity_error}
    sensor = IdealSkin() if domain.skin == "ideal" else CapacitiveSkin()
    repeated: Pytree = jax.tree.map(lambda x: np.full(drawn.indices.size, x, float), sensor)
    quantities = {} if domain.skin == "ideal" else _drawn(drawn, "skin")
    return build(
        drawn.indices,
        drawn.inputs(domain, setting.physics),
        setting,
        skin=repeated._replace(shell=drawn.robot.shell, **quantities),
        p_world_target=drawn.p_world_target,
        task=drawn.course,
        shift=Shift(np.full(count, np.inf), np.zeros((count, 2))),
        qpos=starts(drawn),
        key=drawn.key,
        odometry=Odometry(**odometry, past=np.zeros((count, remembered))),
    )


def _drawn(drawn: Draw, owner: Owner) -> dict[str, Entries]:
    """Return the drawn quantities of an owner by name."""
    return {name: drawn.values[name] for name in quantities_of(owner) if name in drawn.values}


def soften_skins(worlds: World) -> World:
    """Return worlds, or one, with smooth skins, unless these have a temperature.

    Raises:
      InputError: the skin is ideal: this has no smooth form.
    """
    skin, shape = worlds.skin, jnp.shape(worlds.p_world_target)[:-1]
    if isinstance(skin, IdealSkin):
        rule = "it has no smooth form; choose skin=capacitive, or in Python smooth=False"
        raise errors.not_allowed("skin", "ideal", rule)
    if skin.temperature is not None:
        return worlds
    return worlds._replace(skin=skin._replace(temperature=jnp.full(shape, skin.SMOOTH)))


def starts(drawn: Draw) -> np.ndarray:
    """Return start positions (n, 10): the base at the origin, the object in front of it."""
    qpos, yaw = np.zeros((drawn.indices.size, 10)), drawn.values["yaw"]
    front = drawn.robot.sizes[0] + drawn.values["gap"] + solid.extent(drawn.solid, yaw)
    position = np.stack([front, drawn.values["lateral"], drawn.solid.height / 2], axis=-1)
    qpos[:, JOINTS.object] = np.concatenate([position, solid.quaternion(yaw)], axis=-1)
    return qpos


def remembered_steps(domain: Domain, period: float) -> int:
    """Return the number of control steps of `period` [s] that the odometry remembers."""
    if all(domain.range_of(name) in (None, Range(0, 0)) for name in quantities_of("base")):
        return 0
    return 1 + round(max(domain.pose_latency.high, domain.command_delay.high) / period)


def drawn_scene(domain: Domain, drawn: Draw, physics: Physics, i: int) -> Scene:
    """Compile the scene of row i of a draw, for pictures; named objects keep their visual geoms."""
    case = int(drawn.cases[i])
    name = domain.objects[int(domain.object_of(case))]
    if name in RANDOM:
        return scene.compile_row(drawn.inputs(domain, physics), i)
    ground, robot = (float(leaf[i]) for leaf in drawn.friction)
    single = rows(drawn.solid, i) if objects.guesses_of(name) is not None else None
    friction = Friction(ground, robot)
    return scene.load(name, physics, friction, robot=domain.robot, drawn=single)


# --- candidates --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Candidates:
    """Parameters of one law, and the W worlds of each of D domains that the P candidates meet."""

    params: LawParams  # leaves (P, ...); (P, D * W, ...) with `per_world`
    domains: Sequence[Domain]
    seed: int  # of the worlds
    worlds: np.ndarray  # (W,) indices of the worlds, in each of the domains
    points: Points | None = None  # of the unit cube at which the worlds lie; None: drawn worlds
    per_world: bool = False  # whether a candidate has different parameters in each world

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (P, D * W) of the outcomes."""
        num_candidates = jax.tree.leaves(self.params)[0].shape[0]
        return num_candidates, len(self.domains) * self.worlds.size

    @functools.cached_property
    def draws(self) -> list[tuple[np.ndarray, Domain, Draw]]:
        """Worlds by domain and object: positions (n,) among all D * W, domain and draw."""
        return [
            (i * self.worlds.size + at, domain, drawn)
            for i, domain in enumerate(self.domains)
            for at, drawn in points_.draw_by_object(domain, self.seed, self.points, self.worlds)
        ]

    @property
    def distances(self) -> np.ndarray:
        """Distances (D * W,) [m] from the start to the target."""
        distances = np.empty(self.shape[1])
        for columns, _, drawn in self.draws:
            distances[columns] = np.linalg.norm(drawn.p_world_target, axis=1)
        return distances

    def batches(self, setting: Setting) -> Iterator[WorldBatch]:
        """Yield the worlds by domain and object, without law parameters.

        The indices (n,) of a batch are the positions of its worlds among all D * W.
        """
        # Odometry of equal length in all domains lets their worlds share a batch.
        period = setting.physics.control_period
        remembered = max(remembered_steps(domain, period) for domain in self.domains)
        for columns, domain, drawn in self.draws:
            worlds = drawn_worlds(domain, drawn, setting, remembered)
            yield worlds._replace(indices=columns)

    def jobs(self, setting: Setting) -> Iterator[Job]:
        """Yield the worlds of each domain and object, candidate after candidate."""
        num_candidates, width = self.shape
        params, dtype = jax.device_get(self.params), jnp.result_type(float)

        def candidate(worlds: WorldBatch, i: int) -> WorldBatch:
            trials = worlds._replace(indices=width * i + worlds.indices)
            if not self.per_world:
                return trials.with_params(rows(params, i))
            chosen = rows(params, (i, worlds.indices))
            return trials._replace(params=jax.tree.map(lambda x: np.asarray(x, dtype), chosen))

        for worlds in self.batches(setting):
            batches = [candidate(worlds, i) for i in range(num_candidates)]
            leaves, structure = jax.tree.flatten(batches[0].inputs)
            program = structure, *(np.shape(leaf)[1:] for leaf in leaves)
            yield Job(program, num_candidates * worlds.indices.size, batches)
