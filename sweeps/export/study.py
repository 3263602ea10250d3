"""Do the laws in C do what they do in JAX, and how fast? Chance inputs, trials and times.

rps sweeps/export --inputs 10000000
rps sweeps/export --inputs 0 --in-the-loop rps rps_plus
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.record import provenance
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.setting import Setting
from sweeps.export import native
from sweeps.shared import Study, publish

_LAWS = (
    *("rps", "rps_tuned", "nps", "rps_plus", "pursuit", "force_push", "force_push_published"),
    *("dipole", "aps", "learned_mlp", "learned_gru"),
)
_COLUMNS = ("inputs", "greatest", "beyond", "flips", "ill", "unexplained")
_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Export(Study[xr.Dataset]):
    """Compare the laws in C with those in JAX, and time them."""

    laws: tuple[str, ...] = _LAWS
    """Laws that are compared."""
    inputs: int = option(1_000_000, 0, 10**9)
    """Chance inputs of each law, in float and in double each."""
    in_the_loop: tuple[str, ...] = ()
    """Laws with which the paper's 144 trials are run in JAX and with C in the loop."""
    machine: str = ""
    """What it runs on, in words; with these the table is published."""

    TITLE = "Laws in C beside those in JAX"

    def answer(self, run: Run) -> xr.Dataset:
        """Compare law by law."""
        laws = self.laws if self.inputs else ()
        parts = [run.part(f"inputs-{law}", lambda law=law: self._compared(law)) for law in laws]
        found = xr.concat(parts, "law") if parts else xr.Dataset()
        if self.in_the_loop:
            found = found.merge(run.part("trials", self._tried))
        if self.machine and run.folder is not None and self.inputs:
            self._publish(found, run.folder)
        return found

    def _compared(self, law: str) -> xr.Dataset:
        with tempfile.TemporaryDirectory() as where:
            both = [
                native.agreement(law, precision, self.inputs, Path(where))
                for precision in ("float", "double")
            ]
            times = native.latency(law, Path(where))
        columns = {
            name: (("law", "precision"), [[float(getattr(one, name)) for one in both]])
            for name in _COLUMNS
        }
        return xr.Dataset(
            columns | {"latency": (("law", "share"), [times], {"units": "us"})},
            {"law": [law], "precision": ["float", "double"], "share": [0.5, 0.999]},
        )

    def _tried(self) -> xr.Dataset:
        with tempfile.TemporaryDirectory() as where:
            rows = native.ends(list(self.in_the_loop), Setting("fused"), Path(where))
        return xr.Dataset(
            {name: ("tried", [row[name] for row in rows]) for name in rows[0] if name != "law"},
            {"tried": list(self.in_the_loop)},
        )

    def _rows(self, found: xr.Dataset) -> list[list[Any]]:
        rows = []
        for law in found.law.values:
            one = found.sel(law=law)
            single, double = one.sel(precision="float"), one.sel(precision="double")
            rows.append(
                [
                    str(law),
                    float(double.greatest),
                    int(double.flips),
                    *(float(100 * single[k] / single.inputs) for k in ("beyond",)),
                    int(single.flips),
                    int(single.unexplained + double.unexplained),
                    *(float(one.latency.sel(share=share)) for share in (0.5, 0.999)),
                ]
            )
        return rows

    def _publish(self, found: xr.Dataset, out: Path) -> None:
        names = (
            ("law", "{}"), ("double: greatest error", "{:.1g}"), ("flips", "{}"),
            ("float: beyond 1e-6", "{:.2f} %"), ("flips", "{}"), ("unexplained", "{}"),
            ("median [us]", "{:.2f}"), ("99.9th percentile [us]", "{:.2f}"),
        )  # fmt: skip
        publish(
            _HERE / "results" / "export.json",
            [provenance.signed(out)],
            self.machine,
            [{"name": name, "format": text} for name, text in names],
            self._rows(found),
            f"{self.inputs} chance inputs of each law and precision; errors are shares of the "
            "greatest speed and turning rate.",
        )

    def report(self, found: Any, run: Run) -> Sequence[Section]:
        """Tables of both."""
        sections = []
        if "law" in found:
            head = ["law", "double: greatest error", "flips", "float: beyond 1e-6 [%]", "flips",
                    "unexplained", "median [us]", "99.9th percentile [us]"]  # fmt: skip
            rows = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row]
                    for row in self._rows(found)]  # fmt: skip
            sections.append(Section("Chance inputs, and times", "", [head, *rows]))
        if "tried" in found:
            names = [name for name in found if found[name].dims == ("tried",)]
            rows = [
                [str(law), *(f"{float(found[n].sel(tried=law)):g}" for n in names)]
                for law in found.tried.values
            ]
            sections.append(Section("The paper's trials", "", [["law", *map(str, names)], *rows]))
        return sections


export = call_of(Export)
