"""Do the engines agree in random worlds?

    python sweeps/engines.py --worlds 90 --out runs/engines

runs the same worlds in every engine that can run them here (MJX-Warp: on an NVIDIA GPU, and without
prisms, as with `--objects random_box random_cylinder`) and prints a table: success, and the share
of outcomes equal to those of converged C MuJoCo. It can be killed; the same command continues. `rps
sweep` runs one.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from rps_jax import engines, errors
from rps_jax.analysis import tables
from rps_jax.app.cli.options import Spread
from rps_jax.app.cli.parsing import domain_of
from rps_jax.app.cli.running import guarded, use_cache
from rps_jax.record import files
from rps_jax.runs import sweep
from rps_jax.runs.sweep import Plan
from rps_jax.trials.setting import Setting, progress_bar
from rps_jax.world import paper
from rps_jax.world.physics import preset

# The first is what the others are compared with.
ENGINES = {
    "C, reference": Setting(preset(fidelity="reference"), engine="mujoco"),
    "C, standard": Setting(preset(), engine="mujoco"),
    "fused, standard": Setting(preset(), engine="fused"),
    "fused, 5 ms": Setting(replace(preset(), timestep=0.005), engine="fused"),
    "fused, 2 ms": Setting(replace(preset(), timestep=0.002), engine="fused"),
    "fused, fast": Setting(preset(fidelity="fast"), engine="fused"),
    "quasistatic": Setting(preset(), engine="quasistatic"),
    "MJX, standard": Setting(preset(), engine="mjx"),
    "MJX-Warp, standard": Setting(preset(), engine="warp"),
}


@dataclass(frozen=True)
class Options(Spread):
    """Which worlds."""

    domain: str = "wide"
    """paper, hardware, wide, prisms or hostile, or a JSON file of ranges."""
    objects: tuple[str, ...] = ()
    """Objects to push, as random_box random_cylinder; by default the domain's."""
    engines: tuple[str, ...] = ()
    """Engines and physics by name, the first to be compared with; by default all that run here."""
    strategy: str = "rps"
    """rps, nps or aps."""
    worlds: int = 90
    """How many."""
    part: int = 256
    """Trials of a part: the most that is lost when killed. C waits for the slowest of each."""
    out: Path = Path("runs/engines")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run what is missing, then print and write the table."""
    domain = domain_of(options.domain)
    domain = replace(domain, objects=options.objects or domain.objects)
    errors.check_name("strategy", options.strategy, paper.PARAMS)
    arms = {options.strategy: paper.PARAMS[options.strategy]}
    for name in options.engines:
        setting = ENGINES[errors.check_name("engines", name, ENGINES)]
        engines.get(setting.engine).check(domain.families)
    here = (n for n, s in ENGINES.items() if engines.get(s.engine).works(domain.families))
    plans = {
        name: Plan(domain, options.worlds, arms, ENGINES[name], options.part)
        for name in options.engines or here
    }
    shape = options.shape()
    use_cache()
    found = {}
    for name, plan in plans.items():
        folder = options.out / name.replace(", ", "_")
        with progress_bar(plan.trials, name) as report:
            sweep.complete(folder, plan, report=report, **shape)
        found[name] = files.read_results(folder).isel(arm=0)
    text = tables.markdown(tables.agreement_table(found))
    files.write_text(options.out / "engines.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
