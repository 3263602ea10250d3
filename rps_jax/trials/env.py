"""Pushing as an environment for a learning loop of one's own, as mujoco_playground has them.

    env = PushEnv("random_box")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 512))
    state = jax.jit(jax.vmap(env.step))(state, actions)

`reset` and `step` are pure functions of one world. Skin, odometry, physics and the rules by which
a trial ends are those of every other trial here; only what decides is left to the loop.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax import engines, errors
from rps_jax.control.base import check_finite_leaves
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import features
from rps_jax.control.observation import TaxelObservation, Twist
from rps_jax.engines.base import ControlPeriod, Driven, Motion, Stage
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.robot.robot import Robot
from rps_jax.trials import trial
from rps_jax.trials.batch import WorldBatch, rows
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Measurement, Trial, World
from rps_jax.trials.worlds import drawn_scene, drawn_worlds
from rps_jax.world import domain, draws, objects, video
from rps_jax.world.domain import DOMAINS, Domain
from rps_jax.world.draws import Draw
from rps_jax.world.scene import Scene


class Reward(NamedTuple):
    """What a step is worth."""

    # [1/m] that the contact point is nearer to the target than when last felt
    progress: float = 1.0
    no_contact: float = 0.05  # [1/s] cost of being out of contact: that of progress at 5 cm/s
    success: float = 1.0  # [1] for arriving, once
    # Of what the law is not told, for loops that ask for it.
    object: float = 0.0  # [1/m] that the outline of the object is nearer to the target than before
    behind: float = 0.0  # [1] that target and object are seen nearer to one direction: the cosine


# Default weights of `rps learn` and of the Gymnasium environment.
SHAPED_REWARD = Reward(progress=0.5, no_contact=0.02, success=1.0, object=0.5, behind=0.5)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What `reset` and `step` return; the fields are those of mujoco_playground's `State`."""

    data: Trial  # with qpos (10,), qvel (9,), and all that the rules count
    obs: jax.Array  # (44,) see `PushEnv`
    reward: jax.Array  # () [1]
    done: jax.Array  # () [1] 0 or 1
    metrics: dict[str, jax.Array]  # () each
    # `world`: the World; `index`: its number in the domain; `told`: the TaxelObservation.
    info: dict[str, Any]

    def replace(self, **changes: Any) -> State:
        """The state with other values."""
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False)
class PushEnv:
    """One object to be pushed to a target by touch.

    Observation (T + 2,): the T taxels of the robot, the paper's 42, in the order of `Shell.taxels`,
    each the filtered relative change of its capacitance [1], 0 if it is dead; then the target
    (x, y) [m] in the robot's frame, by where the base believes to be.

    Action (3,): the twist (v_x, v_y, omega) in the robot's frame, in units of the parameters'
    v_max, v_max and omega_max. (v_x, v_y) is scaled down to a norm of 1, omega is clipped to +-1.

    Reward: see `Reward`. Without contact nothing is gained; a contact that is found again counts
    from where it was lost, so a sum of rewards tells by how much a push came nearer.

    Done: by the rules of `setting` (the paper's: arrived, 300 s, or 150 s without contact; or
    the object fell over), or if the physics diverged. A state that is done stays as it is, and
    earns nothing.

    Every reset takes one of `worlds` random worlds of the domain, drawn in advance on the host,
    and noise of its own; no other randomisation is needed. Shape family and engine are static.

    Raises:
      InputError: an unknown object, a skin without taxels, or an engine that JAX does not run.
    """

    object: str = "random_box"  # of all worlds; those of the domain are not used
    domain: Domain = DOMAINS["wide"]
    params: RPSParams = RPSParams.paper()  # of which the bounds of the twist and d_success count
    setting: Setting = Setting(engine="fused")
    robot: Robot | str | None = None  # by its name, as kairos; None: the domain's
    weights: Reward = Reward()
    worlds: int = 1024

    def __post_init__(self) -> None:
        """Draws the worlds: now, and not while a loop is traced."""
        engines.get(self.setting.engine).check_traced()
        errors.check_name("skin of an environment", self.domain.skin, ("capacitive",))
        errors.check_count("worlds", self.worlds, at_most=1_000_000)
        rps.check(self.params)
        check_finite_leaves(self.weights)
        self._drive  # noqa: B018

    # --- the loop ---

    def reset(self, rng: jax.Array) -> State:
        """A world by chance, at its start, from a key."""
        key_world, key = jax.random.split(rng)
        index = jax.random.randint(key_world, (), 0, self.worlds)
        world = rows(self.table, index)
        return self.begin(world._replace(key=jax.random.key_data(key)), index)

    @property
    def table(self) -> World:
        """All its worlds, as leaves (worlds, ...)."""
        return self._part.worlds

    def begin(self, world: World, index: jax.Array) -> State:
        """A world, of the index or one that was made of it, at its start."""
        before = trial.start(world, self.params)
        never_felt = jnp.full_like(before.min_distance, jnp.inf)
        now, seen = self._observe(world, before._replace(law_state=never_felt))
        nothing = jnp.zeros_like(now.min_distance)
        info = {"world": world, "index": index, "observation": self._observation(world, now, seen)}
        return State(now, _obs(now, seen), nothing, nothing, _metrics(now, seen, nothing), info)

    def step(self, state: State, action: jax.Array) -> State:
        """One control period with the base at the twist of an action (3,)."""
        world, before = state.info["world"], state.data
        told, twist = trial.execute(world, before, self.twist(action), self.dt)
        robot = trial.pushing(world)
        driven = self._drive(world.fields, trial.motion(told), twist, robot)
        moved = trial.settle(before, told, driven)
        now, seen = self._observe(world, moved)
        gone = moved.done  # it had ended before, or the physics ended it
        progress = jnp.where(jnp.isfinite(before.law_state), before.law_state - now.law_state, 0.0)
        reward = (
            self.weights.progress * progress
            - self.weights.no_contact * self.dt * ~seen.reading.in_contact
            + self.weights.success * now.success
        )
        for weight, gain in zip(self.weights[3:], self._gains(world, before, now), strict=True):
            reward += weight * gain if weight else 0.0
        return state.replace(
            data=now,
            obs=_obs(now, seen),
            reward=jnp.where(gone, 0.0, reward),
            done=now.done.astype(reward.dtype),
            metrics=state.metrics | _metrics(now, seen, jnp.where(gone, 0.0, progress)),
            info=state.info | {"observation": self._observation(world, now, seen)},
        )

    def twist(self, action: jax.Array) -> Twist:
        """The twist [m/s, m/s, rad/s] that an action (3,) asks for."""
        v_max, omega_max = self.params.v_max, self.params.omega_max
        wanted = Twist(v_max * action[0], v_max * action[1], omega_max * action[2])
        return rps.saturate(self.params, wanted)

    def _gains(self, world: World, before: Trial, now: Trial) -> tuple[jax.Array, jax.Array]:
        """By how much a step brought the object nearer [m], and the base behind it [1]."""

        def of(state: Trial) -> tuple[jax.Array, jax.Array]:
            p_object, _ = trial.object_pose(state.qpos)
            away = planar.norm(world.p_world_target - p_object) - fp.circumradius(world.footprint)
            ways = p_object - state.qpos[:2], world.p_world_target - state.qpos[:2]
            lengths = jnp.maximum(planar.norm(ways[0]) * planar.norm(ways[1]), 1e-6)
            return jnp.maximum(away, 0.0), jnp.dot(*ways) / lengths

        (far, apart), (near, together) = of(before), of(now)
        return far - near, together - apart

    def _observe(self, world: World, before: Trial) -> tuple[Trial, Measurement]:
        """Sense and judge, unless the trial has ended."""
        physics, rules = self.setting.physics, self.setting.rules
        told, seen = trial.observe(world, self.params, before, physics=physics, rules=rules)
        felt = jnp.where(seen.reading.in_contact, seen.distance, before.law_state)
        told = told._replace(law_state=felt)
        return jax.tree.map(lambda a, b: jnp.where(before.done, a, b), before, told), seen

    def _observation(self, world: World, now: Trial, seen: Measurement) -> TaxelObservation:
        """What a law that senses taxels is told."""
        felt = world.skin, now.skin, trial.outline(world, now.qpos)
        touch = seen.observation._replace(period=jnp.asarray(self.dt))
        return features.taxel_observation(touch, seen.reading, *felt)

    # --- what it is made of ---

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return len(Twist._fields)

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self.setting.physics.control_period

    @property
    def sim_dt(self) -> float:
        """Physics step [s]."""
        return self.setting.physics.timestep

    @property
    def n_substeps(self) -> int:
        """Physics steps in a control period."""
        return self.setting.physics.substeps

    @property
    def unwrapped(self) -> PushEnv:
        """Itself."""
        return self

    @property
    def xml_path(self) -> str:
        """The MJCF file of the object, or of the family of a random one."""
        known = self.object in objects.OBJECTS
        return str(objects.path_of(self.object if known else self._alone.family_of(0)))

    @property
    def mj_model(self) -> mujoco.MjModel:
        """World 0, with all that is seen."""
        return self._scene(0).model

    @property
    def mjx_model(self) -> mjx.Model:
        """World 0, what touches alone: what the engine `mjx` steps."""
        return mjx.put_model(self._scene(0).physics)

    @functools.cached_property
    def _alone(self) -> Domain:
        return dataclasses.replace(
            domain.parse_domain(self.domain, self.robot), objects=(self.object,)
        )

    @functools.cached_property
    def _drawn(self) -> Draw:
        return draws.draw(self._alone, self.setting.seed, np.arange(self.worlds))

    @functools.cached_property
    def _part(self) -> WorldBatch:
        """All worlds, on the device."""
        part = drawn_worlds(self._alone, self._drawn, self.setting)
        return part._replace(worlds=jax.tree.map(jnp.asarray, part.worlds))

    @functools.cached_property
    def _drive(self) -> Callable[..., Driven]:
        return one_of_many(self._part.stage, self.setting)

    def _scene(self, index: int) -> Scene:
        return drawn_scene(self._alone, self._drawn, self.setting.physics, index)

    def render(
        self,
        trajectory: State | Sequence[State],
        height: int = 240,  # [px]
        width: int = 320,  # [px]
        camera: str | None = None,
        scene_option: None = None,  # unused
        modify_scene_fns: None = None,  # unused
    ) -> Any:
        """Images (height, width, 3) uint8 of states without a batch axis: a list, or one of one.

        Each is drawn in its own world, by the camera oblique (the default) or above.
        """
        del scene_option, modify_scene_fns
        if isinstance(trajectory, State):
            return self.render([trajectory], height, width, camera)[0]
        images = []
        for index, states in itertools.groupby(trajectory, lambda s: int(s.info["index"])):
            shown = list(states)
            target = np.asarray(shown[0].info["world"].p_world_target)
            images += video.images(
                self._scene(index),
                [np.asarray(s.data.qpos) for s in shown],
                p_world_target=target,
                size=(width, height),
                camera=camera or "oblique",
            )
        return images


def _obs(now: Trial, seen: Measurement) -> jax.Array:
    taxels = jnp.where(now.skin.alive, now.skin.signal, 0.0)
    told = seen.observation
    p_robot_target = planar.rotate(-told.yaw, told.p_world_target - told.p_world_robot)
    return jnp.concatenate([taxels, p_robot_target])


def _metrics(now: Trial, seen: Measurement, progress: jax.Array) -> dict[str, jax.Array]:
    flags = {
        "in_contact": seen.reading.in_contact,
        "success": now.success,
        "diverged": now.diverged,
    }
    return {"progress": progress} | {k: v.astype(progress.dtype) for k, v in flags.items()}


def one_of_many(stage: Stage, setting: Setting) -> Callable[..., Driven]:
    """Drives one world; under vmap the stage drives the whole batch, on a GPU as one kernel."""

    def together(fields: Any, motion: Motion, twist: Twist, robot: Robot | None = None) -> Driven:
        return stage.drive(fields, motion, ControlPeriod(twist, setting.physics, robot))

    @jax.custom_batching.custom_vmap
    def drive(*one: Any) -> Driven:
        return rows(together(*jax.tree.map(lambda x: jnp.asarray(x)[None], one)), 0)

    @drive.def_vmap
    def _(size: int, batched: Any, *args: Any) -> tuple[Driven, Driven]:
        def full(x: Any, has: bool) -> Any:
            return x if has else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        driven = together(*jax.tree.map(full, args, tuple(batched)))
        return driven, jax.tree.map(lambda _: True, driven)

    return drive
