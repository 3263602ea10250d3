"""Which ground is nearest to dry friction? Single pushes in C MuJoCo against a rigid object's.

    python sweeps/ground.py --out runs/ground

prints a table: how far objects end from where a rigid one would, the push force and its spread,
hops and tilts; and draws them. It can be killed; the same command continues.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.running import guarded
from rps_jax.record import files, folder, provenance
from rps_jax.studies import ground
from rps_jax.trials.setting import progress_bar


@dataclass(frozen=True)
class Options:
    """Which grounds to compare."""

    grounds: tuple[str, ...] = tuple(ground.GROUNDS)
    """Names of the grounds; by default all."""
    quick: bool = False
    """Whether to run only three of the grounds."""
    out: Path = Path("runs/ground")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run the grounds that are missing, then print, draw and write the table."""
    names = ground.QUICK if options.quick else options.grounds
    errors.check_each_once("grounds", names)
    for name in names:
        errors.check_name("ground", name, ground.GROUNDS)
    out = folder.writable(options.out)
    with folder.hold(out), progress_bar(ground.count(names)) as report:
        provenance.sign(out)
        results = ground.run(names, out, report=report)
    files.write_results(out / "results.nc", results)
    figures.grounds(results, ground.DRAWN, out / "ground.png")
    text = tables.markdown(ground.table(results))
    files.write_text(out / "ground.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
