"""What the paper leaves open: its 144 RPS trials under one reading at a time.

    python sweeps/ambiguities.py --out runs/ambiguities

prints a table: successes with Wilson intervals, median time, and which differences from the
defaults are significant. It can be killed; the same command continues. `--gazebo` tests instead
whether the paper's simulator lost its trials, `--curve` runs skin tolerances.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.options import StudyOptions
from rps_jax.app.cli.running import guarded
from rps_jax.control.strategies import PARAMS
from rps_jax.record import files
from rps_jax.studies import study
from rps_jax.studies.replication import ambiguity
from rps_jax.trials.setting import progress_bar
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS


@dataclass(frozen=True)
class Options(StudyOptions):
    """Which readings to run."""

    readings: tuple[str, ...] = ()
    """Names of the readings; by default all."""
    gazebo: bool = False
    """The ingredients of the paper's simulator, with all three strategies."""
    curve: bool = False
    """Skin tolerances and behaviours on loss of contact."""
    strategies: tuple[str, ...] = ()
    """Laws; by default rps, and with --gazebo also nps and aps."""
    out: Path = Path("runs/ambiguities")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run the conditions that are missing, then print and write the table."""
    if options.gazebo and options.curve:
        raise errors.InputError("--gazebo and --curve are not allowed together: choose one.")
    known = ambiguity.READINGS
    known = ambiguity.GAZEBO if options.gazebo else known
    known = ambiguity.curve() if options.curve else known
    for name in options.readings:
        errors.check_name("reading", name, known)
    names = options.readings or tuple(known)
    if not options.curve:
        names = tuple(dict.fromkeys([ambiguity.DEFAULT, *names]))
    strategies = options.strategies or (paper.STRATEGIES if options.gazebo else ("rps",))
    for name in strategies:
        errors.check_name("strategy", name, PARAMS)
    grid = study.Grid(strategies=strategies, targets=options.targets())
    with options.opened() as out, progress_bar(len(names) * grid.size) as report:
        results = study.run(
            {name: known[name] for name in names}, grid, out, **options.shape(), report=report
        )
    files.write_results(out / "results.nc", results)
    found = [study.rows(results, names[0], strategy) for strategy in strategies]
    if options.gazebo and "paper_gazebo" in names and set(strategies) <= set(paper.STRATEGIES):
        found.append(ambiguity.cells(results))
    if options.curve and not options.readings and "rps" in strategies:
        curve = ambiguity.by_tolerance(results, ambiguity.TOLERANCES)
        trials = grid.size // len(PAPER_OBJECTS)
        figures.tolerance_curve(curve, trials, out / "tolerance.png")
    text = "\n\n".join(tables.markdown(rows) for rows in found)
    files.write_text(out / "table.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
