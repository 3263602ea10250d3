"""Derivatives of MJX at stiff bounces, in double precision.

rps sweeps/gradients/stiff.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import xarray as xr
from mujoco import mjx

from rps_jax.engines import mjx_gradients
from rps_jax.questions import Run, call_of, option
from sweeps.study_base import Parts, Study, Table

_BALL = """<mujoco><option timestep="{step}" cone="elliptic" iterations="100"/><default>
<geom solref="-1e5 -20" solimp="{solimp}"/></default><worldbody><geom type="plane" size="0 0 1"/>
<body pos="0 0 0.25"><freejoint/><geom type="sphere" size="0.05" mass="1"/></body></worldbody>
</mujoco>"""
_DEFAULT, _FROM_ZERO = "0.9 0.95 0.001 0.5 2", "0 0.95 0.001 0.5 2"  # impedance
CASES = {  # step [ms] and impedance of a bounce
    **{"2 ms, default impedance": (2.0, _DEFAULT), "2 ms, impedance from zero": (2.0, _FROM_ZERO)},
    "0.2 ms, default impedance": (0.2, _DEFAULT),
    "0.2 ms, impedance from zero": (0.2, _FROM_ZERO),
}
_FALL, _TIME = 0.2, 0.35  # [m] of the ball, and [s] after which its height counts


@dataclass(frozen=True)
class Stiff(Study[xr.Dataset]):
    """Measure derivatives at stiff bounces.

    A ball falls by 0.2 m. The answer has the `mean` and the deviation `std` of the derivative of
    its later height by the first over starts within 2 cm, and the `slope` of a line through them
    (case).
    """

    TITLE: ClassVar[str] = "Derivatives of stiff contacts"
    DIMENSION: ClassVar[str] = "case"

    starts: int = option(256, 2, 100_000)
    """Number of starts."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each case."""
        return {name: partial(self._bounce, *case) for name, case in CASES.items()}

    def _bounce(self, milliseconds: float, solimp: str) -> xr.Dataset:
        with jax.enable_x64(True):
            plain = mujoco.MjModel.from_xml_string(
                _BALL.format(step=milliseconds / 1e3, solimp=solimp)
            )
            plain.opt.tolerance, plain.opt.ls_iterations = 1e-15, 50
            model, start = mjx.put_model(plain), mjx.make_data(plain)
            length = round(1e3 * _TIME / milliseconds)

            def last(height: jax.Array) -> jax.Array:
                data = start.replace(qpos=start.qpos.at[2].set(height))
                step = partial(mjx_gradients.step, model)
                return jax.lax.scan(lambda d, _: (step(d), None), data, length=length)[0].qpos[2]

            heights = 0.05 + _FALL + np.linspace(-0.01, 0.01, self.starts)
            both = jax.jit(jax.vmap(lambda x: jax.jvp(last, (x,), (jnp.ones_like(x),))))
            ends, slopes = map(np.asarray, both(jnp.asarray(heights)))
        line = np.polyfit(heights, ends, 1)[0]
        return xr.Dataset({"mean": slopes.mean(), "std": slopes.std(ddof=1), "slope": line})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the derivatives at bounces."""
        names = {"mean": "mean", "std": "deviation", "slope": "slope"}
        numbers = ({"name": name, "format": "{:.2g}"} for name in names.values())
        rows = [
            [*case.split(", "), *(float(results[x].sel(case=case)) for x in names)]
            for case in CASES
        ]
        columns = [{"name": "steps"}, {"name": "contact"}, *numbers]
        return [Table(rows, "", columns, name="gradients_stiff", title="Bounces")]


stiff = call_of(Stiff)
