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

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from rps_jax import errors
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.record.options import option
from rps_jax.runs.question import DomainQuestion, LawQuestion, Run, call_of, name_or_custom, seed_of
from rps_jax.studies.probe import Probe
from rps_jax.world import points
from rps_jax.world.domain import Domain

Severity = Callable[[np.ndarray], np.ndarray]  # of points (n, q), (n,)
_EDGE = 1e-9  # least distance of a coordinate to the ends of its range
_ACCEPTED = 0.35  # share of moves that the step is adapted to


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


def combine(groups: np.ndarray, trials: int, least: float = 0.0) -> Estimate:
    """The mean of groups' estimates, with Student's interval, even in the logarithm.

    A few groups agree by luck now and then, so the coefficient of variation is at least `least`.
    """
    p, count = float(groups.mean()), groups.size
    if p == 0:
        return Estimate(0.0, 0.0, 1.0, float("inf"), trials)
    variation = max(least, float(groups.std(ddof=1)) / p / np.sqrt(count))
    reach = variation * float(stats.t.ppf(0.975, count - 1))
    return Estimate(p, p * np.exp(-reach), min(1.0, p * np.exp(reach)), variation, trials)


def run_together(score: Severity, every: Sequence[Steps]) -> list[Found]:
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


def subset_simulation(kinds: Sequence[str], how: Rare, seed: int) -> Steps:
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
        combine(p, trials, least**0.5), p, [*levels, how.level], _uniform(z[failed]), s[failed]
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


@dataclass(frozen=True)
class Rare(DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Estimate how often a law fails that rarely fails, by subset simulation.

    The answer holds `p` and its `low`, `high` and `variation`, and `trials` (repetition); `p_group`
    (repetition, group); and failures that were met, `u` (failure, quantity) with their `severity`.

    Example:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> found = rps_jax.rare("rps", drums, particles=40, groups=2, setting=setting)
      >>> found.p.values.tolist()  # within a second no push is done
      [1.0]
    """

    TITLE: ClassVar[str] = "Rare failures"
    QUICK: ClassVar[Mapping[str, Any]] = {
        "particles": 200,
        "groups": 4,
        "domain": "wide,objects=random_box",
    }

    particles: int = option(1000, 1, 10_000_000)
    """Number of worlds of a level, over all groups; a group should have a hundred."""
    groups: int = option(10, 2, 10_000)
    """Number of groups that share nothing but the levels; their spread is the interval."""
    share: float = option(0.2, 0.05, 0.5)
    """Share of the worlds that reach the next level, whose chains begin in them [1]."""
    beyond: float = option(0.0, 0, 20, unit="m")
    """A failure counts if it missed the target by more than this [m]; 0 counts all failures."""
    levels: int = option(30, 1, 100)
    """Number of levels after which it gives up, and says 0 if nothing has failed."""
    repetitions: int = option(1, 1, 10_000)
    """How often all of it is done, side by side, each time with points of its own."""

    def check(self) -> None:
        least = self.groups * 2 * round(1 / self.share)
        errors.check_count("particles", self.particles, at_least=least, at_most=10_000_000)
        errors.check_count("seed", self.setting.seed, at_least=0, at_most=2**30)
        self.check_engine([self.params])

    @property
    def level(self) -> float:
        """Severity from which on a trial is what is looked for."""
        return 1 + self.beyond

    def answer(self, run: Run) -> xr.Dataset:
        domain, seed = self.ranges, self.setting.seed
        probe = Probe(domain, self.params, self.setting, run.folder, **run.batch_options)
        kinds = [one.kind for one in points.quantities(domain)]
        first = seed_of(seed, "tune") * 10_000
        every = [subset_simulation(kinds, self, first + i) for i in range(self.repetitions)]
        return _labelled(domain, run_together(lambda u: probe(u).severity.values, every))

    def intro(self, results: xr.Dataset) -> str:
        what = "a failure is a trial that does not reach its target."
        if self.beyond:
            what = f"a failure misses the target by more than {self.beyond:g} m."
        return f"{self.label} in the domain {name_or_custom(self.domain)}: {what}"

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        text = (
            "Intervals of 95 %, from the spread of the groups. The last column is the number of "
            "worlds over that of drawn worlds with the same coefficient of variation. A kind of "
            "failure that no group has met is in no interval."
        )
        picture = Picture("rare", partial(draw_estimates, results))
        return [Section("How rare is a failure", text, estimate_table(results), picture)]


rare = call_of(Rare)


def _labelled(domain: Domain, every: Sequence[Found]) -> xr.Dataset:
    estimates = [found.estimate for found in every]
    columns: dict[str, Any] = {
        name: ("repetition", [getattr(one, name) for one in estimates]) for name in Estimate._fields
    }
    levels = np.array(list(zip_longest(*(found.levels for found in every), fillvalue=np.nan))).T
    columns["p_group"] = (("repetition", "group"), np.stack([found.groups for found in every]))
    columns["level"] = (("repetition", "depth"), levels)
    columns["u"] = (("failure", "quantity"), np.concatenate([found.u for found in every]))
    columns["severity"] = ("failure", np.concatenate([found.severity for found in every]))
    return xr.Dataset(columns, {"quantity": list(points.names(domain))})


def worlds_needed(p: float, variation: float) -> float:
    """How many drawn worlds give the probability `p` with this coefficient of variation."""
    return (1 - p) / (p * variation**2) if p > 0 else float("inf")


def estimate_table(found: xr.Dataset) -> list[list[str]]:
    """Header and a row for each repetition, and one for all of them together."""
    rows = [["", "probability of failure", "95 %", "variation", "worlds", "share of drawn worlds"]]
    for i in range(found.sizes["repetition"]):
        one = found.isel(repetition=i)
        p, low, high, variation, trials = (float(one[name]) for name in Estimate._fields)
        rows.append(
            estimate_row(f"splitting, {i + 1}", Estimate(p, low, high, variation, int(trials)))
        )
    if found.sizes["repetition"] > 1:
        rows.append(
            estimate_row("splitting, all", combine(found.p.values, int(found.trials.sum())))
        )
    return rows


def estimate_row(name: str, one: Estimate) -> list[str]:
    """An estimate, and its number of worlds over that of drawn ones."""
    said = ""
    if 0 < one.p < 1:
        said = f"{100 * one.trials / worlds_needed(one.p, one.variation):.2g} %"
    ends = f"[{one.low:.2g}, {one.high:.2g}]"
    return [name, f"{one.p:.3g}", ends, f"{one.variation:.2f}", f"{one.trials:,}", said]


def draw_estimates(found: xr.Dataset) -> Figure:
    """Estimates of every repetition with their intervals."""
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    ax = figure.subplots()
    place = np.arange(found.sizes["repetition"])
    p = found.p.values
    errors = np.abs(np.stack([p - found.low.values, found.high.values - p]))
    ax.errorbar(place + 1, p, errors, fmt="o", ms=4, capsize=2, color="C3", label="splitting")
    if (p > 0).all():
        ax.set_yscale("log")
    ax.set_xlabel("repetition")
    ax.set_ylabel("probability of failure [1]")
    ax.grid(alpha=0.3, axis="y")
    ax.legend(fontsize=8)
    return figure
