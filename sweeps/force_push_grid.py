"""Does our Force Push do on its authors' own ground what theirs did? 243 pushes of each slider.

    python sweeps/force_push_grid.py --out runs/force_push_grid

pushes the box and the cylinder of Heins and Schoellig (2024) along a straight path, by their law
and in their open loop, from every start of their grid; prints how many pushes succeed by their
criterion. It can be killed; the same command runs the laws and sliders that are missing.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rps_jax.analysis import tables
from rps_jax.app.cli.options import Device, Engine
from rps_jax.app.cli.running import choose_device, guarded, use_cache
from rps_jax.record import files, folder, provenance
from rps_jax.studies.replication import force_push_grid as grid
from rps_jax.trials.setting import progress_bar


@dataclass(frozen=True)
class Options:
    """Which pushes."""

    laws: tuple[grid.LawName, ...] = grid.LAWS
    """force_push, and open_loop, which only goes back to the path."""
    sliders: tuple[grid.SliderName, ...] = grid.SLIDERS
    """box, cylinder."""
    duration: float = grid.DURATION
    """Length of a push from its first contact on [s]."""
    engine: Engine = "fused"
    device: Device = "auto"
    out: Path = Path("runs/force_push_grid")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Push what is missing, then print and write the table."""
    choose_device(options.device)
    use_cache()
    out = folder.writable(options.out)
    trials = len(options.laws) * len(options.sliders) * grid.cells().angle.size
    with folder.hold(out), progress_bar(trials) as report:
        provenance.sign(out)
        found = grid.run(
            options.laws,
            options.sliders,
            options.engine,
            out,
            duration=options.duration,
            report=report,
        )
    files.write_results(out / "results.nc", found)
    text = tables.markdown(grid.table(found))
    files.write_text(out / "force_push_grid.md", text + "\n")
    print(text)
    print(f"compile {report.timing.compile:.0f} s, run {report.timing.run:.0f} s")


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
