"""Gymnasium environments of pushing: one world, or many worlds in one program.

    import gymnasium
    import rps_jax.trials.gym  # registers rps_jax/Push-v0

    env = gymnasium.make("rps_jax/Push-v0", object="random_cylinder")
    envs = gymnasium.make_vec("rps_jax/Push-v0", num_envs=64, domain="wide,mass=3:10")

Both step a `PushEnv` and accept its options by name: object, setting, robot, params, weights and
worlds. `gymnasium.make("rps_jax.trials.gym:rps_jax/Push-v0")` needs no second import.

The second steps all worlds in one program, which is much faster than one process for each. Such
processes must be spawned, since JAX hangs in a forked one: `gymnasium.make_vec("rps_jax/Push-v0",
4, "async", vector_kwargs={"context": "spawn"})`.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import soft
from rps_jax.engines import device
from rps_jax.geometry.arrays import Array
from rps_jax.record.files import Arrays
from rps_jax.trials.env import SHAPED_REWARD, PushEnv, State
from rps_jax.trials.worlds import rows
from rps_jax.world import domain as domains
from rps_jax.world.domain import DomainLike

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise errors.not_installed("gymnasium", "gym") from error

Infos = dict[str, Any]
_SEEDS = 2**32  # of one word of a key


def _hold(env: PushEnv, steps: int, state: State, action: Array) -> tuple[State, Array]:
    """Hold an action for `steps` control steps; return the state and the sum of rewards."""

    def step(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], None]:
        state = env.step(carry[0], action)
        return (state, carry[1] + state.reward), None

    return jax.lax.scan(step, (state, jnp.zeros_like(state.reward)), length=steps)[0]


def _restart(env: PushEnv, key: Array) -> tuple[Array, State]:
    """Return the random stream after a restart, and the state at the start of its world."""
    key, world_key = jax.random.split(key)
    return key, env.reset(world_key)


class GymPush(gymnasium.Env[np.ndarray, np.ndarray]):
    """Push an unknown object to a target by touch: `gymnasium.make("rps_jax/Push-v0")`.

    Observation, Box (T + 2,) float32: the T taxels of the robot, the paper's 42, in the order of
    `Shell.taxels`, each the filtered relative change of its capacitance [1]; then the target (x, y)
    [m] in the robot frame (x ahead, y to the left), by odometry; of the task `path` it is the point
    of the path a lookahead ahead. The heading of a goal, and the ends of contacts of senses="ends",
    follow: see `PushEnv`.

    Action, Box (3,) float32 within -1 and 1: the twist (v_x, v_y, omega) in the robot's frame, in
    units of v_max [m/s], v_max and omega_max [rad/s] of `params`. It is held for `hold` [s]. A
    greater one is reduced: (v_x, v_y) to a norm of 1, omega to +-1. On a base that cannot move
    sideways, Box (2,): (v_x, omega).

    Reward [1]: `weights`, a `Reward` of `rps_jax.trials.env`; by default that of `rps learn`.

    Terminated: the object arrived or fell over, the physics diverged, or the task failed, as at the
    touch of a wall. Truncated: a time limit of
    the rules was reached, for the trial or for the time without contact.

    Info: `is_success`, `time` [s] since the start, `in_contact`, `world`, its index, and the
    outcomes of the task, as `progress` of a path; those without a value are left out.

    Raises:
      InputError: an option that `PushEnv` does not allow, a `hold` shorter than a control period,
        an action that is not finite or of another shape, or a step before `reset` or after the end
        of an episode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        domain: DomainLike = "wide",
        hold: float = 0.2,
        **options: Any,
    ):
        """Draw the worlds; nothing is compiled before the first reset."""
        self._vector = GymPushVector(
            1, render_mode, autoreset_mode="Disabled", domain=domain, hold=hold, **options
        )
        self.render_mode, self.push_env = render_mode, self._vector.push_env
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space
        self.metadata = self.metadata | {"render_fps": round(1 / self._vector.period) or 1}

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Start in a random world, which depends on the seed; there are no `options`."""
        if options:
            raise errors.not_allowed("options", options, "this environment has none")
        super().reset(seed=seed)
        obs, info = self._vector.reset(seed=seed)
        return obs[0], self._info(info)

    def step(self, action: object) -> tuple[np.ndarray, float, bool, bool, Infos]:
        """Execute an action (3,), or (2,) on a base that cannot move sideways."""
        *results, infos = self._vector.step([action])
        obs, reward, terminated, truncated = (values[0] for values in results)
        return obs, float(reward), bool(terminated), bool(truncated), self._info(infos)

    @staticmethod
    def _info(infos: Infos) -> Infos:
        """Return the infos of the only world that it has, without masks."""
        return {name: infos[name][0].item() for name in infos if infos.get(f"_{name}", [False])[0]}

    def render(self) -> Any:
        """Return an image (240, 320, 3) uint8 in the mode rgb_array, else None."""
        images = self._vector.render()
        return images and images[0]


class GymPushVector(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Batch of `GymPush` worlds: `gymnasium.make_vec("rps_jax/Push-v0", num_envs=64)`.

    Spaces, rewards and ends are those of `GymPush`, with a first axis of worlds. A trial that has
    ended restarts in another world, as `autoreset_mode` says. `NextStep`, the default, restarts it
    in the step after its last; that step ignores the action, and its reward is 0. `SameStep`
    restarts it at once and returns its last observation and info as `final_obs` and `final_info`.
    `Disabled` leaves that to `reset`.

    A world depends on its own seed alone: of `reset(seed=5)` world i has the seed 5 + i, and a list
    has one seed or None for each. `reset(options={"reset_mask": mask})` restarts the worlds of a
    mask (num_envs,) bool; the others go on, and their infos are masked.

    Raises:
      InputError: as `GymPush`, or another mode, seed or mask.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | Literal["NextStep", "SameStep", "Disabled"] = "NextStep",
        domain: DomainLike = "wide",
        hold: float = 0.2,
        **options: Any,
    ):
        """Draw the worlds; nothing is compiled before the first reset."""
        self.num_envs = errors.check_count("num_envs", num_envs, at_most=1_000_000)
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        errors.check_name("autoreset_mode", mode, [allowed.value for allowed in AutoresetMode])
        for name in options:
            known = (field.name for field in dataclasses.fields(PushEnv))
            errors.check_name("option", name, ("hold", *known))
        options = {"weights": SHAPED_REWARD} | options
        if render_mode is not None:
            errors.check_name("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.push_env = PushEnv(domain=domains.parse_domain(domain), **options)
        dt = self.push_env.dt
        hold = errors.check_finite("hold", hold, at_least=0.999 * dt, at_most=1000, unit="s")
        steps = max(1, round(hold / dt))
        self.period = steps * dt  # [s] of an action
        self.metadata = self.metadata | {"autoreset_mode": AutoresetMode(mode)}
        size = self.push_env.observation_size
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (self.push_env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, bool)
        self._keys: Array | None = None  # (num_envs,) random streams of the worlds
        self._state: State | None = None
        self._start = jax.jit(jax.vmap(partial(_restart, self.push_env)))
        self._act = jax.jit(jax.vmap(partial(_hold, self.push_env, steps)))
        self._select = jax.jit(jax.vmap(soft.tree_where))

    def start(self, where: np.ndarray | None = None) -> None:
        """Start random worlds, all of them or those of a mask (num_envs,)."""
        started = self._start(self._keys)
        if where is not None:
            started = self._select(where, started, (self._keys, self._state))
        self._keys, self._state = started

    @property
    def state(self) -> State:
        """States of all worlds; InputError before the first `reset`."""
        if self._state is None:
            raise errors.InputError("no episode has started: call reset before step and render.")
        return self._state

    def observe(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, Arrays]:
        """Return observations (num_envs, T + 2), terminated and truncated flags, and infos."""
        data, metrics = self.state.data, self.state.metrics
        infos = {
            "is_success": data.success,
            "time": data.steps * self.push_env.dt,
            "in_contact": metrics["in_contact"] > 0,
            "world": self.state.info["index"],
            **data.task.outcomes(),
        }
        infos = {name: np.array(values) for name, values in infos.items()}
        done, late = np.array(data.done), np.array(self.push_env.has_timed_out(data))
        return np.array(self.state.obs, np.float32), done & ~late, late, infos

    @device.standard_jax()
    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, object] | None = None,
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Start in random worlds, which depend on their seeds: all, or those of a `reset_mask`."""
        device.check_process()  # not at construction, where workers cannot report an error
        for name in options or {}:
            errors.check_name("option of reset", name, ["reset_mask"])
        where = self._checked_mask((options or {}).get("reset_mask"))
        if isinstance(seed, int | np.integer):
            errors.check_count("seed", seed, at_least=0, at_most=2**63)
            super().reset(seed=int(seed))
            seed = [int(seed) + i for i in range(self.num_envs)]
        self._seed(seed, where)
        self.start(None if where.all() else where)
        self._ended &= ~where
        obs, _, _, infos = self.observe()
        return obs, self._with_masks(infos, where)

    def _checked_mask(self, mask: object) -> np.ndarray:
        """Return the mask (num_envs,) of the worlds to reset, by default of all."""
        if mask is None:
            return np.ones(self.num_envs, bool)
        where = np.asarray(mask)
        if where.shape != (self.num_envs,) or where.dtype != bool or not where.any():
            kind = f"an array of shape ({self.num_envs},) and type bool"
            raise errors.not_allowed("reset_mask", mask, f"it must be {kind} with a true value")
        if self._state is None and not where.all():
            raise errors.not_allowed("reset_mask", mask, "the first reset must be of all worlds")
        return where

    def _seed(self, seeds: Any, where: np.ndarray) -> None:
        """Set the random streams of worlds in a mask; those without a seed go on with their own."""
        seeds = [None] * self.num_envs if seeds is None else seeds
        if np.shape(seeds) != (self.num_envs,):
            rule = f"give a whole number, or a list of {self.num_envs}"
            raise errors.not_allowed("seed", seeds, rule)
        known = np.array([seed is not None for seed in seeds])
        for seed in np.asarray(seeds, object)[known]:
            errors.check_count("seed", seed, at_least=0, at_most=_SEEDS**2 - 1)
        drawn = self.np_random.integers(_SEEDS, size=self.num_envs)
        values = [drawn[i] if s is None else int(s) for i, s in enumerate(seeds)]
        words = jnp.array([divmod(value, _SEEDS) for value in values], jnp.uint32)
        keys = jax.random.wrap_key_data(words, impl="threefry2x32")
        self._keys = keys if self._keys is None else jnp.where(known & where, keys, self._keys)

    @device.standard_jax()
    def step(self, actions: object) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Execute actions (num_envs, 3), or (num_envs, 2)."""
        device.check_process()
        mode = self.metadata["autoreset_mode"]
        same = mode is AutoresetMode.SAME_STEP
        if mode is AutoresetMode.DISABLED and self._ended.any():
            raise errors.InputError(
                f"the episodes of worlds {np.flatnonzero(self._ended).tolist()} have ended: call "
                "reset before step, in a vector with options={'reset_mask': ended}."
            )
        shape = (self.num_envs, self.push_env.action_size)
        array = errors.check_array("action", actions, shape, dtype=np.float32)
        self._state, rewards = self._act(self.state, array)  # 0 for trials that had ended
        if not same and self._ended.any():
            self.start(self._ended)
        obs, terminated, truncated, infos = self.observe()
        self._ended, final = terminated | truncated, {}
        if same and self._ended.any():
            last = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(self._ended):
                last[i] = obs[i]
            final = {"final_obs": last, "final_info": self._with_masks(infos, self._ended)}
            self.start(self._ended)
            obs, _, _, infos = self.observe()
        infos = self._with_masks(infos, np.ones(self.num_envs, bool))
        return (
            obs,
            np.asarray(rewards, float),
            terminated,
            truncated,
            infos | self._with_masks(final, self._ended),
        )

    def render(self) -> Any:
        """Return an image (240, 320, 3) uint8 of each world in the mode rgb_array, else None."""
        if self.render_mode is None:
            return None
        return tuple(self.push_env.render([rows(self.state, i) for i in range(self.num_envs)]))

    @staticmethod
    def _with_masks(infos: Infos, where: np.ndarray) -> Infos:
        """Return infos, each with the mask of the worlds that have it; none has NaN."""
        masks = {
            name: where & ~np.isnan(x) if np.asarray(x).dtype.kind == "f" else where.copy()
            for name, x in infos.items()
        }
        return dict(infos) | {f"_{name}": mask for name, mask in masks.items()}


if "rps_jax/Push-v0" not in gymnasium.registry:
    gymnasium.register("rps_jax/Push-v0", GymPush, vector_entry_point=GymPushVector)
