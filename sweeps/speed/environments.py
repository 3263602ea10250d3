"""Speed of the programs of docs/environments.md: raw MJX, and the engines mjx and fused.

rps sweeps/speed/environments.py
rps sweeps/speed/environments.py --worlds 4096 --file environments_gpu
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import rps_jax
from rps_jax import Setting
from rps_jax.questions import Run, call_of, option
from sweeps.speed.study import best
from sweeps.study_base import Parts, SpeedStudy, Table, records, text_table

_ROOT = Path(__file__).parents[2]
_PAGE = _ROOT / "docs" / "environments.md"
_ROUNDS = 3  # of which the fastest counts
_COLUMNS = {
    "program": "{program}",
    "environments": "{worlds:,}",
    "control steps in a second": "{rate:,.0f}",
    "over raw MJX": "{factor:.1f}",
    "compile": "{compile:.0f} s",
    "gradient over forward": "{gradient:.1f}",
}


@dataclass(frozen=True)
class Environments(SpeedStudy[xr.Dataset]):
    """Compare the speed of the programs of the page on environments.

    The answer has the control steps in a second, `rate` (program), of all environments together;
    `compile` (program) [s]; and `gradient` (program), the time of a gradient by the law in reverse
    mode, with its own forward run, over that of a forward run of the same smooth pushes.
    """

    TITLE = "Speed of environments"
    DIMENSION = "program"
    GROWS = ("file", "programs")

    programs: tuple[Literal["raw MJX", "fused", "mjx"], ...] = ("raw MJX", "fused", "mjx")
    """Programs: raw MJX, and the engines fused and mjx."""
    worlds: int = option(256, 1, 1_000_000)
    """Number of environments."""
    steps: int = option(50, 2, 10_000)
    """Number of control steps."""
    gradient_worlds: int = option(64, 1, 1_000_000)
    """Number of environments of the gradient."""
    file: str = "environments"
    """Name of the data file."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each program."""
        engines = {x: partial(self._engine, x) for x in ("fused", "mjx")}
        return {name: ({"raw MJX": self._raw} | engines)[name] for name in self.programs}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the rates, their ratios, and the cost of gradients."""
        whole = results.assign(worlds=self.worlds, factor=results.rate / results.rate[0])
        note = f"Gradients are of {self.gradient_worlds} environments."
        rows = text_table(_COLUMNS, records(whole, "program"))
        return [Table(rows, note, name=self.file)]

    def _raw(self) -> xr.Dataset:
        code = re.findall(r"```python\n(.*?)```", _PAGE.read_text(), re.DOTALL)[0]
        sizes = f"n, steps, law = {self.worlds}, {self.steps},"
        names: dict[str, Any] = {}
        with contextlib.chdir(_ROOT):
            exec(code.replace("n, steps, law = 4, 50,", sizes).partition("\nposes =")[0], names)
        compiled, seconds = _timed(jax.vmap(names["push"]), *names["draws"])
        return self._results(compiled, seconds, np.nan)

    def _engine(self, name: str) -> xr.Dataset:
        setting, law = Setting(name), rps_jax.RPSParams.tuned()
        horizon = self.steps * setting.physics.control_period

        def distances(stage: Any, law: Any, world: Any, smooth: bool = False) -> jax.Array:
            options = {"horizon": horizon, "smooth": smooth}
            return rps_jax.rollout(world, law, stage, setting, **options).details.distance

        draw = partial(rps_jax.draw_worlds, "wide,objects=random_box", setting=setting)
        batch = draw(self.worlds)
        compiled, seconds = _timed(
            jax.vmap(partial(distances, batch.stage, law)), jax.tree.map(jnp.asarray, batch.worlds)
        )
        if name == "mjx":
            return self._results(compiled, seconds, np.nan)
        batch = draw(self.gradient_worlds)

        def total(law: Any, worlds: Any) -> jax.Array:
            push = partial(distances, batch.stage, law, smooth=True)
            return jnp.sum(jax.vmap(push)(worlds)[:, -1])

        inputs = jax.tree.map(jnp.asarray, (law, batch.worlds))
        (_, forward), (_, backward) = (_timed(f, *inputs) for f in (total, jax.grad(total)))
        return self._results(compiled, seconds, backward / forward)

    def _results(self, compiled: float, seconds: float, gradient: float) -> xr.Dataset:
        rate = self.worlds * self.steps / seconds
        return xr.Dataset({"rate": rate, "compile": compiled, "gradient": gradient})


environments = call_of(Environments)


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, float]:
    """Return the time of the first run [s], with the compilation, and that of the fastest [s]."""
    program = jax.jit(function)
    run = lambda: jax.block_until_ready(program(*arguments))  # noqa: E731
    return best(run, 1), best(run, _ROUNDS, math.inf)
