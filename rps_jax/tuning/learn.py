"""Learning a law in a run folder that can be killed and continued, within a time that is given."""

import functools
import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from rps_jax import engines, errors
from rps_jax.analysis import tables
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import policy as policies
from rps_jax.control.learned.network import Weights
from rps_jax.control.learned.policy import Policy
from rps_jax.engines import device
from rps_jax.record import files
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.options import option
from rps_jax.runs.question import Run, SimulationQuestion, Split, call_of, seed_of
from rps_jax.trials.env import SHAPED_REWARD, PushEnv
from rps_jax.trials.progress import Bar, Progress, ProgressCallback
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning import rollout
from rps_jax.tuning.ppo import PPO
from rps_jax.tuning.rollout import RunnerState
from rps_jax.world import domain as domains
from rps_jax.world.domain import Domain, DomainLike

_SPARE = 10  # times as long as a validation takes is learned between two
Metrics = dict[str, float]  # of an update, by name

UNITS = {
    "time": ("s", "wall clock since the run began, with compilation"),
    "simulated": ("s", "simulated time, summed over worlds"),
    "success": ("1", "successes of the trials that ended, at the level of the curriculum"),
    "ended": ("1", "trials that ended"),
    "tipped": ("1", "of these, objects that fell over"),
    "lost": ("1", "of these, trials without contact for too long"),
    "earned": ("1", "rewards of a trial that ended, on average"),
    "touching": ("1", "share of the actions after which the object was touched"),
    "level": ("1", "level of the curriculum"),
    "reward": ("1", "reward of an action, on average"),
    "value": ("1", "value function, on average"),
    "kl": ("1", "KL divergence of the policies of the steps from the one that acted"),
    "learning_rate": ("1", "learning rate"),
    "spread": ("1", "standard deviation of the actions"),
    "validation": ("1", "successes in the worlds for validation, without noise; NaN between"),
    "validation_time": ("s", "time of these successes, on average"),
}


@dataclass(frozen=True)
class Learn(PPO, SimulationQuestion[xr.Dataset]):
    """Learn a law from touch by PPO, in random worlds for tuning; `policy.npz` then holds it.

    The answer is the curve: what was found after each update (update), in the units of its
    attributes. Its attributes `compile` and `run` [s] say where the wall clock went.

    Example:
      >>> import rps_jax
      >>> small = {"network": "mlp", "width": 4, "num_envs": 4, "num_steps": 2}
      >>> small |= {"num_minibatches": 1, "drawn": 4, "validation": 2}
      >>> drums, fast = "wide,objects=random_cylinder", rps_jax.Setting("quasistatic")
      >>> curve = rps_jax.learn(drums, minutes=0, updates=1, **small, setting=fast, out="drums")
      >>> curve.success.dims, bool(curve.validation.notnull().all())
      (('update',), True)
    """

    TITLE: ClassVar[str] = "A law, learned"
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("minutes", "updates", "every")
    QUICK: ClassVar[Mapping[str, Any]] = {
        "domain": ("wide,objects=random_box",),
        "network": "mlp",
        "width": 32,
        "num_envs": 256,
        "drawn": 1024,
        "validation": 64,
        "num_minibatches": 4,
        "minutes": 5.0,
    }

    domain: Sequence[DomainLike] = ("wide",)
    """Domains to learn in: wide, real, prisms, hostile, or JSON files of ranges; changes follow
    each, as wide,objects=random_box."""
    minutes: float = option(10.0, 0, 1e5, unit="min")
    """Wall clock after which it ends [min], with compilation and validation, counted over all
    processes that continued the run; 0 stands for no bound."""
    updates: int = option(0, 0, 10**9)
    """Number of updates after which it ends; 0 stands for no bound."""
    drawn: int = option(4096, 1, 1_000_000)
    """Number of random worlds of each shape and domain, of which every trial takes one."""
    validation: int = option(128, 1, 1_000_000)
    """Number of worlds for validation of each shape and domain."""
    every: float = option(1.0, above=0, at_most=1e4, unit="min")
    """Wall clock between two moments at which the run is kept [min]; at the first, and then
    whenever it takes a tenth of the time at most, the law is tried in the worlds for validation,
    and so it is at the end."""
    setting: Setting = field(
        default=Setting(fidelity="fast", rules=Rules(horizon=120.0, max_lost=30.0)), kw_only=True
    )
    out: Path | str | None = field(default="runs/learn", kw_only=True)
    """Run folder, with `policy.npz`; a run that was killed is continued there."""

    @functools.cached_property
    def domains(self) -> tuple[Domain, ...]:
        """The domains."""
        one = isinstance(self.domain, str | Domain)
        several: list[Any] = [self.domain] if one else list(self.domain)
        return tuple(domains.parse_domain(text) for text in several)

    def check(self) -> None:
        if self.out is None:
            raise errors.InputError("out = None is not allowed: the policy is written there.")
        if not (self.minutes or self.updates):
            raise errors.InputError("minutes = 0 is not allowed without updates: give one of them.")
        errors.check_each_once("domain", self.domains)
        errors.check_count("seed", self.setting.seed, at_least=0, at_most=2**30)
        for one in self.domains:
            errors.check_name("skin of a domain to learn in", one.skin, ("capacitive",))
        engines.get(self.setting.engine).check_traced()
        count = self.num_envs * sum(len(one.objects) for one in self.domains)
        if self.num_minibatches > count:
            raise errors.InputError(
                f"num_minibatches = {self.num_minibatches} is not allowed: there are but {count} "
                "worlds."
            )
        period = self.setting.physics.control_period
        if self.hold < 0.999 * period:
            raise errors.InputError(
                f"hold = {self.hold:g} s is not allowed: an action lasts for a control step at "
                f"least, {period:g} s."
            )

    def fields_as_json(self) -> dict[str, Any]:
        """Own fields as JSON, with domains by their ranges."""
        return super().fields_as_json() | {"domain": [asdict(one) for one in self.domains]}

    def environments(self, split: Split = "tune") -> list[PushEnv]:
        """Those in which it is learned; or those for validation, by the rules of the paper."""
        tune = split == "tune"
        rules, worlds = (self.setting.rules, self.drawn) if tune else (Rules(), self.validation)
        setting = replace(self.setting, rules=rules, seed=seed_of(self.setting.seed, split))
        return [
            PushEnv(name, one, RPSParams(), setting, weights=SHAPED_REWARD, worlds=worlds)
            for one in self.domains
            for name in one.objects
        ]

    def progress_bar(self) -> Bar:
        if self.updates:
            return Bar(self.name, self.updates, "updates", shown=self.shows_progress)
        return Bar(self.name, 60 * self.minutes, "clock", shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        assert run.folder is not None
        learning = _Learning(run.folder, self, run.callback, time.perf_counter())
        return learning.through(60 * self.minutes, self.updates, 60 * self.every)

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{self.network.upper()} of {self.width} pairs of units, PPO in {self.num_envs} worlds "
            f"of each shape; judged in the domain itself, without noise, by the paper's rules."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        simulated = float(results.simulated[-1]) if results.sizes["update"] else 0.0
        took = results.attrs["run"]
        judged = results.validation.dropna("update")
        text = (
            f"Compile {results.attrs['compile']:.1f} s, run {took:.1f} s "
            f"({simulated / max(took, 1e-9):.0f} simulated s per s). "
            f"`{run.folder}/policy.npz` is a law by that name, of "
            f"{tables.percent(float(np.max(judged.values, initial=0.0)))} % in validation."
        )
        rows = [["update", "wall clock", "success in validation", "mean time", "curriculum"]]
        for update, rate in zip(judged["update"].values, judged.values, strict=True):
            at = results.sel(update=update)
            rows.append(
                [
                    str(update),
                    f"{float(at.time) / 60:.1f} min",
                    f"{tables.percent(rate)} %",
                    f"{float(at.validation_time):.0f} s",
                    f"{100 * float(at.level):.0f} %",
                ]
            )
        return [
            Section("What was learned", text, rows, Picture("curve", partial(figure_of, results)))
        ]


learn = call_of(Learn)


def _checked_note(note: Any) -> dict[str, Any]:
    """What is kept of a run beside its numbers; ValueError if it is something else."""
    for name in ("spent", "compile", "best"):
        errors.check_number(name, note[name])
    for metrics in note["curve"]:
        for name in UNITS:
            if not isinstance(metrics[name], float | int):
                raise ValueError(f"{name} = {metrics[name]!r} is no number")
    return note


class _Learning:
    """A learning run under way, in its folder."""

    def __init__(self, folder: Path, how: Learn, callback: ProgressCallback, began: float):
        self.folder, self.how, self.report = folder, how, callback
        self._began, self._before = began, 0.0  # [s]
        self._envs = how.environments()
        self._exams = how.environments("validate")
        self._tables = [env.table for env in self._envs]
        self.network = rollout.network_of(how, self._envs)
        self.curve: list[Metrics] = []
        self.best: Weights | None = None  # of the law that validated best, so far
        self.best_rate, self.compile, self._kept = -1.0, 0.0, 0
        begin = self._programs()
        # A copy: no two leaves may share memory, which updates write to.
        self.runner: RunnerState = jax.tree.map(jnp.copy, begin(self._tables))
        self._restore()

    def _programs(self) -> Any:
        """Compile all programs side by side; returns the one that begins."""
        began, envs = time.perf_counter(), self._envs
        tables, self._theirs = self._tables, [env.table for env in self._exams]
        begin = partial(rollout.begin, self.how, self.network, envs, seed=self.how.setting.seed)
        update = partial(rollout.update, self.how, self.network, envs)
        evaluate = partial(rollout.evaluate_policy, self.network, self._exams)
        runner = jax.eval_shape(begin, tables)
        with ThreadPoolExecutor(3) as pool:
            waiting = [
                pool.submit(lambda f, *shapes: f.lower(*shapes).compile(), *each)
                for each in (
                    (jax.jit(update, donate_argnums=1), tables, runner),
                    (jax.jit(evaluate), self._theirs, runner.train.ema),
                    (jax.jit(begin), tables),
                )
            ]
            self._update, self._evaluate, begin = (one.result() for one in waiting)
        self.compile += time.perf_counter() - began
        return begin

    @property
    def spent(self) -> float:
        """Wall clock [s] of this process and of those before it."""
        return self._before + time.perf_counter() - self._began

    def through(self, seconds: float, updates: int, every: float) -> xr.Dataset:
        """Learn until the time is spent, or the updates are made."""
        reserve = 0.0  # [s] for the last validation
        kept = judged = self.spent

        def over() -> bool:
            late = seconds and self.spent + reserve >= seconds
            return bool(late or (updates and len(self.curve) >= updates))

        while not over():
            self.runner, metrics = self._update(self._tables, self.runner)
            self._note({name: float(x) for name, x in jax.device_get(metrics).items()})
            if self.spent - kept > every and not over():
                if self.spent - judged > _SPARE * reserve:
                    reserve, judged = self._validate(), self.spent
                self.keep()
                kept = self.spent
        if self.curve and np.isnan(self.curve[-1]["validation"]):
            self._validate()
        self.keep()
        variables = {}
        for name, (unit, words) in UNITS.items():
            values = [metrics[name] for metrics in self.curve]
            variables[name] = ("update", values, {"units": unit, "long_name": words})
        took = {"compile": self.compile, "run": self.spent - self.compile}
        return xr.Dataset(variables, {"update": np.arange(len(self.curve)) + 1}, took)

    def _note(self, metrics: Metrics) -> None:
        """Add an update to the curve, and tell how far it is."""
        ended = max(metrics["ended"], 1.0)
        before = self.curve[-1]["simulated"] if self.curve else 0.0
        worlds = self.how.num_envs * len(self._envs)
        metrics["success"] = metrics.pop("won") / ended if metrics["ended"] else float("nan")
        metrics["earned"] = metrics["earned"] / ended if metrics["ended"] else float("nan")
        metrics["simulated"] = before + worlds * self.how.num_steps * self.how.hold
        metrics["time"] = self.spent
        metrics["validation"] = metrics["validation_time"] = float("nan")
        self.curve.append({name: metrics[name] for name in UNITS})
        ended = int(sum(metrics["ended"] for metrics in self.curve))
        self.report(Progress(ended, self.curve[-1]["simulated"], self.compile, len(self.curve)))

    def _validate(self) -> float:
        """Try the law; returns how long that took [s]."""
        began = time.perf_counter()
        actor = self.runner.train.ema
        success, took = jax.device_get(self._evaluate(self._theirs, actor))
        self.curve[-1]["validation"] = rate = float(np.mean(success))
        if success.any():
            self.curve[-1]["validation_time"] = float(np.mean(took[success]))
        if rate >= self.best_rate:
            self.best_rate, self.best = rate, jax.device_get(actor)
        return time.perf_counter() - began

    # --- what is kept ---

    def policy(self) -> Policy:
        """The law that validated best, or the latest before any did."""
        made = device.collect_environment()
        how = {
            "success_in_validation": self.best_rate if self.best else None,
            "updates": len(self.curve),
            "simulated": self.curve[-1]["simulated"] if self.curve else 0.0,
            "seconds": round(self.spent, 1),
            "how": {one.name: getattr(self.how, one.name) for one in fields(PPO)},
            **{name: made[name] for name in ("command", "commit", "device", "packages")},
        }
        actor = self.best or jax.device_get(self.runner.train.ema)
        return Policy(self.network, actor, learned=how)

    def keep(self) -> None:
        """Write what continues the run, and the law as it is; two such files are kept in turn."""
        leaves = jax.device_get(jax.tree.leaves(self.runner))
        arrays: dict[str, Any] = {f"leaf_{i:04d}": leaf for i, leaf in enumerate(leaves)}
        for name, weight in (self.best or {}).items():
            arrays[f"best_{name}"] = weight
        note = {"curve": self.curve, "spent": self.spent, "compile": self.compile}
        arrays["note"] = np.array(json.dumps(note | {"best": self.best_rate}))
        self._kept += 1
        Checkpoints(self.folder).put(
            f"learner-{self._kept % 2}", files.encode_arrays(**arrays), ".npz"
        )
        files.write_bytes(self.folder / "policy.npz", policies.encode(self.policy()))
        rows = [{"update": i + 1} | metrics for i, metrics in enumerate(self.curve)]
        files.write_csv(self.folder / "curve.csv", rows)

    def _restore(self) -> None:
        """Take up what was kept last, if it is sound."""
        found = []
        for name, content in Checkpoints(self.folder).items():
            path = Checkpoints(self.folder).folder / name
            try:
                arrays = files.decode_arrays(content)
                note = _checked_note(files.parse_json(str(arrays.pop("note"))))
            except (ValueError, KeyError, TypeError) as error:
                raise files.CorruptFileError(path, error) from error
            found.append((len(note["curve"]), note["spent"], name, note, arrays))
        if not found:
            return
        *_, name, note, arrays = max(found, key=lambda one: one[:2])
        best = {k.removeprefix("best_"): v for k, v in arrays.items() if k.startswith("best_")}
        leaves = [arrays[key] for key in sorted(arrays) if key.startswith("leaf_")]
        like = jax.tree.leaves(self.runner)
        shapes = {key: value.shape for key, value in best.items()}
        if [(x.shape, x.dtype) for x in leaves] != [(x.shape, x.dtype) for x in like] or (
            best and shapes != self.network.shapes
        ):
            raise errors.InputError(
                f"run = {self.folder} cannot be continued: another version made it; choose "
                "another folder."
            )
        own = [jax.device_put(leaf) for leaf in leaves]
        self.runner = jax.tree.unflatten(jax.tree.structure(self.runner), own)
        self.curve, self._before = note["curve"], note["spent"]
        self.compile += note["compile"]
        self.best_rate, self.best, self._kept = note["best"], best or None, int(name[-1])


def figure_of(curve: xr.Dataset) -> Figure:
    """Draw how a law was learned: successes and rewards against both clocks, and PPO's own state.

    The curves of single updates are drawn thin; thick ones are means over 1/40 of the run.
    """
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    axes = figure.subplots(2, 2)
    minutes, simulated = curve.time.values / 60, curve.simulated.values / 3600
    width = max(1, curve.sizes["update"] // 40)

    def draw(ax: Axes, x: np.ndarray, name: str, scale: float, colour: str, label: str) -> None:
        values = scale * curve[name].values
        mean = curve[name].rolling(update=width, min_periods=1, center=True).mean().values
        ax.plot(x, values, color=colour, lw=0.6, alpha=0.35)
        ax.plot(x, scale * mean, color=colour, lw=1.6, label=label)

    judged = np.isfinite(curve.validation.values)
    clocks = (
        (minutes, "wall clock, with compilation [min]"),
        (simulated, "simulated time, summed over worlds [h]"),
    )
    for ax, (x, label) in zip(axes[0], clocks, strict=True):
        draw(ax, x, "success", 100, "C0", "trials that ended, with noise, at the level below")
        ax.plot(x, 100 * curve.level, "k:", lw=1, label="level of the curriculum")
        ax.plot(
            x[judged], 100 * curve.validation.values[judged], "C3o-", ms=4,
            label="validation: the domain itself, no noise",
        )  # fmt: skip
        ax.set(xlabel=label, ylabel="success, level [%]", ylim=(-3, 103))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7, loc="lower right")
    draw(axes[1, 0], minutes, "earned", 1, "C2", "rewards of a trial")
    axes[1, 0].set(xlabel=clocks[0][1], ylabel="rewards of a trial that ended [1]")
    axes[1, 0].grid(alpha=0.3)
    ax = axes[1, 1]
    ax.plot(simulated, curve.spread, label="standard deviation of the actions")
    ax.plot(simulated, 100 * curve.learning_rate, label="100 learning rates")
    ax.plot(simulated, curve.touching, label="share of decisions in contact")
    ax.set(xlabel=clocks[1][1], ylabel="[1]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=7)
    return figure
