"""The commands that tune: es, grad, compare."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import Device, Engine, Fidelity, Physics, Spread

if TYPE_CHECKING:
    from rps_jax.trials.setting import Progress
    from rps_jax.tuning.run import Course, Tuner
    from rps_jax.tuning.space import Space


@dataclass(frozen=True)
class TuneOptions(Spread):
    """What every tuner takes."""

    domain: tuple[str, ...] = ("wide",)
    """Domains to tune in: paper, hardware, wide, real, prisms, hostile, or JSON files of ranges."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects of these domains; random_prism is held out by default."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to tune: names, or logistic (eta, zeta, beta, k), or full (all that are the
    law's, not the robot's speeds, the rules or the switches)."""
    strategy: str = "rps"
    """What is tuned: rps, rps_plus, pursuit, force_push, force_push_published, dipole, or a law of
    a file with bounds, as my_law.py:MyParams; its own parameters are the start if that is paper.
    Gradients are of rps and rps_plus."""
    start: str = "paper"
    """Parameters to begin with: paper, tuned, or a JSON file of changes, as {"L": 0.3}."""
    worlds: int = 512
    """Number of worlds that each candidate meets, in each domain; every generation has its own."""
    validation: int = 512
    """Number of worlds for validation, in each domain."""
    risk: Literal["mean", "cvar"] = "mean"
    """The risk is the mean over all worlds, or (cvar) the mean over the worst tenth of them."""
    time_weight: float = 0.1
    """Score of a success that takes the whole horizon, where a failure scores 1 and more."""
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    horizon: float = 300.0
    """Time after which a trial has failed [s]."""
    budget: float = 0.0
    """Simulated time after which no generation begins [s]; 0 stands for no bound."""
    seed: int = 0
    """Seed of the proposals and of the worlds."""
    device: Device = "auto"
    quick: bool = False
    """Whether to make a small run of minutes on two cores. What is not asked for becomes small: a
    few parameters are tuned, for cylinders, in the quasi-static engine."""
    out: Path = Path("runs/tune")
    """Run folder; a run that was killed is continued there."""

    def space(self) -> Space:
        """The parameters that are tuned."""
        from rps_jax.tuning.space import Space, expanded

        base = parsing.start_of(self.strategy, self.start)
        return Space(expanded(self.tuned, base), base)

    def course(self) -> Course:
        """The worlds in which candidates are tried, and what is wanted of them there."""
        from rps_jax.runs.objective import Objective
        from rps_jax.trials.setting import Setting
        from rps_jax.trials.trial import Rules
        from rps_jax.tuning.run import Course
        from rps_jax.world.physics import preset

        domains = [parsing.domain_of(text) for text in self.domain]
        physics = preset(fidelity=self.fidelity)
        return Course(
            tuple(dataclasses.replace(one, objects=self.objects) for one in domains),
            self.worlds,
            self.validation,
            Setting(physics, Rules(horizon=self.horizon), engine=self.engine),
            Objective(self.risk, time=self.time_weight),
        )

    def quickly(self, **small: Any) -> Any:
        """The options with what is small, where nothing else than the default was asked for.

        Few parameters, those that matter most, since few trials tell no more; and cylinders on the
        quasi-static model, which compile and run fastest.
        """
        small |= {
            "tuned": ("K_h", "K_v", "l_cr", "d_th"),
            "objects": ("random_cylinder",),
            "engine": "quasistatic",
            "horizon": 150.0,
        }
        if self.strategy != "rps":  # whose parameters these are
            del small["tuned"]
        default = type(self)()
        free = {name for name in small if getattr(self, name) == getattr(default, name)}
        return dataclasses.replace(self, **{name: small[name] for name in free})

    def tune(self, search: Callable[..., Tuner], kind: Any) -> None:
        """Run a tuner that is made of a dataclass with some of these options."""
        from rps_jax import engines
        from rps_jax.control import strategies
        from rps_jax.tuning import run

        space, course, shape = self.space(), self.course(), self.shape()
        same = {f.name for f in dataclasses.fields(kind)} & set(self.__dict__)
        how = kind(**{name: getattr(self, name) for name in same})
        running.choose_device(self.device)
        families = [family for one in course.domains for family in one.families]
        engines.get(self.engine).check(families)
        engines.get(self.engine).check_senses(strategies.of(space.base).senses)
        tuner = search(how, space, course)
        out = run.open_run(self.out, tuner)
        with _watched(out, tuner.generations) as report:
            run.tune(out, tuner, report=report, **shape)
        _tell(out, space.names)


@dataclass(frozen=True)
class TuneES(TuneOptions):
    """Tune by evolution."""

    algorithm: Literal["cma", "lra_cma", "sep_cma", "xnes"] = "cma"
    """cma adapts a full covariance; lra_cma adapts its learning rates to noisy scores as well;
    sep_cma keeps to the axes; xnes follows the natural gradient."""
    population: int = 64
    """Number of candidates in a generation."""
    generations: int = 50
    """Number of generations, counted over all restarts."""
    spread: float = 0.5
    """Standard deviation of the first generation about the start, in units of the bounded map."""
    prior: float = 0.002
    """Price of a mean square of 1 between a candidate's coordinates and those of the start."""
    patience: int = 0
    """Number of generations without a better validation after which the search begins again
    elsewhere; 0 stands for never."""

    def run(self) -> None:
        """Tune, then write and print what was found."""
        from rps_jax.tuning.evolution import Evolution, Search

        small = {"worlds": 32, "validation": 64, "population": 12, "generations": 8}
        how = self.quickly(**small, spread=1.0, slots=64) if self.quick else self
        how.tune(Search, Evolution)


@dataclass(frozen=True)
class TuneGrad(TuneOptions):
    """Tune by gradients."""

    worlds: int = 64
    """Number of worlds of a step, in each domain; every step has its own."""
    validation: int = 128
    """Number of worlds for validation, in each domain."""
    estimator: Literal["reverse", "forward", "evolution", "combined"] = "reverse"
    """reverse differentiates windows through the quasi-static model, forward through the fused
    engine; evolution takes antithetic steps in whole trials; combined weighs reverse and evolution
    by their variances."""
    optimiser: str = "adam"
    """Name of an optimiser of optax that needs gradients alone."""
    learning_rate: float = 0.1
    """Learning rate of the first step, in units of the bounded map; it falls to zero along a
    cosine."""
    clip: float = 1.0
    """Bound on the norm of a gradient."""
    world_clip: float = 2.0
    """Bound on the norm of a single world's gradient, for reverse and forward, as a multiple of
    their median."""
    steps: int = 40
    """Number of steps of each descent."""
    starts: int = 4
    """Number of descents side by side, the first from the start itself."""
    spread: float = 0.5
    """Standard deviation of the places where the other descents begin."""
    window: float = 8.0
    """Length of a window of a softened trial, for reverse and forward [s]."""
    within: float = 100.0
    """Windows begin at random times up to this; with 0 they begin with the trials [s]."""
    sigma: float = 0.15
    """Standard deviation of the antithetic steps."""
    pairs: int = 8
    """Number of antithetic pairs for each descent."""

    def run(self) -> None:
        """Tune, then write and print what was found."""
        from rps_jax.tuning.descent import Descent, Search

        small = {"worlds": 64, "validation": 64, "steps": 8, "starts": 1, "learning_rate": 0.3}
        how = self.quickly(**small, slots=64) if self.quick else self
        how.tune(Search, Descent)


@contextlib.contextmanager
def _watched(out: Path, count: int) -> Iterator[Callable[[int, Progress], None]]:
    """The run folder in use, and a bar over generations or steps, for tuners to report to."""
    from tqdm import tqdm

    from rps_jax.record import folder, provenance

    running.use_cache()
    with folder.hold(out), tqdm(total=count, unit="generation", desc="compile") as bar:
        provenance.sign(out)

        def report(generation: int, progress: Progress) -> None:
            bar.set_description("tune", refresh=False)
            bar.set_postfix_str(
                f"{progress.finished} trials, {progress.simulated:.0f} s simulated", refresh=False
            )
            bar.update(generation - bar.n)

        yield report
        bar.update(count - bar.n)


def _tell(out: Path, names: Sequence[str]) -> None:
    """The figure of a tuner's run, and a few lines on the screen."""
    from rps_jax.analysis import figures
    from rps_jax.tuning.run import read_log

    log = read_log(out)
    figures.tuning_log(log, names, out / "tuning.png")
    first, last = log[0], min(log, key=lambda line: line["validation"])
    keys = ("compile", "run", "differentiate", "simulated")
    total = {key: sum(line.get(key, 0.0) for line in log) for key in keys}
    print(
        f"validation: {first['validation']:.4f} at the start, {last['validation']:.4f} after "
        f"{last['generation']} of {len(log)}; success {100 * first['validation_success']:.1f} % "
        f"and {100 * last['validation_success']:.1f} %\n"
        f"compile {total['compile']:.1f} s, run {total['run']:.1f} s, gradients "
        f"{total['differentiate']:.1f} s with their compilation, "
        f"{total['simulated']:.3g} s simulated\n"
        f"parameters: {out / 'tuned.json'}, for --params of rps tune compare and rps sweep\n"
        f"run folder: {out}"
    )


@dataclass(frozen=True)
class TuneCompare(Spread):
    """Compare sets of parameters in worlds kept for testing, which no tuner has seen."""

    params: tuple[str, ...] = ("paper", "tuned")
    """Sets of parameters of RPS: paper, tuned, or JSON files of changes, as {"L": 0.3}."""
    strategies: tuple[str, ...] = ("rps",)
    """What decides: rps, nps, aps, and laws of files, as my_law.py:MyParams; the sets of parameters
    are those of RPS and NPS."""
    domain: tuple[str, ...] = ("paper", "wide", "hostile", "prisms")
    """Domains, each a run of its own: paper, hardware, wide, real, hostile, prisms (those of wide),
    or JSON files of ranges."""
    worlds: int = 10000
    """Number of worlds of each domain; the paper's domain has its grid of 144."""
    physics: Physics = "default"
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    seed: int = 0
    """Seed whose worlds for testing are taken."""
    device: Device = "auto"
    out: Path = Path("runs/compare")
    """Run folder; a run that was killed is continued there."""

    def run(self) -> None:
        """Run what is missing in each domain, then write and print the reports."""
        from rps_jax.record import folder
        from rps_jax.runs import sweep
        from rps_jax.runs.evaluate import seed_of
        from rps_jax.runs.plan import Plan
        from rps_jax.trials.setting import Setting, progress_bar
        from rps_jax.world.physics import preset

        physics = preset(self.physics, self.fidelity)
        setting = Setting(physics, seed=seed_of(self.seed, "test"), engine=self.engine)
        arms = parsing.compared_arms(self.strategies, self.params)
        labels = parsing.labels_of("domain", self.domain)
        domains = dict(zip(labels, map(parsing.domain_of, self.domain), strict=True))
        plans = {
            name: Plan(one, one.combinations if one.targets else self.worlds, arms, setting, 4096)
            for name, one in domains.items()
        }
        shape = self.shape()
        running.choose_device(self.device)
        for plan in plans.values():
            plan.check_here()
        folder.writable(self.out)
        running.use_cache()
        for name, plan in plans.items():
            with progress_bar(plan.trials, name) as report:
                _, results = sweep.complete(self.out / name, plan, report=report, **shape)
            assert results is not None  # it is the whole
            print(f"## {name}\n")
            running.tell_sweep(self.out / name, plan, results)


@dataclass(frozen=True)
class Tune:
    """Tune the law's parameters in many worlds."""

    how: Annotated[
        Annotated[TuneES, tyro.conf.subcommand("es")]
        | Annotated[TuneGrad, tyro.conf.subcommand("grad")]
        | Annotated[TuneCompare, tyro.conf.subcommand("compare")],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> None:
        """Run the tuner, or the comparison."""
        self.how.run()
