"""The command line: `rps table`, `rps push`, `rps sweep` and the others.

Input is checked, and folders are tried, before anything compiles. Heavy modules are imported by
the commands, so that `rps --help` answers at once and MuJoCo finds its rendering backend chosen.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rps_jax import errors
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.domain import Domain
    from rps_jax.robustness import Plan, Shard
    from rps_jax.scene import Friction, Scene
    from rps_jax.slots import Progress, Setting, Timing
    from rps_jax.sweep import Case, Trace
    from rps_jax.trial import Params


@dataclass(frozen=True)
class Spread:
    """How a run's trials are spread over the machine; see `sweep.run`."""

    slots: int | None = None
    """Worlds stepped at once by one worker; by default chosen by the device."""
    workers: int | None = None
    """Host threads; by default chosen by the device."""

    def shape(self) -> dict[str, Any]:
        """The options of `sweep.run`, checked."""
        shape = {"slots": self.slots, "workers": self.workers}
        for name, value in shape.items():
            if value is not None:
                errors.check_finite(name, value, at_least=1)
        return shape


@dataclass(frozen=True)
class Common:
    """Options that every run takes."""

    params: tuple[str, ...] = ()
    """Parameters to change from the paper's, as name=value; those of APS as aps.name=value."""
    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid, thin skin)."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp: an NVIDIA GPU), or
    mujoco (C, on all cores)."""
    timestep: float | None = None
    """Physics step [s]; by default that of the physics."""
    control_period: float | None = None
    """Time between two decisions of the law [s]; by default that of the physics."""
    skin: str | None = None
    """ideal (the paper's simulated contact sensor), thin (the same without foam), capacitive
    (42 taxels) or hardware (these with noise and unequal gains); by default that of the physics,
    ideal or thin."""
    skin_params: tuple[str, ...] = ()
    """Parameters of the skin to change from their defaults, as name=value."""
    mass: float | None = None
    """Mass of the object [kg]; by default its own."""
    gap: float = 0.02
    """Distance between base and object at the start [m]."""
    rear: str = "near"
    """Side of the nonuniform box's load: near the robot, or far from it."""
    horizon: float = 300.0
    """Longest trial [s]."""
    seed: int = 0
    """Seed of the skin's imperfections."""
    out: Path | None = None
    """Run folder; by default runs/<command>-<time>."""
    overwrite: bool = False
    """Allow a run folder that already holds a run."""


@dataclass(frozen=True)
class Table(Spread, Common):
    """Run the paper's trials and print Table II beside the paper's."""

    objects: tuple[str, ...] = ("box", "cylinder", "nonuniform_box")
    """Objects to push."""
    strategies: tuple[str, ...] = ("rps", "nps", "aps")
    """Strategies to run: rps, nps, aps."""
    friction: tuple[str, ...] = ("S1", "S2")
    """Friction sets, each S1, S2 or ground,robot (as 0.25,0.4)."""
    targets: tuple[tuple[float, float], ...] = ()
    """Targets x y [m], one pair after the other; by default the paper's 24."""


@dataclass(frozen=True)
class Push(Common):
    """Run one trial; draw the paper's Fig. 6 and film it."""

    object: str = "box"
    """Object to push."""
    target: tuple[float, float] = (-2.0, 0.0)
    """Target x y [m]."""
    friction: str = "S1"
    """S1, S2 or ground,robot (as 0.25,0.4)."""
    strategy: str = "rps"
    """rps, nps or aps."""
    video: bool = True
    """Film the push."""
    film_length: float = 12.0
    """Length of the film [s], whatever the trial's."""


@dataclass(frozen=True)
class StudyOptions(Spread):
    """What every study of the paper's trials takes; its run folder can be continued."""

    out: Path = Path("runs/study")
    """Run folder; a run that was killed is continued there."""
    quick: bool = False
    """Four of the paper's 24 targets."""

    def targets(self) -> tuple[tuple[float, float], ...]:
        """The paper's targets, or a few of them."""
        from rps_jax import paper, study

        return study.FEW_TARGETS if self.quick else paper.TARGETS

    def open(self) -> Path:
        """The run folder, new or to be continued; checks the options first."""
        from rps_jax import record

        self.shape()
        record.writable(self.out)
        use_cache()
        record.write_json(self.out / "environment.json", record.environment())
        return self.out


@dataclass(frozen=True)
class Hardware(Spread, Common):
    """Run the paper's hardware experiments in simulation, over a range of friction; draw Fig. 7."""

    skin: str | None = "hardware"
    """hardware (42 taxels with noise and unequal gains), capacitive, ideal or thin."""
    layout: str = "circle"
    """The eight targets: circle (each 2.1 m from the start) or grid (2.1 m along x and y)."""


@dataclass(frozen=True)
class Paper(StudyOptions):
    """Reproduce all of the paper into one run folder, with report.md and report.html."""

    out: Path = Path("runs/paper")
    """Run folder; a run that was killed is continued there."""
    quick: bool = False
    """Table II in full; of everything else a few conditions, RPS alone, four of 24 targets."""


@dataclass(frozen=True)
class Sweep(Spread):
    """Push in many random worlds, every strategy in the same ones; the run can be continued."""

    domain: str = "wide"
    """paper, hardware, wide or hostile, or a JSON file of ranges, as {"mass": [3, 60]}."""
    change: tuple[str, ...] = ()
    """Ranges to change, each as quantity=low,high (as mass=3,10)."""
    strategies: tuple[str, ...] = ("rps", "nps", "aps")
    """Strategies to run: rps, nps, aps."""
    params: tuple[str, ...] = ("paper",)
    """Parameters of rps and nps: paper, or JSON files (as {"L": 0.3}); each is run."""
    worlds: int | None = None
    """How many; by default 1000, or the domain's whole grid."""
    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid)."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp: an NVIDIA GPU), or
    mujoco (C, on all cores)."""
    horizon: float = 300.0
    """Longest trial [s]."""
    seed: int = 0
    """Seed of the worlds."""
    part: int = 1024
    """Trials of a part: the most that is lost for each strategy and object when killed."""
    device: str = "auto"
    """auto, cpu or gpu."""
    shard: str = "1/1"
    """k/n: run share k of n, to be merged with `rps merge`."""
    out: Path = Path("runs/sweep")
    """Run folder; a run that was killed is continued there."""


@dataclass(frozen=True)
class Merge:
    """Merge the shards of a sweep into one run folder, with results.nc and the report."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders of the shards; one, if they share it."""
    out: Path
    """Run folder of the whole."""


@dataclass(frozen=True)
class Replay:
    """Run one world of a sweep again; draw it as in the paper's Fig. 6 and film it."""

    run: tyro.conf.Positional[Path]
    """Run folder of the sweep."""
    index: tyro.conf.Positional[int]
    """Index of the world."""
    arm: str | None = None
    """Which of the sweep's strategies with parameters; by default the first."""
    video: bool = False
    """Film the push."""
    film_length: float = 12.0
    """Length of the film [s], whatever the trial's."""
    out: Path | None = None
    """Folder; by default RUN/replay-INDEX."""


@dataclass(frozen=True)
class Doctor:
    """Print versions, devices and folders, and what does not work with its mend."""


Command = (
    Annotated[Table, tyro.conf.subcommand("table")]
    | Annotated[Push, tyro.conf.subcommand("push")]
    | Annotated[Hardware, tyro.conf.subcommand("hardware")]
    | Annotated[Paper, tyro.conf.subcommand("paper")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Merge, tyro.conf.subcommand("merge")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `rps` and `python -m rps_jax`: exit code 0, or 2 for bad input."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="rps",
        args=arguments or ["--help"],
        description="Pushing unknown objects by touch: the Reactive Pushing Strategy in MJX.",
    )
    from rps_jax import video

    video.choose_gl()
    act: dict[type, Callable[[Any], None]] = {
        Table: _table,
        Push: _push,
        Hardware: _hardware,
        Paper: _paper,
        Sweep: _sweep,
        Merge: _merge,
        Replay: _replay,
        Doctor: _doctor,
    }
    return guarded(lambda: act[type(command)](command))


def guarded(action: Callable[[], None]) -> int:
    """Run a command: exit code 0, or one sentence on the error stream and 2 (130: interrupted)."""
    _be_deterministic()
    try:
        action()
    except InputError as error:
        print(f"rps: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"rps: error: {error.filename or 'output'}: {error.strerror}.", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(
            "rps: error: the device is out of memory: ask for fewer worlds at once with --slots.",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        print("rps: interrupted.", file=sys.stderr)
        return 130
    return 0


def _be_deterministic() -> None:
    """Ask XLA for GPU sums in a fixed order: the same command must give the same results."""
    flag = "--xla_gpu_deterministic_ops"
    flags = os.environ.get("XLA_FLAGS", "")
    if flag not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {flag}=true".strip()


def cache_folder() -> Path:
    """Where compiled programs are kept between runs: $RPS_CACHE, else the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("RPS_CACHE") or Path(base) / "rps_jax")


def use_cache() -> None:
    """Keep compiled programs, if the folder can be written; a run needs no cache."""
    import jax

    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    os.environ.setdefault("WARP_CACHE_PATH", str(cache_folder() / "warp"))


# --- what the options mean -----------------------------------------------------------------


def _assignments(kind: str, texts: Sequence[str], known: Sequence[str]) -> dict[str, float]:
    """name=value texts as a dict of floats."""
    values = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"{kind} '{text}' is not allowed: write name=value.")
        errors.check_name(kind, name, known)
        values[name] = errors.check_number(f"{kind} {name}", value)
    return values


def _params(common: Common, strategy: str) -> Params:
    from rps_jax import paper
    from rps_jax.baselines import APSParams
    from rps_jax.law import RPSParams

    errors.check_name("strategy", strategy, paper.STRATEGIES)
    of_the_law = [name for name in RPSParams._fields if name != "reactive"]
    of_aps = [f"aps.{name}" for name in APSParams._fields]
    given = _assignments("params", common.params, [*of_the_law, *of_aps])
    wanted = of_aps if strategy == "aps" else of_the_law
    changes = {name.removeprefix("aps."): v for name, v in given.items() if name in wanted}
    return paper.PARAMS[strategy]._replace(**changes)


def _friction(text: str) -> Friction:
    from rps_jax import scene

    if "," not in text:
        return scene.FRICTION[errors.check_name("friction set", text, scene.FRICTION)]
    parts = text.split(",")
    if len(parts) != 2:
        raise InputError(f"friction '{text}' is not allowed: write S1, S2 or ground,robot.")
    ground, robot = (
        errors.check_finite(f"friction {name}", value, above=0, at_most=10)
        for name, value in zip(("ground", "robot"), parts, strict=True)
    )
    return scene.Friction(ground, robot)


def _setting(common: Common) -> Setting:
    from rps_jax import engines
    from rps_jax.physics import preset
    from rps_jax.slots import Setting
    from rps_jax.trial import Rules

    engines.check(common.engine)
    steps = {"timestep": common.timestep, "control_period": common.control_period}
    physics = dataclasses.replace(
        preset(common.physics, common.fidelity),
        **{k: v for k, v in steps.items() if v is not None},
    )
    return Setting(
        physics=physics,
        rules=Rules(horizon=common.horizon),
        seed=common.seed,
        engine=common.engine,  # pyright: ignore[reportArgumentType]
    )


def _per_world(common: Common) -> dict[str, Any]:
    """The options that become fields of every case."""
    from rps_jax import paper, skin

    name = common.skin or paper.SKIN[common.physics]
    sensor = skin.SKINS[errors.check_name("skin", name, skin.SKINS)]
    changes = _assignments("skin-params", common.skin_params, sensor._fields)
    return {
        "mass": common.mass,
        "skin": sensor._replace(**changes),
        "gap": common.gap,
        "rear": common.rear,
    }


def _cases(options: Table, targets: Sequence[tuple[float, float]]) -> list[Case]:
    """Every combination, in the nesting order of `score.dataset`."""
    from rps_jax import sweep

    for name in ("strategies", "objects", "friction"):
        values = getattr(options, name)
        if not values or len(set(values)) < len(values):
            raise InputError(f"{name} = {values} is not allowed: name each once, at least one.")
    frictions = [_friction(text) for text in options.friction]
    return [
        sweep.Case(name, friction, target, params, **_per_world(options))
        for params in [_params(options, s) for s in options.strategies]
        for name in options.objects
        for friction in frictions
        for target in targets
    ]


def _open(common: Common, command: str) -> Path:
    """The run folder, with what was asked and what it runs on already in it."""
    from rps_jax import record

    out = common.out or Path("runs") / f"{command}-{time.strftime('%Y%m%d-%H%M%S')}"
    record.prepare(out, overwrite=common.overwrite)
    use_cache()
    record.write_json(out / "environment.json", record.environment())
    return out


def _write_config(out: Path, common: Common, setting: Setting, params: dict[str, Params]) -> None:
    from rps_jax import record

    config = {
        "options": dataclasses.asdict(common) | {"out": str(out)},
        "params": {name: values._asdict() for name, values in params.items()},
        "physics": dataclasses.asdict(setting.physics),
        "rules": setting.rules._asdict(),
        "skin": _per_world(common)["skin"]._asdict(),
    }
    record.write_json(out / "config.json", config)


@contextlib.contextmanager
def progress_bar(trials: int, what: str = "push") -> Iterator[Callable[[Progress], None]]:
    """A bar over trials, to be handed to `sweep.run` as its `report`."""
    from tqdm import tqdm

    with tqdm(total=trials, unit="trial", desc="compile", mininterval=0.5) as bar:

        def report(progress: Progress) -> None:
            bar.set_description(what, refresh=False)
            bar.set_postfix_str(f"{progress.simulated:.0f} s simulated", refresh=False)
            bar.update(progress.finished - bar.n)

        yield report


@contextlib.contextmanager
def _clock(horizon: float) -> Iterator[Callable[[Progress], None]]:
    """A bar over the simulated seconds of one trial, to be handed to `sweep.follow`."""
    from tqdm import tqdm

    with tqdm(total=horizon, unit="s", desc="compile", smoothing=0.05) as bar:

        def report(progress: Progress) -> None:
            bar.set_description("push", refresh=False)
            bar.update(round(progress.simulated - bar.n, 3))

        yield report


def _tell(timing: Timing, engine: str) -> None:
    import jax

    print(
        f"compile {timing.compile:.1f} s, run {timing.run:.1f} s "
        f"({timing.simulated / max(timing.run, 1e-9):.0f} simulated s per s) on "
        f"{jax.devices()[0].device_kind}"
    )
    if engine == "warp":
        print(f"contacts lost for want of room: in {timing.overflowed} trials")


# --- the commands --------------------------------------------------------------------------


def _table(options: Table) -> None:
    from rps_jax import figures, paper, record, score, sweep

    setting = _setting(options)
    targets = options.targets or paper.TARGETS
    cases = _cases(options, targets)
    shape = options.shape()
    out = _open(options, "table")
    _write_config(out, options, setting, {s: _params(options, s) for s in options.strategies})
    with progress_bar(len(cases)) as report:
        outcome, timing = sweep.run(cases, setting, **shape, report=report)
    results = score.dataset(outcome, options.strategies, options.objects, options.friction, targets)
    record.write_results(out / "results.nc", results)
    title = "Successes, with Wilson 95 % intervals in percent"
    table = score.markdown(score.table(results))
    text = f"{title}\n\n{table}\n\n{score.summary(results)}\n"
    record.write_text(out / "table.txt", text)
    figures.min_distance(results, out / "min_distance.png")
    print(text)
    _tell(timing, setting.engine)
    print(f"run folder: {out}")


def _push(options: Push) -> None:
    from rps_jax import figures, sweep

    setting = _setting(options)
    params = _params(options, options.strategy)
    case = sweep.Case(
        options.object,
        _friction(options.friction),
        options.target,
        params,
        **_per_world(options),
    )
    sweep.check_followed(options.engine)
    errors.check_finite("film_length", options.film_length, above=0, at_most=600, unit="s")
    out = _open(options, "push")
    _write_config(out, options, setting, {options.strategy: params})

    with _clock(options.horizon) as report:
        (trace,) = sweep.follow([case], setting, report=report)
    _show(trace, options.engine, options.object, figures.title_of(case), out)
    if options.video:
        _film(sweep.scene_of(case, setting.physics), trace, options.film_length, out)
    print(f"run folder: {out}")


def _show(trace: Trace, engine: str, name: str, title: str, out: Path) -> None:
    """Results, figure and a line on the screen for one trial."""
    from rps_jax import figures, record, score

    record.write_results(out / "results.nc", score.trace_dataset(trace))
    figures.one_trial(trace, title, out / "trial.png")
    result = trace.outcome
    x, y = trace.p_world_target
    print(
        f"{name}, target ({x:g}, {y:g}) m: "
        f"{'reached' if result.success else 'not reached'} at {float(result.time):.1f} s, "
        f"least distance {float(result.min_distance):.3f} m, "
        f"contact lost for {float(result.contact_lost_time):.1f} s"
    )
    _tell(trace.timing, engine)


def _film(scene: Scene, trace: Trace, length: float, out: Path) -> None:
    """Stills and video; without the means for them, a line that says how to mend it."""
    import numpy as np
    from tqdm import tqdm

    from rps_jax import figures, trial, video

    target = np.array(trace.p_world_target)
    seen = trace.snapshots
    fps = 25
    rows = _evenly(len(seen.time), round(length * fps))
    stills = _evenly(len(seen.time), 6)
    try:
        images = [video.snapshot(scene, seen.qpos[i], p_world_target=target) for i in stills]
        titles = [f"{seen.time[i]:.0f} s" for i in stills]
        figures.stills(images, titles, out / "stills.png")
        video.render(
            scene,
            tqdm(seen.qpos[rows], unit="frame", desc="film"),
            out / "push.mp4",
            p_world_target=target,
            p_world_contacts=np.asarray(trial.p_world_contact(seen))[rows],
            fps=fps,
        )
    except video.VideoError as error:
        print(f"no video: {error}")


def _evenly(length: int, count: int) -> list[int]:
    """At least two indices into `length` items, from the first to the last."""
    count = max(2, count)
    return [round(i * (length - 1) / (count - 1)) for i in range(count)]


def _hardware(options: Hardware) -> None:
    from rps_jax import figures, hardware, record, reproduce, sweep

    setting = _setting(options)
    params = _params(options, "rps")
    layout = hardware.LAYOUTS[errors.check_name("layout", options.layout, hardware.LAYOUTS)]
    case = sweep.Case(
        hardware.OBJECTS[0], hardware.MIDDLE, layout[0], params, **_per_world(options)
    )
    if options.mass is not None:
        raise InputError("mass is not an option here: each object has the paper's.")
    shape = options.shape()
    out = _open(options, "hardware")
    _write_config(out, options, setting, {"rps": params})
    given = {"layout": options.layout}
    with progress_bar(len(hardware.OBJECTS) * len(layout) * len(hardware.frictions())) as report:
        results = hardware.run(case, setting, **given, **shape, report=report)
    record.write_results(out / "results.nc", results)
    with progress_bar(2 * len(hardware.OBJECTS) * len(layout) * len(hardware.SHIFTS)) as report:
        shifted = hardware.disturb(case, setting, **given, **shape, report=report)
    record.write_results(out / "shifted.nc", shifted)
    figures.paths(hardware.paths(case, setting, **given), layout, out / "paths.png")
    sections = reproduce.hardware_sections(out, results, shifted)
    reproduce.report_to(out, sections)
    print((out / "report.md").read_text())
    print(f"run folder: {out}")


def _paper(options: Paper) -> None:
    from rps_jax import reproduce

    plan = reproduce.Plan.quick() if options.quick else reproduce.Plan()
    out = options.open()
    with progress_bar(plan.trials()) as report:
        path = reproduce.run(out, plan, report=report, **options.shape())
    print(f"report: {path}")


def _domain(options: Sweep) -> Domain:
    from rps_jax import domain

    if options.domain.endswith(".json"):
        chosen = domain.from_json(_json(Path(options.domain)))
    else:
        chosen = domain.DOMAINS[errors.check_name("domain", options.domain, domain.DOMAINS)]
    changes = {}
    for text in options.change:
        name, _, values = text.partition("=")
        errors.check_name("domain quantity", name, domain.RANGES)
        ends = [errors.check_number(f"domain {name}", v) for v in values.split(",")]
        if len(ends) != 2:
            raise InputError(f"change '{text}' is not allowed: write quantity=low,high.")
        changes[name] = getattr(chosen, name)._replace(low=ends[0], high=ends[1])
    return dataclasses.replace(chosen, **changes)


def _json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a JSON file.") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}).") from error
    if not isinstance(values, dict):
        raise InputError(f'{path} holds no names with values: write {{"name": value}}.')
    return values


def _arms(options: Sweep) -> dict[str, Params]:
    """Every strategy with every set of parameters; APS has but one."""
    from rps_jax import law, paper
    from rps_jax.law import RPSParams

    arms: dict[str, Params] = {}
    for name in options.params:
        values = {} if name == "paper" else _json(Path(name))
        for key, value in values.items():
            errors.check_name(f"parameter of {name}", key, RPSParams._fields)
            values[key] = errors.check_number(f"{name} {key}", value)
        for strategy in options.strategies:
            params = paper.PARAMS[errors.check_name("strategy", strategy, paper.PARAMS)]
            label = strategy
            if isinstance(params, RPSParams):
                changed = {k: v for k, v in values.items() if k != "reactive"}
                params = params._replace(**changed)
                law.check(params)
                label = strategy if len(options.params) == 1 else f"{strategy} {Path(name).stem}"
            arms[label] = params
    return arms


def _plan(options: Sweep) -> Plan:
    from rps_jax.physics import preset
    from rps_jax.robustness import Plan
    from rps_jax.slots import Setting
    from rps_jax.trial import Rules

    domain = _domain(options)
    every = domain.combinations if domain.targets else 1000
    setting = Setting(
        preset(options.physics, options.fidelity),
        Rules(horizon=options.horizon),
        options.seed,
        options.engine,  # pyright: ignore[reportArgumentType]
    )
    return Plan(domain, options.worlds or every, _arms(options), setting, options.part)


def _shard(text: str) -> Shard:
    from rps_jax.robustness import Shard

    number, _, of = text.partition("/")
    if not (number.isdigit() and of.isdigit()):
        raise InputError(f"shard '{text}' is not allowed: write k/n, as 3/8.")
    return Shard(int(number), int(of))


def choose_device(name: str) -> None:
    """Have JAX use this kind of device.

    Raises:
      InputError: unknown name, or no such device.
    """
    import jax

    errors.check_name("device", name, ("auto", "cpu", "gpu"))
    if name == "auto":
        return
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[name])
    try:
        jax.devices()
    except RuntimeError as error:
        raise InputError(
            f"device = {name} is not there: install rps_jax[cuda] on a machine with an NVIDIA GPU, "
            "or choose cpu."
        ) from error


def _sweep(options: Sweep) -> None:
    from rps_jax import record, robustness

    plan, shard, shape = _plan(options), _shard(options.shard), options.shape()
    choose_device(options.device)
    out = robustness.open_run(options.out, plan)
    use_cache()
    with robustness.lock(out, shard):
        record.write_json(out / "environment.json", record.environment())
        trials = sum(numbers.size for numbers in robustness.share(plan, shard).values())
        with progress_bar(trials, "sweep") as report:
            timing = robustness.run(out, plan, shard=shard, report=report, **shape)
        _tell(timing, plan.setting.engine)
        if shard.of == 1:
            robustness.merge([out], out)
            _report_sweep(out)
        else:
            print(f"run folder: {out}; when all shards are done: rps merge {out} --out {out}")


def _merge(options: Merge) -> None:
    from rps_jax import record, robustness

    if not options.folders:
        raise InputError("folders = () is not allowed: give the run folders of the shards.")
    record.writable(options.out)
    robustness.merge(list(options.folders), options.out)
    _report_sweep(options.out)


def _report_sweep(out: Path) -> None:
    from rps_jax import robustness

    print(robustness.write_report(out).read_text())
    print(f"run folder: {out}")


def _replay(options: Replay) -> None:
    from rps_jax import record, robustness, sweep, trial

    plan = robustness.load_plan(options.run)
    arms = list(plan.arms)
    name = errors.check_name("arm", options.arm or arms[0], arms)
    errors.check_finite("index", options.index, at_least=0, at_most=plan.worlds - 1)
    errors.check_finite("film_length", options.film_length, above=0, at_most=600, unit="s")
    sweep.check_followed(plan.setting.engine)
    out = record.writable(options.out or options.run / f"replay-{options.index}")
    use_cache()
    part = robustness.world_part(plan, arms.index(name), [options.index])
    strategy = trial.STRATEGIES[type(plan.arms[name])]
    with _clock(float(plan.setting.rules.horizon)) as report:
        (trace,) = sweep.follow_part(part, strategy, plan.setting, report=report)
    title = robustness.title_of(plan, options.index)
    _show(trace, plan.setting.engine, f"world {options.index}, {name}", title, out)
    if options.video:
        _film(robustness.scene_of(plan, options.index), trace, options.film_length, out)
    print(f"run folder: {out}")


def _doctor(_: Doctor) -> None:
    from rps_jax import doctor

    print(doctor.report(cache_folder()))
