"""What is each choice for speed worth, on this machine?

    python sweeps/levers.py --name "mjx standard" --out runs/levers

changes one thing at a time about a program (its physics, what a step does, how it is compiled) and
times it in turns with the program as it is. Prints a table and draws it.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from rps_jax import engines, errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.running import guarded
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.studies import ablation, benchmark


@dataclass(frozen=True)
class Options:
    """Which program."""

    name: str = "mjx standard"
    """Engine and fidelity, as those of benchmark.py."""
    family: str = "box"
    """box, cylinder or prism."""
    worlds: int = 24
    """Batch."""
    simulated: float = 2.0
    """Of each world at a go [s]."""
    goes: int = 5
    """Of each program."""
    at_once: int = 1
    """Programs compiled side by side; what compiling takes is that of a program alone only if 1."""
    out: Path = Path("runs/levers")
    """Run folder."""


def main(options: Options) -> None:
    """Pull every lever; print, draw and write what it is worth."""
    errors.check_name("name", options.name, benchmark.BATCHED)
    errors.check_name("family", options.family, benchmark.FAMILIES)
    engines.get(benchmark.BATCHED[options.name].engine).check([options.family])
    errors.check_count("worlds", options.worlds, at_least=4, at_most=10_000_000)
    errors.check_finite("simulated", options.simulated, at_least=0.04, at_most=60, unit="s")
    errors.check_count("goes", options.goes, at_most=1000)
    errors.check_count("at_once", options.at_once, at_most=1024)
    run_folder.writable(options.out)
    total = 1 + len(ablation.levers(options.name, options.family))
    shape = {"goes": options.goes, "at_once": options.at_once, "simulated": options.simulated}
    pulled = ablation.measure(options.name, options.family, options.worlds, **shape)
    gains, text = [], ""
    for gain in tqdm(pulled, total=total, unit="lever"):
        gains.append(gain)
        text = benchmark.machine() + tables.markdown(ablation.table(gains))
        files.write_text(options.out / "levers.md", text + "\n")
        title = f"{options.name}, {options.family}"
        figures.levers({g.lever: g.times for g in gains}, title, options.out / "levers.png")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
