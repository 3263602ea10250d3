"""How fast is each engine, on this machine, in one run?

    python sweeps/benchmark.py --out runs/benchmark

prints a table: simulated seconds in a second of wall clock, by engine, shape family and batch, and
against C MuJoCo in a closed loop on all cores. A figure shows throughput against batch.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import tyro
from tqdm import tqdm

from rps_jax import engines, errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.running import guarded
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.studies import benchmark
from rps_jax.studies.benchmark import Speed


@dataclass(frozen=True)
class Options:
    """What to time."""

    names: tuple[str, ...] = ()
    """Engines and fidelities; by default all that this machine can run."""
    families: tuple[str, ...] = benchmark.FAMILIES
    """box, cylinder, prism."""
    worlds: tuple[int, ...] = (64, 512)
    """Batches."""
    mujocos: int = 16384
    """Largest batch of MJX and MJX-Warp."""
    at_once: int = 1
    """Programs compiled side by side; what compiling takes is that of a program alone only if 1."""
    refill: int = 64
    """Slots of each worker for the gain of refilling them; 0: not measured."""
    rounds: int = 4
    """How many trials there are then for each slot."""
    out: Path = Path("runs/benchmark")
    """Run folder."""


def main(options: Options) -> None:
    """Time every combination, then print and write the table."""
    options = replace(options, names=options.names or benchmark.here())
    for name in options.names:
        errors.check_name("name", name, benchmark.NAMES)
        if name in benchmark.BATCHED:
            engines.get(benchmark.BATCHED[name].engine).check()
    for family in options.families:
        errors.check_name("family", family, benchmark.FAMILIES)
    errors.check_count("refill", options.refill, at_least=0, at_most=1_000_000)
    errors.check_count("rounds", options.rounds, at_most=1000)
    for worlds in options.worlds:
        errors.check_count("worlds", worlds, at_most=10_000_000)
    errors.check_count("mujocos", options.mujocos, at_most=10_000_000)
    errors.check_count("at_once", options.at_once, at_most=1024)
    wanted = _wanted(options)
    if not any(wanted):
        raise errors.InputError(
            f"names = {options.names} with worlds = {options.worlds} leave nothing to time: MJX "
            f"and MJX-Warp are timed up to --mujocos {options.mujocos} worlds."
        )
    run_folder.writable(options.out)
    speeds, text = [], ""
    where = benchmark.machine()
    if options.refill:
        where += _refilling(options.refill, options.rounds)
    for speed in tqdm(
        _measured(wanted, options.at_once), total=sum(map(len, wanted)), unit="measurement"
    ):
        speeds.append(speed)
        text = where + tables.markdown(benchmark.table(speeds))
        files.write_text(options.out / "benchmark.md", text + "\n")
        points = [(s.family, s.name, s.worlds, s.rate) for s in speeds]
        figures.throughput(points, benchmark.IN_C, options.out / "throughput.png")
    print(text)


def _refilling(slots: int, rounds: int) -> str:
    gain = benchmark.refilling(slots, rounds)
    return (
        f"Refilled slots, {slots} a worker and {rounds} trials in each: {gain.refilled:,.0f} "
        f"simulated s/s, {gain.trials:,.1f} trials/s; batches that wait for their slowest: "
        f"{gain.waiting:,.0f}; gain {gain.refilled / gain.waiting:.2f}.\n\n"
    )


Wanted = tuple[list[tuple[str, str]], list[tuple[str, str, int]]]


def _wanted(options: Options) -> Wanted:
    """Names and families in C; and with their worlds, of what is batched."""
    named = [pair for pair in product(options.names, options.families) if benchmark.can(*pair)]
    in_c = [pair for pair in named if pair[0] in benchmark.IN_C]
    batched = [(*pair, n) for pair in named if pair[0] in benchmark.BATCHED for n in options.worlds]
    slow = [name for name, one in benchmark.BATCHED.items() if one.engine in ("mjx", "warp")]
    return in_c, [b for b in batched if b[0] not in slow or b[2] <= options.mujocos]


def _measured(wanted: Wanted, at_once: int) -> Iterator[Speed]:
    """C first, since the others are compared with it."""
    in_c, batched = wanted
    for name, family in in_c:
        yield benchmark.in_c(name, family)
    calls = [partial(benchmark.traced, n, benchmark.BATCHED[n], *rest) for n, *rest in batched]
    for program in benchmark.side_by_side(calls, at_once):
        yield benchmark.batched(program)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
