"""The commands that ask where a law fails: sensitivity, rare, attack, regress."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rps_jax import errors
from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import Device, Engine, Fidelity, Physics, Spread
from rps_jax.app.cli.sweeping import Domain

if TYPE_CHECKING:
    from xarray import Dataset

    from rps_jax.analysis.report import Section
    from rps_jax.control.strategies import Params
    from rps_jax.studies.failures import rare as rares
    from rps_jax.studies.failures.attack import Hunt
    from rps_jax.trials.setting import Report, Setting
    from rps_jax.world.domain import Domain as Ranges


@dataclass(frozen=True)
class Failing(Spread):
    """What the searches for failures have in common."""

    domain: Domain = "wide"
    change: tuple[str, ...] = ()
    """Ranges to change, each as QUANTITY=LOW,HIGH (for instance mass=3,10)."""
    strategy: str = "rps"
    """The law: rps, nps, rps_plus or another of the package, or one of a file, as
    my_law.py:MyParams."""
    params: str = "tuned"
    """Parameters, if the law is RPS: paper, tuned, or a JSON file of changes, as {"L": 0.3}."""
    robot: str | None = None
    """The robot: ideal, kairos, ridgeback or mpo_500, or a JSON file; by default the domain's."""
    physics: Physics = "default"
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    horizon: float = 300.0
    """Time after which a trial has failed [s]."""
    seed: int = 0
    """Seed of the search, whose worlds are points of its own."""
    device: Device = "auto"

    def law(self) -> tuple[str, Params]:
        """The law that is tried, and what it is called."""
        ((name, params),) = parsing.compared_arms((self.strategy,), (self.params,)).items()
        return (f"rps {name}" if self.strategy == "rps" else name), params

    def ranges(self) -> Ranges:
        """The domain with its changes."""
        return parsing.domain_of(self.domain, self.change, self.robot)

    def setting(self) -> Setting:
        """What all trials share."""
        from rps_jax.trials.setting import Setting
        from rps_jax.trials.trial import Rules
        from rps_jax.world.physics import preset

        physics = preset(self.physics, self.fidelity)
        return Setting(physics, Rules(horizon=self.horizon), self.seed, self.engine)

    def intro(self, out: Path, what: str) -> str:
        """What was asked, and what made it."""
        from rps_jax.record import provenance

        name, _ = self.law()
        return f"{name} in the domain {self.domain}: {what}\n\n{provenance.told(out)}"


@contextmanager
def _held(out: Path, device: str) -> Iterator[None]:
    """The run folder in use and signed, on this device."""
    from rps_jax.record import folder, provenance

    running.choose_device(device)
    folder.writable(out)
    running.use_cache()
    with folder.hold(out):
        provenance.sign(out)
        yield


@contextmanager
def _counted(what: str) -> Iterator[Report]:
    """A bar over trials, of which it is not known how many there will be; it begins with them."""
    from tqdm import tqdm

    bars: list[tqdm] = []

    def show(progress: Any) -> None:
        if not bars:
            bars.append(tqdm(unit="trial", desc=what, mininterval=0.5))
        bars[0].set_postfix_str(f"{progress.simulated:.0f} s simulated", refresh=False)
        bars[0].update(progress.finished - bars[0].n)

    try:
        yield show
    finally:
        for bar in bars:
            bar.close()


def _tell(out: Path, title: str, intro: str, sections: Sequence[Section]) -> None:
    from rps_jax.analysis.report import write_report

    write_report(out, title, intro, sections)
    print((out / "report.md").read_text())
    print(f"run folder: {out}")


@dataclass(frozen=True)
class Sensitivity(Failing):
    """Share the blame for failures among all quantities that are drawn, by Sobol indices."""

    worlds: int = 1024
    """Number of worlds, at most: a power of two for each quantity and two more."""
    apart: bool = False
    """Whether each number of the noise and of a prism's corners is a quantity of its own."""
    out: Path = Path("runs/sensitivity")
    """Run folder; a run that was killed is continued there."""

    def run(self) -> None:
        """Run the worlds that are missing, then write and print the report."""
        from rps_jax.analysis import figures
        from rps_jax.analysis.report import Section
        from rps_jax.record import files
        from rps_jax.runs import sweep
        from rps_jax.runs.results import labelled
        from rps_jax.studies.failures import sobol
        from rps_jax.trials.setting import progress_bar

        domain = self.ranges()
        blocks = sobol.design(domain, self.worlds, self.seed, self.apart)
        name, params = self.law()
        plan, shape = sobol.plan_of(blocks, params, self.setting()), self.shape()
        running.choose_device(self.device)
        plan.check_here()
        running.use_cache()
        with progress_bar(plan.trials, "sensitivity") as report:
            timing, results = sweep.complete(self.out, plan, report=report, **shape)
        assert results is not None  # it is the whole
        found = sobol.analysed(blocks, labelled(results))
        files.write_results(self.out / "sobol.nc", found)
        order = sobol.ranked(found)
        said = {one: sobol.in_words(one) for one in order}
        picture = figures.sobol(found, said, sobol.OUTPUTS, self.out / "sobol.png")
        drawn = [one for one in order if one in found.quantity.values][:5]
        failed = found.success.values == 0
        title = f"{name}, {self.domain}: failures over pairs of quantities, {failed.size:,} worlds"
        pairs = figures.interactions(
            found.u.sel(quantity=drawn).values,
            failed,
            [said[one] for one in drawn],
            {sobol.in_words("object"): [one.removeprefix("random_") for one in domain.objects]},
            title,
            self.out / "interactions.png",
        )
        each = f"{blocks.base} for each of {len(blocks.factors)} quantities and two more"
        what = f"{blocks.worlds:,} worlds, {each}; {int(failed.sum())} fail."
        text = (
            "The first index is the share of the variance that a quantity explains alone, the "
            "total one what goes with it and all its interactions; noise and the corners of "
            "prisms are one quantity each. Intervals are bootstrapped, of 95 %. "
            f"{sobol.reliable(found)}"
        )
        sections = [
            Section("Which quantity is to blame", text, sobol.table(found), picture),
            Section("Does mass cost anything", sobol.said(found)),
            Section("Interactions of the first five", "", (), pairs),
        ]
        running.tell(timing)
        _tell(self.out, "Sensitivity of success", self.intro(self.out, what), sections)


@dataclass(frozen=True)
class Rare(Failing):
    """Estimate how often a law fails that rarely fails, by subset simulation."""

    particles: int = 1000
    """Number of worlds of a level, over all groups; a group should have a hundred."""
    groups: int = 10
    """Number of groups that share nothing but the levels; their spread is the interval."""
    share: float = 0.2
    """Share of the worlds that reach the next level, whose chains begin in them [1]."""
    beyond: float = 0.0
    """A failure counts if it missed the target by more than this [m]; 0 counts all failures."""
    repetitions: int = 1
    """How often all of it is done, each time with other points."""
    brute: int = 0
    """Number of drawn worlds that it is compared with."""
    quick: bool = False
    """Whether to take few particles, drawn worlds and objects: minutes on two cores."""
    out: Path = Path("runs/rare")
    """Run folder; a run that was killed is continued there."""

    def run(self) -> None:
        """Run what is missing, then write and print the report."""
        from rps_jax.analysis import figures
        from rps_jax.analysis.report import Section
        from rps_jax.record import files
        from rps_jax.studies.failures import rare

        how = self if not self.quick else dataclasses.replace(self, particles=200, groups=4)
        splitting = rare.Splitting(how.particles, how.groups, self.share, beyond=self.beyond)
        domain, (_, params), setting = self.ranges(), self.law(), self.setting()
        errors.check_count("brute", self.brute, at_least=0, at_most=1_000_000_000)
        shape = self.shape()
        if self.quick:
            domain = dataclasses.replace(domain, objects=domain.objects[:1])
        against = None
        with _held(self.out, self.device):
            with _counted("rare") as report:
                found = rare.rare(
                    params, domain, self.seed, splitting, self.out,
                    repetitions=self.repetitions, setting=setting, report=report, **shape,
                )  # fmt: skip
            files.write_results(self.out / "rare.nc", found)
        if self.brute:
            against = self.drawn(domain, params, setting, splitting, shape)
        ends = None if against is None else (against.p, against.low, against.high)
        picture = figures.splitting(found, ends, self.out / "rare.png")
        text = (
            "Intervals of 95 %: of the splitting from the spread of its groups, of drawn worlds by "
            "Clopper and Pearson. The last column is the number of worlds over that of drawn "
            "worlds with the same coefficient of variation. A kind of failure that no group has "
            "met is in no interval."
        )
        if against is not None:
            hits = rare.covered(found, against.p)
            text += (
                f" {hits} of {self.repetitions} intervals hold the rate of the drawn worlds, "
                f"and the mean of all is {100 * (float(found.p.mean()) / against.p - 1):+.1f} % "
                "off it."
                if against.p
                else " None of the drawn worlds fails."
            )
        rows = rare.table(found, against)
        what = f"a failure misses the target by more than {self.beyond:g} m." if self.beyond else (
            "a failure is a trial that does not reach its target."
        )  # fmt: skip
        section = Section("How rare is a failure", text, rows, picture)
        _tell(self.out, "Rare failures", self.intro(self.out, what), [section])

    def drawn(
        self, domain: Any, params: Params, setting: Setting, how: rares.Splitting, shape: Any
    ) -> rares.Estimate:
        """The rate in drawn worlds, a sweep in the folder's `drawn`."""
        from rps_jax.runs import sweep
        from rps_jax.runs.evaluate import seed_of
        from rps_jax.runs.plan import Plan
        from rps_jax.studies.failures import rare
        from rps_jax.studies.failures.probe import severity_of
        from rps_jax.trials.setting import progress_bar

        seeded = dataclasses.replace(setting, seed=seed_of(self.seed, "tune"))
        plan = Plan(domain, self.brute, {"law": params}, seeded, 4096)
        with progress_bar(plan.trials, "drawn") as report:
            _, results = sweep.complete(self.out / "drawn", plan, report=report, **shape)
        assert results is not None  # it is the whole
        failed = severity_of(results.sel(arm="law"), setting.rules) >= how.level
        return rare.brute(int(failed.sum()), failed.size)


@dataclass(frozen=True)
class Attack(Failing):
    """Search for failures of many kinds: an archive over three quantities (needs pyribs)."""

    axes: tuple[str, ...] = ("size", "com_offset", "friction_robot")
    """Three quantities of the domain, whose ranges the archive's cells divide."""
    cells: int = 10
    """Number of cells along each axis, for each object."""
    aim: Literal["distance", "time"] = "distance"
    """What is worst: most distance left (failures), or most time (slow successes, too)."""
    algorithm: Literal["cma_me", "cma_mae", "line", "mixed"] = "mixed"
    """How worlds are proposed: cma_me, cma_mae, line (mixtures of elites), or half of each line
    and cma_mae."""
    batch: int = 96
    """Number of worlds of a generation, for each object."""
    generations: int = 1000
    """Number of generations, at most."""
    minutes: float = 5.0
    """Wall-clock time of the search, over all calls that continue it [min]."""
    repeats: int = 2
    """Number of trials that differ in noise alone, in all of which a world must fail."""
    drawn: int = 512
    """Number of drawn worlds with which the search is compared."""
    check: int = 32
    """Number of elites that are tried again in converged C MuJoCo."""
    worst: int = 48
    """Number of elites that are listed, and kept as a sweep to be replayed and filmed."""
    film: bool = False
    """Whether to film the worst twelve."""
    out: Path = Path("runs/attack")
    """Run folder; a search that was killed is continued there."""

    def hunt(self) -> Hunt:
        """The same as the study has it."""
        from rps_jax.studies.failures.attack import Hunt

        known = [f.name for f in dataclasses.fields(Hunt)]
        return Hunt(**{name: getattr(self, name) for name in known})

    def run(self) -> None:
        """Search, then check, list and draw what was found."""
        from rps_jax.analysis import figures
        from rps_jax.analysis.report import Section
        from rps_jax.record import files
        from rps_jax.studies.failures import attack

        hunt, domain, (name, params) = self.hunt(), self.ranges(), self.law()
        setting, shape = self.setting(), self.shape()
        errors.check_count("check", self.check, at_least=0, at_most=100_000)
        errors.check_count("worst", self.worst, at_most=100_000)
        hunt.check(domain)
        with _held(self.out, self.device):
            with _counted("attack") as report:
                found = attack.attack(
                    params, domain, self.seed, hunt, self.out,
                    setting=setting, report=report, **shape,
                )  # fmt: skip
            files.write_results(self.out / "archive.nc", found)
        gain = attack.yields(found)
        title = f"{name}, {self.domain}: worst trial of each cell"
        maps = figures.archive(found, self.axes, title, self.out / "archive.png")
        rise = figures.search(found, gain["drawn"], self.out / "search.png")
        cells = found.margin.size
        text = (
            f"{int(found.failing[-1])} of {cells} cells hold a failure, after "
            f"{int(found.trials[-1]):,} trials and {float(found.simulated[-1]):,.0f} s of time: "
            f"{gain['search']:.2f} an hour. {found.attrs['drawn_trials']:,} trials of drawn worlds "
            f"found {found.attrs['drawn_failing']}: {gain['drawn']:.2f} an hour. The search finds "
            f"{gain['times']:.1f} times as many, at least {gain['times_low']:.1f} times (95 %)."
        )
        margin = "Severity less 1: above 0 a failure, by so many metres; below 0 a success."
        sections = [Section("Failing cells", text, (), rise), Section("Margins", margin, (), maps)]
        if found.sizes["elite"]:
            sections += self.elites(found, domain, (name, params), shape)
        what = f"axes {', '.join(self.axes)}, {self.repeats} noises each."
        _tell(self.out, "A search for failures", self.intro(self.out, what), sections)

    def elites(
        self, found: Dataset, domain: Ranges, law: tuple[str, Params], shape: dict[str, Any]
    ) -> list[Section]:
        """The check in C MuJoCo, and the worst elites as a sweep of their own."""
        import numpy as np

        from rps_jax.analysis import statistics, tables
        from rps_jax.analysis.report import Section
        from rps_jax.runs import sweep
        from rps_jax.runs.plan import Plan
        from rps_jax.studies.failures import attack
        from rps_jax.studies.failures.probe import Probe
        from rps_jax.trials.setting import Setting, progress_bar
        from rps_jax.trials.trial import Rules
        from rps_jax.world import points
        from rps_jax.world.physics import preset

        sections, (name, params) = [], law
        if self.check:
            fine = Setting(preset(self.physics, "reference"), Rules(horizon=self.horizon),
                           engine="mujoco")  # fmt: skip
            count = min(self.check, found.sizes["elite"])
            with progress_bar(count, "C MuJoCo") as report:
                probe = Probe(domain, params, fine, self.out / "check", report=report)
                probe.workers = self.workers
                again = attack.again(found, probe, self.check)
            bad = again.success.values == 0
            low, high = statistics.clopper_pearson(int(bad.sum()), bad.size)
            text = (
                f"{int(bad.sum())} of {bad.size} elites, evenly from the worst to the least bad, "
                f"fail again in converged C MuJoCo: {100 * bad.mean():.0f} % "
                f"[{100 * low:.0f}, {100 * high:.0f}]."
            )
            sections.append(Section("Do they fail elsewhere, too", text))
        at = points.checked(domain, found.u.values[: self.worst])
        plan = Plan(domain, len(at.u), {name: params}, self.setting(), points=at)
        with progress_bar(plan.trials, "worst") as report:
            _, results = sweep.complete(self.out / "worlds", plan, report=report, **shape)
        assert results is not None  # it is the whole
        run = str(self.out / "worlds")
        text = (
            f"{int((results.success.values == 0).sum())} of {results.sizes['world']} fail again in "
            f"the same engine. `rps film {shlex.quote(run)} --which hardest --grid 3x4` films the "
            "worst."
        )
        sections.append(Section("The worst", text, tables.hardest_table(results, run, self.worst)))
        if self.film and np.any(results.success.values == 0):
            from rps_jax.app.cli.looking import Film

            Film(self.out / "worlds", grid="3x4", which="hardest").run()
        return sections


@dataclass(frozen=True)
class Regress(Spread):
    """Try laws in 200 worlds that were hard for those before them, and compare."""

    strategies: tuple[str, ...] = ("rps",)
    """What decides: rps, rps_plus or another of the package, and laws of files, as
    my_law.py:MyParams."""
    params: tuple[str, ...] = ("tuned",)
    """Sets of parameters of RPS: paper, tuned, or JSON files of changes, as {"L": 0.3}."""
    against: str = "tuned"
    """Law of the file that changes are told against: paper, tuned, rps_plus or learned_gru."""
    worlds: int | None = None
    """How many of the worlds; by default all."""
    fidelity: Fidelity = "standard"
    engine: Engine = "fused"
    device: Device = "auto"
    out: Path | None = None
    """Run folder; by default everything is kept in memory."""

    def run(self) -> None:
        """Run the worlds, then print what got better and worse."""
        from rps_jax.analysis import tables
        from rps_jax.record import folder, provenance
        from rps_jax.studies.failures import regress
        from rps_jax.trials.setting import Setting, progress_bar
        from rps_jax.world.physics import preset

        arms = parsing.compared_arms(self.strategies, self.params)
        known = regress.worlds()
        errors.check_name("against", self.against, map(str, known.law.values))
        setting = Setting(preset(fidelity=self.fidelity), engine=self.engine)
        plan, shape = regress.plan_of(arms, setting, self.worlds), self.shape()
        running.choose_device(self.device)
        plan.check_here()
        if self.out is not None:
            folder.writable(self.out)
            provenance.sign(self.out)
        running.use_cache()
        with progress_bar(plan.trials, "regress") as report:
            found = regress.regress(
                arms, self.out, worlds=self.worlds, setting=setting, report=report, **shape
            )
        running.tell(report.timing)
        print(tables.markdown(regress.table(found)))
        for arm in arms:
            rows = regress.changes(found, arm, self.against)
            if len(rows) > 1:
                print(f"\n{arm} against {self.against}, world by world:\n")
                print(tables.markdown(rows))
