"""Outcomes of a million worlds in one file, so that failures can be studied without a GPU.

    rps sweeps/random_worlds/million.py --machine "one NVIDIA H200"

runs three laws in the same 1,048,576 worlds of `wide` and writes `million.nc`: the end of each
trial, its time and its smallest distance to the target. `rps_jax.world.draws` computes the drawn
quantities again from the seed and the index of a world. More laws can be added to a run folder.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.analysis import statistics, tables
from rps_jax.laws import resolve_law
from rps_jax.questions import Plan, Run, call_of, option
from rps_jax.record import files
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.study_base import Rows, Table, TrialStudy, run_parts, run_plans

ENDS = ("success", *statistics.FAILURES)  # `how` is an index into these
UNTOUCHED = 65_535  # `missed` of an object that was never touched
_LONG_NAMES = {
    "success": "1 for success; eight worlds per byte, world 0 first (numpy.unpackbits)",
    "how": f"end of the trial: {', '.join(f'{i} {name}' for i, name in enumerate(ENDS))}",
    "steps": "control steps until the trial ended; `control_period` is the length of a step [s]",
    "missed": f"smallest distance of contact and target [mm]; {UNTOUCHED}: never touched",
}


@dataclass(frozen=True)
class Million(TrialStudy[xr.Dataset]):
    """Run laws in a million worlds, and store the end, time and smallest distance of each trial.

    The results hold `success` (law, byte), `how`, `steps` and `missed` (law, world).
    """

    TITLE = "A million outcomes"
    QUICK: ClassVar = {"worlds": 64}
    GROWS = ("laws",)

    laws: tuple[str, ...] = ("rps_tuned", "rps_plus", "learned")
    """Laws to run in the same worlds."""
    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn."""
    worlds: int = option(2**20, 1, 2**30)
    """Number of worlds."""
    setting: Setting = field(default=Setting("fused", seed=37), kw_only=True)

    def check(self) -> None:
        """Check that the laws and the domain exist."""
        _ = dict(map(resolve_law, self.laws))
        parse_domain(self.domain)

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return self.worlds * len(self.laws)

    @property
    def test_setting(self) -> Setting:
        """Setting with the seed of the test worlds."""
        return dataclasses.replace(self.setting, split="test")

    def answer(self, run: Run) -> xr.Dataset:
        """Run the laws that are missing."""
        parts = {law: partial(self._outcomes, law, run) for law in self.laws}
        results = run_parts(run, "law", parts, self.worlds)
        for name, long_name in _LONG_NAMES.items():
            results[name].attrs["long_name"] = long_name
        results.attrs = {
            "objects": " ".join(parse_domain(self.domain).objects),
            "control_period": self.setting.physics.control_period,
            "max_lost": float(self.setting.rules.max_lost),
        }
        return results

    def attributes(self) -> dict[str, str | int]:
        """Return the attributes of the results, with the seed of `draws.draw`."""
        return super().attributes() | {"seed": self.test_setting.world_seed}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the ends of each law's trials."""
        return [Table(table(results), name="million", title="Ends")]

    def publish(self, results: xr.Dataset, run_folder: Path) -> None:
        """Write the data file of the table, and all outcomes."""
        super().publish(results, run_folder)
        files.write_results(self.folder / "million.nc", packed(results))

    def _outcomes(self, law: str, run: Run) -> xr.Dataset:
        """Return the outcomes of one law in compact types."""
        laws = dict([resolve_law(law)])
        plan = Plan(parse_domain(self.domain), self.worlds, laws, self.test_setting, 16_384)
        (outcomes,) = run_plans(run, {f"sweep_{law}": plan}).values()
        outcomes = outcomes.isel(law=0)
        how = 1 + statistics.failure_modes(outcomes, float(self.setting.rules.max_lost))
        steps = np.rint(outcomes.time.values / self.setting.physics.control_period)
        distance = outcomes.min_distance.values
        millimetres = np.rint(1000 * np.nan_to_num(distance, posinf=0))
        missed = np.where(np.isfinite(distance), millimetres, UNTOUCHED)
        return xr.Dataset(
            {
                "success": ("byte", np.packbits(outcomes.success.values > 0)),
                "how": ("world", how.astype(np.uint8)),
                "steps": ("world", steps.astype(np.uint16)),
                "missed": ("world", np.minimum(missed, UNTOUCHED).astype(np.uint16)),
            }
        )


million = call_of(Million)


def packed(results: xr.Dataset) -> xr.Dataset:
    """Return the results with an encoding that compresses them."""
    for name in results:
        results[name].encoding = {"zlib": True, "complevel": 9, "shuffle": True}
    return results


def table(results: xr.Dataset) -> Rows:
    """Return a header and a row per law: its rate, its failures by kind, its median time."""
    rows = [["law", "success", *statistics.FAILURES, "median time of a success"]]
    for law in map(str, results.law.values):
        how = results.how.sel(law=law).values
        counts = np.bincount(how, minlength=len(ENDS))
        steps = results.steps.sel(law=law).values[how == 0]
        median = tables.median(steps * results.attrs["control_period"])
        rows.append([law, tables.rate(how == 0), *(f"{int(n):,}" for n in counts[1:]), median])
    return rows
