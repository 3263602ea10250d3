"""Do outcomes hang on who compiles the loop, and how much faster is it compiled here than by XLA?

The same worlds are swept twice, each time in a process of its own: the loop compiled here (`cc`, on
a GPU NVRTC), and by XLA, as where there is no compiler; or on a GPU, and on processors.

    rps sweeps/speed/compilers.py --machine "2 cores of an AMD EPYC"
    rps sweeps/speed/compilers.py --against cpu --worlds 4000 --machine "one NVIDIA H100"
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import programs
from sweeps.speed.commands import TIMING, printed
from sweeps.study_base import Study, Table

_LIMIT = 3600.0  # [s] of a sweep
# Which are compared: their names, and the environment and options of the second.
_PAIRS: dict[str, tuple[tuple[str, str], dict[str, str], str]] = {
    "xla": (("compiled here", "by XLA"), {"RPS_COMPILER": "none"}, ""),
    "cpu": (("on the GPU", "on processors"), {}, " --device cpu"),
}


@dataclass(frozen=True)
class Compilers(Study[xr.Dataset]):
    """Compare sweeps whose loop was compiled here with sweeps by XLA, or on processors.

    The answer holds the share of equal outcomes, the rates of success, and simulated seconds in a
    second of both, for each skin.
    """

    TITLE: ClassVar[str] = "The loop compiled here, and by XLA"
    GROWS: ClassVar[tuple[str, ...]] = ("skins", "file")

    law: str = "rps_tuned"
    """What decides."""
    skins: tuple[str, ...] = ("capacitive", "ideal")
    """Skins, as a domain has them."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of worlds of `wide`."""
    against: Literal["xla", "cpu"] = "xla"
    """With what the sweep as this machine runs it is compared: one by XLA, or on processors."""
    file: str = "compilers"
    """Name of the data file."""

    def num_trials(self) -> int | None:
        """How many skins there are."""
        return len(self.skins)

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep what was not swept before."""
        found = []
        for number, skin in enumerate(self.skins):
            found.append(run.checkpoint(skin, partial(self._compared, skin)))
            run.callback(Progress(number + 1, 0.0))
        whole: Any = xr.concat(found, "skin").assign_coords(skin=list(self.skins))
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return the comparison."""
        return {self.file: Table([self._columns, *self.table(results)])}

    def intro(self, results: xr.Dataset) -> str:
        """Where it was compared."""
        return programs.machine()

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Outcomes and speeds of both."""
        return [Section("Outcomes and speeds", "", [self._columns, *self.table(results)])]

    @property
    def _columns(self) -> list[str]:
        names, *_ = _PAIRS[self.against]
        return ["law", "skin", "worlds", "equal outcomes", *names, "simulated s/s"]

    def table(self, found: xr.Dataset) -> list[list[str]]:
        """A row for each skin."""
        rows = []
        for skin in map(str, found.skin.values):
            one = {name: leaf.item() for name, leaf in found.sel(skin=skin).items()}
            rates = f"{one['rate_here']:,.0f} and {one['rate_other']:,.0f}"
            rows.append([
                self.law, skin, f"{self.worlds:,}", f"{100 * one['equal']:.1f} %",
                f"{100 * one['here']:.1f} %", f"{100 * one['other']:.1f} %", rates,
            ])  # fmt: skip
        return rows

    def _compared(self, skin: str) -> xr.Dataset:
        """The same sweep by both."""
        _, environment, more = _PAIRS[self.against]
        asked = f"sweep --laws {self.law} --domain wide,skin={skin} --worlds {self.worlds}"
        with tempfile.TemporaryDirectory() as folder:
            here, rate_here = _swept(asked, Path(folder), "here", {})
            other, rate_other = _swept(asked + more, Path(folder), "other", environment)
        told = {
            "equal": float((here == other).mean()),
            "here": float(here.mean()),
            "other": float(other.mean()),
            "rate_here": rate_here,
            "rate_other": rate_other,
        }
        return xr.Dataset({name: ((), value) for name, value in told.items()})


compilers = call_of(Compilers)


def _swept(
    asked: str, folder: Path, name: str, environment: Mapping[str, str]
) -> tuple[Any, float]:
    """Which worlds are won, and simulated seconds in a second once all is compiled.

    Raises:
      InputError: the sweep failed.
    """
    said, out = "", folder
    for number in range(2):  # the first compiles
        out = folder / f"run_{name}_{number}"
        words = ["-m", "rps_jax", *asked.split(), "--out", str(out)]
        said, _ = printed(words, asked, str(folder), _LIMIT, environment=environment)
    if (told := TIMING.search(said)) is None:
        raise InputError(f"{asked} does not tell how long it ran.")
    return rps_jax.load(out).success.values, float(told.group(3))
