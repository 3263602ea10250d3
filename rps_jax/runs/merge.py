"""The shards of a sweep, joined into one run folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record import folder, provenance
from rps_jax.record.options import option
from rps_jax.runs import results, sweep
from rps_jax.runs.plan import load_plan
from rps_jax.runs.question import Question, Run, call_of, labelled
from rps_jax.trials.progress import Report


@dataclass(frozen=True)
class Merge(Question[xr.Dataset]):
    """Merge the shards of a sweep into one run folder, with its results and its report."""

    TITLE: ClassVar[str] = sweep.Sweep.TITLE

    folders: tuple[Path, ...] = option((), positional=True)
    """Run folders of the shards; one, if they share it."""
    out: Path | str | None = option(None, kw_only=True)
    """Run folder of the whole."""

    def check(self) -> None:
        """Check that there are shards, and where they go."""
        if not self.folders:
            raise InputError("folders = () is not allowed: give the run folders of the shards.")
        if self.out is None:
            raise InputError("out = None is not allowed: name the run folder of the whole.")

    def answered(self, report: Report) -> xr.Dataset:
        """Outcomes (law, world) of the whole."""
        return self.answer(self.run_in(Path(str(self.out)), report))

    def answer(self, run: Run) -> xr.Dataset:
        """Gather the parts of all shards."""
        out = folder.writable(Path(str(self.out)))
        _, found = results.merge([Path(one) for one in self.folders], out)
        for one in self.folders:
            provenance.sign(out, provenance.signed(Path(one)))
        return labelled(found)

    def intro(self, found: xr.Dataset) -> str:
        """What was asked."""
        return sweep.intro_of(load_plan(Path(str(self.out))))

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        """What a sweep reports."""
        return sweep.report_of(load_plan(Path(str(self.out))), found, run.folder)


merge = call_of(Merge)
