"""How fast is each engine, on this machine, in one run?

    python sweeps/benchmark.py --out runs/benchmark

prints a table: simulated seconds in a second of wall clock, by engine, shape family and batch, and
against C MuJoCo in a closed loop on all cores. A figure shows throughput against batch.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import jax
import tyro
from tqdm import tqdm

from rps_jax import benchmark, engines, errors, figures, record, score
from rps_jax.benchmark import Speed
from rps_jax.cli import guarded


@dataclass(frozen=True)
class Options:
    """What to time."""

    names: tuple[str, ...] = ()
    """Engines and fidelities; by default all that this machine can run."""
    families: tuple[str, ...] = benchmark.FAMILIES
    """box, cylinder."""
    worlds: tuple[int, ...] = (64, 512)
    """Batches."""
    out: Path = Path("runs/benchmark")
    """Run folder."""


def main(options: Options) -> None:
    """Time every combination, then print and write the table."""
    options = replace(options, names=options.names or benchmark.here())
    for name in options.names:
        errors.check_name("name", name, benchmark.NAMES)
        if name in benchmark.BATCHED:
            engines.check(benchmark.BATCHED[name].engine)
    for family in options.families:
        errors.check_name("family", family, benchmark.FAMILIES)
    for worlds in options.worlds:
        errors.check_finite("worlds", worlds, at_least=1)
    record.writable(options.out)
    speeds, text = [], ""
    for measure in tqdm(_measurements(options), unit="measurement"):
        speeds.append(measure())
        where = f"{jax.devices()[0].device_kind}, {os.cpu_count()} processors"
        text = f"On {where}.\n\n{score.markdown(benchmark.table(speeds))}"
        record.write_text(options.out / "benchmark.md", text + "\n")
    figures.throughput(speeds, options.out / "throughput.png")
    print(text)


def _measurements(options: Options) -> list[Callable[[], Speed]]:
    """C first, since the others are compared with it."""
    named = list(product(options.names, options.families))
    in_c = [partial(benchmark.in_c, n, f) for n, f in named if n in benchmark.IN_C]
    batched = [
        partial(benchmark.batched, n, f, worlds)
        for n, f in named
        if n in benchmark.BATCHED
        for worlds in options.worlds
    ]
    return [*in_c, *batched]


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
