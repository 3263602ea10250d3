"""How good is the gradient of each estimator, after how many seconds of simulation?

    python sweeps/gradient_quality.py --out runs/gradients

prints a table: cosine to finite differences, bias, standard error and the share of finite
derivatives, by estimator and horizon; and draws it. What was finished before it was killed stays.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from rps_jax.analysis import figures, tables
from rps_jax.app.cli.running import guarded, use_cache
from rps_jax.record import files
from rps_jax.studies import gradient_quality
from rps_jax.studies.gradient_quality import Study
from rps_jax.tuning.space import Space, expanded


@dataclass(frozen=True)
class Options:
    """Which gradients."""

    estimators: tuple[str, ...] = gradient_quality.ESTIMATORS
    """reverse, clipped (reverse with a bound in each world), forward, evolution or combined."""
    object: str = Study.object
    """random_box, random_cylinder or random_prism."""
    tuned: tuple[str, ...] = Study.space.names
    """Parameters to differentiate by, by name, or logistic, or full."""
    horizons: tuple[float, ...] = Study.horizons
    """Times after which the distance is looked at [s]."""
    worlds: int = Study.worlds
    """Of one estimate."""
    repeats: int = Study.repeats
    """Estimates, each in worlds of its own."""
    truth: int = Study.truth
    """Worlds of the finite differences."""
    engine: str = Study.engine
    """Of the truth, of forward mode and of evolution."""
    seed: int = Study.seed
    """Of the worlds."""
    out: Path = Path("runs/gradients")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run what is missing, then print and write the table and the figure."""
    study = Study(
        object=options.object,
        space=Space(expanded(options.tuned)),
        horizons=options.horizons,
        worlds=options.worlds,
        repeats=options.repeats,
        truth=options.truth,
        engine=options.engine,  # pyright: ignore[reportArgumentType]
        seed=options.seed,
    )
    out = options.out
    use_cache()
    with tqdm(total=len(options.estimators) + 1, unit="estimator") as bar:

        def report(name: str) -> None:
            bar.set_description(name)
            bar.update(bool(bar.desc))

        results = gradient_quality.run(study, out, options.estimators, report=report)
        bar.update(bar.total - bar.n)
    files.write_results(out / "results.nc", results)
    text = tables.markdown(gradient_quality.table(results))
    files.write_text(out / "quality.md", text + "\n")
    figures.gradient_quality(results, out / "quality.png")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
