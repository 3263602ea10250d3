"""The commands that tune: es, grad, compare."""

from __future__ import annotations


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
