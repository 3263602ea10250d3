"""Fit a domain's ranges to logs of a robot: in which of its worlds can the logs be recorded?

    rps fit push.csv --domain wide

The law that drove the robot pushes in many worlds of the domain, in closed loop. A neural posterior
(`posterior`) learns to predict a world's quantities from the statistics of its log (`logs`). Logged
commands are not replayed: pushing is unstable without feedback, so in a slightly different world
the robot loses the object within seconds. All logs are of one robot that pushes one object on one
floor.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.artist import setp

from rps_jax import errors
from rps_jax.analysis.figures.style import WIDTH, Figure, quantity, styled, tiles
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams
from rps_jax.control.registry import LawLike
from rps_jax.engines import device
from rps_jax.engines.base import Stage
from rps_jax.errors import InputError
from rps_jax.geometry.arrays import Array
from rps_jax.geometry.solid import GRAVITY
from rps_jax.record import files
from rps_jax.record.files import Arrays, JsonObject
from rps_jax.record.options import option
from rps_jax.runs.push import Trace, recorded_law
from rps_jax.runs.question import (
    BagQuestion,
    DefaultLaw,
    DomainQuestion,
    LawQuestion,
    Rows,
    Run,
    SimulationQuestion,
    call_of,
)
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.setting import Setting, Split, seed_of
from rps_jax.trials.trial import ControlLoop, Trial, World, object_pose
from rps_jax.trials.worlds import drawn_worlds, rows
from rps_jax.tuning import logs as logs_
from rps_jax.tuning import posterior
from rps_jax.tuning.logs import Log, RawLog
from rps_jax.world import domain as domains
from rps_jax.world import points
from rps_jax.world.domain import QUANTITIES, VELOCITY_ERRORS, Domain, Range, unit_of
from rps_jax.world.draws import Draw

_BATCH = 64  # worlds of one object that are stepped at once
SAMPLES = 2000
UNDETERMINED = 0.8  # share of the prior's 90 % interval above which nothing was learned
_DELAYS = ("pose_latency", "command_delay")
# Functions of quantities, for logs that determine these but not the quantities: unit, quantities
# and function.
DERIVED: dict[str, tuple[str, tuple[str, ...], Callable[..., np.ndarray]]] = {
    "ground_force": ("N", ("friction_ground", "mass"), lambda a, b: GRAVITY * a * b),
    "loop_delay": ("s", _DELAYS, lambda a, b: a + b),
    "reaction_time": ("s", (*_DELAYS, "robot_lag"), lambda a, b, c: a + b + c),
}


@dataclass(frozen=True)
class Fitted:
    """Posterior of the quantities of a domain, and the fitted domain."""

    data: xr.Dataset  # see `Fit`
    domain: Domain  # with the 90 % intervals of all determined quantities as ranges

    @styled
    def plot(self) -> Figure:
        """Draw each quantity's posterior and prior; pale if undetermined."""
        names = self.data.quantity.values.tolist()
        figure, axes = tiles(len(names), 4, (WIDTH / 4, 1.25), (0, 0.4))
        for ax, name in zip(axes.ravel(), names, strict=False):
            column = self.data.sel(quantity=name)
            ax.axvspan(float(column.prior_low), float(column.prior_high), color="0.88")
            flat = bool(column.undetermined)
            ax.hist(column["sample"], 40, density=True, alpha=0.4 if flat else 1.0)
            ax.set_title(textwrap.fill(quantity(name) + " (undetermined)" * flat, 28))
            ax.set(yticks=[], xlabel=f"[{column.unit.values}]")
        setp(axes[:, 0].tolist(), ylabel="density")
        figure.legend(["90 % of the prior", "posterior"], loc="outside lower center", ncols=2)
        return figure


@dataclass(frozen=True)
class LogsQuestion(BagQuestion[Fitted], SimulationQuestion[Fitted]):
    """Question about logs, its first arguments."""

    logs: str | Path | Trace | Sequence[str | Path | Trace] = option((), positional=True)
    """Logs of one object on one floor: tables FILE.csv (time, x, y, yaw, contact_type, contact_x,
    contact_y, v_x, v_y, omega, target_x, target_y and, if known, object_x, object_y, object_yaw,
    force_x, force_y, taxel_0, ...), bags FILE.mcap, run folders of rps push, or traces. Titles may
    name other units than m, rad, s and N, as 'yaw [deg]'."""

    REMOVED: ClassVar = {"columns": "rename the columns of the table"}


@dataclass(frozen=True)
class Fit(LawQuestion[Fitted], DomainQuestion[Fitted], LogsQuestion):
    """Fit a domain's ranges (mass, friction, skin, drive) to logs of a robot.

    The answer's `data` has samples (sample, quantity) of the posterior, the 5, 50 and 95 %
    quantiles `low`, `median` and `high` of posterior and prior, whether a quantity is
    `undetermined`, correlations, and the probability of each of the domain's objects. Its `domain`
    is the fitted domain, which `rps fit` writes as fitted.json.

    Examples:
      >>> import rps_jax
      >>> brief = rps_jax.Setting(rules=rps_jax.Rules(horizon=6.0))
      >>> trace = rps_jax.push("box", target=(2.0, 0.5), setting=brief)
      >>> fitted = rps_jax.fit(trace, "wide", law="rps", quick=True)
      >>> fitted.data.sample.dims
      ('draw', 'quantity')
      >>> results = rps_jax.sweep("rps", fitted.domain, worlds=4, setting=brief)
    """

    TITLE = "A domain fitted to logs"
    QUICK: ClassVar = {"worlds": 768, "window": 20.0}
    # The values of the logs matter.
    IGNORED_FIELDS = ("logs", "topics")

    law: LawLike = DefaultLaw("rps")
    worlds: int = option(6144, 96, 1_000_000)
    """Number of worlds of the domain that are simulated."""
    window: float = option(30.0, 5, 300, unit="s")
    """Length of the first part of each log that is used [s]; at most that of the shortest log."""

    @cached_property
    def raw_logs(self) -> list[RawLog]:
        """Logs, loaded and validated."""
        logs: Any = self.logs
        several = [logs] if isinstance(logs, str | Path | Trace) else list(logs)
        if not several:
            raise InputError("logs = () is not allowed: give at least one.")
        robot = self.ranges.robot
        raw = [logs_.read(log, robot.shell, self.topics) for log in several]
        for log in raw:
            log.columns["twist"] = robot.twist_of_middle(log.columns["twist"])
        return raw

    @cached_property
    def bank(self) -> Bank:
        """Simulated worlds with which the logs are compared."""
        period = self.setting.physics.control_period
        times = [raw.columns["time"] for raw in self.raw_logs]
        slowest = max(float(np.median(np.diff(time))) for time in times)
        interval = period * max(1, math.ceil(slowest / period - 0.05))
        shortest = min(float(time[-1] - time[0]) for time in times)
        window = interval * math.floor(min(self.window, shortest) / interval + 1e-6)
        exact = self.raw_logs[0].exact
        return Bank(self.ranges, self.params, self.setting, window, interval, exact)

    @cached_property
    def observed(self) -> tuple[list[Log], list[str]]:
        """Logs on the bank's clock, and the optional fields that all of them have."""
        bank = self.bank
        logs = [logs_.resample(raw, bank.interval, bank.window) for raw in self.raw_logs]
        fields = [k for k in logs_.OPTIONAL if all(getattr(log, k) is not None for log in logs)]
        return logs, fields

    def check(self) -> None:
        self.check_engine([self.params])
        self.ranges.task.check_target("task", self.ranges.task, "logs have a target, so omit it")
        if len({raw.exact for raw in self.raw_logs}) > 1:
            raise InputError("logs of traces and of odometry are not allowed together: fit each.")
        for raw in self.raw_logs:
            start, target = raw.columns["pose"][0], raw.columns["target"]
            distance, far = float(np.linalg.norm(target - start[:2])), self.ranges.distance
            if not self.ranges.targets and not far.low - 0.1 <= distance <= far.high + 0.1:
                raise InputError(
                    f"a log's target is {distance:.2f} m from its start, and the domain's distance "
                    f"is {far.low:g} to {far.high:g} m: name a domain that contains it, as wide,"
                    f"distance={min(distance, far.low):.1f}:{max(distance, far.high):.1f}."
                )
        self.check_method()

    def check_method(self) -> None:
        """Raise InputError unless the posterior can be computed for these logs and this law."""
        check_law(self.label, registry.law_of(self.params), self.setting)

    def num_trials(self) -> int | None:
        return self.worlds

    def fields_as_json(self) -> JsonObject:
        """Fields as JSON; logs by the digests of their values."""
        contents = (b"".join(v.tobytes() for v in raw.columns.values()) for raw in self.raw_logs)
        record = {"tune_seed": seed_of(self.setting.seed, "tune")}
        return super().fields_as_json() | record | {"logs": list(map(files.sha256, contents))}

    def answer(self, run: Run) -> Fitted:
        """Compute and sample the posterior, and summarise it."""
        data = self.sample_posterior(run)
        fitted = fitted_domain(self.ranges, data)
        if run.folder is not None:
            files.write_json(run.folder / "fitted.json", domains.to_json(fitted))
        return Fitted(data, fitted)

    def sample_posterior(self, run: Run) -> xr.Dataset:
        """Simulate the missing worlds, train the posterior, and sample it for the logs."""
        simulated = self.bank.worlds(self.worlds, run)
        logs, fields = self.observed
        names = statistic_names(simulated, fields)
        x = pd.concat([logs_.statistics(log, self.bank.interval) for log in logs])[names].to_numpy()
        set_phase(run.callback, "learn")
        bank = simulated.sel(statistic=names).statistics.values
        networks = posterior.train(simulated.u.values, bank, self.setting.seed)
        data = summary(self.ranges, posterior.sample(networks, x, SAMPLES, self.setting.seed))
        low, high = np.nanquantile(bank.reshape(-1, len(names)), [0.001, 0.999], axis=0)
        outside = np.mean((x < low) | (x > high), axis=0)
        name = "share of logs beyond 99.8 % of the worlds, by statistic"
        data["outside"] = xr.DataArray(outside, {"statistic": names}, attrs={"long_name": name})
        return data

    def intro(self, results: Fitted) -> str:
        fields = self.observed[1]
        return (
            f"Logs: {len(self.raw_logs)}, the first {self.bank.window:g} s of each at "
            f"{1 / self.bank.interval:.3g} Hz, with {', '.join(fields) or 'touch and odometry'}; "
            f"{self.num_trials()} worlds of the domain {self.domain}, "
            f"{self.use_of_worlds}."
        )

    @property
    def use_of_worlds(self) -> str:
        """Use of the worlds, for reports."""
        return f"law {self.label}, in closed loop"

    def report(self, results: Fitted, run: Run) -> Sequence[Section]:
        data, fitted = results.data, f"{self.out}/fitted.json"  # with robot and task
        sweep = self.next_command("sweep", domain=fitted, laws=self.label, robot=None, task=None)
        text = (
            "Median and 90 % interval. A quantity is undetermined if its interval is at least "
            f"{UNDETERMINED:.0%} of the prior's: the logs do not determine it, and its range is "
            f"unchanged. `{sweep}` simulates the fitted domain."
        )
        if (share := float(data.outside.mean())) > 0.05:
            counts = (data.outside.to_series() > 0).groupby(logs_.meaning).agg(["sum", "size"])
            parts = (f"{n} of {size} of {topic}" for topic, (n, size) in counts.iterrows() if n)
            text += (
                f" {share:.0%} of the logs' statistics, {', '.join(parts)}, lie outside those of "
                "the domain's worlds. This fit is invalid: the logs are of another law, robot or "
                "object, or the domain's ranges of what is named here are too narrow."
            )
        objects = data.probability.to_series().items()
        pairs = [["object", "probability"], *([str(x), f"{share:.2f}"] for x, share in objects)]
        return [
            Section("Quantities", text, table(data), Picture("marginals", results.plot)),
            Section("Objects", "", pairs),
            Section("Correlated quantities", "Correlations above 0.5.", correlations(data)),
        ]


fit = call_of(Fit)


# --- simulated worlds ----------------------------------------------------------------------


@dataclass(frozen=True)
class Bank:
    """Simulated worlds of a domain and the statistics of their logs."""

    domain: Domain
    params: LawParams
    setting: Setting
    window: float  # [s]
    interval: float  # [s]
    exact: bool = False  # logs have the true pose, not the pose by odometry

    def worlds(self, count: int, run: Run, split: Split = "tune") -> xr.Dataset:
        """Return coordinates `u` (world, quantity) and `statistics` (world, way, statistic).

        The ways are the world itself and its mirror image.
        """
        size, chunks = _BATCH * len(self.domain.objects), list[xr.Dataset]()
        for first in range(0, count, size):
            index = np.arange(first, min(first + size, count))
            compute = partial(self._simulate, index, split, run)
            chunks.append(run.checkpoint(f"{split}-{first:07d}", compute))
            run.callback(Progress(int(index[-1]) + 1, (index[-1] + 1) * self.window))
        return xr.concat(chunks, "world")

    def _simulate(self, index: np.ndarray, split: Split, run: Run) -> xr.Dataset:
        """Return coordinates and statistics of the worlds with these indices."""
        seed = seed_of(self.setting.seed, split)
        at, drawn = zip(*points.draw_by_object(self.domain, seed, None, index), strict=True)
        workers = run.workers or self.setting.simulator.workers("cpu")
        with ThreadPoolExecutor(workers) as pool:
            pairs = zip(*pool.map(device.standard_jax()(self.statistics), drawn), strict=True)
        order = np.argsort(np.concatenate(at))
        ways = [pd.concat(frames).iloc[order] for frames in pairs]
        cube = points.points_of(self.domain, index, seed)
        columns = [points.names(self.domain).index(name) for name in coordinates(self.domain)]
        return xr.Dataset(
            {
                "u": (("world", "quantity"), cube[:, columns]),
                "statistics": (("world", "way", "statistic"), np.float32(np.stack(ways, 1))),
            },
            {"quantity": list(coordinates(self.domain)), "statistic": list(ways[0])},
        )

    def statistics(self, drawn: Draw) -> tuple[pd.DataFrame, ...]:
        """Return statistics of worlds (n,) of one object, and of their mirror images."""
        log = self.logs(drawn)
        return tuple(logs_.statistics(x, self.interval) for x in (log, logs_.mirror(log)))

    def logs(self, drawn: Draw) -> Log:
        """Return the logs of worlds (n,) of one object, padded to one batch size."""
        count = drawn.indices.size
        part = drawn_worlds(self.domain, drawn, self.setting).with_params(self.params)
        repeated = np.resize(np.arange(count), max(count, _BATCH))
        worlds, params = rows((part.worlds, part.params), repeated)
        physics, law = self.setting.physics, recorded_law(registry.law_of(self.params), "force")
        loop = ControlLoop(physics, self.setting.rules, law)
        num_rows = round(self.window / self.interval)
        row_steps = max(1, round(self.interval / physics.control_period))
        rows_ = _simulate_logs(part.stage, worlds, params, loop, rows=num_rows, row_steps=row_steps)
        columns = {k: np.swapaxes(np.asarray(x, float), 0, 1)[:count] for k, x in rows_.items()}
        true_pose, valid = columns.pop("true_pose"), columns.pop("done") < 0.5
        if self.exact:
            columns["pose"] = true_pose
        return Log(valid=valid, target=np.asarray(part.worlds.p_world_target), **columns)


def check_law(label: str, law: Law, setting: Setting) -> None:
    """Raise InputError unless logs of this law can be simulated in this setting."""
    setting.simulator.check_traced()
    setting.simulator.check_senses("force")
    if law.senses != "touch":
        rule = f"it senses {law.senses}; fit needs a law that senses touch, as rps or rps_plus"
        raise errors.not_allowed("law", label, rule)


@partial(jax.jit, static_argnames=("rows", "row_steps"))
def _simulate_logs(
    stage: Stage, worlds: World, params: LawParams, loop: ControlLoop, *, rows: int, row_steps: int
) -> dict[str, Array]:
    """Return the logs of a batch, (rows, B, ...), with one row every `row_steps` control steps."""
    control_step = partial(trial.control_step, stage, worlds, params, loop=loop)

    def row(trials: Trial, _: None) -> tuple[Trial, dict[str, Array]]:
        trials, snapshot = control_step(trials)
        trials = jax.lax.fori_loop(1, row_steps, lambda _, t: control_step(t)[0], trials)
        obs = snapshot.details[1]  # of `recorded_law`
        p_world_object, yaw = jax.vmap(object_pose)(snapshot.qpos)
        columns = {
            "pose": jnp.concatenate([obs.touch.p_world_robot, obs.touch.yaw[:, None]], -1),
            "true_pose": snapshot.qpos[:, :3],
            "contact_type": snapshot.reading.contact_type,
            "p_robot_contact": snapshot.reading.p_robot_contact,
            "twist": jnp.stack([jnp.broadcast_to(x, yaw.shape) for x in snapshot.twist], -1),
            "object_pose": jnp.concatenate([p_world_object, yaw[:, None]], -1),
            "f_robot": obs.f_robot,
            "done": snapshot.done,
        }
        if trials.skin.signal.shape[-1]:
            columns["signal"] = jnp.where(trials.skin.alive, trials.skin.signal, 0.0)
        return trials, columns

    trials = trial.start_all(worlds, params, law=loop.law)
    return jax.lax.scan(row, trials, length=rows)[1]


# --- from samples to a domain --------------------------------------------------------------


def coordinates(domain: Domain) -> tuple[str, ...]:
    """Return the coordinates of a domain's cube that are fitted: all but the task's and shapes."""
    task = {*domains.quantities_of("task"), "com_bearing", "friction", "target"}
    candidates = (x for x in points.coordinates(domain) if x.kind in ("range", "choice"))
    return tuple(x.name for x in candidates if x.name not in task)


def statistic_names(bank: xr.Dataset, fields: Sequence[str]) -> list[str]:
    """Return the names of the statistics of logs with these optional fields that a world has."""
    names = map(str, bank.dropna("statistic", how="all").statistic.values)
    return [n for n in names if n.split("/")[0] in ("base", *fields)]


def values_of(domain: Domain, u: np.ndarray) -> Arrays:
    """Return quantities (n,) of points (n, D) in their units, and the derived quantities."""
    ranges = {x.name: x.range for x in points.coordinates(domain) if x.kind == "range"}
    columns = zip(coordinates(domain), u.T, strict=True)
    values = {name: ranges[name].at(column) for name, column in columns if name in ranges}
    for name, (_, inputs, function) in DERIVED.items():
        if values.keys() >= set(inputs):
            values[name] = function(*(values[key] for key in inputs))
    return values


def summary(domain: Domain, u: np.ndarray) -> xr.Dataset:
    """Return the posterior of its points (n, D), as `Fit` describes it."""
    uniform = np.random.default_rng(0).random((20_000, u.shape[1]))
    values, prior = (pd.DataFrame(values_of(domain, x)) for x in (u, uniform))
    ranks = [np.searchsorted(np.sort(prior[k]), v) / 20_000 for k, v in values.items()]
    rank = np.stack(ranks, -1)  # (n, quantities) quantile of the prior
    low, high = np.quantile(rank, [0.05, 0.95], axis=0)
    columns: dict[str, Any] = {
        "sample": (("draw", "quantity"), values.to_numpy()),
        "undetermined": ("quantity", ((high - low) >= 0.9 * UNDETERMINED).astype(np.int8)),
        "shrinkage": ("quantity", 1 - (high - low) / 0.9),
        "correlation": (("quantity", "other"), np.nan_to_num(np.corrcoef(rank.T))),
    }
    for prefix, source in (("", values), ("prior_", prior)):
        quantiles = np.quantile(source, [0.05, 0.5, 0.95], axis=0)
        for name, row in zip(("low", "median", "high"), quantiles, strict=True):
            columns[prefix + name] = ("quantity", row)
    count, objects = len(domain.objects), np.zeros(len(u), int)
    if "object" in coordinates(domain):
        objects = np.floor(u[:, 0] * count).astype(int)
    columns["probability"] = ("object", np.bincount(objects, minlength=count) / len(u))
    names = list(map(str, values))
    units = [DERIVED[name][0] if name in DERIVED else unit_of(name) for name in names]
    coords = {"quantity": names, "other": names, "object": list(domain.objects)}
    return xr.Dataset(columns, coords | {"unit": ("quantity", units)})


def fitted_domain(domain: Domain, data: xr.Dataset) -> Domain:
    """Return the domain with the 90 % interval of each determined quantity as its range.

    All three errors of the velocity share one range. Objects with a probability below 5 % are
    removed.
    """
    intervals = data[["low", "high"]].isel(quantity=data.undetermined.values == 0).to_dataframe()
    changes: dict[str, Any] = {
        str(name): Range(float(row.low), float(row.high), interval.log)
        for name, row in intervals.iterrows()
        if name in QUANTITIES and (interval := domain.range_of(str(name))) is not None
    }
    velocity = intervals.reindex(VELOCITY_ERRORS)
    if velocity.low.notna().all():
        changes["velocity_error"] = Range(float(velocity.low.min()), float(velocity.high.max()))
    objects = tuple(map(str, data.object.values[data.probability.values >= 0.05]))
    if not set(objects) & domains.RANDOM.keys():  # these draw no mass
        changes |= {name: getattr(Domain, name, None) for name in domains.OBJECT_QUANTITIES}
    return domain.with_changes(changes | {"objects": objects})


# --- report --------------------------------------------------------------------------------


def table(data: xr.Dataset) -> Rows:
    """Return a header and one row for each quantity."""
    rows = [["quantity", "unit", "median", "90 %", "prior 90 %", "information"]]
    columns = ["median", "low", "high", "prior_low", "prior_high", "undetermined", "shrinkage"]
    for name, row in data[columns].to_dataframe().iterrows():
        interval = f"{row.low:.3g} to {row.high:.3g}"
        prior = f"{row.prior_low:.3g} to {row.prior_high:.3g}"
        gain = "undetermined" if row.undetermined else f"{row.shrinkage:.0%} narrower"
        rows.append([quantity(str(name)), row.unit, f"{row['median']:.3g}", interval, prior, gain])
    return rows


def correlations(data: xr.Dataset) -> Rows:
    """Return a header and the pairs of quantities that the logs determine only in combination."""
    correlation = data.correlation.values
    names = data.quantity.values.tolist()
    pairs = [
        (i, j)
        for i, j in np.argwhere(np.tril(abs(correlation), -1) > 0.5)
        if not DERIVED.keys() & {names[i], names[j]}
    ]
    rows = [[quantity(names[i]), quantity(names[j]), f"{correlation[i, j]:.2f}"] for i, j in pairs]
    return [["", "", "correlation"], *rows]
