"""What does success depend on, and what does it cost in time and in the way driven?

    python sweeps/landscape.py --params paper tuned --out runs/landscape

varies each of the law's parameters alone, and looks for the undominated among candidates between
and around the sets of parameters; draws both and prints the front. Runs a few hundred candidates,
each in --worlds worlds of each domain: for a GPU.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.options import Spread
from rps_jax.app.cli.parsing import domain_of, labels_of, params_of
from rps_jax.app.cli.running import guarded, use_cache
from rps_jax.control.law import BOUNDS
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.studies import sensitivity
from rps_jax.trials.setting import progress_bar
from rps_jax.tuning.run import Course
from rps_jax.tuning.space import SUBSETS


@dataclass(frozen=True)
class Options(Spread):
    """Which parameters, where."""

    params: tuple[str, ...] = ("paper", "tuned")
    """Sets of parameters: paper, tuned, or JSON files (as {"L": 0.3})."""
    domain: tuple[str, ...] = ("wide",)
    """paper, hardware, wide, prisms, hostile, or JSON files of ranges."""
    worlds: int = 999
    """That each candidate meets, in each domain."""
    values: int = 9
    """Of each parameter."""
    candidates: int = 256
    """Between and around the sets."""
    spread: float = 0.5
    """Standard deviation around, in units of the bounded map."""
    seed: int = 0
    """Of worlds and candidates."""
    out: Path = Path("runs/landscape")
    """Run folder."""


def main(options: Options) -> None:
    """Run, draw and print."""
    for name in ("worlds", "values", "candidates"):
        errors.check_finite(name, getattr(options, name), at_least=2, at_most=1e6)
    errors.check_finite("spread", options.spread, at_least=0, at_most=10)
    labels = labels_of("params", options.params)
    sets = {label: params_of(name) for label, name in zip(labels, options.params, strict=True)}
    course = Course(tuple(domain_of(text) for text in options.domain))
    out = run_folder.writable(options.out)
    use_cache()
    files.write_json(out / "environment.json", provenance.environment())
    common: dict[str, Any] = {"worlds": options.worlds, "seed": options.seed} | options.shape()
    each = len(course.domains) * options.worlds
    varied = len(sets) * len(SUBSETS["full"]) * options.values
    with progress_bar(varied * each, "sensitivity") as report:
        found = sensitivity.sensitivity(sets, course, count=options.values, report=report, **common)
    files.write_results(out / "sensitivity.nc", found)
    log = [name for name, bound in BOUNDS.items() if bound.log]
    figures.sensitivity(found, log, out / "sensitivity.png")
    several: dict[str, Any] = {"candidates": options.candidates, "spread": options.spread}
    with progress_bar(2 * (options.candidates + len(sets)) * each, "front") as report:
        front = sensitivity.front(sets, course, report=report, **several, **common)
    files.write_results(out / "front.nc", front)
    figures.front(front, out / "front.png")
    text = tables.markdown(sensitivity.front_table(front))
    files.write_text(out / "front.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
