"""The command line: `rps table`, `rps push`, `rps sweep` and the others.

Input is checked, and folders are tried, before anything compiles. Heavy modules are imported by
the commands, so that `rps --help` answers at once and MuJoCo finds its rendering backend chosen.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rps_jax import engines, errors
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.app import viewer
    from rps_jax.app.film import Take
    from rps_jax.control.law import RPSParams
    from rps_jax.control.strategies import Params
    from rps_jax.runs.sweep import Plan, Shard
    from rps_jax.trials.pushes import Case, Trace
    from rps_jax.trials.setting import Progress, Setting, Timing
    from rps_jax.tuning.evolution import Course, Space
    from rps_jax.world.domain import Domain
    from rps_jax.world.scene import Friction, Scene


DEVICES = ("auto", "cpu", "gpu")


@dataclass(frozen=True)
class Spread:
    """How a run's trials are spread over the machine; see `sweep.run`."""

    slots: int | None = None
    """Worlds stepped at once by one worker; by default chosen by the device."""
    workers: int | None = None
    """Host threads; by default chosen by the device."""

    def shape(self) -> dict[str, Any]:
        """The options of `sweep.run`, checked."""
        from rps_jax.trials import batch

        batch.check_shape(self.slots, self.workers)
        return {"slots": self.slots, "workers": self.workers}


@dataclass(frozen=True)
class Conditions:
    """What the trials that are asked for one by one have in common."""

    params: tuple[str, ...] = ()
    """Parameters to change from the paper's, as name=value; those of APS as aps.name=value."""
    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid, thin skin)."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp, on an NVIDIA GPU),
    mujoco (C, on all cores), or quasistatic (planar, no inertia: fastest, and differentiable)."""
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


@dataclass(frozen=True)
class Common(Conditions):
    """Options that every run of such trials takes."""

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
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp, on an NVIDIA GPU),
    or quasistatic (planar, no inertia)."""
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
        from rps_jax.studies import study
        from rps_jax.world import paper

        return study.FEW_TARGETS if self.quick else paper.TARGETS

    @contextlib.contextmanager
    def opened(self) -> Iterator[Path]:
        """The run folder, new or to be continued, in use; checks the options first."""
        from rps_jax.record import folder as run_folder
        from rps_jax.record import provenance

        self.shape()
        choose_device("auto")
        run_folder.writable(self.out)
        use_cache()
        with run_folder.hold(self.out):
            provenance.sign(self.out)
            yield self.out


@dataclass(frozen=True)
class Hardware(Spread, Common):
    """Run the paper's hardware experiments in simulation, over a range of friction; draw Fig. 7."""

    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid)."""
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp, on an NVIDIA GPU),
    or quasistatic (planar, no inertia)."""
    mass: float | None = None
    """Not to be set: each object of the hardware has the paper's."""
    rear: str = "near"
    """Of no effect: no object of the hardware is nonuniform."""
    skin: str | None = "hardware"
    """hardware (42 taxels with noise and unequal gains), capacitive, ideal or thin."""
    layout: str = "circle"
    """The eight targets: circle (each 2.1 m from the start) or grid (2.1 m along x and y)."""


@dataclass(frozen=True)
class Paper(StudyOptions):
    """Reproduce all of the paper into one run folder, with report.md and report.html."""

    out: Path = Path("runs/paper")
    """Run folder; a run that was killed is continued there. Another than the default with --quick,
    if both are wanted."""
    quick: bool = False
    """Table II in full; of everything else a few conditions, RPS alone, four of 24 targets."""


@dataclass(frozen=True)
class Sweep(Spread):
    """Push in many random worlds, every strategy in the same ones; the run can be continued."""

    domain: str = "wide"
    """paper, hardware, wide, prisms or hostile, or a JSON file of ranges, as {"mass": [3, 60]}."""
    change: tuple[str, ...] = ()
    """Ranges to change, each as quantity=low,high (as mass=3,10)."""
    strategies: tuple[str, ...] = ("rps", "nps", "aps")
    """Strategies to run: rps, nps, aps."""
    params: tuple[str, ...] = ("paper",)
    """Parameters of rps and nps: paper, tuned, or JSON files (as {"L": 0.3}); each is run."""
    worlds: int | None = None
    """How many; by default 1000, or the domain's whole grid."""
    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid)."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "mjx"
    """mjx, fused (the same equations, specialised: much faster), warp (MJX-Warp, on an NVIDIA GPU),
    mujoco (C, on all cores), or quasistatic (planar, no inertia: fastest, and differentiable)."""
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
    ray: str | None = None
    """Run on the workers of a Ray cluster: auto, its host:port, or local (all of this host). Each
    claims a GPU, or else as many processors as --workers, one by default."""
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
class Film:
    """Film many trials of a run side by side: the targets of a table, or worlds of a sweep."""

    run: tyro.conf.Positional[Path]
    """Run folder of `rps table` or `rps sweep`."""
    grid: str = "4x6"
    """Rows and columns of the film."""
    object: str = "box"
    """Of a table: the object."""
    friction: str = "S1"
    """Of a table: the friction."""
    strategy: str = "rps"
    """Of a table: the strategy."""
    which: str = "first"
    """Of a sweep: its first worlds, or its hardest."""
    arm: str | None = None
    """Of a sweep: which of its strategies with parameters; by default the first."""
    seconds: float | None = None
    """Simulated time that is filmed, at most [s]; by default until the last trial ends."""
    speed: float | None = None
    """Simulated seconds in a second of the film; by default the film lasts less than a minute."""
    camera: str = "oblique"
    """oblique or above."""
    out: Path | None = None
    """The MP4 to write; by default RUN/film.mp4."""


@dataclass(frozen=True)
class View(Conditions):
    """Push in the browser: watch, drag the target, shove the object, push again."""

    run: tyro.conf.Positional[Path | None] = None
    """Run folder of a sweep, to begin with one of its worlds; by default the options' push."""
    index: tyro.conf.Positional[int] = 0
    """Index of the world in the sweep."""
    arm: str | None = None
    """Which of the sweep's strategies with parameters; by default the first."""
    object: str = "box"
    """Object to push."""
    target: tuple[float, float] = (-2.0, 0.0)
    """Target x y [m]."""
    friction: str = "S1"
    """S1, S2 or ground,robot (as 0.25,0.4)."""
    strategy: str = "rps"
    """rps, nps or aps."""
    engine: str = "fused"
    """fused, mjx or quasistatic."""
    host: str = "127.0.0.1"
    """Address to serve the page on; by default to this machine alone."""
    port: int = 8080
    """Port to serve the page on; 0 takes any that is free."""


@dataclass(frozen=True)
class TuneOptions(Spread):
    """What every tuner takes."""

    domain: tuple[str, ...] = ("wide",)
    """Domains to tune in: paper, hardware, wide, prisms, hostile, or JSON files of ranges."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects of these domains; random_prism is held out by default."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to tune, by name, or logistic (eta, zeta, beta, k), or full (all that
    are the law's, not the robot's speeds, the rules or the switches)."""
    start: str = "paper"
    """Parameters to begin with: paper, tuned, or a JSON file (as {"L": 0.3})."""
    worlds: int = 512
    """Worlds that each candidate meets, in each domain; others in the next generation."""
    validation: int = 512
    """Worlds for validation, in each domain."""
    risk: str = "mean"
    """mean over the worlds, or cvar: the mean over the worst tenth."""
    time_weight: float = 0.1
    """What a success that takes the whole horizon scores, where a failure scores 1 and more."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "fused"
    """fused, mjx, warp, mujoco or quasistatic."""
    horizon: float = 300.0
    """Longest trial [s]."""
    budget: float = 0.0
    """Simulated time after which tuning ends [s]; 0: no bound."""
    seed: int = 0
    """Of proposals and worlds."""
    device: str = "auto"
    """auto, cpu or gpu."""
    quick: bool = False
    """A small run, minutes on two cores: what is not asked for is small, parameters are few; of
    cylinders, on the quasi-static model."""
    out: Path = Path("runs/tune")
    """Run folder; a run that was killed is continued there."""


@dataclass(frozen=True)
class TuneES(TuneOptions):
    """Tune by evolution."""

    strategy: str = "CMA_ES"
    """A distribution-based strategy of evosax, by name."""
    population: int = 64
    """Candidates of a generation."""
    generations: int = 50
    """In all."""
    spread: float = 0.5
    """Standard deviation of the first generation, in units of the bounded map."""
    prior: float = 0.002
    """Price of a mean square of 1 between a candidate's coordinates and the start's."""
    patience: int = 0
    """Generations without a better validation before a restart elsewhere; 0: never."""


@dataclass(frozen=True)
class TuneGrad(TuneOptions):
    """Tune by gradients."""

    worlds: int = 64
    """Worlds of a step, in each domain; others in the next step."""
    validation: int = 128
    """Worlds for validation, in each domain."""
    estimator: str = "reverse"
    """reverse (windows through the quasi-static model), forward (windows through the fused engine),
    evolution (antithetic steps, in whole trials), or combined (reverse and evolution by their
    variances)."""
    optimiser: str = "adam"
    """An optimiser of optax, by name."""
    learning_rate: float = 0.1
    """At first, in units of the bounded map; it falls to zero along a cosine."""
    clip: float = 1.0
    """Bound on the norm of a gradient."""
    world_clip: float = 2.0
    """Bound on that of a single world, for reverse and forward, as a multiple of their median."""
    steps: int = 40
    """In all."""
    starts: int = 4
    """Descents side by side, the first from the start itself."""
    spread: float = 0.5
    """Standard deviation of the other starts."""
    window: float = 8.0
    """Length of a window of a softened trial, for reverse and forward [s]."""
    within: float = 100.0
    """Windows begin at random times up to this; with 0 at the start of the trials [s]."""
    sigma: float = 0.15
    """Standard deviation of the antithetic steps."""
    pairs: int = 8
    """Antithetic pairs of a start."""


@dataclass(frozen=True)
class TuneCompare(Spread):
    """Compare sets of parameters in worlds kept for testing, which no tuner has seen."""

    params: tuple[str, ...] = ("paper", "tuned")
    """Sets of parameters: paper, tuned, or JSON files (as {"L": 0.3})."""
    domain: tuple[str, ...] = ("paper", "wide", "hostile", "prisms")
    """Domains, each a run of its own: paper, hardware, wide, hostile, prisms (those of wide), or
    JSON files of ranges."""
    worlds: int = 10000
    """Of each domain; of the paper's its grid of 144."""
    physics: str = "default"
    """default (isotropic friction) or paper_gazebo (friction pyramid)."""
    fidelity: str = "standard"
    """How finely the physics is solved: reference, standard or fast."""
    engine: str = "fused"
    """fused, mjx, warp, mujoco or quasistatic."""
    seed: int = 0
    """The worlds are those for testing of this seed."""
    device: str = "auto"
    """auto, cpu or gpu."""
    out: Path = Path("runs/compare")
    """Run folder; a run that was killed is continued there."""


@dataclass(frozen=True)
class Tune:
    """Tune the law's parameters in many worlds."""

    how: Annotated[
        Annotated[TuneES, tyro.conf.subcommand("es")]
        | Annotated[TuneGrad, tyro.conf.subcommand("grad")]
        | Annotated[TuneCompare, tyro.conf.subcommand("compare")],
        tyro.conf.arg(name=""),
    ]


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
    | Annotated[Film, tyro.conf.subcommand("film")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Tune, tyro.conf.subcommand("tune")]
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
    from rps_jax.analysis import video

    video.choose_gl()
    act: dict[type, Callable[[Any], None]] = {
        Table: _table,
        Push: _push,
        Hardware: _hardware,
        Paper: _paper,
        Sweep: _sweep,
        Merge: _merge,
        Replay: _replay,
        Film: _film_run,
        View: _view,
        Tune: _tune,
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
        mend = "make room, then run the same command again; what is done is kept"
        hint = f": {mend}" if error.errno == errno.ENOSPC else ""
        where = error.filename or "output"
        print(f"rps: error: {where}: {error.strerror}{hint}.", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(
            "rps: error: the device is out of memory: ask for fewer worlds at once with --slots; "
            "what is done is kept.",
            file=sys.stderr,
        )
        return 2
    except MemoryError:
        print(
            "rps: error: this machine is out of memory: ask for fewer worlds; what is done is "
            "kept.",
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


def _params(common: Conditions, names: Sequence[str]) -> dict[str, Params]:
    """The parameters of these strategies, with the changes that are asked for."""
    from rps_jax.control import strategies

    known = strategies.PARAMS
    fields = {name: _fields(name, known[_known_strategy(name)]) for name in names}
    options = dict.fromkeys(option for of in fields.values() for option in of)
    given = _assignments("params", common.params, list(options))
    return {
        name: known[name]._replace(**{of[option]: v for option, v in given.items() if option in of})
        for name, of in fields.items()
    }


def _known_strategy(name: str) -> str:
    from rps_jax.control import strategies

    return errors.check_name("strategy", name, strategies.PARAMS)


def _fields(strategy: str, params: Params) -> dict[str, str]:
    """How the options name the parameters of a strategy: option -> field."""
    from rps_jax.control.law import RPSParams

    if isinstance(params, RPSParams):
        return {name: name for name in params._fields if name != "reactive"}
    return {f"{strategy}.{name}": name for name in params._fields}


def _friction(text: str) -> Friction:
    from rps_jax.world import scene

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


def _setting(common: Conditions) -> Setting:
    from rps_jax.trials.setting import Setting
    from rps_jax.trials.trial import Rules
    from rps_jax.world.physics import preset

    engines.get(common.engine).check()
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


def _per_world(common: Conditions) -> dict[str, Any]:
    """The options that become fields of every case."""
    from rps_jax.robot import skin
    from rps_jax.world import paper

    name = common.skin or paper.SKIN[common.physics]
    sensor = skin.SKINS[errors.check_name("skin", name, skin.SKINS)]
    changes = _assignments("skin-params", common.skin_params, sensor._fields)
    return {
        "mass": common.mass,
        "skin": sensor._replace(**changes),
        "gap": common.gap,
        "rear": common.rear,
    }


def _case(
    common: Conditions,
    name: str,
    friction: str,
    strategy: str,
    p_world_target: tuple[float, float],
) -> Case:
    """One trial, of an object by its name."""
    from rps_jax.trials import pushes

    params = _params(common, [strategy])[strategy]
    return pushes.Case(name, _friction(friction), p_world_target, params, **_per_world(common))


def _cases(options: Table, targets: Sequence[tuple[float, float]]) -> list[Case]:
    """Every combination, in the nesting order of `score.dataset`."""
    from rps_jax.trials import pushes

    for name in ("strategies", "objects", "friction"):
        _each_once(name, getattr(options, name))
    frictions = [_friction(text) for text in options.friction]
    return [
        pushes.Case(name, friction, target, params, **_per_world(options))
        for params in _params(options, options.strategies).values()
        for name in options.objects
        for friction in frictions
        for target in targets
    ]


def _open(common: Common, command: str) -> Path:
    """The run folder, with what was asked and what it runs on already in it."""
    from rps_jax.record import files, provenance
    from rps_jax.record import folder as run_folder

    out = common.out or Path("runs") / f"{command}-{time.strftime('%Y%m%d-%H%M%S')}"
    choose_device("auto")
    run_folder.prepare(out, overwrite=common.overwrite)
    use_cache()
    files.write_json(out / "environment.json", provenance.environment())
    return out


def _write_config(out: Path, common: Common, setting: Setting, params: dict[str, Params]) -> None:
    from rps_jax.record import files
    from rps_jax.record import folder as run_folder

    config = {
        "options": dataclasses.asdict(common) | {"out": str(out)},
        "params": {name: values._asdict() for name, values in params.items()},
        "physics": dataclasses.asdict(setting.physics),
        "rules": setting.rules._asdict(),
        "skin": _per_world(common)["skin"]._asdict(),
    }
    files.write_json(out / run_folder.CONFIG, config)


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


def _tell(timing: Timing, device: str | None = None) -> None:
    import jax

    print(
        f"compile {timing.compile:.1f} s, run {timing.run:.1f} s "
        f"({timing.simulated / max(timing.run, 1e-9):.0f} simulated s per s) on "
        f"{device or jax.devices()[0].device_kind}"
    )


# --- the commands --------------------------------------------------------------------------


def _table(options: Table) -> None:
    from rps_jax.analysis import figures, tables
    from rps_jax.record import files
    from rps_jax.trials import pushes
    from rps_jax.world import paper

    setting = _setting(options)
    targets = options.targets or paper.TARGETS
    cases = _cases(options, targets)
    shape = options.shape()
    out = _open(options, "table")
    _write_config(out, options, setting, _params(options, options.strategies))
    with progress_bar(len(cases)) as report:
        outcome, timing = pushes.run(cases, setting, **shape, report=report)
    results = tables.dataset(
        outcome, options.strategies, options.objects, options.friction, targets
    )
    files.write_results(out / "results.nc", results)
    title = "Successes, with Wilson 95 % intervals in percent"
    table = tables.markdown(tables.table(results))
    text = f"{title}\n\n{table}\n\n{tables.summary(results)}\n"
    files.write_text(out / "table.txt", text)
    figures.min_distance(results, out / "min_distance.png")
    print(text)
    _tell(timing)
    print(f"run folder: {out}")


def _push(options: Push) -> None:
    from rps_jax.analysis import figures
    from rps_jax.trials import pushes

    setting = _setting(options)
    params = _params(options, [options.strategy])
    case = _case(options, options.object, options.friction, options.strategy, options.target)
    engines.get(options.engine).check_followed()
    errors.check_finite("film_length", options.film_length, above=0, at_most=600, unit="s")
    out = _open(options, "push")
    _write_config(out, options, setting, params)

    with _clock(options.horizon) as report:
        (trace,) = pushes.follow([case], setting, report=report)
    _show(trace, options.object, figures.title_of(case), out)
    if options.video:
        _film(pushes.scene_of(case, setting.physics), trace, options.film_length, out)
    print(f"run folder: {out}")


def _show(trace: Trace, name: str, title: str, out: Path) -> None:
    """Results, figure and a line on the screen for one trial."""
    from rps_jax.analysis import figures, tables
    from rps_jax.record import files

    files.write_results(out / "results.nc", tables.trace_dataset(trace))
    figures.one_trial(trace, title, out / "trial.png")
    result = trace.outcome
    x, y = trace.p_world_target
    print(
        f"{name}, target ({x:g}, {y:g}) m: "
        f"{'reached' if result.success else 'not reached'} at {float(result.time):.1f} s, "
        f"least distance {float(result.min_distance):.3f} m, "
        f"contact lost for {float(result.contact_lost_time):.1f} s"
    )
    _tell(trace.timing)


def _film(scene: Scene, trace: Trace, length: float, out: Path) -> None:
    """Stills and video; without the means for them, a line that says how to mend it."""
    import numpy as np
    from tqdm import tqdm

    from rps_jax.analysis import figures, video
    from rps_jax.trials import trial

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
    from rps_jax.analysis import figures
    from rps_jax.record import files
    from rps_jax.studies import hardware, reproduce
    from rps_jax.trials import pushes
    from rps_jax.world import paper

    setting = _setting(options)
    params = _params(options, ["rps"])
    layout = paper.HARDWARE_LAYOUTS[
        errors.check_name("layout", options.layout, paper.HARDWARE_LAYOUTS)
    ]
    case = pushes.Case(
        paper.HARDWARE_OBJECTS[0], hardware.MIDDLE, layout[0], params["rps"], **_per_world(options)
    )
    engines.get(options.engine).check_followed()  # by Fig. 7
    if options.mass is not None:
        raise InputError(
            f"mass = {options.mass:g} is not allowed: each object of the hardware has the paper's."
        )
    shape = options.shape()
    out = _open(options, "hardware")
    _write_config(out, options, setting, params)
    given = {"layout": options.layout}
    with progress_bar(
        len(paper.HARDWARE_OBJECTS) * len(layout) * len(hardware.frictions())
    ) as report:
        results = hardware.run(case, setting, **given, **shape, report=report)
    files.write_results(out / "results.nc", results)
    with progress_bar(
        2 * len(paper.HARDWARE_OBJECTS) * len(layout) * len(hardware.SHIFTS)
    ) as report:
        shifted = hardware.disturb(case, setting, **given, **shape, report=report)
    files.write_results(out / "shifted.nc", shifted)
    figures.paths(hardware.paths(case, setting, **given), layout, out / "paths.png")
    sections = reproduce.hardware_sections(out, results, shifted)
    reproduce.report_to(out, sections)
    print((out / "report.md").read_text())
    print(f"run folder: {out}")


def _paper(options: Paper) -> None:
    from rps_jax.record import folder as run_folder
    from rps_jax.studies import reproduce

    plan = reproduce.Plan.quick() if options.quick else reproduce.Plan()
    with options.opened() as out:
        run_folder.claim(out, dataclasses.asdict(plan))
        with progress_bar(plan.trials()) as report:
            path = reproduce.run(out, plan, report=report, **options.shape())
    print(f"report: {path}")


def domain_of(text: str) -> Domain:
    """A domain by name or from a JSON file."""
    from rps_jax.world import domain

    if text.endswith(".json"):
        return domain.from_json(_json(Path(text)))
    return domain.DOMAINS[errors.check_name("domain", text, domain.DOMAINS)]


def _domain(options: Sweep) -> Domain:
    from rps_jax.world import domain

    chosen = domain_of(options.domain)
    changes = {}
    for text in options.change:
        name, _, values = text.partition("=")
        errors.check_name("domain quantity", name, domain.RANGES)
        if values.count(",") != 1:
            raise InputError(f"change '{text}' is not allowed: write quantity=low,high.")
        if name in chosen.idle:
            raise InputError(
                f"change '{text}' is not allowed: the domain's objects, frictions, targets or skin "
                f"leave no {name} to draw."
            )
        low, high = (errors.check_number(f"domain {name}", end) for end in values.split(","))
        changes[name] = getattr(chosen, name)._replace(low=low, high=high)
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
    """Every strategy with every set of parameters; one that is not the law has but one."""
    from rps_jax.control import strategies
    from rps_jax.control.law import RPSParams

    _each_once("strategies", options.strategies)
    labels = labels_of("params", options.params)
    sets = {at: _of_the_law(name) for at, name in zip(labels, options.params, strict=True)}
    arms: dict[str, Params] = {}
    for name, changes in sets.items():
        for strategy in options.strategies:
            params = strategies.PARAMS[_known_strategy(strategy)]
            label = strategy
            if isinstance(params, RPSParams):
                params = params._replace(**changes)
                label = strategy if len(sets) == 1 else f"{strategy} {name}"
            arms[label] = params
    return arms


def labels_of(field: str, names: Sequence[str]) -> list[str]:
    """Short names of what files hold: each file's own, after its folder's where two are alike.

    Raises:
      InputError: none is given, or one twice.
    """
    for parts in (1, 2):
        labels = ["/".join((*Path(name).parts[:-1], Path(name).stem)[-parts:]) for name in names]
        if len(set(labels)) == len(names):
            break
    _each_once(field, names, labels)
    return labels


def _each_once(field: str, given: Sequence[Any], labels: Sequence[Any] | None = None) -> None:
    """Raises InputError if nothing is given, or one twice, by its label if it has one."""
    if not given or len(set(given if labels is None else labels)) < len(given):
        raise InputError(f"{field} = {given} is not allowed: name each once, at least one.")


def _of_the_law(name: str) -> dict[str, float]:
    """Changes of the paper's parameters: of `paper`, of `tuned`, or those of a JSON file."""
    from rps_jax.control.law import RPSParams

    known = _fields("rps", RPSParams.paper())
    if name == "tuned":
        return {key: float(getattr(RPSParams.tuned(), key)) for key in known}
    values = {} if name == "paper" else _json(Path(name))
    for key in values:
        errors.check_name(f"parameter of {name}", key, known)
    return {key: errors.check_number(f"{name} {key}", value) for key, value in values.items()}


def params_of(name: str) -> RPSParams:
    """The law's parameters: `paper`, `tuned`, or the paper's with the changes of a JSON file."""
    from rps_jax.control import law
    from rps_jax.control.law import RPSParams

    return law.check(RPSParams.paper()._replace(**_of_the_law(name)))


def _plan(options: Sweep) -> Plan:
    from rps_jax.runs.sweep import Plan
    from rps_jax.trials.setting import Setting
    from rps_jax.trials.trial import Rules
    from rps_jax.world.physics import preset

    domain = _domain(options)
    every = domain.combinations if domain.targets else 1000
    setting = Setting(
        preset(options.physics, options.fidelity),
        Rules(horizon=options.horizon),
        options.seed,
        options.engine,  # pyright: ignore[reportArgumentType]
    )
    worlds = every if options.worlds is None else options.worlds
    return Plan(domain, worlds, _arms(options), setting, options.part)


def _shard(text: str) -> Shard:
    from rps_jax.runs.sweep import Shard

    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal()):
        raise InputError(f"shard '{text}' is not allowed: write k/n, as 3/8.")
    return Shard(int(number), int(of))


def choose_device(name: str) -> None:
    """Have JAX use this kind of device.

    Raises:
      InputError: unknown name, or no such device.
    """
    import jax

    errors.check_name("device", name, DEVICES)
    if name == "auto":
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:  # whichever JAX raises
            asked = jax.config.jax_platforms
            raise InputError(
                f"JAX_PLATFORMS = {asked} is not there: name a device that is, or none."
            ) from error
        return
    before = jax.config.jax_platforms
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[name])
    with contextlib.suppress(RuntimeError, AssertionError):  # whichever JAX raises
        if jax.default_backend() == name:
            return
    jax.config.update("jax_platforms", before)
    raise InputError(
        f"device = {name} is not there: install rps_jax[cuda] on a machine with an NVIDIA GPU, or "
        "choose cpu."
    )


def _check_here(device: str, setting: Setting, domains: Iterable[Domain]) -> None:
    """Choose the device, on which the engine must be able to step worlds of these domains."""

    choose_device(device)
    families = [family for one in domains for family in one.families]
    engines.get(setting.engine).check(families)


def _on_cluster(address: str, options: Sweep) -> Callable[..., Timing]:
    """`robustness.run`, by the workers of a cluster."""
    import jax

    from rps_jax.runs import cluster

    errors.check_name("device", options.device, DEVICES)
    choose_device("cpu")  # for this process: the workers here need the GPUs
    return partial(
        cluster.run,
        address=address,
        prepare=partial(_prepare, options.device, bool(jax.config.jax_enable_x64)),
        gpus=options.device != "cpu" and options.engine != "mujoco",
    )


def _prepare(device: str, x64: bool) -> None:
    """Make a worker's process compute as this one would."""
    import jax

    _be_deterministic()
    jax.config.update("jax_enable_x64", x64)
    choose_device(device)
    use_cache()


def _sweep(options: Sweep) -> None:
    from rps_jax.record import folder as run_folder
    from rps_jax.record import provenance
    from rps_jax.runs import sweep

    plan, shard, shape = _plan(options), _shard(options.shard), options.shape()
    run = sweep.run
    if options.ray:
        run = _on_cluster(options.ray, options)
    else:
        _check_here(options.device, plan.setting, [plan.domain])
    out = sweep.open_run(options.out, plan)
    use_cache()
    with run_folder.hold(out, shard.number, shard.of):
        trials = sum(numbers.size for numbers in sweep.share(plan, shard).values())
        with progress_bar(trials, "sweep") as report:
            timing = run(out, plan, shard=shard, report=report, **shape)
        _tell(timing, provenance.signed(out)["device"]["kind"])
        if shard.of == 1:
            sweep.merge([out], out)
            _report_sweep(out)
        else:
            print(f"run folder: {out}; when all shards are done: rps merge {out} --out {out}")


def _merge(options: Merge) -> None:
    from rps_jax.record import folder as run_folder
    from rps_jax.record import provenance
    from rps_jax.runs import sweep

    if not options.folders:
        raise InputError("folders = () is not allowed: give the run folders of the shards.")
    run_folder.writable(options.out)
    sweep.merge(list(options.folders), options.out)
    for folder in options.folders:
        provenance.sign(options.out, provenance.signed(folder))
    _report_sweep(options.out)


def _report_sweep(out: Path) -> None:
    from rps_jax.runs import sweep

    print(sweep.write_report(out).read_text())
    print(f"run folder: {out}")


def _tune(options: Tune) -> None:
    act: dict[type, Callable[[Any], None]] = {
        TuneES: _tune_es,
        TuneGrad: _tune_grad,
        TuneCompare: _tune_compare,
    }
    act[type(options.how)](options.how)


def _tune_compare(options: TuneCompare) -> None:
    from rps_jax.record import folder as run_folder
    from rps_jax.runs import sweep
    from rps_jax.runs.sweep import Plan
    from rps_jax.trials.setting import Setting
    from rps_jax.tuning import evolution as tune
    from rps_jax.world.physics import preset

    setting = Setting(
        preset(options.physics, options.fidelity),
        seed=tune.seed_of(options.seed, "test"),
        engine=options.engine,  # pyright: ignore[reportArgumentType]
    )
    labels = labels_of("params", options.params)
    arms = {at: params_of(name) for at, name in zip(labels, options.params, strict=True)}
    plans = {}
    for at, text in zip(labels_of("domain", options.domain), options.domain, strict=True):
        one = domain_of(text)
        count = one.combinations if one.targets else options.worlds
        plans[at] = Plan(one, count, arms, setting, part=4096)
    shape = options.shape()
    _check_here(options.device, setting, [plan.domain for plan in plans.values()])
    run_folder.writable(options.out)
    use_cache()
    for name, plan in plans.items():
        out = sweep.open_run(options.out / name, plan)
        with run_folder.hold(out):
            with progress_bar(plan.trials, name) as report:
                sweep.run(out, plan, report=report, **shape)
            sweep.merge([out], out)
            print(f"## {name}\n")
            _report_sweep(out)


def _tune_es(options: TuneES) -> None:
    from rps_jax.tuning import evolution as tune

    how = options
    if how.quick:
        how = _quickly(
            how, worlds=32, validation=64, population=12, generations=8, spread=1.0, slots=64
        )
    space, course = _space(how), _course(how)
    evolution = tune.Evolution(
        how.strategy,
        how.population,
        how.generations,
        how.spread,
        how.prior,
        how.patience,
        how.budget,
        how.seed,
    )
    shape = how.shape()
    _check_here(how.device, course.setting, course.domains)
    out = tune.open_run(how.out, space, course, evolution)
    with _tuning(out, evolution.generations) as report:
        tune.evolve(out, space, course, evolution, report=report, **shape)
    _tell_tuned(out, space.names)


def _tune_grad(options: TuneGrad) -> None:
    from rps_jax.tuning import descent

    how = options
    if how.quick:
        how = _quickly(
            how, worlds=64, validation=64, steps=8, starts=1, learning_rate=0.3, slots=64
        )
    space, course = _space(how), _course(how)
    same = {f.name for f in dataclasses.fields(descent.Descent)} & set(how.__dict__)
    chosen = descent.Descent(**{name: getattr(how, name) for name in same})
    shape = how.shape()
    _check_here(how.device, course.setting, course.domains)
    out = descent.open_run(how.out, space, course, chosen)
    with _tuning(out, chosen.steps + 1) as report:
        descent.descend(out, space, course, chosen, report=report, **shape)
    _tell_tuned(out, space.names)


def _quickly(options: Any, **small: Any) -> Any:
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
    default = type(options)()
    free = {name for name in small if getattr(options, name) == getattr(default, name)}
    return dataclasses.replace(options, **{name: small[name] for name in free})


def _space(options: TuneOptions) -> Space:
    from rps_jax.tuning import evolution as tune

    return tune.Space(tune.expanded(options.tuned), params_of(options.start))


@contextlib.contextmanager
def _tuning(out: Path, count: int) -> Iterator[Callable[[int, Progress], None]]:
    """The run folder in use, and a bar over generations or steps, for tuners to report to."""
    from tqdm import tqdm

    from rps_jax.record import folder as run_folder
    from rps_jax.record import provenance

    use_cache()
    with run_folder.hold(out), tqdm(total=count, unit="generation", desc="compile") as bar:
        provenance.sign(out)

        def report(generation: int, progress: Progress) -> None:
            bar.set_description("tune", refresh=False)
            bar.set_postfix_str(
                f"{progress.finished} trials, {progress.simulated:.0f} s simulated", refresh=False
            )
            bar.update(generation - bar.n)

        yield report
        bar.update(count - bar.n)


def _tell_tuned(out: Path, names: Sequence[str]) -> None:
    """The figure of a tuner's run, and a few lines on the screen."""
    from rps_jax.analysis import figures
    from rps_jax.tuning import evolution as tune

    log = tune.read_log(out)
    figures.tuning(log, names, out / "tuning.png")
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


def _course(options: TuneOptions) -> Course:
    from rps_jax.trials.setting import Setting
    from rps_jax.trials.trial import Rules
    from rps_jax.tuning.evolution import Course, Objective
    from rps_jax.world.physics import preset

    domains = [domain_of(text) for text in options.domain]
    setting = Setting(
        preset(fidelity=options.fidelity),
        Rules(horizon=options.horizon),
        engine=options.engine,  # pyright: ignore[reportArgumentType]
    )
    return Course(
        tuple(dataclasses.replace(one, objects=options.objects) for one in domains),
        options.worlds,
        options.validation,
        setting,
        Objective(options.risk, time=options.time_weight),
    )


def _one_world(run: Path, index: int, arm: str | None) -> tuple[Plan, str]:
    """The plan of a sweep, one of whose worlds can be followed, and the arm that is meant."""
    from rps_jax.runs import sweep

    plan = sweep.load_plan(run)
    arms = list(plan.arms)
    name = errors.check_name("arm", arm or arms[0], arms)
    errors.check_count("index", index, at_least=0, at_most=plan.worlds - 1)
    if plan.setting.engine == "mujoco":
        print("C MuJoCo's trials are not followed: this is the same world in the fused engine.")
        plan = dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, engine="fused"))
    engines.get(plan.setting.engine).check_followed()
    return plan, name


def _replay(options: Replay) -> None:
    from rps_jax.control import strategies
    from rps_jax.record import folder as run_folder
    from rps_jax.runs import sweep
    from rps_jax.trials import pushes

    plan, name = _one_world(options.run, options.index, options.arm)
    errors.check_finite("film_length", options.film_length, above=0, at_most=600, unit="s")
    out = run_folder.writable(options.out or options.run / f"replay-{options.index}")
    use_cache()
    part = sweep.world_part(plan, list(plan.arms).index(name), [options.index])
    strategy = strategies.of(plan.arms[name])
    with _clock(float(plan.setting.rules.horizon)) as report:
        (trace,) = pushes.follow_part(part, strategy, plan.setting, report=report)
    _show(trace, f"world {options.index}, {name}", sweep.title_of(plan, options.index), out)
    if options.video:
        _film(sweep.scene_of(plan, options.index), trace, options.film_length, out)
    print(f"run folder: {out}")


def _film_run(options: Film) -> None:
    from tqdm import tqdm

    from rps_jax.analysis import video
    from rps_jax.app import film
    from rps_jax.record import folder as run_folder

    shape = film.shape_of(options.grid)
    for name in ("seconds", "speed"):
        if getattr(options, name) is not None:
            errors.check_finite(name, getattr(options, name), above=0, at_most=1e5)
    errors.check_name("camera", options.camera, ("oblique", "above"))
    out = options.out or options.run / "film.mp4"
    if out.is_dir():
        raise InputError(f"out = {out} is a folder: name a file, as {out / 'film.mp4'}.")
    if options.out:
        run_folder.writable(out.parent)
    takes, setting = _takes(options, shape[0] * shape[1])
    for what in video.check():
        if not what.ok:
            raise InputError(what.mend)
    use_cache()
    seconds = min(float(setting.rules.horizon), options.seconds or math.inf)
    with tqdm(total=round(seconds), unit="s", desc="film") as bar, _one_sentence(video.VideoError):
        film.shoot(
            takes,
            setting,
            out,
            shape=shape,
            speed=options.speed or film.default_speed(seconds),
            seconds=seconds,
            camera=options.camera,
            report=lambda simulated: bar.update(round(simulated) - bar.n),
        )
    print(f"film: {out}")


@contextlib.contextmanager
def _one_sentence(kind: type[Exception]) -> Iterator[None]:
    """Report an exception that is a sentence as bad input."""
    try:
        yield
    except kind as error:
        raise InputError(str(error)) from error


def _takes(options: Film, count: int) -> tuple[list[Take], Setting]:
    """The trials to film, at most so many, and what they share."""
    from rps_jax.app import film
    from rps_jax.record import folder as run_folder
    from rps_jax.world import paper

    if (options.run / run_folder.MANIFEST).exists():
        plan, arm = _one_world(options.run, 0, options.arm)
        return film.of_sweep(options.run, plan, arm, options.which, count), plan.setting
    table = _table_of(options.run)
    for field, name in (
        ("objects", options.object),
        ("friction", options.friction),
        ("strategies", options.strategy),
    ):
        errors.check_name(f"{field} of the run", name, getattr(table, field))
    table = dataclasses.replace(
        table,
        objects=(options.object,),
        friction=(options.friction,),
        strategies=(options.strategy,),
    )
    setting = _setting(table)
    return film.of_cases(_cases(table, (table.targets or paper.TARGETS)[:count]), setting), setting


def _table_of(run: Path) -> Table:
    """What was asked of `rps table` for the run in a folder."""
    try:
        asked = json.loads((run / "config.json").read_text())["options"]
        return Table(**{name: _tuples(value) for name, value in asked.items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"run = {run} holds neither a table nor a sweep: give the folder of `rps table` or "
            "`rps sweep`."
        ) from error


def _tuples(value: Any) -> Any:
    """JSON's lists as tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _view(options: View) -> None:
    from rps_jax.app import viewer

    asked = viewer.Asked(options.object, options.friction, options.strategy, options.target)
    make = partial(_push_of, options, _setting(options))
    _case(options, *asked)
    engines.get(options.engine).check_followed()
    first = partial(make, asked)
    if options.run is not None:
        plan, name = _one_world(options.run, options.index, options.arm)
        first = partial(_push_in_world, plan, name, options.index)
    page = viewer.open_page(options.host, options.port, asked, make)
    use_cache()
    print(f"page: {page.url} (Ctrl-C ends it)", flush=True)
    try:
        page.begin(first)
        page.run()
    except KeyboardInterrupt:
        print("page closed.")
    finally:
        page.close()


def _push_of(options: View, setting: Setting, asked: viewer.Asked) -> viewer.Push:
    """The push that the page asks for."""
    from rps_jax.app import viewer
    from rps_jax.trials import pushes
    from rps_jax.trials.stepper import Live

    case = _case(options, *asked)
    title = (
        f"{case.object.replace('_', ' ')}, friction ground {case.friction.ground:g}, robot "
        f"{case.friction.robot:g}, {asked.strategy}"
    )
    return viewer.Push(Live.of_case(case, setting), pushes.scene_of(case, setting.physics), title)


def _push_in_world(plan: Plan, arm: str, index: int) -> viewer.Push:
    """A world of a sweep."""
    from rps_jax.app import viewer
    from rps_jax.control import strategies
    from rps_jax.runs import sweep
    from rps_jax.trials.stepper import Live

    part = sweep.world_part(plan, list(plan.arms).index(arm), [index])
    live = Live(part, strategies.of(plan.arms[arm]), plan.setting)
    title = sweep.title_of(plan, index).replace("$\\mu$", "friction")
    return viewer.Push(live, sweep.scene_of(plan, index), f"{title}, {arm}")


def _doctor(_: Doctor) -> None:
    from rps_jax.app import doctor

    choose_device("auto")
    print(doctor.report(cache_folder()))
