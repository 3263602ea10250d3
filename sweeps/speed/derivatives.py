"""Time of exact derivatives over the time of the trials themselves, by the same compilers.

Forward is the program that runs sweeps. A gradient is that of the sum of the final distances, by
reverse mode through all control steps, and includes its own forward run.

    rps sweeps/speed/derivatives.py --machine "2 cores of an AMD EPYC"
    rps sweeps/speed/derivatives.py --worlds 4096 --file derivatives_gpu --machine "one NVIDIA H200"
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import RPSParams, Setting
from rps_jax.control import registry
from rps_jax.engines import native
from rps_jax.laws import law_of
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.trial import ControlLoop, advance, start_all, unroll
from rps_jax.trials.worlds import Candidates, soften_skins
from rps_jax.worlds import parse_domain
from sweeps.speed.study import best
from sweeps.study_base import Parts, SpeedStudy, Table, records, text_table

_ROUNDS = 5  # of which the fastest counts
_COLUMNS = {
    "family": "{family}",
    "worlds": "{worlds:,}",
    "horizon": "{horizon:g} s",
    "forward": "{forward:.1f} ms",
    "gradient by the law": "{law:.1f} ms",
    "over forward": "{law_ratio:.1f}",
    "by law and worlds": "{all:.1f} ms",
    "over forward, all": "{all_ratio:.1f}",
    "compile": "{compile:.1f} s",
    "memory of a world and step": "{memory:.1f} kB",
    "finite": "{finite:.1f} %",
}


@dataclass(frozen=True)
class Derivatives(SpeedStudy[xr.Dataset]):
    """Compare the time of exact gradients with that of the trials, for each shape family.

    The results hold the times [s] of a forward run, of a gradient by the law's parameters and of
    one by all inputs, the time to compile one [s], its memory and the share of finite worlds.
    """

    TITLE = "Time of derivatives"
    DIMENSION = "family"
    GROWS = ("families", "file")

    families: tuple[Literal["box", "cylinder", "prism"], ...] = ("box", "cylinder")
    """Families of the objects: box, cylinder, prism."""
    worlds: int = option(64, 1, 1_000_000)
    """Number of worlds of `wide`."""
    horizon: float = option(8.0, 0.1, 300, unit="s")
    """Simulated time [s]."""
    file: str = "derivatives"
    """Name of the data file."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each family."""
        return {family: partial(self._measured, family) for family in self.families}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return times, ratios, memory and the share of finite gradients."""
        seconds = {name: 1e3 * results[name] for name in ("forward", "law", "all")}
        ratios = {f"{x}_ratio": results[x] / results.forward for x in ("law", "all")}
        whole = results.assign(**seconds, **ratios, worlds=self.worlds, horizon=self.horizon)
        return [Table(text_table(_COLUMNS, records(whole, "family")), name=self.file)]

    def _measured(self, family: str) -> xr.Dataset:
        setting, params = Setting("fused"), RPSParams.paper()
        domain = parse_domain(f"wide,objects=random_{family}")
        single = jax.tree.map(lambda x: np.asarray(x)[None], params)
        (batch,) = Candidates(single, [domain], 0, np.arange(self.worlds)).batches(setting)
        worlds = jax.tree.map(jnp.asarray, soften_skins(batch.worlds))
        repeated = jax.tree.map(lambda x: jnp.full(self.worlds, x, float), params)
        law = registry.smooth_law(law_of(params))
        loop = ControlLoop(setting.physics, law=law)
        steps = round(self.horizon / setting.physics.control_period)
        live = jnp.ones(self.worlds, bool)

        def forward(params: Any, worlds: Any) -> jax.Array:
            trials = start_all(worlds, params, live, law=law)
            return advance([(batch.stage, worlds, params, trials)], loop, steps)[0].qpos

        def score(params: Any, worlds: Any) -> jax.Array:
            trials = start_all(worlds, params, live, law=law)
            inputs = batch.stage, worlds, params, trials, loop, steps
            return jnp.sum(unroll(*inputs, native.mapped)[1].details.distance[-1])

        by_law = jax.grad(score)
        by_all = jax.grad(score, argnums=(0, 1), allow_int=True)
        results, times = {}, {}
        for name, function in (("forward", forward), ("law", by_law), ("all", by_all)):
            start = time.perf_counter()
            program = jax.jit(function).lower(repeated, worlds).compile()
            times[name] = time.perf_counter() - start
            results[name], times[f"run_{name}"] = _timed(program, repeated, worlds)
            usage: Any = program.memory_analysis()
            memory = usage.temp_size_in_bytes
        leaves = [np.asarray(x).reshape(self.worlds, -1) for x in jax.tree.leaves(results["law"])]
        finite = np.isfinite(np.concatenate(leaves, axis=1)).all(axis=1)
        return xr.Dataset(
            {
                **{name: times[f"run_{name}"] for name in ("forward", "law", "all")},
                "compile": times["all"],
                "memory": memory / self.worlds / steps / 1e3,
                "finite": 100 * finite.mean(),
            }
        )


derivatives = call_of(Derivatives)


def _timed(program: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the results of a program, and its fastest time [s]."""
    results = jax.block_until_ready(program(*arguments))
    return results, best(lambda: jax.block_until_ready(program(*arguments)), _ROUNDS, math.inf)
