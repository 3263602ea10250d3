"""Derivatives of MJX at stiff bounces and after few iterations of the solver, in double precision.

rps sweeps/gradients/stiff.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import xarray as xr
from mujoco import mjx

from rps_jax.engines import mjx_gradients
from rps_jax.questions import Run, call_of, option
from sweeps.study_base import Parts, Study, Table

_BALL = """<mujoco><option timestep="{step}" cone="elliptic" iterations="{iterations}"/><default>
<geom solref="{solref}" solimp="{solimp}"/></default><worldbody><geom type="plane" size="0 0 1"/>
<body pos="0 0 {height}"><freejoint/><geom type="sphere" size="0.05" mass="1"/></body></worldbody>
</mujoco>"""
_DEFAULT, _FROM_ZERO = "0.9 0.95 0.001 0.5 2", "0 0.95 0.001 0.5 2"  # impedance
CASES = {  # step [ms] and impedance of a bounce; or a number of iterations
    **{"2 ms, default impedance": (2.0, _DEFAULT), "2 ms, impedance from zero": (2.0, _FROM_ZERO)},
    "0.2 ms, default impedance": (0.2, _DEFAULT),
    "0.2 ms, impedance from zero": (0.2, _FROM_ZERO),
}
ITERATIONS = (1, 2, 4, 8)
_FALL, _TIME = 0.2, 0.35  # [m] of the ball, and [s] after which its height counts


@dataclass(frozen=True)
class Stiff(Study[xr.Dataset]):
    """Measure derivatives at stiff bounces, and after few iterations of the solver.

    A ball falls by 0.2 m. The answer has the `mean` and the deviation `std` of the derivative of
    its later height by the first over starts within 2 cm, and the `slope` of a line through them
    (case); and the `error` (case) of the derivatives of a step of a sliding ball after few
    iterations, against central differences of the converged step, relative to the largest entry.
    """

    TITLE: ClassVar[str] = "Derivatives of stiff contacts"
    DIMENSION: ClassVar[str] = "case"

    starts: int = option(256, 2, 100_000)
    """Number of starts."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each case."""
        bounces = {name: partial(self._bounce, *case) for name, case in CASES.items()}
        return bounces | {f"{n} iterations": partial(self._few, n) for n in ITERATIONS}

    def _bounce(self, milliseconds: float, solimp: str) -> xr.Dataset:
        with jax.enable_x64(True):
            options = {"step": milliseconds / 1e3, "iterations": 100, "solref": "-1e5 -20"}
            model, start = _load(height=0.05 + _FALL, solimp=solimp, **options)
            length = round(1e3 * _TIME / milliseconds)

            def last(height: jax.Array) -> jax.Array:
                data = start.replace(qpos=start.qpos.at[2].set(height))
                step = partial(mjx_gradients.step, model)
                return jax.lax.scan(lambda d, _: (step(d), None), data, length=length)[0].qpos[2]

            heights = 0.05 + _FALL + np.linspace(-0.01, 0.01, self.starts)
            both = jax.jit(jax.vmap(lambda x: jax.jvp(last, (x,), (jnp.ones_like(x),))))
            ends, slopes = map(np.asarray, both(jnp.asarray(heights)))
        line = np.polyfit(heights, ends, 1)[0]
        return _row(mean=slopes.mean(), std=slopes.std(ddof=1), slope=line)

    def _few(self, iterations: int) -> xr.Dataset:
        with jax.enable_x64(True):
            options = {"step": 0.002, "solref": "0.02 1", "solimp": _DEFAULT, "height": 0.0499}
            few, start = _load(iterations=iterations, **options)
            many, _ = _load(iterations=100, **options)
            still = np.zeros(start.qvel.size)
            still[:2] = 0.5, 0.2

            def after(step: Any, model: Any, qvel: jax.Array) -> jax.Array:
                return step(model, start.replace(qvel=qvel)).qvel

            jacobian = np.asarray(
                jax.jit(jax.jacrev(partial(after, mjx_gradients.step, few)))(still)
            )
            sides = still + 1e-6 * np.concatenate([np.eye(still.size), -np.eye(still.size)])
            above, below = np.split(jax.vmap(partial(after, mjx.step, many))(sides), 2)
        slope = ((above - below) / 2e-6).T
        return _row(error=np.abs(jacobian - slope).max() / np.abs(slope).max())

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the derivatives at bounces, and the errors by iterations."""
        numbers = ({"name": name, "format": "{:.2g}"} for name in ("mean", "deviation", "slope"))
        bounces = [
            [
                *case.split(", "),
                *(float(results[x].sel(case=case)) for x in ("mean", "std", "slope")),
            ]
            for case in CASES
        ]
        few = [[n, float(results.error.sel(case=f"{n} iterations"))] for n in ITERATIONS]
        error = [{"name": "iterations"}, {"name": "error", "format": "{:.0e}"}]
        columns = [{"name": "steps"}, {"name": "contact"}, *numbers]
        named = {"name": "gradients_stiff", "title": "Bounces"}
        return [
            Table(bounces, "", columns, **named),
            Table(few, "", error, name="gradients_iterations", title="Iterations"),
        ]


def _load(**options: Any) -> tuple[mjx.Model, mjx.Data]:
    model = mujoco.MjModel.from_xml_string(_BALL.format(**options))
    model.opt.tolerance, model.opt.ls_iterations = 1e-15, 50
    return mjx.put_model(model), mjx.make_data(model)


def _row(**values: float) -> xr.Dataset:
    return xr.Dataset({x: values.get(x, np.nan) for x in ("mean", "std", "slope", "error")})


stiff = call_of(Stiff)
