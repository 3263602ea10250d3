"""Do outcomes hang on who compiles the loop, and how much faster is it compiled here than by XLA?

The same worlds are swept twice, each time in a process of its own: the loop compiled here (`cc`, on
a GPU NVRTC), and by XLA, as where there is no compiler.

    rps sweeps/speed/compilers.py --machine "2 cores of an AMD EPYC"
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.record import provenance
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps import shared
from sweeps.shared import Study
from sweeps.speed.commands import TOLD, printed

_LIMIT = 3600.0  # [s] of a sweep
_COLUMNS = ("law", "skin", "worlds", "equal outcomes", "compiled here", "by XLA", "simulated s/s")


@dataclass(frozen=True)
class Compilers(Study[xr.Dataset]):
    """Compare sweeps whose loop was compiled here with sweeps that XLA compiled.

    The answer holds the share of equal outcomes, the rates of success, and simulated seconds in a
    second of both, for each skin.
    """

    TITLE: ClassVar[str] = "The loop compiled here, and by XLA"
    GROWS: ClassVar[tuple[str, ...]] = ("skins", "machine")

    law: str = "rps_tuned"
    """What decides."""
    skins: tuple[str, ...] = ("capacitive", "ideal")
    """Skins, as a domain has them."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of worlds of `wide`."""
    machine: str = ""
    """What it runs on, in words; with these the table is published."""
    file: str = "compilers"
    """Name of the data file."""

    def trials(self) -> int | None:
        """How many skins there are."""
        return len(self.skins)

    def answer(self, run: Run) -> xr.Dataset:
        """Sweep what was not swept before."""
        found = []
        for number, skin in enumerate(self.skins):
            found.append(run.part(skin, partial(_compared, self.law, skin, self.worlds)))
            run.report(Progress(number + 1, 0.0))
        whole: Any = xr.concat(found, "skin").assign_coords(skin=list(self.skins))
        if self.machine and run.folder is not None:
            path = Path(__file__).parent / "results" / f"{self.file}.json"
            columns = [{"name": one} for one in _COLUMNS]
            made = [provenance.signed(run.folder)]
            shared.publish(path, made, self.machine, columns, self.table(whole))
        return whole

    def intro(self, found: xr.Dataset) -> str:
        """Where it was compared."""
        return shared.machine()

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        """Outcomes and speeds of both."""
        return [Section("Outcomes and speeds", "", [list(_COLUMNS), *self.table(found)])]

    def table(self, found: xr.Dataset) -> list[list[str]]:
        """A row for each skin."""
        rows = []
        for skin in map(str, found.skin.values):
            one = {name: leaf.item() for name, leaf in found.sel(skin=skin).items()}
            rates = f"{one['rate_here']:,.0f} and {one['rate_xla']:,.0f}"
            rows.append([
                self.law, skin, f"{self.worlds:,}", f"{100 * one['equal']:.1f} %",
                f"{100 * one['here']:.1f} %", f"{100 * one['xla']:.1f} %", rates,
            ])  # fmt: skip
        return rows


compilers = call_of(Compilers)


def _compared(law: str, skin: str, worlds: int) -> xr.Dataset:
    """The same sweep compiled by both."""
    with tempfile.TemporaryDirectory() as folder:
        outcomes, rates = zip(
            *(_swept(law, skin, worlds, Path(folder), by) for by in (None, "none")), strict=True
        )
    here, xla = outcomes
    told = {
        "equal": float((here == xla).mean()),
        "here": float(here.mean()),
        "xla": float(xla.mean()),
        "rate_here": rates[0],
        "rate_xla": rates[1],
    }
    return xr.Dataset({name: ((), value) for name, value in told.items()})


def _swept(law: str, skin: str, worlds: int, folder: Path, by: str | None) -> tuple[Any, float]:
    """Which worlds are won, and simulated seconds in a second once all is compiled.

    Raises:
      InputError: the sweep failed.
    """
    chosen = {} if by is None else {"RPS_COMPILER": by}
    asked = f"sweep --laws {law} --domain wide,skin={skin} --worlds {worlds}"
    said, out = "", folder
    for number in range(2):  # the first compiles
        out = folder / f"run_{by}_{number}"
        words = ["-m", "rps_jax", *asked.split(), "--out", str(out)]
        said, _ = printed(words, asked, str(folder), _LIMIT, environment=chosen)
    if (told := TOLD.search(said)) is None:
        raise InputError(f"skins = {skin}: the sweep does not tell how long it ran.")
    return rps_jax.load(out).success.values, float(told.group(3))
