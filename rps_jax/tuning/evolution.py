"""Tuning the law: its parameters as a bounded vector, one graded objective, and evolution.

Worlds for tuning, validation and test come from disjoint seeds. Every candidate of a generation
meets the same worlds; the next generation meets others.
"""

from __future__ import annotations

import functools
import json
import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.setting import Progress, Setting, Timing
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.trials.worlds import drawn_worlds, remembered_steps
from rps_jax.world import domain
from rps_jax.world.domain import Domain

# --- vector <-> parameters -----------------------------------------------------------------


class Bound(NamedTuple):
    """Between what a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # evenly in its logarithm
    of: str = ""  # as a share of this other parameter


# v_max, omega_max, v_approach and d_success belong to the robot and the task, not to the law.
BOUNDS = {
    "eta": Bound(1, 100, log=True),  # [1]
    "zeta": Bound(-2, 5),  # [1]
    "beta": Bound(0.01, 0.3),  # [m]
    "k": Bound(5, 500, log=True),  # [1/m]
    "K_h": Bound(0.1, 5, log=True),  # [1]
    "K_v": Bound(0.02, 2, log=True),  # [1/s]
    "L": Bound(0.03, 1.5, log=True),  # [m]
    "l_cr": Bound(0.1, 0.289),  # [m] the half width of the base is 0.29
    "l_mr": Bound(0.02, 0.98, of="l_cr"),  # [1]
    "a_r_max": Bound(1, 100, log=True),  # [1]
    "d_th": Bound(0.02, 2, log=True),  # [m]
    "gamma_max": Bound(0.5, 1.57),  # [rad]
    "v_lost": Bound(0.001, 0.05, log=True),  # [m/s]
}
SUBSETS = {"logistic": ("eta", "zeta", "beta", "k"), "full": tuple(BOUNDS)}


def expanded(names: Sequence[str]) -> tuple[str, ...]:
    """The same names, with those of a subset in its place."""
    return tuple(name for text in names for name in SUBSETS.get(text, (text,)))


@dataclass(frozen=True)
class Space:
    """The parameters that are tuned, as vectors (p,) without bounds; the others stay.

    A coordinate is the logit of where the parameter, or its logarithm, lies between its bounds.
    """

    names: tuple[str, ...] = SUBSETS["logistic"]
    base: RPSParams = RPSParams()

    def __post_init__(self) -> None:
        """Raises InputError for unknown or repeated names, or a base outside the bounds."""
        if not self.names or len(set(self.names)) < len(self.names):
            raise errors.InputError(
                f"tuned = {self.names} is not allowed: name each parameter once, at least one."
            )
        for name in self.names:
            bound = BOUNDS[errors.check_name("tuned parameter", name, BOUNDS)]
            share = _share(bound, self.base, name)
            errors.check_finite(f"{name}, to be tuned", share, above=bound.low)
            if share >= bound.high:
                raise errors.InputError(
                    f"{name}, to be tuned = {share:g} is not allowed: it must be below "
                    f"{bound.high:g}."
                )

    def vector(self, params: RPSParams) -> jax.Array:
        """The vector (..., p) of parameters with leaves (...)."""
        return jnp.stack([self._coordinate(params, name) for name in self.names], axis=-1)

    def _coordinate(self, params: RPSParams, name: str) -> jax.Array:
        low, high, log, _ = bound = BOUNDS[name]
        value = jnp.asarray(_share(bound, params, name), float)
        if log:
            low, high, value = math.log(low), math.log(high), jnp.log(value)
        return jax.scipy.special.logit((value - low) / (high - low))

    def params(self, vector: jax.Array) -> RPSParams:
        """The parameters of vectors (..., p): leaves (...)."""
        vector = jnp.asarray(vector)
        filled = {
            name: jnp.broadcast_to(jnp.asarray(value, vector.dtype), vector.shape[:-1])
            for name, value in self.base._asdict().items()
        }
        for name in sorted(self.names, key=lambda name: bool(BOUNDS[name].of)):
            low, high, log, of = BOUNDS[name]
            u = jax.nn.sigmoid(vector[..., self.names.index(name)])
            value = low * (high / low) ** u if log else low + (high - low) * u
            filled[name] = value * filled[of] if of else value
        # A share of a tuned parameter that is itself fixed must not pass it.
        filled["l_mr"] = jnp.minimum(filled["l_mr"], filled["l_cr"])
        return RPSParams(**filled)


def _share(bound: Bound, params: RPSParams, name: str) -> Any:
    value = getattr(params, name)
    return value / getattr(params, bound.of) if bound.of else value


# --- the objective -------------------------------------------------------------------------


@dataclass(frozen=True)
class Objective:
    """What is minimised: a score of every trial, and the risk over worlds.

    A success scores its time, a failure one more and how far it missed; both score the time
    without contact.
    """

    risk: str = "mean"
    """mean, or cvar: the mean over the worst `tail` of the worlds."""
    tail: float = 0.1
    """[1] Share of the worlds that cvar looks at."""
    time: float = 0.1
    """[1] Of a success that takes the whole horizon."""
    lost: float = 0.1
    """[1] Of as much time without contact as the rules allow."""
    miss: float = 0.5
    """[1/m] Of a metre missed, up to one metre."""

    def __post_init__(self) -> None:
        """Raises InputError for weights or a risk that mean nothing."""
        errors.check_name("risk", self.risk, ("mean", "cvar"))
        errors.check_finite("tail", self.tail, above=0, at_most=1)
        for name in ("time", "lost", "miss"):
            errors.check_finite(name, getattr(self, name), at_least=0)

    def score(self, success: Any, time: Any, lost: Any, missed: Any, rules: Rules) -> Any:
        """Scores (...) [1] of trials, less is better, about 0 to 2.

        Args:
          success: (...) [1] 0 or 1, or between for a softened trial.
          time: (...) [s] until its end.
          lost: (...) [s] without contact.
          missed: (...) [m] least distance to the target.
          rules: when a trial ends.
        """
        failed = 1 + self.miss * jnp.minimum(missed, 1.0)
        return (
            self.time * time / rules.horizon
            + self.lost * lost / max(float(rules.max_lost), 1e-6)
            + (1 - success) * failed
        )

    def value(self, scores: ArrayLike) -> jax.Array:
        """The risk (...) of scores (..., W) over their worlds."""
        scores = jnp.asarray(scores)
        if self.risk == "mean":
            return jnp.mean(scores, axis=-1)
        worst = max(1, round(self.tail * scores.shape[-1]))
        return jnp.mean(jnp.sort(scores, axis=-1)[..., -worst:], axis=-1)


# --- candidates in worlds ------------------------------------------------------------------

SPLITS = ("tune", "validate", "test")


def seed_of(seed: int, split: str) -> int:
    """The seed of the worlds of one split: no two splits of any seeds share a world.

    Of a domain that draws little, as `paper`, the worlds hardly depend on the seed.
    """
    return len(SPLITS) * seed + SPLITS.index(errors.check_name("split", split, SPLITS))


class Ask(NamedTuple):
    """Candidates and the worlds that each of them meets."""

    params: Any  # RPSParams, leaves (P,)
    seed: int  # of the worlds
    worlds: np.ndarray  # (W,) their indices, in each of the D domains


class Answer(NamedTuple):
    """How an `Ask` went."""

    score: np.ndarray  # (P, D * W) [1]
    success: np.ndarray  # (P, D * W) [1]
    time: np.ndarray  # (P, D * W) [s]
    path: np.ndarray  # (P, D * W) [m]


class _Group(NamedTuple):
    """Worlds of an ask that can be batched: those of one object of one domain."""

    params: Any  # RPSParams, leaves (P,), on the host
    part: Part  # the worlds, whose parameters are still to be filled in
    first: int  # number of the ask's first trial
    width: int  # trials of each candidate
    column: np.ndarray  # (n,) of the worlds among those


def try_out(
    asks: Sequence[Ask],
    domains: Sequence[Domain],
    setting: Setting,
    objective: Objective,
    *,
    report: Callable[[Progress], Any] = lambda progress: None,
    **shape: Any,
) -> tuple[list[Answer], Timing]:
    """Every candidate in every world of its ask, all asks in one batch for a shape family."""
    widths = [len(domains) * ask.worlds.size for ask in asks]
    sizes = [len(ask.params.L) * width for ask, width in zip(asks, widths, strict=True)]
    firsts = [sum(sizes[:i]) for i in range(len(sizes))]
    found = Answer(*np.full((4, sum(sizes)), np.nan))
    lost, way = np.empty((2, sum(sizes)))  # [s], [m] missed: all the way until it ends nearer
    longest = max(remembered_steps(one, setting.physics.control_period) for one in domains)
    jobs: dict[Any, list[_Group]] = {}
    for ask, width, first, size in zip(asks, widths, firsts, sizes, strict=True):
        params, of_ask = jax.device_get(ask.params), way[first : first + size].reshape(-1, width)
        for part, column, distance in parts(ask, domains, setting):
            of_ask[:, column] = distance
            part = _remembering(part, longest)
            alike = jax.tree.map(lambda leaf: leaf.shape[1:], part.worlds)
            kind = (*jax.tree.leaves(alike), jax.tree.structure(alike))
            jobs.setdefault(kind, []).append(_Group(params, part, first, width, column))

    def collect(numbers: np.ndarray, outcome: Outcome) -> None:
        found.success[numbers], found.time[numbers] = outcome.success, outcome.time
        found.path[numbers] = outcome.path_length
        lost[numbers] = outcome.contact_lost_time
        near = outcome.min_distance
        way[numbers] = np.where(np.isfinite(near), near, way[numbers])

    count = [sum(len(g.params.L) * g.column.size for g in groups) for groups in jobs.values()]
    timing = batch.run(
        [Job(strategies.RPS, n, _filled(g)) for n, g in zip(count, jobs.values(), strict=True)],
        setting,
        collect=collect,
        report=report,
        **shape,
    )
    rules = setting.rules
    found.score[:] = objective.score(found.success, found.time, lost, way, rules)
    return [
        Answer(*(row[first : first + size].reshape(-1, width) for row in found))
        for width, first, size in zip(widths, firsts, sizes, strict=True)
    ], timing


def parts(
    ask: Ask, domains: Sequence[Domain], setting: Setting
) -> Iterator[tuple[Part, np.ndarray, np.ndarray]]:
    """Worlds of an ask by domain and object, their columns, and the targets' distances [m]."""
    for d, one in enumerate(domains):
        which = one.object_of(ask.worlds)
        for thing in np.unique(which):
            rows = np.flatnonzero(which == thing)
            drawn = domain.draw(one, ask.seed, ask.worlds[rows])
            part = drawn_worlds(one, drawn, RPSParams(), setting)
            yield part, d * ask.worlds.size + rows, np.linalg.norm(drawn.p_world_target, axis=1)


def _remembering(part: Part, steps: int) -> Part:
    """The part with room for so many steps of odometry, which batches it with other domains'."""
    odometry = part.worlds.odometry
    past = np.zeros((part.numbers.size, steps), odometry.past.dtype)
    return part._replace(worlds=part.worlds._replace(odometry=odometry._replace(past=past)))


def _filled(groups: Sequence[_Group]) -> Iterator[Part]:
    """The groups' worlds with the parameters of one candidate after the other."""
    for params, part, first, width, column in groups:
        for p in range(len(params.L)):
            own: Any = [np.full(column.size, leaf[p], leaf.dtype) for leaf in params]
            worlds = part.worlds._replace(params=RPSParams(*own))
            yield Part(first + p * width + column, worlds, part.stage)


# --- evolution -----------------------------------------------------------------------------

# Of evosax, those that keep a distribution over candidates.
STRATEGIES = ("CMA_ES", "Sep_CMA_ES", "MA_ES", "Rm_ES", "SNES", "PGPE")


@dataclass(frozen=True)
class Evolution:
    """How evolution searches."""

    strategy: str = "CMA_ES"
    """A distribution-based strategy of evosax, by name."""
    population: int = 64
    """Candidates of a generation."""
    generations: int = 50
    """In all, over restarts."""
    spread: float = 0.5
    """[1] Standard deviation of the first generation, about the base parameters."""
    prior: float = 0.002
    """[1] Price of a mean square of 1 between a candidate's coordinates and the base's: keeps the
    search where the bounded map is not flat."""
    patience: int = 0
    """Generations without a better validation before a restart elsewhere; 0: never."""
    budget: float = 0.0
    """[s] Simulated time after which no generation begins; 0: no bound."""
    seed: int = 0
    """Of the proposals, and of the worlds for tuning and validation."""

    def __post_init__(self) -> None:
        """Raises InputError for an unknown strategy or counts that mean nothing."""
        errors.check_name("strategy", self.strategy, STRATEGIES)
        errors.check_finite("population", self.population, at_least=4, at_most=1e5)
        if self.strategy == "PGPE" and self.population % 2:
            raise errors.InputError(
                f"population = {self.population} is not allowed for PGPE: its candidates are pairs."
            )
        errors.check_finite("generations", self.generations, at_least=1, at_most=1e6)
        errors.check_finite("spread", self.spread, above=0, at_most=10)
        errors.check_finite("prior", self.prior, at_least=0)
        errors.check_finite("patience", self.patience, at_least=0)
        errors.check_finite("budget", self.budget, at_least=0, unit="s")
        errors.check_finite("seed", self.seed, at_least=0, at_most=2**30)

    def algorithm(self, size: int) -> Any:
        """The strategy of evosax for vectors (size,)."""
        return _algorithm(self.strategy, self.population, size)


@functools.cache  # evosax compiles for each instance
def _algorithm(strategy: str, population: int, size: int) -> Any:
    from evosax import algorithms  # which runs programs when it is imported

    return getattr(algorithms, strategy)(population, jnp.zeros(size))


class Search(NamedTuple):
    """The state of an evolution, all that a resumed one needs."""

    state: Any  # of evosax
    generation: jax.Array  # () int32: how many are done
    best: jax.Array  # (p,) the mean that validated best
    best_value: jax.Array  # () its value there
    since: jax.Array  # () int32: generations since then
    restarts: jax.Array  # () int32


def begin(evolution: Evolution, space: Space, mean: jax.Array) -> Search:
    """The state before the first generation, about `mean` (p,)."""
    zero = jnp.zeros((), jnp.int32)
    state = _init(evolution, mean, zero)
    return Search(state, zero, mean, jnp.asarray(jnp.inf), zero, zero)


def _init(evolution: Evolution, mean: jax.Array, restarts: jax.Array) -> Any:
    algorithm = evolution.algorithm(mean.size)
    key = jax.random.fold_in(jax.random.key(evolution.seed), restarts)
    state = algorithm.init(key, mean, algorithm.default_params)
    if hasattr(state, "std"):  # of one coordinate or of each
        state = state.replace(std=jnp.full_like(state.std, evolution.spread))
    return state


def propose(evolution: Evolution, search: Search) -> tuple[jax.Array, Any]:
    """The next generation (P, p), and the strategy's state that goes with it."""
    algorithm = evolution.algorithm(search.best.size)
    key, _ = _keys(evolution, search)
    return algorithm.ask(key, search.state, algorithm.default_params)


def learn(
    evolution: Evolution, search: Search, asked: Any, candidates: jax.Array, values: jax.Array
) -> Search:
    """The search after a generation (P, p) of values (P,); NaN ranks worst."""
    algorithm = evolution.algorithm(search.best.size)
    _, key = _keys(evolution, search)
    values = jnp.asarray(values, search.best.dtype)
    worst = jnp.max(jnp.where(jnp.isnan(values), -jnp.inf, values))
    ranked = jnp.where(jnp.isnan(values), worst + 1.0, values)
    state, _ = algorithm.tell(key, candidates, ranked, asked, algorithm.default_params)
    return search._replace(state=state, generation=search.generation + 1)


def validated(evolution: Evolution, search: Search, mean: jax.Array, value: Any) -> Search:
    """The search after its mean (p,) was tried on the worlds for validation."""
    value = jnp.asarray(value, search.best_value.dtype)
    better = value < search.best_value
    search = search._replace(
        best=jnp.where(better, mean, search.best),
        best_value=jnp.where(better, value, search.best_value),
        since=jnp.where(better, 0, search.since + 1),
    )
    if not evolution.patience or int(search.since) < evolution.patience:
        return search
    restarts = search.restarts + 1
    key = jax.random.fold_in(jax.random.key(evolution.seed + 1), restarts)
    elsewhere = jax.random.normal(key, search.best.shape, search.best.dtype)
    state = _init(evolution, elsewhere, restarts)
    return search._replace(state=state, since=jnp.zeros((), jnp.int32), restarts=restarts)


def _keys(evolution: Evolution, search: Search) -> tuple[jax.Array, jax.Array]:
    key = jax.random.fold_in(jax.random.key(evolution.seed), 2**20 + search.generation)
    ask, tell = jax.random.split(key)
    return ask, tell


# --- runs that can be continued ------------------------------------------------------------


@dataclass(frozen=True)
class Course:
    """In which worlds candidates are tried."""

    domains: tuple[Domain, ...] = (domain.DOMAINS["wide"],)
    worlds: int = 512
    """Of a generation, in each domain."""
    validation: int = 512
    """Worlds for validation, in each domain."""
    setting: Setting = Setting(engine="fused")
    objective: Objective = Objective()

    def __post_init__(self) -> None:
        """Raises InputError for no domain or no worlds."""
        if not self.domains:
            raise errors.InputError("domains = () is not allowed: name at least one.")
        errors.check_finite("worlds", self.worlds, at_least=1, at_most=1e7)
        errors.check_finite("validation", self.validation, at_least=1, at_most=1e7)

    def ask(self, params: RPSParams, seed: int, generation: int) -> Ask:
        """Candidates with leaves (P,) in the worlds of a generation."""
        worlds = generation * self.worlds + np.arange(self.worlds)
        return Ask(params, seed_of(seed, "tune"), worlds)

    def validate(self, params: RPSParams, seed: int) -> Ask:
        """Candidates with leaves (P,) in the worlds for validation."""
        return Ask(params, seed_of(seed, "validate"), np.arange(self.validation))


def open_run(folder: Path, space: Space, course: Course, evolution: Evolution) -> Path:
    """The run folder; one that holds a run must hold this one, but for how long it goes on.

    Raises:
      InputError: it cannot be written, or holds another run.
    """
    own = {"evolution": asdict(replace(evolution, generations=1, budget=0.0))}
    return run_folder.claim(folder, configuration(space, course) | own)


def configuration(space: Space, course: Course) -> dict[str, Any]:
    """What is tuned, and in which worlds, as JSON."""
    setting = asdict(course.setting) | {"rules": course.setting.rules._asdict()}
    return {
        "tuned": space.names,
        "base": {name: float(value) for name, value in space.base._asdict().items()},
        "course": asdict(course) | {"setting": setting},
    }


def evolve(
    folder: Path,
    space: Space,
    course: Course,
    evolution: Evolution,
    *,
    report: Callable[[int, Progress], Any] = lambda generation, progress: None,
    **shape: Any,
) -> RPSParams:
    """Tune by evolution, in a run folder; one that was killed goes on with the same proposals.

    Every generation is a line of `log.jsonl`: the least and mean value and their spread, the base
    parameters in the same worlds, the strategy's mean on the worlds for validation, and its
    parameters. `state.npz` is all that is needed to go on. Returns the mean that validated best,
    as `tuned.json` holds it.
    """
    search = begin(evolution, space, space.vector(space.base))
    search, log = resume(folder, search, "generation")
    while int(search.generation) < evolution.generations and not spent(log, evolution.budget):
        generation = int(search.generation)
        candidates, asked = propose(evolution, search)
        mean = asked.mean
        asks = [
            course.ask(space.params(candidates), evolution.seed, generation),
            course.ask(space.params(space.vector(space.base)[None]), evolution.seed, generation),
            course.validate(space.params(mean[None]), evolution.seed),
        ]
        (tried, base, check), timing = try_out(
            asks,
            course.domains,
            course.setting,
            course.objective,
            report=lambda progress, g=generation: report(g, progress),
            **shape,
        )
        away = jnp.mean((candidates - space.vector(space.base)) ** 2, axis=-1)
        values = course.objective.value(tried.score)
        value = float(course.objective.value(check.score)[0])
        search = learn(evolution, search, asked, candidates, values + evolution.prior * away)
        search = validated(evolution, search, mean, value)
        log.append(
            {
                "generation": generation,
                "best": finite(np.nanmin(values)),
                "mean": finite(np.nanmean(values)),
                "spread": finite(np.nanstd(values)),
                "not_finite": int(np.isnan(values).sum()),
                "base": finite(course.objective.value(base.score)[0]),
                "validation": finite(value),
                "validation_success": float(check.success.mean()),
                "restarts": int(search.restarts),
                "simulated": timing.simulated,
                "compile": timing.compile,
                "run": timing.run,
                "params": named(space, mean),
            }
        )
        files.write_json(folder / "tuned.json", named(space, search.best))
        save(folder, search, log)
    return space.params(search.best)


def spent(log: Sequence[dict[str, Any]], budget: float) -> bool:
    """Whether the generations of a log have simulated a budget [s]; never one of 0."""
    return 0 < budget <= sum(line["simulated"] for line in log)


def finite(value: Any) -> float | None:
    """As JSON has it: None for what is not finite."""
    return float(value) if np.isfinite(value) else None


def named(space: Space, vector: jax.Array) -> dict[str, float]:
    """The tuned parameters of a vector (p,) by name, and the others that are not the paper's."""
    found, usual = (
        {name: float(f"{float(value):.7g}") for name, value in params._asdict().items()}
        for params in (space.params(vector), RPSParams.paper())
    )
    return {n: x for n, x in found.items() if n in space.names or x != usual[n]}


def save(folder: Path, search: Any, log: list[dict[str, Any]]) -> None:
    """Write the state of a search, a pytree of arrays, and its log."""
    files.write_text(folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in log))
    leaves: dict[str, Any] = {f"{i:03d}": x for i, x in enumerate(jax.tree.leaves(search))}
    files.atomic(folder / "state.npz", lambda path: np.savez(path, **leaves))


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The generations of a run so far, as `evolve` logs them."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def resume(folder: Path, search: Any, done: str) -> tuple[Any, list[dict[str, Any]]]:
    """The state and the log of a run folder; `search` and none in a new one.

    Args:
      folder: where `save` wrote.
      search: a state of the same structure.
      done: its field that counts the lines of the log.

    Raises:
      InputError: the run is corrupt.
    """
    if not (folder / "state.npz").exists():
        return search, []
    try:
        with np.load(folder / "state.npz", allow_pickle=False) as file:
            leaves = [jnp.asarray(file[name]) for name in sorted(file.files)]
        search = jax.tree.unflatten(jax.tree.structure(search), leaves)
        return search, read_log(folder)[: int(getattr(search, done))]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise errors.InputError(
            f"{folder} holds a corrupt run ({error}): restore it, or choose another folder."
        ) from error
