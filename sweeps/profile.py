"""Where does the time of a control step go, on this machine?

    python sweeps/profile.py --families box prism --out runs/profile

runs programs of engines under XLA's profiler, and prints for each the functions of this package
whose operations take most of a control step.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from rps_jax import engines, errors
from rps_jax.analysis import tables
from rps_jax.app.cli.running import guarded
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.studies import benchmark, profile


@dataclass(frozen=True)
class Options:
    """Which programs."""

    names: tuple[str, ...] = ("fused standard",)
    """Engines and fidelities, as those of benchmark.py."""
    families: tuple[str, ...] = benchmark.FAMILIES
    """box, cylinder, prism."""
    worlds: int = 64
    """Batch."""
    steps: int = 20
    """Control steps that are timed."""
    most: int = 12
    """Functions of each program in the table."""
    out: Path = Path("runs/profile")
    """Run folder."""


def main(options: Options) -> None:
    """Profile each program; print and write where its time goes."""
    for name in options.names:
        errors.check_name("names", name, benchmark.BATCHED)
        engines.get(benchmark.BATCHED[name].engine).check(options.families)
    for family in options.families:
        errors.check_name("families", family, benchmark.FAMILIES)
    errors.check_count("worlds", options.worlds, at_most=10_000_000)
    errors.check_count("steps", options.steps, at_most=1000)
    errors.check_count("most", options.most, at_most=1000)
    run_folder.writable(options.out)
    every = [(name, family) for name in options.names for family in options.families]
    found = []
    for name, family in tqdm(every, unit="program"):
        found.append(profile.measure(name, family, options.worlds, steps=options.steps))
    whole = "\n".join(
        f"{p.name}, {p.family}: {1e6 * p.step:,.0f} us a control step of {p.worlds:,} worlds, "
        f"{1e6 * p.timed:,.0f} us in operations while the profiler ran."
        for p in found
    )
    text = (
        benchmark.machine() + whole + "\n\n" + tables.markdown(profile.table(found, options.most))
    )
    files.write_text(options.out / "profile.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
