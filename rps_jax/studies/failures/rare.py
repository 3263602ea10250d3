"""How often does a law fail that rarely fails? Subset simulation over the unit cube.

The probability of a severity of at least 1 is a product of probabilities that are not small: of a
level that a fifth of all worlds reach, of the next one given that, and so on (Au and Beck, 2001;
Cerou and Guyader's multilevel splitting is its near relative). Worlds beyond a level are found by
Markov chains that begin in those worlds and move in the normal quantiles z of u, a random half of
the coordinates at a time, by the preconditioned Crank-Nicolson step z' = sqrt(1 - b^2) z + b e,
under which the normal law does not change; a move to below the level is refused.

All is done by several groups that share nothing but the levels. Their mean is the estimate, and
their spread is its interval: no assumption about how far the chains mix is needed, but a kind of
failure that no group has met is in no interval.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.control.strategies import Params
from rps_jax.record import folder as run_folder
from rps_jax.runs.evaluate import seed_of
from rps_jax.studies.failures.probe import Probe
from rps_jax.trials.setting import Report, Setting, unheard
from rps_jax.world import points
from rps_jax.world.domain import Domain

Severity = Callable[[np.ndarray], np.ndarray]  # of points (n, q), (n,)
_EDGE = 1e-9  # least distance of a coordinate to the ends of its range
_ACCEPTED = 0.35  # share of moves that the step is adapted to


@dataclass(frozen=True)
class Splitting:
    """How a small probability is looked for."""

    particles: int = 1000
    """Number of worlds of a level, over all groups; a group should have a hundred."""
    groups: int = 10
    """Number of groups that share nothing but the levels; their spread is the interval."""
    share: float = 0.2
    """[1] Share of the worlds that reach the next level, whose chains begin in them."""
    levels: int = 30
    """Number of levels after which it gives up, and says 0 if nothing has failed."""
    beyond: float = 0.0
    """[m] A failure counts if it missed the target by more than this; 0 counts all failures."""

    def __post_init__(self) -> None:
        """Raises InputError for numbers that mean nothing together."""
        errors.check_count("groups", self.groups, at_least=2, at_most=10_000)
        errors.check_finite("share", self.share, at_least=0.05, at_most=0.5)
        least = self.groups * 2 * round(1 / self.share)
        errors.check_count("particles", self.particles, at_least=least, at_most=10_000_000)
        errors.check_count("levels", self.levels, at_most=100)
        errors.check_finite("beyond", self.beyond, at_least=0, at_most=20, unit="m")

    @property
    def level(self) -> float:
        """The severity from which on a trial is what is looked for."""
        return 1 + self.beyond


class Estimate(NamedTuple):
    """A probability, with its interval of 95 %."""

    p: float  # [1]
    low: float
    high: float
    variation: float  # [1] of the estimate: standard error over estimate
    trials: int


class Found(NamedTuple):
    """What subset simulation came to."""

    estimate: Estimate
    groups: np.ndarray  # (groups,) [1] what each came to
    levels: list[float]  # severities that were the levels, the last one that of the event
    u: np.ndarray  # (n, q) worlds of the last levels that fail
    severity: np.ndarray  # (n,)


Steps = Generator[np.ndarray, np.ndarray, Found]


def joined(groups: np.ndarray, trials: int, least: float = 0.0) -> Estimate:
    """The mean of groups' estimates, with Student's interval, even in the logarithm.

    A few groups agree by luck now and then, so the coefficient of variation is at least `least`.
    """
    p, count = float(groups.mean()), groups.size
    if p == 0:
        return Estimate(0.0, 0.0, 1.0, float("inf"), trials)
    variation = max(least, float(groups.std(ddof=1)) / p / np.sqrt(count))
    reach = variation * float(stats.t.ppf(0.975, count - 1))
    return Estimate(p, p * np.exp(-reach), min(1.0, p * np.exp(reach)), variation, trials)


def split(score: Severity, kinds: Sequence[str], how: Splitting, seed: int = 0) -> Found:
    """The probability that `score` of a uniform point reaches a level.

    Args:
      score: of points (n, q), asked for one batch of all groups at a time.
      kinds: (q,) of the coordinates; those of noise are drawn anew or kept, not moved.
      how: sizes, and the level.
      seed: of the points and moves.
    """
    (found,) = together(score, [steps(kinds, how, seed)])
    return found


def together(score: Severity, every: Sequence[Steps]) -> list[Found]:
    """Several of them side by side, which are asked for one batch of all of them at a time."""
    found: dict[int, Found] = {}
    asked = dict(enumerate(map(next, every)))
    while asked:
        told = score(np.concatenate(list(asked.values())))
        ends = np.cumsum([len(u) for u in asked.values()])[:-1]
        for i, s in zip(list(asked), np.split(told, ends), strict=True):
            try:
                asked[i] = every[i].send(s)
            except StopIteration as end:
                del asked[i]
                found[i] = end.value
    return [found[i] for i in sorted(found)]


def steps(kinds: Sequence[str], how: Splitting, seed: int) -> Steps:
    """Subset simulation, which asks for the severities (n,) of points (n, q) as it goes on."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    noise = np.array([kind == "noise" for kind in kinds])
    shape = (how.groups, how.particles // how.groups)
    trials, step, levels = 0, 0.6, []
    least = 0.0  # squared variation of independent worlds, which chains cannot have less of

    def ask(z: np.ndarray) -> Generator[np.ndarray, np.ndarray, np.ndarray]:
        nonlocal trials
        trials += z[..., 0].size
        told = yield _uniform(z.reshape(-1, z.shape[-1]))
        return told.reshape(z.shape[:-1])

    z = rng.standard_normal((*shape, len(kinds)))
    s, p = (yield from ask(z)), np.ones(how.groups)
    for _ in range(how.levels):
        # One level for all groups, which is nearly independent of each; it must be passed.
        level = float(np.sort(s, axis=None)[-max(2, round(how.share * s.size))])
        if level >= how.level or (s >= level).all():
            break
        levels.append(level)
        least += _variation(s >= level)
        p *= (s >= level).mean(axis=1)
        starts = [_chosen(one >= level, round(how.share * shape[1]), rng) for one in s]
        z_now = np.stack([one[at] for one, at in zip(z, starts, strict=True)])
        s_now = np.stack([one[at] for one, at in zip(s, starts, strict=True)])
        zs, ss = [z_now], [s_now]
        while sum(one.shape[1] for one in ss) < shape[1]:
            moved = _moved(z_now, step, noise, rng)
            s_moved = yield from ask(moved)
            ok = s_moved >= level
            z_now, s_now = np.where(ok[..., None], moved, z_now), np.where(ok, s_moved, s_now)
            step = float(np.clip(step * np.exp(ok.mean() - _ACCEPTED), 0.02, 1.0))
            zs.append(z_now)
            ss.append(s_now)
        z, s = (np.concatenate(some, axis=1)[:, : shape[1]] for some in (zs, ss))
    p *= (s >= how.level).mean(axis=1)
    failed = (s >= how.level) & (p > 0)[:, None]
    least += _variation(s >= how.level)
    return Found(
        joined(p, trials, least**0.5), p, [*levels, how.level], _uniform(z[failed]), s[failed]
    )


def _variation(reached: np.ndarray) -> float:
    """Squared coefficient of variation of a rate from so many independent worlds."""
    rate = max(float(reached.mean()), 1 / reached.size)
    return (1 - rate) / rate / reached.size


def _uniform(z: np.ndarray) -> np.ndarray:
    """Points (n, q) of the cube at these normal quantiles."""
    return np.clip(stats.norm.cdf(z), _EDGE, 1 - _EDGE)


def _chosen(beyond: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """As many of the worlds `beyond` (n,) as chains begin, each as often as another."""
    some = rng.permutation(np.flatnonzero(beyond))
    # A group that has none goes on with worlds that no longer count: its product is 0.
    return np.resize(some if some.size else np.arange(beyond.size), count)


def _moved(z: np.ndarray, step: float, noise: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moves of a random half of the coordinates; of the noise, all of it anew or none."""
    fresh = rng.standard_normal(z.shape)
    moved = np.where(rng.random(z.shape) < 0.5, np.sqrt(1 - step**2) * z + step * fresh, z)
    again = rng.random((*z.shape[:-1], 1)) < 0.5 * step
    return np.where(noise, np.where(again, fresh, z), moved)


# --- of a law ------------------------------------------------------------------------------


def rare(
    params: Params,
    domain: Domain | str = "wide",
    seed: int = 0,
    how: Splitting = Splitting(),
    out: str | Path | None = None,
    *,
    repetitions: int = 1,
    setting: Setting = Setting(engine="fused"),
    slots: int | None = None,
    workers: int | None = None,
    report: Report = unheard,
) -> xr.Dataset:
    """The probability with which a law fails in a domain, by subset simulation.

    Args:
      params: of any strategy.
      domain: ranges of what differs between worlds, or their name in `DOMAINS`.
      seed: of the points and moves; they are points of their own, of no split.
      how: sizes, and what counts as a failure.
      out: run folder, in which a run that was killed is continued; None keeps all in memory.
      repetitions: how often all of it is done, side by side, each with points of its own.
      setting: physics, engine and rules.
      slots: worlds stepped at once by a worker, in each shape family.
      workers: host threads; by default as suits engine and device.
      report: called after every segment of the run.

    Returns:
      `p` and its `low`, `high` and `variation`, and `trials` (repetition); `p_group` (repetition,
      group); and failures that were met, `u` (failure, quantity) with their `severity`.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> few = rps_jax.Splitting(40, groups=2)
      >>> setting = rps_jax.Setting(rules=rules, engine="fused")
      >>> found = rps_jax.rare(rps_jax.RPSParams.paper(), drums, how=few, setting=setting)
      >>> found.p.values.tolist()  # within a second no push is done
      [1.0]
    """
    errors.check_count("repetitions", repetitions, at_most=10_000)
    errors.check_count("seed", seed, at_least=0, at_most=2**30)
    domain = points.named(domain)
    folder = None if out is None else Path(out)
    probe = Probe(domain, params, setting, folder, slots, workers, report)
    if folder is not None:
        asked = {"study": "rare", "seed": seed, "how": asdict(how), "repetitions": repetitions}
        run_folder.claim(folder, asked | probe.configuration())
    kinds = [one.kind for one in points.quantities(domain)]
    first = seed_of(seed, "tune") * 10_000
    every = [steps(kinds, how, first + repetition) for repetition in range(repetitions)]
    found = together(lambda u: probe(u).severity.values, every)
    return _labelled(domain, found)


def _labelled(domain: Domain, every: Sequence[Found]) -> xr.Dataset:
    estimates = [found.estimate for found in every]
    columns: dict[str, Any] = {
        name: ("repetition", [getattr(one, name) for one in estimates]) for name in Estimate._fields
    }
    deepest = max(len(found.levels) for found in every)
    levels = np.full((len(every), deepest), np.nan)
    for i, found in enumerate(every):
        levels[i, : len(found.levels)] = found.levels
    columns["p_group"] = (("repetition", "group"), np.stack([found.groups for found in every]))
    columns["level"] = (("repetition", "depth"), levels)
    u, severity = (np.concatenate([getattr(f, name) for f in every]) for name in ("u", "severity"))
    columns["u"] = (("failure", "quantity"), u)
    columns["severity"] = ("failure", severity)
    return xr.Dataset(columns, {"quantity": list(points.names(domain))})


def brute(failures: int, trials: int) -> Estimate:
    """The same probability from drawn worlds, with the interval of Clopper and Pearson."""
    p = failures / trials
    low, high = statistics.clopper_pearson(failures, trials)
    variation = np.sqrt((1 - p) / (p * trials)) if failures else float("inf")
    return Estimate(p, low, high, float(variation), trials)


def worlds_needed(p: float, variation: float) -> float:
    """How many drawn worlds give the probability `p` with this coefficient of variation."""
    return (1 - p) / (p * variation**2) if p > 0 else float("inf")


def table(found: xr.Dataset, against: Estimate | None = None) -> list[list[str]]:
    """Header and a row for each repetition, all of them together, and drawn worlds beside them."""
    rows = [["", "probability of failure", "95 %", "variation", "worlds", "share of drawn worlds"]]

    def row(name: str, one: Estimate) -> list[str]:
        share = one.trials / worlds_needed(one.p, one.variation) if one.p else float("nan")
        ends = f"[{one.low:.2g}, {one.high:.2g}]"
        said = "" if one is against else f"{100 * share:.2g} %"
        return [name, f"{one.p:.3g}", ends, f"{one.variation:.2f}", f"{one.trials:,}", said]

    for i in range(found.sizes["repetition"]):
        one = found.isel(repetition=i)
        p, low, high, variation = (float(one[name]) for name in Estimate._fields[:4])
        each = Estimate(p, low, high, variation, int(one.trials))
        rows.append(row(f"splitting, {i + 1}", each))
    if found.sizes["repetition"] > 1:
        whole = joined(found.p.values, int(found.trials.sum()))
        rows.append(row("splitting, all", whole))
    if against is not None:
        rows.append(row("drawn worlds", against))
    return rows


def covered(found: xr.Dataset, p: float) -> int:
    """In how many repetitions the interval holds `p`."""
    return int(((found.low <= p) & (p <= found.high)).sum())
