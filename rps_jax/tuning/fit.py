"""Which worlds are these? A robot's own logs, and the part of a domain in which they may be made.

    rps fit push.csv --domain wide

Many worlds of the domain are pushed with the law that drove the robot, in closed loop, and a neural
posterior (`posterior`) learns to tell a world's quantities from the statistics of its log (`logs`).
Logged commands alone are not replayed: pushing is unstable without feedback, so that in a slightly
wrong world the object would be lost within seconds, whereas in closed loop every world gives a log
of the kind that was seen. All logs are of one robot that pushes one object on one floor.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, ClassVar

import jax
import numpy as np
import xarray as xr

from rps_jax import engines
from rps_jax.analysis.figures.style import Figure, quantity, tiles
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.control.registry import LawLike
from rps_jax.errors import InputError
from rps_jax.geometry.solid import GRAVITY
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.question import (
    DomainQuestion,
    LawQuestion,
    Run,
    SimulationQuestion,
    call_of,
    seed_of,
)
from rps_jax.trials import trial
from rps_jax.trials.batch import rows
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, object_pose
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.tuning import logs as logs_
from rps_jax.tuning import posterior
from rps_jax.tuning.logs import Given, Log
from rps_jax.world import domain as domains
from rps_jax.world import draws, points
from rps_jax.world.domain import QUANTITIES, VELOCITY_ERRORS, Domain, Range
from rps_jax.world.draws import Draw

_TOGETHER = 64  # worlds of one object that are stepped at once
SAMPLES = 2000
UNDETERMINED = 0.8  # share of the prior's 90 % interval from which on nothing was learned
_DELAYS = ("pose_latency", "command_delay")
# What is told of a world beside its quantities, of what may be told where they may not.
DERIVED: dict[str, tuple[str, tuple[str, ...], Callable[..., np.ndarray]]] = {
    "ground_force": ("N", ("friction_ground", "mass"), lambda a, b: GRAVITY * a * b),
    "loop_delay": ("s", _DELAYS, lambda a, b: a + b),
    "reaction_time": ("s", (*_DELAYS, "robot_lag"), lambda a, b, c: a + b + c),
}
_WORDS = {"ground_force": "friction force of the ground",
          "loop_delay": "latency of the pose and delay of the command"}  # fmt: skip


@dataclass(frozen=True)
class Fitted:
    """What logs tell of a domain."""

    data: xr.Dataset  # see `Fit`
    domain: Domain  # with the 90 % intervals of what is determined as its ranges

    def plot(self) -> Figure:
        """Draw each quantity's posterior over its prior."""
        return marginals(self.data)


@dataclass(frozen=True)
class OfLogs(SimulationQuestion[Fitted]):
    """A question about logs."""

    logs: tuple[str | Any, ...] = option((), positional=True)
    """Logs of one object on one floor: tables FILE.csv (time, x, y, yaw, contact_type, contact_x,
    contact_y, v_x, v_y, omega, target_x, target_y and, if known, object_x, object_y, object_yaw,
    force_x, force_y, taxel_0, ...), bags FILE.mcap, run folders of rps push, or traces."""


@dataclass(frozen=True)
class Fit(LawQuestion[Fitted], DomainQuestion[Fitted], OfLogs):
    """Fit a domain's ranges to logs of a robot: what of mass, friction, skin and drive they tell.

    The answer's `data` holds samples (sample, quantity) of the posterior, its 5, 50 and 95 %
    quantiles `low`, `median` and `high` and those of the prior, whether a quantity is
    `undetermined`, correlations, and the probability of each of the domain's objects. Its `domain`
    is the fitted one, which the shell writes as fitted.json.

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting(rules=rps_jax.Rules(horizon=6.0))
      >>> trace = rps_jax.push("box", target=(2.0, 0.5), setting=brief)  # doctest: +SKIP
      >>> fitted = rps_jax.fit(trace, "wide", law="rps", quick=True)  # doctest: +SKIP
      >>> rps_jax.sweep("rps", fitted.domain)  # doctest: +SKIP
    """

    TITLE: ClassVar[str] = "A domain fitted to logs"
    QUICK: ClassVar[Mapping[str, Any]] = {"worlds": 768, "window": 20.0}

    law: LawLike = "rps"
    worlds: int = option(6144, 96, 1_000_000)
    """Number of worlds of the domain that are simulated."""
    window: float = option(30.0, 5, 300, unit="s")
    """Length of the beginning of each log that is looked at [s]; the shortest log's, if less."""

    @cached_property
    def given(self) -> list[Given]:
        """The logs, read and checked."""
        several = self.logs if isinstance(self.logs, tuple | list) else (self.logs,)
        if not several:
            raise InputError("logs = () is not allowed: give at least one.")
        return [logs_.read(one, self.ranges.robot.shell) for one in several]

    @cached_property
    def bank(self) -> Bank:
        """The simulated worlds that the logs are compared with."""
        period = self.setting.physics.control_period
        interval = max(logs_.pace(one, period) for one in self.given)
        shortest = min(map(logs_.length, self.given))
        window = interval * math.floor(min(self.window, shortest) / interval + 1e-6)
        return Bank(self.ranges, registry.law_of(self.params), self.params, self.setting, window,
                    interval, self.given[0].exact)  # fmt: skip

    @cached_property
    def observed(self) -> tuple[list[Log], list[str]]:
        """The logs on the bank's clock, and what all of them have besides."""
        found = [logs_.on_clock(one, self.bank.interval, self.bank.window) for one in self.given]
        has = [k for k in logs_.OPTIONAL if all(getattr(one, k) is not None for one in found)]
        return found, has

    def check(self) -> None:
        self.check_engine([self.params])
        check_law(self.label, self.bank.law, self.setting)
        if len({one.exact for one in self.given}) > 1:
            raise InputError("logs of traces and of a robot's odometry are not allowed together.")
        for given in self.given:
            start, target = given.columns["pose"][0], given.columns["target"]
            away, far = float(np.linalg.norm(target - start[:2])), self.ranges.distance
            if not self.ranges.targets and not far.low - 0.1 <= away <= far.high + 0.1:
                raise InputError(
                    f"a log's target is {away:.2f} m from its start, and the domain's distance is "
                    f"{far.low:g} to {far.high:g} m: name a domain that has it, as wide,"
                    f"distance={min(away, far.low):.1f}:{max(away, far.high):.1f}."
                )

    def num_trials(self) -> int | None:
        return self.worlds

    def fields_as_json(self) -> dict[str, Any]:
        """Own fields as JSON; logs by the digests of their numbers."""
        usual = dataclasses.replace(self, logs=())
        content = [b"".join(np.ascontiguousarray(v).tobytes() for v in g.columns.values())
                   for g in self.given]  # fmt: skip
        return super(Fit, usual).fields_as_json() | {"logs": [files.sha256(one) for one in content]}

    def answer(self, run: Run) -> Fitted:
        """Simulate what is missing of the worlds, learn from them, and judge the logs."""
        simulated = self.bank.worlds(self.worlds, run)
        observed, has = self.observed
        names = chosen(simulated, has)
        x = np.concatenate(
            [matrix(logs_.statistics(one, self.bank.interval), names) for one in observed]
        )
        set_phase(run.callback, "learn")
        bank = simulated.sel(statistic=names).statistics.values
        learned = posterior.train(simulated.u.values, bank, self.setting.seed)
        found = posterior.sample(learned, x, SAMPLES, self.setting.seed)
        data = summary(self.ranges, found)
        low, high = np.nanquantile(bank.reshape(-1, len(names)), [0.001, 0.999], axis=0)
        data["outside"] = np.mean((x < low) | (x > high))
        data["outside"].attrs["long_name"] = "share of statistics beyond 99.8 % of the worlds'"
        fitted = fitted_domain(self.ranges, data)
        if run.folder is not None:
            files.write_json(run.folder / "fitted.json", dataclasses.asdict(fitted))
        return Fitted(data, fitted)

    def intro(self, results: Fitted) -> str:
        has = self.observed[1]
        return (
            f"Logs: {len(self.given)}, the first {self.bank.window:g} s of each at "
            f"{1 / self.bank.interval:.3g} Hz, with {', '.join(has) or 'touch and odometry'}; "
            f"{self.worlds} worlds of the domain {self.domain}, law {self.label}, in closed loop."
        )

    def report(self, results: Fitted, run: Run) -> Sequence[Section]:
        data = results.data
        text = (
            "Median and 90 % interval. A quantity is undetermined if its interval is at least "
            f"{UNDETERMINED:.0%} of the prior's: the logs do not tell it, and its range stays as "
            f"it was. `rps sweep --domain {self.out}/fitted.json` pushes in the fitted domain."
        )
        if (beyond := float(data.outside)) > 0.05:
            text += (
                f" {beyond:.0%} of the logs' statistics lie beyond those of 99.8 % of the domain's "
                "worlds: the logs are not of this domain, law or robot, and nothing here holds."
            )
        pairs = [["object", "probability"]]
        share = data.probability.to_series()
        pairs += [[str(name), f"{value:.2f}"] for name, value in share.items()]
        return [
            Section("Quantities", text, table(data), Picture("marginals", results.plot)),
            Section("Objects", "", pairs),
            Section("Told only together", "Correlations above 0.5.", together(data)),
        ]


fit = call_of(Fit)


# --- simulated worlds ----------------------------------------------------------------------


@dataclass(frozen=True)
class Bank:
    """Worlds of a domain and the statistics of their logs, which any log can be judged by."""

    domain: Domain
    law: Law
    params: Any
    setting: Setting
    window: float  # [s]
    interval: float  # [s]
    exact: bool = False  # logs have the pose where the base is, not where it believes to be

    def worlds(self, count: int, run: Run, split: Any = "tune") -> xr.Dataset:
        """Coordinates `u` (world, quantity) and `statistics` (world, way, statistic) of worlds.

        A way is the world as it is, or in a mirror.
        """
        each, found = _TOGETHER * len(self.domain.objects), []
        for first in range(0, count, each):
            index = np.arange(first, min(first + each, count))
            part = run.checkpoint(f"{split}-{first:07d}", partial(self._part, index, split, run))
            found.append(part)
            run.callback(Progress(int(index[-1]) + 1, (index[-1] + 1) * self.window))
        whole = xr.concat(found, "world")
        assert isinstance(whole, xr.Dataset)
        return whole

    def _part(self, index: np.ndarray, split: Any, run: Run) -> xr.Dataset:
        which = self.domain.object_of(index)
        seed = seed_of(self.setting.seed, split)
        groups = [index[which == thing] for thing in np.unique(which)]
        drawn = [draws.draw(self.domain, seed, group) for group in groups]
        with ThreadPoolExecutor(
            run.workers or engines.get(self.setting.engine).workers("cpu")
        ) as p:
            made = list(p.map(self.statistics, drawn))
        order = np.argsort(np.concatenate(groups))
        names = list(made[0][0])
        ways = [np.concatenate([matrix(one[i], names) for one in made])[order] for i in (0, 1)]
        every = points.points_of(self.domain, index, seed)
        own = [points.names(self.domain).index(name) for name in coordinates(self.domain)]
        return xr.Dataset(
            {
                "u": (("world", "quantity"), every[:, own]),
                "statistics": (("world", "way", "statistic"), np.float32(np.stack(ways, 1))),
            },
            {"quantity": list(coordinates(self.domain)), "statistic": names},
        )

    def statistics(self, drawn: Draw) -> tuple[dict[str, np.ndarray], ...]:
        """Statistics of worlds (n,) of one object, and in the mirror."""
        seen = self.logs(drawn)
        return tuple(logs_.statistics(x, self.interval) for x in (seen, logs_.mirrored(seen)))

    def logs(self, drawn: Draw) -> Log:
        """The logs of worlds (n,) of one object; the program always steps as many."""
        count = drawn.indices.size
        part = drawn_worlds(self.domain, drawn, self.setting).with_params(self.params)
        repeated = np.resize(np.arange(count), max(count, _TOGETHER))
        worlds, params = rows((part.worlds, part.params), repeated)
        period = self.setting.physics.control_period
        every = max(1, round(self.interval / period))
        loop = ControlLoop(self.setting.physics, self.setting.rules, _telling(self.law))
        seen = _tracks(
            part.stage, worlds, params, loop,
            steps=round(self.window / self.interval), every=every,
        )  # fmt: skip
        seen = jax.tree.map(lambda x: np.swapaxes(np.asarray(x, float), 0, 1), seen)
        kept: dict[str, Any] = rows(seen, slice(count))
        exact = kept.pop("true_pose")
        pose = {"pose": exact} if self.exact else {}
        valid = kept.pop("done") < 0.5
        return Log(valid=valid, target=np.asarray(part.worlds.p_world_target), **(kept | pose))


def check_law(label: str, law: Law, setting: Setting) -> None:
    """Raises InputError unless logs of this law can be simulated in this setting."""
    engines.get(setting.engine).check_traced()
    engines.get(setting.engine).check_senses("force")
    if law.senses != "touch":
        raise InputError(
            f"law = {label} senses {law.senses}: fit knows laws that sense touch, as rps and "
            "rps_plus."
        )


@cache
def _telling(law: Law) -> Law:
    """The law, with what it observed and the contact's force as its details."""
    return dataclasses.replace(law, step=partial(_tell, law), senses="force")


def _tell(law: Law, params: Any, memory: Any, seen: Any) -> Any:
    memory, twist, _ = law.step(params, memory, seen.touch)
    return memory, twist, seen


@partial(jax.jit, static_argnames=("steps", "every"))
def _tracks(
    stage: Any, worlds: Any, params: LawParams, loop: ControlLoop, *, steps: int, every: int
) -> dict[str, jax.Array]:
    """Logs of a batch, (steps, B, ...), one row every so many control steps."""
    jnp = jax.numpy
    one = partial(trial.control_step, stage, worlds, params, loop=loop)

    def row(trials: Any, _: Any) -> Any:
        after, seen = one(trials)
        after = jax.lax.fori_loop(1, every, lambda _, t: one(t)[0], after)
        touch = seen.details.touch
        place, yaw = jax.vmap(object_pose)(seen.qpos)
        found = {
            "pose": jnp.concatenate([touch.p_world_robot, touch.yaw[:, None]], -1),
            "true_pose": seen.qpos[:, :3],
            "contact_type": seen.reading.contact_type,
            "p_robot_contact": seen.reading.p_robot_contact,
            "twist": jnp.stack([jnp.broadcast_to(x, yaw.shape) for x in seen.twist], -1),
            "object_pose": jnp.concatenate([place, yaw[:, None]], -1),
            "f_robot": seen.details.f_robot,
            "done": seen.done,
        }
        if after.skin.signal.shape[-1]:
            found["signal"] = jnp.where(after.skin.alive, after.skin.signal, 0.0)
        return after, found

    trials = trial.start_all(worlds, params, jnp.ones(len(worlds.qpos), bool), law=loop.law)
    return jax.lax.scan(row, trials, length=steps)[1]


# --- from samples to a domain --------------------------------------------------------------


def coordinates(domain: Domain) -> tuple[str, ...]:
    """The coordinates of a domain's cube that are fitted: all but the task's and shapes."""
    task = {*domains.quantities_of("task"), "com_bearing", "friction", "target"}
    return tuple(
        one.name for one in points.coordinates(domain)
        if one.kind in ("range", "choice") and one.name not in task
    )  # fmt: skip


def chosen(bank: xr.Dataset, has: Sequence[str]) -> list[str]:
    """Names of the statistics that logs with these columns have."""
    return [n for n in map(str, bank.statistic.values) if n.split("/")[0] in ("base", *has)]


def matrix(found: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Statistics (B, F) in an order."""
    return np.stack([found[name] for name in names], -1)


def values_of(domain: Domain, u: np.ndarray) -> dict[str, np.ndarray]:
    """Quantities (n,) in their units, and what is derived of them, of points (n, D)."""
    found = {}
    for name, column in zip(coordinates(domain), u.T, strict=True):
        if name != "object":
            found[name] = getattr(domain, "velocity_error" if name in VELOCITY_ERRORS else name).at(
                column
            )
    for name, (_, of, make) in DERIVED.items():
        if all(one in found for one in of):
            found[name] = make(*(found[one] for one in of))
    return found


def summary(domain: Domain, u: np.ndarray) -> xr.Dataset:
    """The posterior, from its points (n, D): see `Fit`."""
    prior = values_of(domain, np.random.default_rng(0).random((20_000, u.shape[1])))
    found = values_of(domain, u)
    at = np.stack([np.searchsorted(np.sort(prior[k]), v) / 20_000 for k, v in found.items()], -1)
    ends = np.quantile(at, [0.05, 0.95], axis=0)
    unit = {k: QUANTITIES[k].unit if k in QUANTITIES else "1" for k in found}
    unit |= {k: told for k, (told, *_) in DERIVED.items() if k in found}
    columns: dict[str, Any] = {
        "sample": (("draw", "quantity"), np.stack(list(found.values()), -1)),
        "undetermined": ("quantity", ((ends[1] - ends[0]) >= 0.9 * UNDETERMINED).astype(np.int8)),
        "shrinkage": ("quantity", 1 - (ends[1] - ends[0]) / 0.9),
        "correlation": (("quantity", "other"), np.nan_to_num(np.corrcoef(at.T))),
    }
    for prefix, source in (("", found), ("prior_", prior)):
        cuts = np.quantile(np.stack(list(source.values()), -1), [0.05, 0.5, 0.95], axis=0)
        for name, values in zip(("low", "median", "high"), cuts, strict=True):
            columns[prefix + name] = ("quantity", values)
    which = np.zeros(len(u), int)
    if "object" in coordinates(domain):
        which = np.floor(u[:, 0] * len(domain.objects)).astype(int)
    share = np.bincount(which, minlength=len(domain.objects)) / len(u)
    columns["probability"] = ("object", share)
    names = list(found)
    coords = {"quantity": names, "other": names, "object": list(domain.objects)}
    return xr.Dataset(columns, coords | {"unit": ("quantity", [unit[k] for k in names])})


def fitted_domain(domain: Domain, data: xr.Dataset) -> Domain:
    """The domain with the 90 % interval of each determined quantity as its range.

    One range holds all three errors of the velocity. Objects of less than 5 % are left out.
    """
    told = data.isel(quantity=np.flatnonzero(data.undetermined.values == 0))
    ends = {
        str(name): (float(told.low[i]), float(told.high[i]))
        for i, name in enumerate(told.quantity.values)
    }
    changes: dict[str, Any] = {
        name: Range(*ends[name], getattr(domain, name).log) for name in ends if name in QUANTITIES
    }
    if all(name in ends for name in VELOCITY_ERRORS):
        low, high = zip(*(ends[name] for name in VELOCITY_ERRORS), strict=True)
        changes["velocity_error"] = Range(min(low), max(high))
    likely = data.probability.values >= 0.05
    objects = tuple(o for o, is_ in zip(domain.objects, likely, strict=True) if is_)
    return dataclasses.replace(domain, objects=objects, **changes)


# --- how it is told ------------------------------------------------------------------------


def words(name: str) -> str:
    """A quantity, or what is derived of some, in words."""
    return _WORDS.get(name) or quantity(name)


def table(data: xr.Dataset) -> list[list[str]]:
    """Header and one row for each quantity."""
    found = [["quantity", "unit", "median", "90 %", "prior 90 %", "told"]]
    for name in data.quantity.values:
        one = data.sel(quantity=name)
        ends = [f"{float(one[k]):.3g} to {float(one[m]):.3g}"
                for k, m in (("low", "high"), ("prior_low", "prior_high"))]  # fmt: skip
        told = "undetermined" if one.undetermined else f"{float(one.shrinkage):.0%} narrower"
        middle = f"{float(one['median']):.3g}"
        found.append([words(str(name)), str(one.unit.values), middle, *ends, told])
    return found


def together(data: xr.Dataset) -> list[list[str]]:
    """Header and the pairs of quantities that are told only together."""
    at = data.correlation.values
    names = [str(q) for q in data.quantity.values]
    pairs = [(i, j) for i, j in np.argwhere(np.tril(abs(at), -1) > 0.5)
             if not DERIVED.keys() & {names[i], names[j]}]  # fmt: skip
    told = [[words(names[i]), words(names[j]), f"{at[i, j]:.2f}"] for i, j in pairs]
    return [["", "", "correlation"], *told]


def marginals(data: xr.Dataset) -> Figure:
    """Draw each quantity's posterior (blue) over its prior's 90 % (grey)."""
    names = [str(q) for q in data.quantity.values]
    drawn, axes = tiles(len(names), 4, (3, 1.9), (0, 0))
    for ax, name in zip(axes.ravel(), names, strict=False):
        one = data.sel(quantity=name)
        ax.axvspan(float(one.prior_low), float(one.prior_high), color="0.88")
        flat = bool(one.undetermined)
        ax.hist(one["sample"], 40, density=True, color="0.6" if flat else "C0")
        ax.set_title(words(name) + (" (undetermined)" if flat else ""), fontsize=8)
        ax.set(yticks=[], xlabel=f"[{one.unit.values}]")
        ax.tick_params(labelsize=7)
    return drawn
