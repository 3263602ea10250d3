"""Published table and learning curves of runs of `rps learn`.

    rps sweeps/learned runs/mlp runs/gru --machine "one H200"

writes `results/learned.json` of this folder, one row for each run, which
`sweeps/render_tables.py` shows on its page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rps_jax import errors, load
from rps_jax.analysis import statistics
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.record import folder as run_folder
from rps_jax.record import provenance
from rps_jax.tuning import learn
from sweeps.study_base import Study, Table, write_table

COLUMNS = (
    {"name": "network"},
    {"name": "version"},
    {"name": "device"},
    {"name": "objects"},
    {"name": "worlds at once", "format": "{:,}"},
    {"name": "updates", "format": "{:,}"},
    {"name": "simulated", "format": "{:,.0f} h"},
    {"name": "compilation", "format": "{:.0f} s"},
    {"name": "in all", "format": "{:.1f} min"},
    {"name": "success in validation", "format": "{:.1f} %", "rest": " [{:.1f}, {:.1f}] of {:,}"},
    {"name": "time of a success", "format": "{:.0f} s"},
)
_NOTE = (
    "Validation: worlds of the domain that no update has met, by the rules of the paper, "
    "without noise in the actions; of each run the law that did best there, which "
    "flatters it. The interval is Wilson's."
)


@dataclass(frozen=True)
class Learned(Study[list[list[Any]]]):
    """Compare runs of `rps learn`: a table with one row per run, and their learning curves.

    The results are the rows.
    """

    TITLE = "A law learned from touch"

    runs: tuple[str, ...] = option((), positional=True)
    """Run folders of `rps learn`."""

    def check(self) -> None:
        """Check that there are runs, each once."""
        errors.check_each_once("runs", self.runs)

    def answer(self, run: Run) -> list[list[Any]]:
        """Collect the rows."""
        return [row(Path(folder)) for folder in self.runs]

    def publish(self, results: list[list[Any]], run_folder: Path) -> None:
        """Write the data file, with the commands of the runs."""
        runs = [provenance.read_environment(Path(folder)) for folder in self.runs]
        path = self.folder / self.RESULTS / "learned.json"
        write_table(path, runs, self.machine, Table(results, _NOTE, COLUMNS))

    def report_tables(self, results: list[list[Any]]) -> Sequence[Table]:
        """Return the rows, and the curve of each run."""
        tables = [Table(results, _NOTE, COLUMNS, title="Runs")]
        for folder, (network, *_) in zip(self.runs, results, strict=True):
            draw = partial(learn.figure_of, load(folder))
            picture = Picture(f"learned_{network.strip('`')}", draw)
            tables.append(Table((), title=str(folder), picture=picture))
        return tables


learned = call_of(Learned)


def row(folder: Path) -> list[Any]:
    """Return the row of a run, for the law with the best validation."""
    curve, manifest = load(folder), run_folder.read_manifest(folder)
    environment = provenance.read_environment(folder)
    judged = curve.dropna("update", subset=["validation"])
    rates = judged.validation.values
    best = judged.isel(update=len(rates) - 1 - int(np.argmax(rates[::-1])))
    names = [name for domain in manifest["domain"] for name in domain["objects"]]
    objects = [name.removeprefix("random_") for name in names]
    tried, rate = manifest["validation"] * len(objects), float(best.validation)
    interval = statistics.wilson(round(rate * tried), tried)
    return [
        f"`{manifest['network']}`",
        environment["packages"]["rps_jax"],
        f"{environment['device']['kind']}, {environment['processors']} processors",
        ", ".join(dict.fromkeys(objects)),
        manifest["num_envs"] * len(objects),
        curve.sizes["update"],
        float(curve.simulated[-1]) / 3600,
        float(curve.attrs["compile"]),
        float(curve.time[-1]) / 60,
        [100 * rate, 100 * interval[0], 100 * interval[1], tried],
        float(best.validation_time),
    ]
