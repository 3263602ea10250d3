"""The command line: `rps table`, `rps push`, `rps doctor`.

Input is checked, and folders are tried, before anything compiles. Heavy modules are imported by
the commands, so that `rps --help` answers at once and MuJoCo finds its rendering backend chosen.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rps_jax import errors
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.law import RPSParams
    from rps_jax.scene import Friction
    from rps_jax.sweep import Case, Setting, Timing, Trace


@dataclass(frozen=True)
class Common:
    """Options that every run takes."""

    params: tuple[str, ...] = ()
    """Parameters of the law to change from the paper's, as name=value."""
    physics: str = "default"
    """default (elliptic friction cone) or pyramidal."""
    timestep: float | None = None
    """Physics step [s]; by default that of the physics."""
    control_period: float | None = None
    """Time between two decisions of the law [s]; by default that of the physics."""
    skin: str = "ideal"
    """ideal (the paper's simulated contact sensor) or capacitive (42 taxels)."""
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
class Table(Common):
    """Run the paper's trials and print Table II beside the paper's."""

    objects: tuple[str, ...] = ("box", "cylinder", "nonuniform_box")
    """Objects to push."""
    strategies: tuple[str, ...] = ("rps", "nps")
    """Strategies to run: rps, nps."""
    friction: tuple[str, ...] = ("S1", "S2")
    """Friction sets, each S1, S2 or ground,robot (as 0.25,0.4)."""
    targets: tuple[tuple[float, float], ...] = ()
    """Targets x y [m], one pair after the other; by default the paper's 24."""
    slots: int | None = None
    """Worlds stepped at once by one worker; by default chosen by the device."""
    workers: int | None = None
    """Host threads; by default chosen by the device."""


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
    """rps or nps."""
    video: bool = True
    """Film the push."""
    film_length: float = 12.0
    """Length of the film [s], whatever the trial's."""


@dataclass(frozen=True)
class Doctor:
    """Print versions, devices and folders, and what does not work with its mend."""


Command = (
    Annotated[Table, tyro.conf.subcommand("table")]
    | Annotated[Push, tyro.conf.subcommand("push")]
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
    _be_deterministic()
    act: dict[type, Callable[[Any], None]] = {Table: _table, Push: _push, Doctor: _doctor}
    return guarded(lambda: act[type(command)](command))


def guarded(action: Callable[[], None]) -> int:
    """Run a command: exit code 0, or one sentence on the error stream and 2 (130: interrupted)."""
    try:
        action()
    except InputError as error:
        print(f"rps: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"rps: error: {error.filename or 'output'}: {error.strerror}.", file=sys.stderr)
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


def _params(common: Common, strategy: str) -> RPSParams:
    from rps_jax import law

    if strategy == "aps":
        raise InputError("strategy 'aps' is not available yet: choose from rps, nps.")
    errors.check_name("strategy", strategy, ("rps", "nps"))
    base = law.RPSParams.paper() if strategy == "rps" else law.RPSParams.nps()
    names = [name for name in base._fields if name != "reactive"]
    return base._replace(**_assignments("params", common.params, names))


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
    from rps_jax import scene, skin, sweep
    from rps_jax.trial import Rules

    errors.check_name("physics", common.physics, scene.PHYSICS)
    steps = {"timestep": common.timestep, "control_period": common.control_period}
    physics = dataclasses.replace(
        scene.PHYSICS[common.physics], **{k: v for k, v in steps.items() if v is not None}
    )
    sensor = skin.SKINS[errors.check_name("skin", common.skin, skin.SKINS)]
    changes = _assignments("skin-params", common.skin_params, sensor._fields)
    return sweep.Setting(
        physics=physics,
        rules=Rules(horizon=common.horizon),
        skin=sensor._replace(**changes),
        gap=common.gap,
        rear=errors.check_name("rear", common.rear, ("near", "far")),  # pyright: ignore[reportArgumentType]
        seed=common.seed,
    )


def _cases(options: Table, targets: Sequence[tuple[float, float]]) -> list[Case]:
    """Every combination, in the nesting order of `score.dataset`."""
    from rps_jax import sweep

    for name in ("strategies", "objects", "friction"):
        values = getattr(options, name)
        if not values or len(set(values)) < len(values):
            raise InputError(f"{name} = {values} is not allowed: name each once, at least one.")
    frictions = [_friction(text) for text in options.friction]
    return [
        sweep.Case(name, friction, target, params, options.mass)
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


def _write_config(
    out: Path, common: Common, setting: Setting, params: dict[str, RPSParams]
) -> None:
    from rps_jax import record

    config = {
        "options": dataclasses.asdict(common) | {"out": str(out)},
        "params": {name: values._asdict() for name, values in params.items()},
        "physics": dataclasses.asdict(setting.physics),
        "rules": dataclasses.asdict(setting.rules),
        "skin": {"kind": common.skin, **setting.skin._asdict()},
    }
    record.write_json(out / "config.json", config)


def _tell(timing: Timing) -> None:
    import jax

    print(
        f"compile {timing.compile:.1f} s, run {timing.run:.1f} s "
        f"({timing.simulated / max(timing.run, 1e-9):.0f} simulated s per s) on "
        f"{jax.devices()[0].device_kind}"
    )


# --- the commands --------------------------------------------------------------------------


def _table(options: Table) -> None:
    from tqdm import tqdm

    from rps_jax import figures, paper, record, score, sweep

    setting = _setting(options)
    targets = options.targets or paper.TARGETS
    cases = _cases(options, targets)
    for name, value in (("slots", options.slots), ("workers", options.workers)):
        if value is not None:
            errors.check_finite(name, value, at_least=1)
    out = _open(options, "table")
    _write_config(out, options, setting, {s: _params(options, s) for s in options.strategies})

    with tqdm(total=len(cases), unit="trial", desc="compile", mininterval=0.5) as bar:

        def report(progress: sweep.Progress) -> None:
            bar.set_description("push", refresh=False)
            bar.set_postfix_str(f"{progress.simulated:.0f} s simulated", refresh=False)
            bar.update(progress.finished - bar.n)

        outcome, timing = sweep.run(
            cases, setting, slots=options.slots, workers=options.workers, report=report
        )
    results = score.dataset(outcome, options.strategies, options.objects, options.friction, targets)
    record.write_results(out / "results.nc", results)
    text = f"{score.table(results)}\n\n{score.summary(results)}\n"
    record.write_text(out / "table.txt", text)
    figures.min_distance(results, out / "min_distance.png")
    print(text)
    _tell(timing)
    print(f"run folder: {out}")


def _push(options: Push) -> None:
    from tqdm import tqdm

    from rps_jax import figures, record, score, sweep

    setting = _setting(options)
    params = _params(options, options.strategy)
    case = sweep.Case(
        options.object, _friction(options.friction), options.target, params, options.mass
    )
    errors.check_finite("film_length", options.film_length, above=0, at_most=600, unit="s")
    out = _open(options, "push")
    _write_config(out, options, setting, {options.strategy: params})

    with tqdm(total=setting.rules.horizon, unit="s", desc="compile", smoothing=0.05) as bar:

        def report(progress: sweep.Progress) -> None:
            bar.set_description("push", refresh=False)
            bar.update(round(progress.simulated - bar.n, 3))

        trace = sweep.follow(case, setting, report=report)
    record.write_results(out / "results.nc", score.trace_dataset(trace))
    figures.one_trial(case, trace, out / "trial.png")
    result = trace.outcome
    print(
        f"{options.object}, target ({case.p_world_target[0]:g}, {case.p_world_target[1]:g}) m: "
        f"{'reached' if result.success else 'not reached'} at {float(result.time):.1f} s, "
        f"least distance {float(result.min_distance):.3f} m, "
        f"contact lost for {float(result.contact_lost_time):.1f} s"
    )
    _tell(trace.timing)
    if options.video:
        _film(options, case, setting, trace, out)
    print(f"run folder: {out}")


def _film(options: Push, case: Case, setting: Setting, trace: Trace, out: Path) -> None:
    """Stills and video; without the means for them, a line that says how to mend it."""
    import numpy as np
    from tqdm import tqdm

    from rps_jax import figures, sweep, trial, video

    scene = sweep.scene_of(case, setting)
    target = np.array(case.p_world_target)
    seen = trace.snapshots
    fps = 25
    rows = _evenly(len(seen.time), round(options.film_length * fps))
    stills = _evenly(len(seen.time), 6)
    try:
        images = [video.snapshot(scene, seen.qpos[i], p_world_target=target) for i in stills]
        figures.stills(images, np.asarray(seen.time)[stills], out / "stills.png")
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


def _doctor(_: Doctor) -> None:
    from rps_jax import doctor

    print(doctor.report(cache_folder()))
