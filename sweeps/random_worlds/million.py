"""A million outcomes in one file, so that failures can be studied without a GPU.

    rps sweeps/random_worlds/million.py --machine "one NVIDIA H100"

pushes with three laws in the same 1,048,576 worlds of `wide`, and writes `million.nc`: how each
trial ended, when, and how near it came. What was drawn follows from seed and index, by
`rps_jax.world.draws`. A law is a part of the run folder, which may be asked for more laws later.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics, tables
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs import execution
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import Run, call_of, seed_of
from rps_jax.trials.setting import Setting
from rps_jax.world import domain as domains
from sweeps.study_base import Table, TrialStudy

ENDS = ("success", *statistics.FAILURES)  # numbers of `how`
UNTOUCHED = 65_535  # `missed` of an object that was never touched
_WORDS = {
    "success": "1 where the object arrived; eight worlds a byte, world 0 first (numpy.unpackbits)",
    "how": f"how the trial ended: {', '.join(f'{i} {name}' for i, name in enumerate(ENDS))}",
    "steps": "control steps until the trial ended; times `control_period` [s] they are its time",
    "missed": f"least distance of contact and target [mm]; {UNTOUCHED}: never touched",
}


@dataclass(frozen=True)
class Million(TrialStudy[xr.Dataset]):
    """Push in a million worlds, and keep of each trial how it ended, when and how near it came.

    The answer holds `success` (law, byte), `how`, `steps` and `missed` (law, world).
    """

    TITLE: ClassVar[str] = "A million outcomes"
    QUICK: ClassVar[dict[str, Any]] = {"worlds": 64}
    GROWS: ClassVar[tuple[str, ...]] = ("laws",)

    laws: tuple[str, ...] = ("rps_tuned", "rps_plus", "learned_gru")
    """Laws, which all meet the same worlds."""
    domain: str = "wide"
    """Ranges from which worlds are drawn."""
    worlds: int = option(2**20, 1, 2**30)
    """Number of worlds."""
    setting: Setting = field(default=Setting("fused", seed=37), kw_only=True)

    def check(self) -> None:
        """Check that the laws and the domain are known."""
        registry.resolve_laws(self.laws)
        domains.named(self.domain)

    def num_trials(self) -> int | None:
        """How many trials there are."""
        return self.worlds * len(self.laws)

    @property
    def seeded(self) -> Setting:
        """The setting with the seed of the worlds for testing."""
        return dataclasses.replace(self.setting, seed=seed_of(self.setting.seed, "test"))

    def answer(self, run: Run) -> xr.Dataset:
        """Push with the laws that are missing."""
        each = [run.checkpoint(law, partial(self._of, law, run)) for law in self.laws]
        found = xr.concat(each, xr.IndexVariable("law", list(self.laws)))
        for name, words in _WORDS.items():
            found[name].attrs["long_name"] = words
        ranges, seed = domains.named(self.domain), self.seeded.seed
        found.attrs = {
            "domain": self.domain,
            "seed": seed,
            "objects": " ".join(ranges.objects),
            "control_period": self.setting.physics.control_period,
            "max_lost": float(self.setting.rules.max_lost),
        }
        return found

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the rates of the laws."""
        return {"million": Table([HEADER, *table(results)])}

    def publish(self, results: xr.Dataset, run_folder: Path) -> None:
        """Write the data file of the table, and all outcomes."""
        super().publish(results, run_folder)
        files.write_results(self.folder / "million.nc", packed(results))

    def _of(self, law: str, run: Run) -> xr.Dataset:
        """Outcomes of one law, small."""
        laws = registry.resolve_laws([law])
        plan = Plan(domains.named(self.domain), self.worlds, laws, self.seeded, 16_384)
        folder = None if run.folder is None else run.folder / f"sweep_{law}"
        one = execution.run_plan(plan, folder, **run.batch_options).isel(law=0)
        won, off = one.success.values > 0, one.min_distance.values
        how = 1 + statistics.failure_modes(one, float(self.setting.rules.max_lost))
        steps = np.rint(one.time.values / self.setting.physics.control_period)
        missed = np.where(np.isfinite(off), np.rint(1000 * np.nan_to_num(off, posinf=0)), UNTOUCHED)
        return xr.Dataset(
            {
                "success": ("byte", np.packbits(won)),
                "how": ("world", how.astype(np.uint8)),
                "steps": ("world", steps.astype(np.uint16)),
                "missed": ("world", np.minimum(missed, UNTOUCHED).astype(np.uint16)),
            }
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """How the trials of each law ended."""
        return [Section("Ends", "", [HEADER, *table(results)])]


million = call_of(Million)

HEADER = ["law", "success", *statistics.FAILURES, "median time of a success"]


def packed(found: xr.Dataset) -> xr.Dataset:
    """The data with the encoding by which they are small in a file."""
    for name in found:
        found[name].encoding = {"zlib": True, "complevel": 9, "shuffle": True}
    return found


def table(found: xr.Dataset) -> list[list[str]]:
    """A row for each law: its rate, its failures by kind, its median time."""
    rows = []
    for law in map(str, found.law.values):
        how = found.how.sel(law=law).values
        counts = np.bincount(how, minlength=len(ENDS))
        steps = found.steps.sel(law=law).values[how == 0]
        median = f"{np.median(steps) * found.attrs['control_period']:.1f} s" if steps.size else "-"
        share = tables.share(int(counts[0]), how.size)
        rows.append([law, share, *(f"{int(n):,}" for n in counts[1:]), median])
    return rows
