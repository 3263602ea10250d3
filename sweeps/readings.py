"""How much do our choices matter? The paper's 144 RPS trials under one changed choice at a time.

    python sweeps/readings.py --out runs/readings

prints one row for each reading: successes with Wilson 95 % intervals for each object, and the
median time. A run folder keeps `readings.txt` and, for each reading, labelled results.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
import xarray as xr
from tqdm import tqdm

from rps_jax import errors, paper, record, scene, score, sweep
from rps_jax.cli import guarded, use_cache
from rps_jax.law import RPSParams
from rps_jax.scene import FRICTION, PHYSICS, Physics
from rps_jax.skin import CapacitiveSkin, IdealSkin
from rps_jax.sweep import Setting


@dataclass(frozen=True)
class Reading:
    """One change of what the defaults are."""

    what: str
    setting: Setting = Setting()
    params: RPSParams = RPSParams.paper()


def _physics(**changes) -> Setting:
    return Setting(physics=replace(Physics(), **changes))


READINGS = {
    "default": Reading("the defaults"),
    "timestep_5ms": Reading("physics step 5 ms instead of 10 ms", _physics(timestep=0.005)),
    "timestep_2ms": Reading("physics step 2 ms", _physics(timestep=0.002)),
    "solver_50_50": Reading(
        "50 solver and 50 line-search iterations instead of 10 and 14",
        _physics(iterations=50, ls_iterations=50),
    ),
    "solver_8_10": Reading("8 and 10 iterations", _physics(iterations=8, ls_iterations=10)),
    "solver_4_6": Reading("4 and 6 iterations", _physics(iterations=4, ls_iterations=6)),
    "pyramidal": Reading(
        "friction pyramid instead of the cone, 5 ms", Setting(physics=PHYSICS["pyramidal"])
    ),
    "period_50ms": Reading("control period 50 ms instead of 20 ms", _physics(control_period=0.05)),
    "tangent_as_printed": Reading(
        "tangent as printed (gamma_max = inf)", params=RPSParams(gamma_max=np.inf)
    ),
    "l_mr_5cm": Reading("l_mr = 0.05 m instead of 0.15 m", params=RPSParams(l_mr=0.05)),
    "a_r_max_5": Reading("a_r_max = 5 instead of 10", params=RPSParams(a_r_max=5.0)),
    "tolerance_3mm": Reading("skin tolerance 3 mm instead of 6 mm", Setting(skin=IdealSkin(0.003))),
    "tolerance_1mm": Reading("skin tolerance 1 mm", Setting(skin=IdealSkin(0.001))),
    "capacitive": Reading("capacitive skin of 42 taxels", Setting(skin=CapacitiveSkin())),
    "rear_far": Reading("load on the far left corner", Setting(rear="far")),
    "gap_5cm": Reading("initial gap 5 cm instead of 2 cm", Setting(gap=0.05)),
}


@dataclass(frozen=True)
class Options:
    """Which readings to run, and where to leave them."""

    readings: tuple[str, ...] = tuple(READINGS)
    """Names of the readings."""
    out: Path = Path("runs/readings")
    """Run folder."""
    slots: int | None = None
    """Worlds stepped at once by one worker; by default chosen by the device."""
    workers: int | None = None
    """Host threads; by default chosen by the device."""
    overwrite: bool = False
    """Allow a run folder that already holds a run."""


def run(reading: Reading, options: Options) -> tuple[str, xr.Dataset]:
    """One row of text and the labelled results of a reading."""
    cases = [
        sweep.Case(name, friction, target, reading.params)
        for name in scene.PAPER_OBJECTS
        for friction in FRICTION.values()
        for target in paper.TARGETS
    ]
    with tqdm(total=len(cases), unit="trial", desc=reading.what[:40], leave=False) as bar:
        outcome, _ = sweep.run(
            cases,
            reading.setting,
            slots=options.slots,
            workers=options.workers,
            report=lambda progress: bar.update(progress.finished - bar.n),
        )
    results = score.dataset(outcome, ["rps"], scene.PAPER_OBJECTS, tuple(FRICTION), paper.TARGETS)
    won = results.success.sum(("strategy", "target")).values
    cells = "  ".join(f"{row[0]:2d} {row[1]:2d}" for row in won)
    low, high = score.wilson(int(won.sum()), len(cases))
    time = results.time.values[results.success.values.astype(bool)]
    median = f"{np.median(time):5.1f}" if time.size else "  -  "
    share = f"{won.sum():3d} [{100 * low:3.0f}, {100 * high:3.0f}] %"
    diverged = int(results.diverged.sum())
    return f"{cells}  {share}  {median} s  {diverged:2d} diverged  {reading.what}", results


def main(options: Options) -> None:
    """Run the readings one after the other; each is kept as soon as it is done."""
    for name in options.readings:
        errors.check_name("reading", name, READINGS)
    out = record.prepare(options.out, overwrite=options.overwrite)
    use_cache()
    record.write_json(out / "environment.json", record.environment())
    record.write_json(
        out / "config.json", {"readings": {n: READINGS[n].what for n in options.readings}}
    )
    lines = ["successes of 24, S1 S2: box, cylinder, nonuniform box; of 144 with Wilson 95 %; time"]
    print(lines[0])
    for name in options.readings:
        row, results = run(READINGS[name], options)
        record.write_results(out / f"{name}.nc", results)
        lines.append(row)
        record.write_text(out / "readings.txt", "\n".join(lines) + "\n")
        tqdm.write(row, file=sys.stdout)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
