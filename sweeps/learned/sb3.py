"""PPO of Stable-Baselines3 in the environment `rps_jax/Push-v0`.

    pip install stable-baselines3  # in a separate environment: it installs PyTorch
    rps sweeps/learned/sb3.py --machine "two cores"

runs PPO for a minute of wall clock in one environment of `gymnasium.make`, and for another minute
in many worlds that step together. The vector environments of the library step one world at a time;
`Batched` adapts the one of `gymnasium.make_vec`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import InputError, Rules, Setting
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures.style import Figure, panel
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import Parts, Rows, Study, Table, records

_VARIABLES = {
    "time": {"units": "s", "long_name": "wall clock since learning began"},
    "steps": {"units": "1", "long_name": "steps of all worlds"},
    "episodes": {"units": "1", "long_name": "trials that ended since the previous row"},
    "reward": {"units": "1", "long_name": "mean sum of the rewards of these"},
    "success": {"units": "1", "long_name": "share of these that succeeded"},
}


@dataclass(frozen=True)
class SB3(Study[xr.Dataset]):
    """Learn by PPO of Stable-Baselines3 in worlds of Gymnasium, and publish its curves.

    The answer holds `time` [s], `steps`, `episodes`, `reward` and `success` (envs, row).
    """

    TITLE = "PPO of Stable-Baselines3"
    DIMENSION = "envs"

    domain: DomainLike = "wide,distance=0.7:1,bearing=-0.3:0.3"
    """Ranges from which worlds are drawn."""
    object: str = "random_cylinder"
    """Object of all worlds."""
    num_envs: tuple[int, ...] = option((1, 256), 1, 100_000)
    """Numbers of worlds that are stepped together; 1: the environment of gymnasium.make itself."""
    hold: float = option(0.5, above=0, at_most=60, unit="s")
    """How long an action is carried out [s]."""
    seconds: float = option(60.0, above=0, at_most=1e5, unit="s")
    """Wall clock of learning [s], without the compilation of the worlds."""
    rows: int = option(6, 1, 1000)
    """Number of rows of the curve."""
    setting: Setting = field(
        default=Setting(fidelity="fast", rules=Rules(horizon=60.0, max_lost=20.0)), kw_only=True
    )

    def check(self) -> None:
        """Check the domain, and that the libraries are there."""
        parse_domain(self.domain)
        for name in ("gymnasium", "stable_baselines3"):
            if not importlib.util.find_spec(name):
                raise InputError(
                    f"{name} is not installed: run pip install gymnasium stable-baselines3."
                )

    def parts(self, run: Run) -> Parts:
        """Return the function that learns with each number of worlds."""
        return {n: partial(self._learned, n) for n in self.num_envs}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the learning curves."""
        names = ("stable-baselines3", "torch", "gymnasium")
        versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
        note = f"{versions}; one run with one seed, with noise in the actions."
        picture = Picture("sb3", partial(figure_of, results))
        return [Table(table(results), note, (), "worlds", "sb3", "Curve", picture=picture)]

    def _learned(self, count: int) -> xr.Dataset:
        names = ("", ".common.vec_env", ".common.callbacks")
        sb3, vec, back = (importlib.import_module(f"stable_baselines3{name}") for name in names)
        gymnasium = importlib.import_module("gymnasium")
        name = "rps_jax.trials.gym:rps_jax/Push-v0"
        fields = ("object", "domain", "setting", "hold")
        options = {field: getattr(self, field) for field in fields}
        if count == 1:
            worlds = gymnasium.make(name, **options)
        else:
            envs = gymnasium.make_vec(name, num_envs=count, autoreset_mode="SameStep", **options)
            worlds = vec.VecMonitor(batched(vec.VecEnv, envs))
        options = {"n_steps": max(32, 512 // count), "batch_size": max(64, 8 * count)}
        options |= {"n_epochs": 10, "learning_rate": 1e-3, "policy_kwargs": {"log_std_init": -0.7}}
        model = sb3.PPO("MlpPolicy", worlds, seed=self.setting.seed, device="cpu", **options)
        learner = model.get_env()
        learner.reset()
        learner.step(np.zeros((count, 3), np.float32))  # compiles
        curve: list[list[float]] = []
        start_time, rows, ended = time.perf_counter(), self.rows, []
        interval = self.seconds / rows

        class Curve(back.BaseCallback):
            def _on_step(self) -> bool:
                infos = self.locals["infos"]
                ended.extend((i["episode"]["r"], i["is_success"]) for i in infos if "episode" in i)
                elapsed = time.perf_counter() - start_time
                if elapsed >= interval * (len(curve) + 1):
                    mean = np.mean(ended, axis=0) if ended else [np.nan] * 2
                    curve.append([elapsed, self.num_timesteps, len(ended), *mean])
                    ended.clear()
                return len(curve) < rows

        model.learn(10**9, callback=Curve())
        columns = zip(_VARIABLES.items(), np.transpose(curve), strict=True)
        return xr.Dataset({name: ("row", values, about) for (name, about), values in columns})


sb3 = call_of(SB3)


def batched(base: Any, envs: Any) -> Any:
    """Adapt a vector environment of Gymnasium, in the mode SameStep, to Stable-Baselines3."""

    class Batched(base):
        render_mode = None

        def __init__(self) -> None:
            super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

        def reset(self) -> np.ndarray:
            return envs.reset(seed=self._seeds[0])[0]

        def step_async(self, actions: np.ndarray) -> None:
            self._actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            obs, rewards, terminated, truncated, info = envs.step(self._actions)
            infos: list[dict[str, Any]] = [{} for _ in range(envs.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                infos[i] = {
                    "terminal_observation": info["final_obs"][i],
                    "TimeLimit.truncated": bool(truncated[i]),
                    "is_success": bool(info["final_info"]["is_success"][i]),
                }
            return obs, rewards.astype(np.float32), terminated | truncated, infos

        def close(self) -> None:
            envs.close()

        def get_attr(self, name: str, indices: Any = None) -> list[Any]:
            return [getattr(envs, name)] * envs.num_envs

        def set_attr(self, name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError

        def env_method(self, name: str, *args: Any, **kwargs: Any) -> list[Any]:
            raise NotImplementedError

        def env_is_wrapped(self, kind: Any, indices: Any = None) -> list[bool]:
            return [False] * envs.num_envs

    return Batched()


def table(results: xr.Dataset) -> Rows:
    """Return header and rows of the curve."""
    rows = [
        [
            "worlds",
            "wall clock",
            "steps of all worlds",
            "trials that ended",
            "reward of these",
            "success",
        ]
    ]
    for row in records(results, "envs", "row"):
        trials = int(row["episodes"])
        successes = round(row["success"] * trials) if trials else 0
        rows.append(
            [
                f"{row['envs']:,}",
                f"{row['time']:.0f} s",
                f"{int(row['steps']):,}",
                f"{trials:,}",
                f"{row['reward']:.2f}" if trials else "-",
                tables.share(successes, trials),
            ]
        )
    return rows


def figure_of(results: xr.Dataset) -> Figure:
    """Plot success over wall clock, with Wilson 95 % limits."""
    figure, ax = panel((6, 3.2), "wall clock [s]", "success [%]")
    for i, count in enumerate(results.envs.values):
        curve = results.sel(envs=count)
        rows = np.flatnonzero(curve.episodes.values > 0)
        time, trials = curve.time[rows], curve.episodes.values[rows].astype(int)
        successes = np.rint(curve.success.values[rows] * trials).astype(int)
        limits = [statistics.wilson(int(w), int(n)) for w, n in zip(successes, trials, strict=True)]
        ax.plot(time, 100 * successes / trials, "o-", color=f"C{i}", label=f"{count} at once")
        ax.fill_between(time, *100 * np.transpose(limits), color=f"C{i}", alpha=0.2, lw=0)
    ax.set_ylim(0, 100)
    ax.legend(title="worlds")
    return figure
