"""How finely must the physics be solved? The paper's 432 trials against converged C MuJoCo.

    python sweeps/fidelity.py --out runs/fidelity

prints a table: successes, share of outcomes equal to the reference's, error of the object's place
after 5 s, and cost. It can be killed; the same command continues.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rps_jax import engines, errors
from rps_jax.analysis import tables
from rps_jax.app.cli.options import StudyOptions
from rps_jax.app.cli.running import guarded
from rps_jax.record import files
from rps_jax.studies import fidelity, study
from rps_jax.trials.setting import progress_bar
from rps_jax.world import paper


@dataclass(frozen=True)
class Options(StudyOptions):
    """Which settings of the solver to compare."""

    conditions: tuple[str, ...] = tuple(fidelity.CONDITIONS)
    """Names of the settings, the reference always among them; by default all that run everywhere:
    warp_standard and warp_fast (MJX-Warp) take an NVIDIA GPU."""
    out: Path = Path("runs/fidelity")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run the conditions that are missing, then print and write the table."""
    known = fidelity.CONDITIONS | fidelity.IN_WARP
    for name in options.conditions:
        condition = known[errors.check_name("condition", name, known)]
        engines.get(condition.setting.engine).check()
    names = tuple(dict.fromkeys([fidelity.REFERENCE, *options.conditions]))
    grid = study.Grid(strategies=paper.STRATEGIES, targets=options.targets())
    with options.opened() as out, progress_bar(len(names) * grid.size) as report:
        results = fidelity.run(names, grid, out, **options.shape(), report=report)
    files.write_results(out / "results.nc", results)
    text = tables.markdown(fidelity.table(results))
    files.write_text(out / "fidelity.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
