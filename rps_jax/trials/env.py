"""Pushing as an environment for custom learning loops, in the style of mujoco_playground.

    env = PushEnv("random_box")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 512))
    state = jax.jit(jax.vmap(env.step))(state, actions)

`reset` and `step` are pure functions of one world. Skin, odometry, physics and rules are those of
all trials; the learning loop takes the place of the law.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.control.base import check_finite_leaves
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import features
from rps_jax.control.observation import EndsObservation, Observation, TaxelObservation, Twist
from rps_jax.engines import device, native
from rps_jax.engines.base import ControlPeriod
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Pair, Pytree
from rps_jax.record.options import check_fields, option
from rps_jax.robot.robot import RobotLike
from rps_jax.trials import trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Measurement, SingleWorld, Trial, World
from rps_jax.trials.worlds import WorldBatch, drawn_scene, drawn_worlds, rows, soften_skins
from rps_jax.world import domain, draws, video
from rps_jax.world.domain import DOMAINS, Domain, DomainLike
from rps_jax.world.draws import Draw
from rps_jax.world.scene import JOINTS
from rps_jax.world.tasks import TaskLike
from rps_jax.world.tasks.base import heading_of, is_relative


class Reward(NamedTuple):
    """Weights of the terms of the reward."""

    # [1/m] of the decrease of the way from contact point to target since the last contact; of a
    # path it is the way along the path
    progress: float = 1.0
    no_contact: float = 0.05  # [1/s] cost without contact, which equals progress at 5 cm/s
    success: float = 1.0  # [1] once, for a success
    # Terms that use the true state, which a law does not observe.
    object: float = 0.0  # [1/m] of the decrease of the way from outline to target
    behind: float = 0.0  # [1] of the increase of the cosine between directions to target and object
    failure: float = 0.0  # [1] cost once, of a trial that ends without success


# Default weights of `rps learn` and of the Gymnasium environment.
SHAPED_REWARD = Reward(progress=0.5, no_contact=0.02, success=1.0, object=0.5, behind=0.5)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """State of an environment, with the fields of mujoco_playground's `State`."""

    data: Trial  # with qpos (10,), qvel (9,) and the counters of the rules
    obs: Array  # (44,) see `PushEnv`
    reward: Array  # () [1]
    done: Array  # () [1] 0 or 1
    metrics: dict[str, Array]  # () each
    # `world`: the World; `index`: its index in the domain; `observation`: the TaxelObservation.
    info: dict[str, Pytree]

    def replace(self, **changes: object) -> State:
        """Return the state with other values."""
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False)
class PushEnv:
    """Environment: push one object to a target by touch.

    Observation (T + 2,): the T taxels of the robot, the paper's 42, in the order of `Shell.taxels`,
    each the filtered relative change of its capacitance [1], 0 if it is dead; then the target
    (x, y) [m] in the robot's frame, at the pose that the odometry estimates. Of a path, it is the
    point of the path a lookahead ahead of the contact. A goal with a heading adds its cosine and
    sine in the robot's frame, which are 0 before the end of a path. With senses="ends", the last
    T + 5 numbers are the offsets [m] of the left and the right end of the contact, whether each was
    seen, whether the contact is even, and whether each taxel works.

    Action (3,): the twist (v_x, v_y, omega) in the robot's frame, in units of the parameters'
    v_max, v_max and omega_max. (v_x, v_y) is scaled down to a norm of 1, omega is clipped to +-1.
    Action (2,) of a base that cannot move sideways: (v_x, omega).

    Reward: see `Reward`. There is no progress without contact; after a new contact, progress counts
    from where the contact was lost. So the sum of rewards measures how much nearer the object is.

    Done: by the rules of `setting` (the paper's: success, 300 s, or 150 s without contact; or
    the object fell over), if the physics diverged, or if the task failed, as at the touch of a
    wall. `data.task.outcomes()` has the task's outcomes. A state that is done does not change, and
    its rewards are 0.

    `step` has derivatives by state and action with every engine that has them; with the others
    they are refused. With `smooth`, contact is a weight from 0 to 1, and so are progress and the
    cost of lost contact, which otherwise switch. Signals of taxels change smoothly from the first
    compression of the foam on. Jumps remain: success, the end of a trial, a first contact, from
    which on progress counts, and the bounds of the action.

    Every reset takes one of `worlds` random worlds of the domain, which are drawn in advance on the
    host, and new noise. Shape family and engine are static.

    Raises:
      InputError: an unknown object, a skin without taxels, an engine that JAX does not run, or a
        key, state or action of another type or shape.
    """

    object: str = "random_box"  # in all worlds; the objects of the domain are not used
    domain: DomainLike = DOMAINS["wide"]
    params: RPSParams = RPSParams.paper()  # only the bounds of the twist and d_success are used
    setting: Setting = Setting(engine="fused")
    robot: RobotLike | None = None  # name, as kairos; None: the domain's
    task: TaskLike | None = None  # name, as path; None: the domain's
    weights: Reward = Reward()
    worlds: int = option(1024, 1, 1_000_000)
    smooth: bool = False  # whether contact is a weight, for derivatives
    senses: Literal["taxels", "ends"] = "taxels"  # ends: also of contacts, and the dead taxels

    def __post_init__(self) -> None:
        """Check the options, and draw the worlds before a loop is traced."""
        check_fields(self)
        object.__setattr__(self, "setting", self.setting.with_robot(self._alone.robot))
        self.setting.simulator.check_traced()
        errors.check_name("skin of an environment", self._alone.skin, ("capacitive",))
        rps.check(self.params)
        check_finite_leaves(self.weights)
        with device.standard_jax():
            self._batch  # noqa: B018
        if is_relative(self.table.task):
            rule = "environments know only headings in the world: give heading instead"
            raise errors.not_allowed("task turn", "a relative heading", rule)

    # --- the loop ---

    @device.standard_jax()
    def reset(self, rng: Array) -> State:
        """Return a random world at its start, from a key."""
        device.check_process()
        try:
            key_world, key = jax.random.split(rng)
        except (TypeError, ValueError) as error:
            rule = "give one key, as jax.random.key(0), and map reset over several by jax.vmap"
            raise errors.not_allowed("rng", repr(rng), rule) from error
        index = jax.random.randint(key_world, (), 0, self.worlds)
        world = rows(self.table, index)
        return self.begin(world._replace(key=jax.random.key_data(key)), index)

    @property
    def table(self) -> World:
        """Worlds of the domain, with leaves (worlds, ...)."""
        return self._batch.worlds

    def begin(self, world: World, index: Array) -> State:
        """Return the start of the world `index`, or of one derived from it."""
        start = trial.start(world, self.params)
        no_contact = jnp.full_like(start.min_distance, jnp.inf)
        current, measured = self._observe(world, start._replace(law_state=no_contact))
        zero = jnp.zeros_like(current.min_distance)
        obs = self._observation(world, current, measured)
        info = {"world": world, "index": index, "observation": obs}
        metrics = _metrics(current, measured, zero)
        return State(current, _obs(obs), zero, zero, metrics, info)

    @device.standard_jax()
    def step(self, state: State, action: Array) -> State:
        """Run one control period with the base at the twist of an action (3,)."""
        if not isinstance(state, State):
            rule = "give the State that reset returned"
            raise errors.not_allowed("state", repr(state), rule)
        engine, physics = self.setting.simulator, self.setting.physics
        inputs = state.info["world"], state.data, self.twist(action)
        world, previous, twist = engine.guard_derivatives(inputs)
        decided, twist = trial.execute(world, previous, twist, self.dt)
        period = ControlPeriod(twist, physics, trial.pushing(world))
        stage = SingleWorld(self._batch.stage)
        driven = stage.drive(world.fields, trial.motion(decided), period)
        moved = trial.settle(world, previous, decided, driven)
        current, measured = self._observe(world, moved)
        ended = moved.done  # before this step, or because the physics diverged
        distance = previous.law_state
        progress = jnp.where(jnp.isfinite(distance), distance - current.law_state, 0.0)
        reward = (
            self.weights.progress * progress
            - self.weights.no_contact * self.dt * soft.not_(measured.reading.in_contact)
            + self.weights.success * current.success
            - self.weights.failure * (current.done & ~current.success)
        )
        targets = state.info["observation"].touch, measured.observation
        terms = self._true_state_terms(world, previous, current, *targets)
        weights = self.weights.object, self.weights.behind
        for weight, term in zip(weights, terms, strict=True):
            reward += weight * term if weight else 0.0
        obs = self._observation(world, current, measured)
        return state.replace(
            data=current,
            obs=_obs(obs),
            reward=jnp.where(ended, 0.0, reward),
            done=current.done.astype(reward.dtype),
            metrics=state.metrics | _metrics(current, measured, jnp.where(ended, 0.0, progress)),
            info=state.info | {"observation": obs},
        )

    def twist(self, action: Array) -> Twist:
        """Return the twist [m/s, m/s, rad/s] of an action (3,) or (2,), within the bounds."""
        size = self.action_size
        names = "v_x, v_y and omega" if size == 3 else "v_x and omega"
        rule = f"it must be {size} numbers: {names}; map step over several worlds by jax.vmap"
        try:
            action = jnp.asarray(action)
        except (TypeError, ValueError) as error:
            raise errors.not_allowed("action", repr(action), rule) from error
        if action.shape != (size,) or jnp.iscomplexobj(action):
            raise errors.not_allowed("action", f"{action.dtype}{[*action.shape]}", rule)
        if size == 2:
            action = jnp.stack([action[0], jnp.zeros_like(action[0]), action[1]])
        v_max, omega_max = self.params.v_max, self.params.omega_max
        twist = Twist(v_max * action[0], v_max * action[1], omega_max * action[2])
        return rps.saturate(self.params, twist)

    def _true_state_terms(
        self, world: World, previous: Trial, current: Trial, *touches: Observation
    ) -> Pair:
        """Return the changes of the terms `object` [m] and `behind` [1] of the reward."""

        def terms(state: Trial, touch: Observation) -> Pair:
            p_object, _ = trial.object_pose(state.qpos)
            way = world.task.remaining(state.task, world.p_world_target, p_object)
            gap = way - fp.circumradius(world.footprint)
            p_base = state.qpos[JOINTS.base_position]
            ways = p_object - p_base, touch.p_world_target - p_base
            lengths = jnp.maximum(planar.norm(ways[0]) * planar.norm(ways[1]), 1e-6)
            return jnp.maximum(gap, 0.0), jnp.dot(*ways) / lengths

        (old_gap, old_cosine), (gap, cosine) = map(terms, (previous, current), touches)
        return old_gap - gap, cosine - old_cosine

    def _observe(self, world: World, previous: Trial) -> tuple[Trial, Measurement]:
        """Sense and judge, unless the trial has ended; `law_state` is the last way felt [m]."""
        loop = ControlLoop(self.setting.physics, self.setting.rules)
        judged, measured = trial.observe(world, self.params, previous, loop)
        contact, last = measured.reading.in_contact, previous.law_state
        p_world_contact = trial.contact_of(judged.qpos, measured.reading.p_robot_contact)
        way = world.task.remaining(judged.task, world.p_world_target, p_world_contact)
        distance = jnp.where(contact > 0.5, way, last)
        if self.smooth:  # a first contact switches
            touched = jnp.isfinite(last)
            mixed = soft.where(contact, way, jnp.where(touched, last, 0.0))
            distance = jnp.where(touched, mixed, distance)
        judged = judged._replace(law_state=distance)
        frozen = soft.tree_where(previous.done, previous, judged)
        return frozen, measured

    def _observation(
        self, world: World, current: Trial, measured: Measurement
    ) -> TaxelObservation | EndsObservation:
        """Return the observation of a law that senses taxels, or ends."""
        skin = world.skin, current.skin, trial.outline(world, current.qpos)
        touch = measured.observation._replace(period=jnp.asarray(self.dt))
        return features.OBSERVATIONS[self.senses](touch, measured.reading, *skin)

    def has_timed_out(self, data: Trial) -> Array:
        """Return whether trials (...) ended by a time limit, and not by success or failure."""
        rules, lost = self.setting.rules, data.lost_steps * self.dt
        late = (data.steps * self.dt >= rules.horizon) | (lost > rules.max_lost)
        return data.done & late & ~(data.success | data.tipped | data.diverged)

    # --- properties ---

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        count, ends = self._alone.robot.shell.count, self.senses == "ends"
        return count + 2 + 2 * (heading_of(self.table.task) is not None) + (count + 5) * ends

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return len(Twist._fields) - (self._alone.robot.drive != "omni")

    @property
    def is_native(self) -> bool:
        """Whether `engines.native` can compile its functions of one world."""
        return native.compiles(self._batch.stage)

    @property
    def program(self) -> Hashable:
        """Key of all but the worlds' fields on which `begin` and `step` depend."""
        setting = self.setting
        loop = setting.simulator.name, setting.physics, setting.rules, self._batch.stage
        return *loop, self._alone.robot.drive, self.params, self.weights, self.smooth, self.senses

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self.setting.physics.control_period

    @functools.cached_property
    def _alone(self) -> Domain:
        ranges = domain.parse_domain(self.domain, self.robot, self.task)
        return dataclasses.replace(ranges, objects=(self.object,))

    @functools.cached_property
    def _drawn(self) -> Draw:
        return draws.draw(self._alone, self.setting.world_seed, np.arange(self.worlds))

    @functools.cached_property
    def _batch(self) -> WorldBatch:
        """Worlds of the domain, on the device."""
        part = drawn_worlds(self._alone, self._drawn, self.setting)
        worlds = soften_skins(part.worlds) if self.smooth else part.worlds
        return part._replace(worlds=jax.tree.map(jnp.asarray, worlds))

    def render(
        self,
        trajectory: State | Sequence[State],
        height: int = 240,  # [px]
        width: int = 320,  # [px]
        camera: str | None = None,
    ) -> Any:
        """Render images (height, width, 3) uint8 of states without a batch axis.

        The camera is oblique (the default) or above. One state gives one image.
        """
        if isinstance(trajectory, State):
            return self.render([trajectory], height, width, camera)[0]
        if not isinstance(trajectory, Sequence):
            raise errors.not_allowed("trajectory", repr(trajectory), "give one State or a list")
        images = []
        for index, states in itertools.groupby(trajectory, lambda s: int(s.info["index"])):
            shown = list(states)
            world: World = jax.device_get(shown[0].info["world"])
            poses, size = [np.asarray(s.data.qpos) for s in shown], (width, height)
            view, lines = camera or "oblique", world.task.lines()
            scene = drawn_scene(self._alone, self._drawn, self.setting.physics, index)
            images += video.images(
                scene,
                poses,
                p_world_target=world.p_world_target,
                lines=lines,
                size=size,
                camera=view,
            )
        return images


def _obs(obs: TaxelObservation | EndsObservation) -> Array:
    """Return the observation (n,) of `PushEnv`."""
    touch = obs.touch
    goal = planar.rotate(-touch.yaw, touch.p_world_target - touch.p_world_robot)
    parts = [obs.signal, goal]
    if touch.yaw_target is not None:
        parts.append(jnp.nan_to_num(planar.unit(jnp.asarray(touch.yaw_target) - touch.yaw)))
    if isinstance(obs, EndsObservation):
        parts += [obs.ends, obs.seen, obs.even[None], obs.alive]
    return jnp.concatenate([x.astype(goal.dtype) for x in parts])


def _metrics(current: Trial, measured: Measurement, progress: Array) -> dict[str, Array]:
    flags = {"in_contact": measured.reading.in_contact, "success": current.success}
    flags |= {"diverged": current.diverged}
    return {"progress": progress} | {k: v.astype(progress.dtype) for k, v in flags.items()}
