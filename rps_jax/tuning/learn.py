"""Learn a law by PPO in a run folder, within a time limit; a killed run resumes from checkpoints.

`Learn` holds the options and the report. `_Learner` holds the programs and the state of a run.
"""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.stages import Lowered

from rps_jax import errors
from rps_jax.analysis import tables
from rps_jax.analysis.figures.style import WIDTH, Figure, legend_above, styled, tiles
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import policy as policies
from rps_jax.control.learned.network import Network, Weights
from rps_jax.control.learned.policy import Policy
from rps_jax.engines import device
from rps_jax.record import files
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.spec import Spec
from rps_jax.trials.env import SHAPED_REWARD, PushEnv
from rps_jax.trials.progress import Bar, Progress, ProgressCallback, Timing
from rps_jax.trials.setting import Setting, Split
from rps_jax.trials.trial import Rules
from rps_jax.tuning import collection
from rps_jax.tuning.collection import RunnerState
from rps_jax.tuning.ppo import PPO
from rps_jax.tuning.run import DomainsQuestion
from rps_jax.world.tasks.base import heading_of

_CHECKPOINT = "learner"
_VALIDATION_RATIO = 10  # learning time between two validations, as a multiple of their time
Metrics = dict[str, float]  # results of an update, by name

METRICS = {  # of an update, by name
    "time": Spec("s", "wall clock since the start of the run, with compilation"),
    "simulated": Spec("s", "simulated time, summed over worlds"),
    "success": Spec("1", "success rate of the trials that ended, at the level of the curriculum"),
    "ended": Spec("1", "trials that ended"),
    "tipped": Spec("1", "number of them whose object fell over"),
    "lost": Spec("1", "number of them that lost contact for too long"),
    "earned": Spec("1", "mean reward of the trials that ended"),
    "touching": Spec("1", "share of the actions that end in contact"),
    "level": Spec("1", "level of the curriculum"),
    "reward": Spec("1", "mean reward of an action"),
    "value": Spec("1", "mean of the value function"),
    "kl": Spec("1", "mean KL divergence between the acting policy and the updated ones"),
    "learning_rate": Spec("1", "learning rate"),
    "spread": Spec("1", "standard deviation of the actions"),
    "validation": Spec("1", "success rate in worlds for validation, without noise, or NaN"),
    "validation_time": Spec("s", "mean time of these successes"),
}


@dataclass(frozen=True)
class Learn(PPO, DomainsQuestion):
    """Learn a law from touch by PPO, in random worlds for tuning, and write it as `policy.npz`.

    The answer is the learning curve: the metrics of each update (update), with units as
    attributes. Its attributes `compile` and `run` [s] split the wall clock, and `test_success` [1]
    is the success rate of the learned law in test worlds.

    Examples:
      >>> import rps_jax
      >>> small = {"network": "mlp", "width": 4, "num_envs": 4, "num_steps": 2}
      >>> small |= {"num_minibatches": 1, "drawn": 4, "validation": 2}
      >>> drums, fast = "wide,objects=random_cylinder", rps_jax.Setting("quasistatic")
      >>> curve = rps_jax.learn(drums, minutes=0, updates=1, **small, setting=fast, out="drums")
      >>> curve.success.dims, bool(curve.validation.notnull().all())
      (('update',), True)
    """

    TITLE = "A learned law"
    IGNORED_FIELDS = ("minutes", "updates", "every")
    REPORTS_TIMES = True
    RENAMED: ClassVar = {
        "hard": "prioritised",
        "enough": "success_threshold",
        "level": "initial_level",
        "spread": "action_std",
        "average": "ema_updates",
    }
    QUICK: ClassVar = {
        "domain": ("wide,objects=random_box",),
        "network": "mlp",
        "width": 32,
        "num_envs": 256,
        "drawn": 1024,
        "validation": 64,
        "num_minibatches": 4,
        "minutes": 15.0,
        "updates": 300,  # on any machine the same number
    }

    minutes: float = option(10.0, 0, 1e5, unit="min")
    """Wall clock after which the run stops [min], with compilation and validation, summed over all
    processes of the run; 0 means no limit."""
    updates: int = option(0, 0, 10**9)
    """Number of updates after which the run stops; 0 means no limit."""
    drawn: int = option(4096, 1, 1_000_000)
    """Number of random worlds of each shape and domain; every trial uses one of them."""
    validation: int = option(128, 1, 1_000_000)
    """Number of worlds for validation of each shape and domain."""
    success: float = option(1.0, 0, 100)
    """Reward of a success [1]; the rest of a trial earns at most about 1 per metre."""
    failure: float = option(0.0, 0, 100)
    """Cost of a trial that ends without success [1]. Above 0, a time limit ends a trial for the
    value function, too, which otherwise continues it."""
    every: float = option(1.0, above=0, at_most=1e4, unit="min")
    """Wall clock between two checkpoints [min]. The law is validated at the first checkpoint, at
    the end, and at every checkpoint for which validation takes at most a tenth of the time."""
    setting: Setting = field(
        default=Setting(fidelity="fast", rules=Rules(horizon=120.0, max_lost=30.0)), kw_only=True
    )
    out: Path | str | None = field(default="runs/learn", kw_only=True)
    """Run folder, with `policy.npz`; a killed run resumes there."""

    def check(self) -> None:
        if self.out is None:
            raise errors.InputError("out = None is not allowed: name a folder for the policy.")
        if not (self.minutes or self.updates):
            raise errors.InputError("minutes = 0 is not allowed without updates: set one of them.")
        errors.check_each_once("domain", self.domains)
        for domain in self.domains:
            errors.check_name("skin of a domain to learn in", domain.skin, ("capacitive",))
            if heading_of(domain.task) is not None:
                rule = "a learned law does not sense the heading of a goal; choose another task"
                raise errors.not_allowed("task", domain.task.kind, rule)
        self.setting.simulator.check_traced()
        count = self.num_envs * sum(len(domain.objects) for domain in self.domains)
        if self.num_minibatches > count:
            rule = f"there are only {count} worlds; raise num_envs"
            raise errors.not_allowed("num_minibatches", self.num_minibatches, rule)
        if self.initial:
            initial = policies.read(self.initial).network
            kind, width, taxels, hold, actions = initial
            sizes = {(x.robot.shell.count, 2 + (x.robot.drive == "omni")) for x in self.domains}
            if {Network(self.network, self.width, x, self.hold, n) for x, n in sizes} != {initial}:
                options = f"network = {kind}, width = {width} and hold = {hold:g} s"
                rule = f"its network needs {options}, and robots with {taxels} taxels"
                rule += ", which move sideways" if actions == 3 else ", which do not move sideways"
                raise errors.not_allowed("initial", self.initial, rule)
        period = self.setting.physics.control_period
        errors.check_number("hold", self.hold, at_least=0.999 * period, unit="s")

    def environments(self, split: Split) -> list[PushEnv]:
        """Return the environments of a split; those for validation have the paper's rules."""
        tune = split == "tune"
        rules, worlds = (self.setting.rules, self.drawn) if tune else (Rules(), self.validation)
        setting = replace(self.setting, rules=rules, split=split)
        reward = SHAPED_REWARD._replace(success=self.success, failure=self.failure)
        return [
            PushEnv(name, domain, RPSParams(), setting, weights=reward, worlds=worlds)
            for domain in self.domains
            for name in domain.objects
        ]

    def progress_bar(self) -> Bar:
        limit = (self.updates, "updates") if self.updates else (60 * self.minutes, "clock")
        return Bar(self.name, *limit, shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        assert run.folder is not None
        return _Learner(run.folder, self, run.callback).run()

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{self.network.upper()} of {self.width} pairs of units, PPO in {self.num_envs} worlds "
            f"of each shape; validated in the domain itself, without noise, by the paper's rules."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        simulated = float(results.simulated[-1]) if results.sizes["update"] else 0.0
        times = Timing(results.attrs["compile"], results.attrs["run"], simulated)
        validated = results.to_dataframe().dropna(subset="validation")
        worlds = self.validation * sum(len(domain.objects) for domain in self.domains)

        def share(rate: float) -> str:
            return tables.share(round(rate * worlds), worlds)

        tested = ""
        if "test_success" in results.attrs:
            rate = share(results.attrs["test_success"])
            tested = f"Test: in worlds that it has not met, it succeeds in {rate}. "
        text = (
            f"`{run.folder}/policy.npz` is the learned law. {tested}In validation its success is "
            f"{share(max(validated.validation, default=0.0))}; these worlds chose it among the "
            f"validated laws. {str(times).capitalize()}."
        )
        rows = [["update", "wall clock", "success in validation", "mean time", "curriculum"]]
        for update, row in validated.iterrows():
            wall, level = f"{row.time / 60:.1f} min", f"{100 * row.level:.0f} %"
            mean = f"{row.validation_time:.0f} s" if row.validation else "-"
            rows.append([str(update), wall, share(row.validation), mean, level])
        picture = Picture("curve", partial(figure_of, results)) if results.sizes["update"] else None
        return [Section("Learning curve", text, rows, picture)]


learn = call_of(Learn)


class _Learner:
    """State of a learning run, with its compiled programs and its checkpoints."""

    def __init__(self, folder: Path, options: Learn, callback: ProgressCallback):
        """Compile all programs concurrently, and start or resume the run."""
        self.folder, self.options, self.callback = folder, options, callback
        self._start_time = time.perf_counter()  # [s]
        envs, validation_envs = (options.environments(split) for split in ("tune", "validate"))
        self._num_worlds = options.num_envs * len(envs)
        self._tables = tables = [env.table for env in envs]
        self.network = network = collection.network_of(options, envs)
        compile_start = time.perf_counter()
        self._validation_tables = [env.table for env in validation_envs]
        start = partial(collection.start, options, network, envs, seed=options.setting.seed)
        update = partial(collection.update, options, network, envs)
        evaluate = partial(collection.evaluate_policy, network, validation_envs)
        shapes = jax.eval_shape(start, tables)
        lowered = (
            jax.jit(update, donate_argnums=1).lower(tables, shapes),
            jax.jit(evaluate).lower(self._validation_tables, shapes.train.ema),
            jax.jit(start).lower(tables),
        )
        with ThreadPoolExecutor(3) as pool:
            self._update, self._evaluate, compiled_start = pool.map(Lowered.compile, lowered)
        self.compile = time.perf_counter() - compile_start
        # A copy: no two leaves may share memory, which updates write to.
        self.runner: RunnerState = jax.tree.map(jnp.copy, compiled_start(tables))
        self.best = jax.device_get(self.runner.train.ema)
        self.best_rate, self.curve = -1.0, list[Metrics]()
        self._restore()

    @property
    def elapsed(self) -> float:
        """Wall clock [s] of all processes of this run."""
        return time.perf_counter() - self._start_time

    def run(self) -> xr.Dataset:
        """Learn until the time limit or the number of updates, with 0 for no limit."""
        seconds, updates = 60 * self.options.minutes, self.options.updates
        reserve = 0.0  # [s] for the last validation, and as long for the test
        last_checkpoint = last_validation = self.elapsed

        def is_finished() -> bool:
            late = seconds and self.elapsed + 2 * reserve >= seconds
            return bool(late or (updates and len(self.curve) >= updates))

        while not is_finished():
            shares = self.elapsed / (seconds or np.inf), len(self.curve) / (updates or np.inf)
            progress = jnp.asarray(max(shares), float)
            runner = self.runner._replace(progress=progress)
            self.runner, metrics = self._update(self._tables, runner)
            self._record({name: float(x) for name, x in jax.device_get(metrics).items()})
            if self.elapsed - last_checkpoint > 60 * self.options.every and not is_finished():
                if self.elapsed - last_validation > _VALIDATION_RATIO * reserve:
                    reserve, last_validation = self._validate(), self.elapsed
                self.checkpoint()
                last_checkpoint = self.elapsed
        if self.curve and np.isnan(self.curve[-1]["validation"]):
            self._validate()
        curve = self.checkpoint()
        if self.curve:
            tables = [env.table for env in self.options.environments("test")]
            success, _ = jax.device_get(self._evaluate(tables, self.best))
            curve.attrs["test_success"] = float(np.mean(success))
        return curve

    def _record(self, metrics: Metrics) -> None:
        """Add an update to the curve, and report the progress."""
        options, ended = self.options, metrics["ended"] or float("nan")
        steps = self._num_worlds * options.num_steps
        simulated = self.curve[-1]["simulated"] if self.curve else 0.0
        metrics["success"] = metrics["succeeded"] / ended
        metrics["earned"] /= ended
        metrics["simulated"] = simulated + steps * options.hold
        metrics["time"] = self.elapsed
        metrics["validation"] = metrics["validation_time"] = float("nan")
        self.curve.append({name: metrics[name] for name in METRICS})
        total = int(sum(metrics["ended"] for metrics in self.curve))
        self.callback(Progress(total, metrics["simulated"], self.compile, len(self.curve)))

    def _validate(self) -> float:
        """Validate the law; return the wall clock of the validation [s]."""
        start_time = self.elapsed
        actor = self.runner.train.ema
        success, times = jax.device_get(self._evaluate(self._validation_tables, actor))
        self.curve[-1]["validation"] = rate = float(np.mean(success))
        if success.any():
            self.curve[-1]["validation_time"] = float(np.mean(times[success]))
        if rate >= self.best_rate:
            self.best_rate, self.best = rate, jax.device_get(actor)
        return self.elapsed - start_time

    # --- checkpoints ---

    def policy(self) -> Policy:
        """Return the law with the best validation, or the latest law before any validation."""
        environment, validated = device.collect_environment(), self.best_rate >= 0
        provenance = {
            "success_in_validation": self.best_rate if validated else None,
            "updates": len(self.curve),
            "simulated": self.curve[-1]["simulated"] if self.curve else 0.0,
            "seconds": round(self.elapsed, 1),
            "how": {option.name: getattr(self.options, option.name) for option in fields(PPO)},
            **{name: environment[name] for name in ("command", "commit", "device", "packages")},
        }
        actor = self.best if validated else jax.device_get(self.runner.train.ema)
        return Policy(self.network, actor, learned=provenance)

    @property
    def _state(self) -> tuple[RunnerState, Weights, np.ndarray, np.ndarray]:
        """Runner, best weights, best rate with both times, and curve (updates, metrics)."""
        rows = [list(metrics.values()) for metrics in self.curve]
        scalars = np.array([self.best_rate, self.compile, self.elapsed])
        return self.runner, self.best, scalars, np.array(rows, float).reshape(-1, len(METRICS))

    def checkpoint(self) -> xr.Dataset:
        """Write the checkpoint, the law and the curve, and return the curve."""
        state = jax.device_get(self._state)
        leaves = {f"leaf_{i:04d}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}
        Checkpoints(self.folder).put(_CHECKPOINT, files.encode_arrays(**leaves), ".npz")
        files.write_bytes(self.folder / "policy.npz", policies.encode(self.policy()))
        columns = zip(METRICS, state[-1].T, strict=True)
        variables = {name: ("update", x, METRICS[name].attributes) for name, x in columns}
        times = {"compile": self.compile, "run": self.elapsed - self.compile}
        curve = xr.Dataset(variables, {"update": np.arange(len(self.curve)) + 1}, times)
        files.write_csv(self.folder / "curve.csv", curve.to_dataframe())
        return curve

    def _restore(self) -> None:
        """Restore the checkpoint, if there is one."""
        content = Checkpoints(self.folder).get(_CHECKPOINT)
        if content is None:
            return
        expected, structure = jax.tree.flatten(self._state)
        try:
            leaves = [leaf for _, leaf in sorted(files.decode_arrays(content).items())]
            kinds = [[(x.dtype, x.shape) for x in several[:-1]] for several in (leaves, expected)]
            if kinds[0] != kinds[1] or leaves[-1].shape[1:] != (len(METRICS),):
                raise ValueError("another version wrote it")
        except ValueError as error:
            raise files.CorruptFileError(self.folder / "parts", error) from error
        runner, self.best, scalars, curve = jax.tree.unflatten(structure, leaves)
        self.runner = jax.device_put(runner)
        self.best_rate, compile_time, elapsed = scalars.tolist()
        self.compile += compile_time
        self._start_time -= elapsed
        self.curve = [dict(zip(METRICS, row, strict=True)) for row in curve.tolist()]


@styled
def figure_of(curve: xr.Dataset) -> Figure:
    """Draw a learning curve: success against both clocks.

    The thin line has single updates; the thick line is a mean over 1/40 of the run.
    """
    figure, axes = tiles(2, 2, (WIDTH / 2, 2.6), (0, 0))
    width, valid = max(1, curve.sizes["update"] // 40), curve.validation.notnull().values
    success = 100 * curve.success
    mean = success.rolling(update=width, min_periods=1, center=True).mean()
    for ax, x, label in (
        (axes[0, 0], curve.time / 60, "wall clock, with compilation [min]"),
        (axes[0, 1], curve.simulated / 3600, "simulated time, summed over worlds [h]"),
    ):
        ax.plot(x, success, color="C0", lw=0.6, alpha=0.35)
        ax.plot(x, mean, color="C0", lw=1.6, label="trials that ended, with noise, at the level")
        ax.plot(x, 100 * curve.level, "k:", lw=1, label="level of the curriculum")
        validation = "validation: the domain itself, no noise"
        ax.plot(x[valid], 100 * curve.validation[valid], "C3o-", ms=3, label=validation)
        ax.set(xlabel=label, ylabel="success, level [%]", ylim=(-3, 103))
        ax.grid(alpha=0.3)
        legend_above(ax, columns=1)
    return figure
