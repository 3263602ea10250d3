"""Subset simulation: small failure probabilities as products of larger ones.

The probability that the severity reaches 1 is a product of conditional probabilities: of a level
that a fifth of the worlds reach, of the next level given the first, and so on (Au and Beck, 2001;
multilevel splitting by Cerou and Guyader is closely related). Markov chains start in the worlds
above a level and sample more of them. A step changes a random half of the normal quantiles z of the
world's point u by the preconditioned Crank-Nicolson proposal z' = sqrt(1 - b^2) z + b e, which
leaves the normal distribution invariant. Proposals below the level are rejected.

Several groups of worlds share only the levels. The mean of their estimates is the estimate, and
their spread gives the interval, without assumptions about how well the chains mix. The interval
does not cover failures that no group has reached.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import ClassVar, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from rps_jax import errors
from rps_jax.questions import LawQuestion, Run, Section, call_of, option
from rps_jax.runs.question import DomainQuestion, Rows
from rps_jax.studies.probe import Probe
from rps_jax.world import points

Severity = Callable[[np.ndarray], np.ndarray]  # of points (n, q), (n,)
_EDGE = 1e-9  # least distance of a coordinate to the ends of its range
_ACCEPTANCE = 0.35  # acceptance rate of proposals to which the step is adapted
_MIN_STEP, _MAX_STEP = 0.02, 1.0  # [1] b


class Estimate(NamedTuple):
    """Probability with its interval of 95 %."""

    p: float  # [1]
    low: float
    high: float
    variation: float  # [1] coefficient of variation: standard error over estimate
    trials: int


class Result(NamedTuple):
    """Result of a subset simulation."""

    estimate: Estimate
    p_group: np.ndarray  # (groups,) [1] estimate of each group
    levels: list[float]  # severities of the levels; the last is that of the event
    u: np.ndarray  # (n, q) failing worlds of the last level
    severity: np.ndarray  # (n,)


# Yields points (n, q), receives their severities (n,), and returns the result.
Simulation = Generator[np.ndarray, np.ndarray, Result]


def combine(p_group: np.ndarray, trials: int, min_variation: float = 0.0) -> Estimate:
    """Return the mean of the groups' estimates, with Student's interval in the logarithm.

    A few groups may agree by chance, so the coefficient of variation has a lower bound.
    """
    p, count = float(p_group.mean()), p_group.size
    if p == 0:
        return Estimate(0.0, 0.0, 1.0, float("inf"), trials)
    variation = max(min_variation, float(p_group.std(ddof=1)) / p / np.sqrt(count))
    half_width = variation * float(stats.t.ppf(0.975, count - 1))
    low, high = p * np.exp(-half_width), min(1.0, p * np.exp(half_width))
    return Estimate(p, low, high, variation, trials)


def run_together(severity: Severity, simulations: Sequence[Simulation]) -> list[Result]:
    """Run simulations side by side, with one batch of points of all of them at a time."""
    results: dict[int, Result] = {}
    requests = dict(enumerate(map(next, simulations)))
    while requests:
        answers = severity(np.concatenate(list(requests.values())))
        splits = np.cumsum([len(u) for u in requests.values()])[:-1]
        for i, s in zip(list(requests), np.split(answers, splits), strict=True):
            try:
                requests[i] = simulations[i].send(s)
            except StopIteration as stop:
                del requests[i]
                results[i] = stop.value
    return [results[i] for i in sorted(results)]


def subset_simulation(kinds: Sequence[str], options: Rare, seed: int) -> Simulation:
    """Return a subset simulation over points whose coordinates have these kinds (q,)."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    noise = np.array([kind == "noise" for kind in kinds])
    shape = (options.groups, options.particles // options.groups)
    trials, step, levels = 0, 0.6, []
    variance = 0.0  # squared variation of independent worlds, a lower bound for chains

    def request(z: np.ndarray) -> Generator[np.ndarray, np.ndarray, np.ndarray]:
        nonlocal trials
        trials += z[..., 0].size
        severity = yield _uniform(z.reshape(-1, z.shape[-1]))
        return severity.reshape(z.shape[:-1])

    z = rng.standard_normal((*shape, len(kinds)))
    s, p_group = (yield from request(z)), np.ones(options.groups)
    for _ in range(options.levels):
        # All groups share the level, which is nearly independent of each.
        level = float(np.sort(s, axis=None)[-max(2, round(options.share * s.size))])
        if level >= options.level or (s >= level).all():
            break
        levels.append(level)
        variance += _squared_variation(s >= level)
        p_group *= (s >= level).mean(axis=1)
        chains = round(options.share * shape[1])
        starts = np.stack([_resample(above, chains, rng) for above in s >= level])
        z_chain = np.take_along_axis(z, starts[..., None], axis=1)
        s_chain = np.take_along_axis(s, starts, axis=1)
        z_levels, s_levels = [z_chain], [s_chain]
        while len(s_levels) * chains < shape[1]:
            proposal = _propose(z_chain, step, noise, rng)
            s_proposal = yield from request(proposal)
            accepted = s_proposal >= level
            z_chain = np.where(accepted[..., None], proposal, z_chain)
            s_chain = np.where(accepted, s_proposal, s_chain)
            step *= np.exp(accepted.mean() - _ACCEPTANCE)
            step = float(np.clip(step, _MIN_STEP, _MAX_STEP))
            z_levels.append(z_chain)
            s_levels.append(s_chain)
        z = np.concatenate(z_levels, axis=1)[:, : shape[1]]
        s = np.concatenate(s_levels, axis=1)[:, : shape[1]]
    failed = s >= options.level
    p_group *= failed.mean(axis=1)
    variance += _squared_variation(failed)
    failed &= (p_group > 0)[:, None]
    estimate = combine(p_group, trials, variance**0.5)
    return Result(estimate, p_group, [*levels, options.level], _uniform(z[failed]), s[failed])


def _squared_variation(reached: np.ndarray) -> float:
    """Return the squared coefficient of variation of a rate from independent worlds."""
    rate = max(float(reached.mean()), 1 / reached.size)
    return (1 - rate) / rate / reached.size


def _uniform(z: np.ndarray) -> np.ndarray:
    """Return points (n, q) of the unit cube from normal quantiles."""
    return np.clip(stats.norm.cdf(z), _EDGE, 1 - _EDGE)


def _resample(above: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Resample starts (count,) of chains uniformly from the worlds (n,) above the level."""
    starts = rng.permutation(np.flatnonzero(above))
    # A group without such worlds continues with any worlds: its estimate is already 0.
    return np.resize(starts if starts.size else np.arange(above.size), count)


def _propose(z: np.ndarray, step: float, noise: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Propose changes of a random half of the coordinates; noise changes as a whole or not."""
    fresh = rng.standard_normal(z.shape)
    proposal = np.where(rng.random(z.shape) < 0.5, np.sqrt(1 - step**2) * z + step * fresh, z)
    new_noise = rng.random((*z.shape[:-1], 1)) < 0.5 * step
    return np.where(noise, np.where(new_noise, fresh, z), proposal)


# --- of a law ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rare(DomainQuestion[xr.Dataset], LawQuestion[xr.Dataset]):
    """Estimate small failure probabilities by subset simulation.

    The result has, by repetition, `p` with `low`, `high`, `variation` and `trials`; the estimates
    `p_group` (repetition, group); and the failing worlds `u` (failure, quantity) with `severity`.

    Examples:
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=1.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> results = rps_jax.rare("rps", drums, particles=40, groups=2, setting=setting)
      >>> results.p.values.tolist()  # no push ends within a second
      [1.0]
    """

    TITLE = "Rare failures"
    QUICK: ClassVar = {
        "particles": 200,
        "groups": 4,
        "domain": "wide,objects=random_box",
    }

    particles: int = option(1000, 1, 10_000_000)
    """Number of worlds of a level, over all groups; use at least 100 for each group."""
    groups: int = option(10, 2, 10_000)
    """Number of groups, which share only the levels; their spread gives the interval."""
    share: float = option(0.2, 0.05, 0.5)
    """Share of the worlds that reach the next level [1]; chains start in these worlds."""
    beyond: float = option(0.0, 0, 20, unit="m")
    """Distance from the target beyond which a failure counts [m]; 0 counts all failures."""
    levels: int = option(30, 1, 100)
    """Maximum number of levels; without a failure by then the estimate is 0."""
    repetitions: int = option(1, 1, 10_000)
    """Number of independent repetitions, which run side by side."""

    def check(self) -> None:
        least = self.groups * 2 * round(1 / self.share)
        errors.check_count("particles", self.particles, at_least=least, at_most=10_000_000)
        self.check_engine([self.params])

    @property
    def level(self) -> float:
        """Severity of the event whose probability is estimated."""
        return 1 + self.beyond

    def answer(self, run: Run) -> xr.Dataset:
        domain, seed = self.ranges, self.setting.seed
        probe = Probe(domain, self.params, self.setting, run)
        kinds = [quantity.kind for quantity in points.coordinates(domain)]
        seeds = 30_000 * seed + np.arange(self.repetitions)
        simulations = [subset_simulation(kinds, self, int(i)) for i in seeds]
        results = run_together(lambda u: probe(u).severity.values, simulations)
        estimates, p_groups, levels, u, severity = zip(*results, strict=True)
        depths = list(zip_longest(*levels, fillvalue=np.nan))
        return xr.Dataset(
            {
                **{name: ("repetition", x) for name, x in pd.DataFrame([*estimates]).items()},
                "p_group": (("repetition", "group"), np.stack(p_groups)),
                "level": (("repetition", "depth"), np.array(depths).T),
                "u": (("failure", "quantity"), np.concatenate(u)),
                "severity": ("failure", np.concatenate(severity)),
            },
            {"quantity": list(points.names(domain))},
        )

    def intro(self, results: xr.Dataset) -> str:
        event = "does not reach its target"
        if self.beyond:
            event = f"misses the target by more than {self.beyond:g} m"
        return f"{self.label} in the domain {self.worlds_in_words}: a failure {event}."

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        text = (
            "Intervals of 95 %, from the spread of the groups. The last column is the number of "
            "worlds over the number of drawn worlds with the same coefficient of variation. The "
            "intervals do not cover failures that no group has reached."
        )
        return [Section("Probability of failure", text, estimate_table(results))]


rare = call_of(Rare)


def worlds_needed(p: float, variation: float) -> float:
    """Return the number of drawn worlds with this coefficient of variation of `p`."""
    return (1 - p) / (p * variation**2) if p > 0 else float("inf")


def estimate_table(results: xr.Dataset) -> Rows:
    """Return a row for each repetition, and one for all of them together."""
    rows = [["", "probability of failure", "95 %", "variation", "worlds", "share of drawn worlds"]]
    columns = results[list(Estimate._fields)].to_dataframe()
    for i, values in enumerate(columns.itertuples(index=False), start=1):
        rows.append(estimate_row(f"splitting, {i}", Estimate(*values)))
    if results.sizes["repetition"] > 1:
        combined = combine(results.p.values, int(results.trials.sum()))
        rows.append(estimate_row("splitting, all", combined))
    return rows


def estimate_row(name: str, estimate: Estimate) -> list[str]:
    """Return a row with an estimate and its number of worlds over that of drawn worlds."""
    p, low, high, variation, trials = estimate
    ratio = f"{100 * trials / worlds_needed(p, variation):.2g} %" if 0 < p < 1 else ""
    return [name, f"{p:.3g}", f"[{low:.2g}, {high:.2g}]", f"{variation:.2f}", f"{trials:,}", ratio]
