"""The commands of random worlds: sweep, ladder, ceiling, merge, replay."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rps_jax import errors
from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import Device, Engine, Fidelity, Physics, Spread, Strategies
from rps_jax.app.cli.replicating import show
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from xarray import Dataset

    from rps_jax.runs.plan import Plan
    from rps_jax.trials.setting import Timing

Domain = Annotated[
    str,
    tyro.conf.arg(
        help=(
            "Ranges from which worlds are drawn: paper, hardware, wide, real (wide, but with "
            'limited robots), prisms or hostile, or a JSON file of ranges, as {"mass": [3, 60]}.'
        )
    ),
]


@dataclass(frozen=True)
class Sweep(Spread):
    """Push in many random worlds, every strategy in the same ones; the run can be continued."""

    domain: Domain = "wide"
    change: tuple[str, ...] = ()
    """Ranges to change, each as QUANTITY=LOW,HIGH (for instance mass=3,10)."""
    strategies: Strategies = ("rps", "nps", "aps")
    params: tuple[str, ...] = ("paper",)
    """Sets of parameters of RPS and NPS, each of which is run: paper, tuned, or JSON files of
    changes to the paper's, as {"L": 0.3}."""
    worlds: int | None = None
    """Number of worlds; by default 1000, or the whole grid of a domain with listed targets."""
    points: Path | None = None
    """Points of the domain's unit cube at which the worlds lie, instead of drawn ones: a NetCDF
    file of what rps_jax.worlds_at returned, as points.nc of a run folder."""
    robot: str | None = None
    """The robot: ideal, kairos (the paper's), ridgeback or mpo_500, or a JSON file of its limits.
    By default the domain's, which is ideal but in the domain real."""
    physics: Physics = "default"
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    horizon: float = 300.0
    """Time after which a trial has failed [s]."""
    seed: int = 0
    """Seed of the worlds."""
    part: int = 1024
    """Number of trials in a part: what is lost of each strategy and object when killed, at most."""
    device: Device = "auto"
    shard: str = "1/1"
    """Share K/N of the run: the N shares are run apart, and joined by `rps merge`."""
    ray: str | None = None
    """Run on the workers of a Ray cluster: auto, its HOST:PORT, or local (all of this host). Each
    worker claims a GPU, or else as many processors as --workers, one by default."""
    models: bool = False
    """Whether to run the same worlds on other grounds, cones and steps and in the quasi-static
    model, too, and to report how much the rates hang on these."""
    out: Path = Path("runs/sweep")
    """Run folder; a run that was killed is continued there."""

    def plan(self) -> Plan:
        """What is run."""
        from rps_jax.record import files
        from rps_jax.runs.plan import Plan
        from rps_jax.trials.setting import Setting
        from rps_jax.trials.trial import Rules
        from rps_jax.world import points
        from rps_jax.world.physics import preset

        domain = parsing.domain_of(self.domain, self.change, self.robot)
        every = domain.combinations if domain.targets else 1000
        arms = parsing.sweep_arms(self.strategies, self.params)
        physics = preset(self.physics, self.fidelity)
        setting = Setting(physics, Rules(horizon=self.horizon), self.seed, self.engine)
        count, at = every if self.worlds is None else self.worlds, None
        if self.points is not None:
            if self.worlds is not None:
                raise InputError("worlds is not allowed with points: the file says how many.")
            count, at = points.asked(domain, files.read(self.points))
        return Plan(domain, count, arms, setting, self.part, at)

    def run(self) -> None:
        """Run what is missing, then write and print the report."""
        from rps_jax.runs import sweep
        from rps_jax.trials.setting import progress_bar

        plan, shard, shape = self.plan(), parsing.shard_of(self.shard), self.shape()
        if self.ray:
            by = _on_cluster(self.ray, self.device)
        else:
            running.choose_device(self.device)
            plan.check_here()
            by = sweep.run_missing
        if self.models and (self.ray or shard.of > 1):
            raise InputError("models is not allowed with ray or a shard: run it in one process.")
        running.use_cache()
        with progress_bar(plan.trials_of(shard), "sweep") as report:
            timing, results = sweep.complete(self.out, plan, shard, by=by, report=report, **shape)
        models = None
        if self.models and results is not None:
            models = _on_models(self.out, plan, results, shape)
        running.tell_sweep(self.out, plan, results, timing, models)


@dataclass(frozen=True)
class Ladder(Spread):
    """Push with every law of the package in the same worlds, by what each law is told."""

    domain: Domain = "wide"
    laws: tuple[str, ...] = ()
    """Laws: all by default, or some of nps, "rps paper", "rps tuned", rps_plus, pursuit,
    force_push, force_push_published, aps, dipole, learned_gru, learned_mlp, and laws of files, as
    my_law.py:MyParams or policy.npz; pursuit=mine.json is pursuit with the values of a file."""
    worlds: int | None = None
    """Number of worlds; by default 1000, or the whole grid of a domain with listed targets."""
    robot: str | None = None
    """The robot: ideal, kairos (the paper's), ridgeback or mpo_500, or a JSON file of its limits.
    By default the domain's, which is ideal but in the domain real."""
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    seed: int = 0
    """Seed whose worlds for testing are taken."""
    device: Device = "auto"
    models: bool = False
    """Whether to run the same worlds on other grounds, cones and steps and in the quasi-static
    model, too, and to report how much the rates hang on these."""
    quick: bool = False
    """Whether to take 64 worlds where no number is asked for, of one kind of objects: minutes on
    two cores."""
    out: Path = Path("runs/ladder")
    """Run folder; a run that was killed is continued there."""

    def plan(self) -> Plan:
        """What is run."""
        from rps_jax.runs.evaluate import seed_of
        from rps_jax.runs.plan import Plan
        from rps_jax.studies import ladder
        from rps_jax.trials.setting import Setting
        from rps_jax.world.physics import preset

        domain = parsing.domain_of(self.domain, (), self.robot)
        usual = domain.combinations if domain.targets else 1000
        if self.quick:
            usual, domain = 64, dataclasses.replace(domain, objects=domain.objects[:1])
        laws = ladder.rungs(self.laws or tuple(ladder.RUNGS))
        seed = seed_of(self.seed, "test")
        setting = Setting(preset(fidelity=self.fidelity), seed=seed, engine=self.engine)
        return Plan(domain, usual if self.worlds is None else self.worlds, laws, setting)

    def run(self) -> None:
        """Run what is missing, then write and print the report."""
        from rps_jax.runs import sweep
        from rps_jax.studies import ladder
        from rps_jax.trials.setting import progress_bar

        plan, shape = self.plan(), self.shape()
        running.choose_device(self.device)
        plan.check_here()
        running.use_cache()
        with progress_bar(plan.trials, "ladder") as report:
            timing, results = sweep.complete(self.out, plan, report=report, **shape)
        models = None
        if self.models and results is not None:
            models = _on_models(self.out, plan, results, shape)
        running.tell_sweep(self.out, plan, results, timing, models, ladder.sections)


@dataclass(frozen=True)
class Ceiling:
    """Tell how many worlds of a sweep or a ladder can be won: a planner that knows them tries."""

    folder: tyro.conf.Positional[Path]
    """Run folder of the sweep or the ladder."""
    lost_by: tuple[str, ...] = ("rps tuned",)
    """Arms of it; worlds that they all lose are tried."""
    sample: int = 300
    """Number of worlds that are tried whoever won them: the first ones."""
    most: int | None = None
    """Number of lost worlds that are tried: the first of them; by default all."""
    samples: int = 64
    """Trials of a world in each round."""
    rounds: int = 12
    """Rounds after which a world counts as not won."""
    device: Device = "auto"
    quick: bool = False
    """Whether to try 4 worlds at most with 12 samples in 3 rounds: minutes on two cores."""
    out: Path | None = None
    """Run folder, continued if it was killed; by default RUN/ceiling."""
    spread: Annotated[Spread, tyro.conf.arg(name="")] = Spread()

    def run(self) -> None:
        """Run what is missing, then write and print the report."""
        from rps_jax.analysis.report import write_report
        from rps_jax.record.files import read_results
        from rps_jax.runs.plan import load_plan
        from rps_jax.studies import ceiling
        from rps_jax.trials.setting import progress_bar

        errors.check_count("sample", self.sample, at_least=0, at_most=10_000_000)
        if self.most is not None:
            errors.check_count("most", self.most, at_most=10_000_000)
        plan, results = load_plan(self.folder), read_results(self.folder)
        search = ceiling.Search(self.samples, self.rounds)
        numbers, _ = ceiling.chosen(results, self.lost_by, self.sample, self.most)
        if self.quick:
            search, numbers = ceiling.Search(12, 3), numbers[:4]
        running.choose_device(self.device)
        mine = ceiling.planned(plan.domain, numbers, plan.setting)
        out = self.folder / "ceiling" if self.out is None else self.out
        running.use_cache()
        with progress_bar(numbers.size * search.samples * search.rounds, "plan") as report:
            shape = self.spread.shape() | {"report": report}
            found = ceiling.complete(out, mine, numbers, search, **shape)
            timing = report.timing
        running.tell(timing)
        print(", ".join(f"{name} {value}" for name, value in ceiling.told(found).items()))
        sections = ceiling.sections(found, results, self.lost_by)
        print(write_report(out, "Ceiling", f"Worlds of {self.folder}.", sections).read_text())
        print(f"run folder: {out}")


def _on_models(out: Path, plan: Plan, results: Dataset, shape: dict[str, Any]) -> Dataset:
    """The same worlds on every other model, too, as `models.nc` beside the results."""
    from rps_jax.record import files
    from rps_jax.runs import models
    from rps_jax.runs.results import labelled
    from rps_jax.trials.setting import progress_bar

    others = len(models.plans(plan)) - 1
    with progress_bar(plan.trials * others, "models") as report:
        found = models.complete(plan, out, labelled(results), report=report, **shape)
    files.write_results(out / "models.nc", found)
    return found


def _on_cluster(address: str, device: str) -> Callable[..., Timing]:
    """What runs a plan on the workers of a cluster."""
    import jax

    from rps_jax.runs import cluster

    running.choose_device("cpu")  # for this process: the workers here need the GPUs
    return partial(
        cluster.run_on_cluster,
        address=address,
        prepare=partial(_prepare, device, bool(jax.config.jax_enable_x64)),
        gpus=device != "cpu",
    )


def _prepare(device: str, x64: bool) -> None:
    """Make a worker's process compute as this one would."""
    import jax

    running.be_deterministic()
    jax.config.update("jax_enable_x64", x64)
    running.choose_device(device)
    running.use_cache()


@dataclass(frozen=True)
class Merge:
    """Merge the shards of a sweep into one run folder, with results.nc and the report."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of the shards; one, if they share it."""
    out: Path
    """Run folder of the whole."""

    def run(self) -> None:
        """Merge, then write and print the report."""
        from rps_jax.record import folder, provenance
        from rps_jax.runs.results import merge

        if not self.folders:
            raise InputError("folders = () is not allowed: give the run folders of the shards.")
        folder.writable(self.out)
        plan, results = merge(list(self.folders), self.out)
        for one in self.folders:
            provenance.sign(self.out, provenance.signed(one))
        running.tell_sweep(self.out, plan, results)


@dataclass(frozen=True)
class Replay:
    """Run one world of a sweep again; draw it as in the paper's Fig. 6 and film it."""

    folder: tyro.conf.Positional[Path]
    """Run folder of the sweep."""
    index: tyro.conf.Positional[int]
    """Index of the world."""
    arm: str | None = None
    """Which of the sweep's strategies with parameters; by default the first."""
    video: bool = False
    """Whether to film the push."""
    film_length: float = 12.0
    """Length of the film [s], whatever the trial's."""
    out: Path | None = None
    """Folder of what is made; by default RUN/replay-INDEX."""

    def run(self) -> None:
        """Follow the world, then show it."""
        from rps_jax.record import folder
        from rps_jax.runs.push import check_length, chosen, replay
        from rps_jax.trials.setting import clock

        plan, name = chosen(self.folder, self.index, self.arm)
        tell_followed(self.folder, plan)
        check_length(self.film_length)
        out = folder.writable(self.out or self.folder / f"replay-{self.index}")
        running.use_cache()
        with clock(float(plan.setting.rules.horizon)) as report:
            seen = replay(self.folder, self.index, name, report=report)
        show(seen, f"world {self.index}, {name}", out, self.film_length if self.video else None)


def tell_followed(folder: Path, plan: Plan) -> None:
    """Say so if a world is followed in another engine than the run's."""
    from rps_jax.runs.plan import load_plan

    theirs = load_plan(folder).setting.engine
    if theirs != plan.setting.engine:
        print(
            f"Trials of the engine {theirs} cannot be followed: this is the same world in the "
            f"engine {plan.setting.engine}."
        )
