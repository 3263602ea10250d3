"""Push force of random objects that are pushed straight ahead, beside Coulomb's mu m g.

rps sweeps/ground/straight.py --machine "one core of an AMD EPYC"
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Range, Twist
from rps_jax.engines.mujoco import Batch
from rps_jax.geometry.solid import GRAVITY
from rps_jax.physics import PHYSICS, ControlPeriod, EngineName, Motion, Physics, get_engine, preset
from rps_jax.questions import Run, call_of, option
from rps_jax.trials.worlds import starts
from rps_jax.world import points
from rps_jax.world.physics import MUJOCO_GROUND
from rps_jax.world.scene import WorldInputs
from rps_jax.worlds import parse_domain
from sweeps.ground.pushes import DISTANCE, GAP
from sweeps.study_base import QuickStudy, Rows, Table, run_parts, text_table

SPEED = 0.05  # [m/s] of the base, as of the laws
_SETTLE = 1.0  # [s] that objects stand before the push
_STEADY = 0.05  # [1] standard deviation over mean of a force without chatter, at most
_ZERO = Range(0, 0)
CENTRED = replace(
    parse_domain("wide"), com_offset=_ZERO, lateral=_ZERO, yaw=_ZERO, gap=Range(GAP, GAP)
)
FRICTIONS = ((0.1, 0.3), (0.3, 0.6), (0.6, 0.7))


class Kind(NamedTuple):
    """Ground, engine and speed of pushes."""

    what: str  # label
    physics: Physics
    engine: EngineName = "mujoco"
    speed: float = SPEED  # [m/s]


_STANDARD = preset()
_DAMPED = replace(_STANDARD, ground_solref=(0.1, 0.3), ground_impedance=0.7)
KINDS = {
    "reference": Kind("ours, 1 ms", preset(fidelity="reference")),
    "standard": Kind("ours, standard: 10 ms", _STANDARD),
    "fused": Kind("ours, standard: 10 ms, engine fused", _STANDARD, "fused"),
    "fast": Kind("ours, fast: 20 ms, damping ratio 0.3", preset(fidelity="fast")),
    "slow": Kind("ours, 10 ms, base at 2.5 cm/s", _STANDARD, speed=SPEED / 2),
    "impratio_1": Kind("ours, 10 ms, impratio 1", replace(_STANDARD, impratio=1.0)),
    "impratio_100": Kind("ours, 10 ms, impratio 100", replace(_STANDARD, impratio=100.0)),
    "lower": Kind("(0.1 s, 0.2), impedance 0.3, 10 ms", replace(_STANDARD, ground_impedance=0.3)),
    "damped": Kind("(0.1 s, 0.3), impedance 0.7, 10 ms", _DAMPED),
    "damped_fused": Kind("(0.1 s, 0.3), impedance 0.7, 10 ms, engine fused", _DAMPED, "fused"),
    "mujocos": Kind("MuJoCo's own, 2 ms", replace(_STANDARD, timestep=0.002, **MUJOCO_GROUND)),
}


@dataclass(frozen=True)
class Straight(QuickStudy[xr.Dataset]):
    """Push random objects straight ahead: `force` over mu m g and its `spread` (kind, world)."""

    TITLE = "Force of straight pushes"
    QUICK: ClassVar = {"worlds": 9, "kinds": ("standard", "lower")}
    CHOICES: ClassVar = {"kinds": KINDS}
    GROWS = ("kinds",)
    PRESETS: ClassVar = PHYSICS["default"]

    kinds: tuple[str, ...] = tuple(KINDS)
    """Names of the grounds; by default all."""
    worlds: int = option(600, 3, 100_000)
    """Number of objects."""
    seed: int = option(5, 0, 2**32 - 1)
    """Seed of the worlds."""

    def num_trials(self) -> int | None:
        """Return the number of pushes."""
        return len(self.kinds) * self.worlds

    def answer(self, run: Run) -> xr.Dataset:
        """Push on the grounds that are missing."""
        parts = {name: partial(self._pushed, KINDS[name]) for name in self.kinds}
        return run_parts(run, "kind", parts, self.worlds)

    def _pushed(self, kind: Kind) -> xr.Dataset:
        index = np.arange(self.worlds)
        force, spread, friction = np.zeros((3, self.worlds))
        for i, family in enumerate(CENTRED.families):
            rows = index[CENTRED.object_of(index) == i]
            drawn = points.draw(CENTRED, self.seed, None, rows)
            late = push(family, drawn, kind) / (drawn.friction.ground * drawn.solid.mass * GRAVITY)
            force[rows], spread[rows] = late.mean(axis=0), late.std(axis=0)
            friction[rows] = drawn.friction.ground
        spread /= np.where(force > 0, force, np.nan)  # an object that fell over has no force
        columns = {"force": force, "spread": spread, "friction": friction}
        return xr.Dataset({name: ("world", values) for name, values in columns.items()})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the share of pushes near mu m g, and the kind of the other deviations."""
        return [Table(table(results), name="straight", title="Straight pushes")]

    def intro(self, results: xr.Dataset) -> str:
        """Describe the pushes."""
        return (
            f"{self.worlds} boxes, cylinders and prisms of `wide` without an offset of the centre "
            f"of mass, pushed {DISTANCE:g} m straight ahead at {100 * SPEED:g} cm/s. The force is "
            "the mean over the second half, over mu m g. A steady force has a standard deviation "
            f"of at most {100 * _STEADY:g} % of its mean; any other one chatters."
        )


straight = call_of(Straight)


def push(family: str, drawn: Any, kind: Kind) -> np.ndarray:
    """Return push forces (steps, n) [N] of the second half of straight pushes, one each step.

    Objects of a draw (n,) settle first. A side of a prism is flush with the front of the base.
    """
    physics = replace(kind.physics, control_period=kind.physics.timestep)
    if family == "prism":
        drawn.values["yaw"] = yaw_of_side(drawn.solid.vertices)
    engine, qpos = get_engine(kind.engine), starts(drawn)
    stage, fields = engine.stage(WorldInputs(family, drawn.solid, drawn.friction, physics))
    count, pushed = len(qpos), round(DISTANCE / kind.speed / physics.timestep)
    speeds = np.repeat([0.0, kind.speed], [round(_SETTLE / physics.timestep), pushed])
    if engine.traced:
        still = jnp.zeros((count, 9))

        def step(motion: Motion, speed: jax.Array) -> tuple[Motion, jax.Array | None]:
            twists = Twist(jnp.full(count, speed), *jnp.zeros((2, count)))
            driven = stage.drive(fields, motion, ControlPeriod(twists, physics, force=True))
            return driven.motion, driven.force

        fields = jax.tree.map(lambda x: jnp.asarray(x, float), fields)
        start = Motion(jnp.asarray(qpos, float), still, still)
        force = jax.jit(lambda motion: jax.lax.scan(step, motion, jnp.asarray(speeds))[1])(start)
        return -np.asarray(force, float)[-(pushed // 2) :, :, 0]
    batch, rows, late = Batch(stage, qpos, 1), np.arange(count), []
    for speed in speeds:
        batch.drive(rows, np.tile([speed, 0.0, 0.0], (count, 1)), 1)
        late.append(-batch.force[:, 0])
    batch.close()
    return np.array(late[-(pushed // 2) :])


def yaw_of_side(vertices: np.ndarray) -> np.ndarray:
    """Return the least yaw (n,) [rad] at which a side of polygons (n, N, 2) faces the base.

    The centroid is in front of this side.
    """
    edge = np.roll(vertices, -1, axis=1) - vertices
    square = np.maximum((edge**2).sum(axis=-1), 1e-12)  # corners may be repeated
    along = -(vertices * edge).sum(axis=-1) / square
    turn = np.angle(-(edge[..., 1] + 1j * edge[..., 0]))
    turn = np.where((along > 0) & (along < 1), turn, np.inf)
    return np.take_along_axis(turn, np.abs(turn).argmin(axis=1)[:, None], axis=1)[:, 0]


_COLUMNS = {
    "ground": "{ground}",
    "within 5 %": "{near:.1f} %",
    "within 10 %": "{within:.1f} %",
    **{
        f"within 5 %, friction {low} to {high}": f"{{near_{i}:.1f}} %"
        for i, (low, high) in enumerate(FRICTIONS)
    },
    "off by 5 %, steady": "{steady:.1f} %",
    "off by 5 %, chatter": "{chatter:.1f} %",
    "force: 1, 50 and 99 %": "{low:.3f}, {median:.3f}, {high:.3f}",
    "spread at 95 %": "{spread:.2f}",
}


def table(results: xr.Dataset) -> Rows:
    """Return a header and a row per ground."""
    rows = []
    for name in map(str, results.kind.values):
        kind = results.sel(kind=name)
        force, spread, friction = (kind[x].values for x in ("force", "spread", "friction"))
        off, steady = np.abs(force - 1) > 0.05, spread <= _STEADY  # NaN chatters
        shares = {
            "near": ~off,
            "within": np.abs(force - 1) <= 0.1,
            "steady": off & steady,
            "chatter": off & ~steady,
        }
        row = {key: 100 * float(mask.mean()) for key, mask in shares.items()}
        for i, (low, high) in enumerate(FRICTIONS):
            row[f"near_{i}"] = 100 * float(np.mean(~off[(friction >= low) & (friction < high)]))
        row["low"], row["median"], row["high"] = map(float, np.quantile(force, (0.01, 0.5, 0.99)))
        rows.append(
            row | {"ground": KINDS[name].what, "spread": float(np.nanquantile(spread, 0.95))}
        )
    return text_table(_COLUMNS, rows)
