"""What the runs of `rps learn` found, as a published table and a figure of their curves.

    python sweeps/learned.py runs/mlp runs/gru --device "one H200"

writes `sweeps/results/learned.json`, one row for each run, and draws each run's curve to
`notebooks/pictures/learned_NETWORK.png`.
"""

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from rps_jax import errors
from rps_jax.analysis import figures, statistics
from rps_jax.app.cli.running import guarded
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = (
    {"name": "network"},
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


@dataclass(frozen=True)
class Options:
    """Which runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of `rps learn`."""
    device: tuple[str, ...]
    """What they ran on, in words: one for all, or one for each."""


def row(folder: Path, device: str) -> list[Any]:
    """The row of a run: its law is the one that validated best."""
    curve, asked = files.read(folder / "curve.nc"), run_folder.manifest(folder)
    how, lessons = asked["how"], asked["lessons"]
    judged = curve.dropna("update", subset=["validation"])
    rates = judged.validation.values
    best = judged.isel(update=len(rates) - 1 - int(np.argmax(rates[::-1])))
    kinds = [name.removeprefix("random_") for name in lessons["objects"]]
    each = len(kinds) * len(lessons["domains"])
    tried, rate = lessons["validation"] * each, float(best.validation)
    ends = statistics.wilson(round(rate * tried), tried)
    return [
        f"`{how['network']}`",
        device,
        ", ".join(kinds),
        how["worlds"] * each,
        curve.sizes["update"],
        float(curve.simulated[-1]) / 3600,
        float(curve.attrs["compile"]),
        float(curve.time[-1]) / 60,
        [100 * rate, 100 * ends[0], 100 * ends[1], tried],
        float(best.validation_time),
    ]


def main(options: Options) -> None:
    """Gather, write and print."""
    errors.check_each_once("runs", options.runs)
    devices = options.device * (len(options.runs) if len(options.device) == 1 else 1)
    if len(devices) != len(options.runs):
        raise errors.InputError(
            f"device = {options.device} is not allowed: give one for all runs, or one for each."
        )
    rows = [row(folder, device) for folder, device in zip(options.runs, devices, strict=True)]
    made = [provenance.signed(folder) for folder in options.runs]
    last, known = made[-1], ("rps_jax", "jax", "mujoco", "mujoco-mjx")
    data = {
        "command": [f"rps {shlex.join(one['command'][1:])}" for one in made],
        "device": "; ".join(dict.fromkeys(devices)),
        "versions": {name: last["packages"][name] for name in known},
        "commit": last["commit"],
        "date": last["time"][:10],
        "note": "Validation: worlds of the domain that no update has met, by the rules of the "
        "paper, without noise in the actions; of each run the law that did best there, which "
        "flatters it. The interval is Wilson's.",
        "columns": list(COLUMNS),
        "rows": rows,
    }
    path = ROOT / "sweeps" / "results" / "learned.json"
    path.write_text(json.dumps(data, indent=1) + "\n")
    for folder, one in zip(options.runs, rows, strict=True):
        picture = ROOT / "notebooks" / "pictures" / f"learned_{one[0].strip('`')}.png"
        figures.learning_curve(files.read(folder / "curve.nc"), picture)
    print(path.read_text())


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options))))
