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
from sweeps.gradients.mjx_upstream import with_derivative
from sweeps.study_base import Parts, Study, Table

_BALL = """<mujoco><option timestep="{step}" cone="elliptic" iterations="100"/><default>
<geom solref="-1e5 -20" solimp="{solimp}" margin="{margin}"/></default><worldbody>
<geom type="plane" size="0 0 1"/><body pos="0 0 0.25"><freejoint/>
<geom type="sphere" size="0.05" mass="1"/></body></worldbody></mujoco>"""
_IMPEDANCES = {"default impedance": "0.9", "impedance from zero": "0"}
_WIDTH = 0.001  # [m] of the impedance
_AHEAD = 0.005  # [m] at which contacts act in the backward pass alone, as in DiffMJX
_PASSES = {"exact": 0.0, f"from {1e3 * _AHEAD:g} mm": _AHEAD}
CASES = {  # step [ms], impedance and distance of a bounce
    f"{step:g} ms, {name}, {backward}": (step, first, distance)
    for step in (2.0, 0.2)
    for name, first in _IMPEDANCES.items()
    for backward, distance in _PASSES.items()
}
_FALL, _TIME = 0.2, 0.35  # [m] of the ball, and [s] after which its height counts


@dataclass(frozen=True)
class Stiff(Study[xr.Dataset]):
    """Measure derivatives at stiff bounces.

    A ball falls by 0.2 m. The answer has the `mean` and the deviation `std` of the derivative of
    its later height by the first over starts within 2 cm, and the `slope` of a line through them
    (case). Derivatives are exact, or those of contacts that act from a distance along the same
    path.
    """

    TITLE: ClassVar[str] = "Derivatives of stiff contacts"
    DIMENSION: ClassVar[str] = "case"

    starts: int = option(256, 2, 100_000)
    """Number of starts."""

    def parts(self, run: Run) -> Parts:
        """Return the function that measures each case."""
        return {name: partial(self._bounce, *case) for name, case in CASES.items()}

    def _bounce(self, milliseconds: float, first: str, ahead: float) -> xr.Dataset:
        def model_of(first: str, margin: float) -> mujoco.MjModel:
            shape = f"{first} 0.95 {margin or _WIDTH} 0.5 2"
            xml = _BALL.format(step=milliseconds / 1e3, solimp=shape, margin=margin / 2)
            plain = mujoco.MjModel.from_xml_string(xml)
            plain.opt.tolerance, plain.opt.ls_iterations = 1e-15, 50
            return plain

        with jax.enable_x64(True):
            plain = model_of(first, 0.0)
            model, start = mjx.put_model(plain), mjx.make_data(plain)
            twin = mjx.put_model(model_of("0", ahead)) if ahead else None
            length = round(1e3 * _TIME / milliseconds)

            def step(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
                moved = mjx_gradients.step(model, data)
                if twin is not None:
                    felt = mjx_gradients.step(twin, data)
                    moved = moved.replace(
                        qpos=with_derivative(moved.qpos, felt.qpos),
                        qvel=with_derivative(moved.qvel, felt.qvel),
                    )
                return moved, None

            def last(height: jax.Array) -> jax.Array:
                data = start.replace(qpos=start.qpos.at[2].set(height))
                return jax.lax.scan(step, data, length=length)[0].qpos[2]

            heights = 0.05 + _FALL + np.linspace(-0.01, 0.01, self.starts)
            both = jax.jit(jax.vmap(lambda x: jax.jvp(last, (x,), (jnp.ones_like(x),))))
            heights_after, slopes = map(np.asarray, both(jnp.asarray(heights)))
        line = np.polyfit(heights, heights_after, 1)[0]
        return xr.Dataset({"mean": slopes.mean(), "std": slopes.std(ddof=1), "slope": line})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the derivatives at bounces."""
        names = {"mean": "mean", "std": "deviation", "slope": "slope"}
        formats = ({"name": name, "format": "{:.2g}"} for name in names.values())
        rows = [
            [*case.split(", "), *(float(results[x].sel(case=case)) for x in names)]
            for case in CASES
        ]
        words = ({"name": name, "merge": True} for name in ("steps", "contact"))
        columns = [*words, {"name": "derivatives"}, *formats]
        return [Table(rows, "", columns, name="gradients_stiff", title="Bounces")]


stiff = call_of(Stiff)
