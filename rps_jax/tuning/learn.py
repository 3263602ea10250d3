"""Learning a law in a run folder that can be killed and continued, within a time that is given."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import engines, errors
from rps_jax.analysis import figures
from rps_jax.control.law import RPSParams
from rps_jax.control.learned import policy as policies
from rps_jax.control.learned.network import Weights
from rps_jax.control.learned.policy import Policy
from rps_jax.engines import EngineName
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Parts
from rps_jax.runs.evaluate import seed_of
from rps_jax.trials.env import PushEnv, Reward
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules, World
from rps_jax.tuning import crowd
from rps_jax.tuning.crowd import Learner
from rps_jax.tuning.ppo import PPO
from rps_jax.world import domain as domains
from rps_jax.world.domain import Domain
from rps_jax.world.physics import Fidelity, preset

REWARD = Reward(progress=0.5, no_contact=0.02, success=1.0, object=0.5, behind=0.5)
_SPARE = 10  # times as long as a validation takes is learned between two
Told = dict[str, float]  # of an update, by name
Watch = Callable[[Told], object]  # called after every update

UNITS = {
    "time": ("s", "wall clock since the run began, with compilation"),
    "simulated": ("s", "simulated time, summed over worlds"),
    "success": ("1", "successes of the trials that ended, at the level of the curriculum"),
    "ended": ("1", "trials that ended"),
    "tipped": ("1", "of these, objects that fell over"),
    "lost": ("1", "of these, trials without contact for too long"),
    "earned": ("1", "rewards of a trial that ended, on average"),
    "touching": ("1", "share of the decisions after which the object was touched"),
    "level": ("1", "level of the curriculum"),
    "reward": ("1", "reward of a decision, on average"),
    "value": ("1", "what the value function said, on average"),
    "divergence": ("1", "divergence of the policies of the steps from the one that acted"),
    "learning_rate": ("1", "learning rate"),
    "spread": ("1", "standard deviation of the actions"),
    "validation": ("1", "successes in the worlds for validation, without noise; NaN between"),
    "validation_time": ("s", "time of these successes, on average"),
}


@dataclass(frozen=True)
class Lessons:
    """In which worlds a law is learned, and by which it is judged."""

    domains: tuple[Domain, ...] = (domains.DOMAINS["wide"],)
    objects: tuple[str, ...] = ("random_box", "random_cylinder", "random_prism")
    """Shapes of the objects of these domains."""
    drawn: int = 4096
    """Number of random worlds of each shape and domain that are drawn, of which trials take one."""
    validation: int = 128
    """Number of worlds for validation of each shape and domain."""
    horizon: float = 120.0
    """Time after which a trial in which a law is learned ends [s]; it is judged by 300 s."""
    max_lost: float = 30.0
    """Time without contact after which it ends [s]; a law is judged by 150 s."""
    fidelity: Fidelity = "fast"
    engine: EngineName = "fused"

    def __post_init__(self) -> None:
        """Raises InputError for no domain, no objects, or numbers that mean nothing."""
        errors.check_each_once("domains", self.domains)
        errors.check_each_once("objects", self.objects)
        for name in ("drawn", "validation"):
            errors.check_count(name, getattr(self, name), at_most=1_000_000)
        self.rules.check()
        for one in self.domains:
            alone = replace(one, objects=self.objects)
            errors.check_name("skin of a domain to learn in", one.skin, ("capacitive",))
            engines.get(self.engine).check(alone.families)
        engines.get(self.engine).check_followed()

    @property
    def rules(self) -> Rules:
        """When a trial in which a law is learned ends."""
        return Rules(self.horizon, self.max_lost)

    def environments(self, seed: int) -> list[PushEnv]:
        """Those in which it is learned, of the worlds for tuning."""
        return self._made(seed_of(seed, "tune"), self.rules, self.drawn)

    def examinations(self, seed: int) -> list[PushEnv]:
        """Those by which it is judged, of the worlds for validation, by the rules of the paper."""
        return self._made(seed_of(seed, "validate"), Rules(), self.validation)

    def _made(self, seed: int, rules: Rules, worlds: int) -> list[PushEnv]:
        setting = Setting(preset(fidelity=self.fidelity), rules, seed, self.engine)
        return [
            PushEnv(name, one, RPSParams(), setting, weights=REWARD, worlds=worlds)
            for one in self.domains
            for name in self.objects
        ]


def learn(
    domain: Domain | str | Sequence[Domain | str] = "wide",
    out: str | Path = "runs/learn",
    how: PPO = PPO(),
    *,
    minutes: float = 10.0,
    updates: int = 0,
    lessons: Lessons = Lessons(),
    every: float = 1.0,
    watch: Watch = lambda told: None,
) -> xr.Dataset:
    """Learn a law from touch, in random worlds for tuning; `policy.npz` then holds it.

    Args:
      domain: ranges of what differs between worlds, or their name in `DOMAINS`; or several.
      out: run folder; a run that was killed is continued there.
      how: the algorithm's numbers, and the network.
      minutes: wall clock after which it ends [min], with compilation and validation, counted over
        all processes that worked in the folder; 0 stands for no bound.
      updates: number of updates after which it ends, likewise; 0 stands for no bound.
      lessons: its objects, rules and engine; its domains are those above.
      every: wall clock between two looks [min], at which the run is kept; at the first, and then
        whenever it takes a tenth of the time at most, the law is tried in the worlds for
        validation, and so it is at the end.
      watch: called with the numbers of every update.

    Returns:
      The curve: what was found after each update (update), in the units of its attributes. Its
      attributes `compile` and `run` [s] say where the wall clock went.

    Raises:
      InputError: an argument is not allowed, or `out` holds another run.

    Example:
      >>> import rps_jax
      >>> drums = rps_jax.Lessons(
      ...     objects=("random_cylinder",), drawn=4, validation=2, engine="quasistatic"
      ... )
      >>> how = rps_jax.PPO("mlp", width=4, worlds=4, decisions=2, batches=1)
      >>> curve = rps_jax.learn("wide", "drums", how, minutes=0, updates=1, lessons=drums)
      >>> curve.success.dims, bool(curve.validation.notnull().all())
      (('update',), True)
    """
    several = [domain] if isinstance(domain, Domain | str) else list(domain)
    lessons = replace(lessons, domains=tuple(domains.named(one) for one in several))
    errors.check_finite("every", every, above=0, at_most=1e4)
    began = time.perf_counter()
    folder = open_run(Path(out), how, lessons, minutes, updates)
    with run_folder.hold(folder):
        provenance.sign(folder)
        run = _Run(folder, how, lessons, began)
        return run.through(60 * minutes, updates, 60 * every, watch)


def open_run(folder: Path, how: PPO, lessons: Lessons, minutes: float, updates: int) -> Path:
    """The folder of a run; one that holds a run must hold this one, but for its length.

    Raises:
      InputError: it cannot be written, holds another run, or nothing can be learned in this way.
    """
    errors.check_finite("minutes", minutes, at_least=0, at_most=1e5)
    errors.check_count("updates", updates, at_least=0, at_most=10**9)
    if not (minutes or updates):
        raise errors.InputError("minutes = 0 is not allowed without updates: give one of them.")
    count = how.worlds * len(lessons.domains) * len(lessons.objects)
    if how.batches > count:
        raise errors.InputError(
            f"batches = {how.batches} is not allowed: there are but {count} worlds."
        )
    if how.hold < 0.999 * (period := preset(fidelity=lessons.fidelity).control_period):
        raise errors.InputError(
            f"hold = {how.hold:g} s is not allowed: an action lasts for a control step at least, "
            f"{period:g} s."
        )
    return run_folder.claim(folder, {"how": asdict(how), "lessons": _as_json(lessons)})


def _as_json(lessons: Lessons) -> dict[str, Any]:
    return json.loads(json.dumps(asdict(lessons)))


class _Best(NamedTuple):
    """The law that validated best, so far."""

    success: float = -1.0  # [1]; -1 before a validation
    actor: Weights | None = None


class _Run:
    """A learning run under way, in its folder."""

    def __init__(self, folder: Path, how: PPO, lessons: Lessons, began: float):
        self.folder, self.how, self.lessons = folder, how, lessons
        self._began, self._before = began, 0.0  # [s]
        self._envs = lessons.environments(how.seed)
        self._exams = lessons.examinations(how.seed)
        self.network = crowd.network_of(how, self._envs)
        self.curve: list[Told] = []
        self.best, self.compile, self._kept = _Best(), 0.0, 0
        begin = self._programs()
        # A copy: no two leaves may share memory, which updates write to.
        self.learner: Learner = jax.tree.map(jnp.copy, begin(self._tables(self._envs)))
        self._restore()

    def _programs(self) -> Any:
        """Compile all programs side by side; returns the one that begins."""
        began, envs = time.perf_counter(), self._envs
        tables, theirs = self._tables(envs), self._tables(self._exams)
        begin = partial(crowd.begin, self.how, self.network, envs)
        update = partial(crowd.update, self.how, self.network, envs)
        examine = partial(crowd.examine, self.network, self._exams)
        learner = jax.eval_shape(begin, tables)
        with ThreadPoolExecutor(3) as pool:
            waiting = [
                pool.submit(lambda f, *shapes: f.lower(*shapes).compile(), *each)
                for each in (
                    (jax.jit(update, donate_argnums=1), tables, learner),
                    (jax.jit(examine), theirs, learner.student.smoothed),
                    (jax.jit(begin), tables),
                )
            ]
            self._update, self._examine, begin = (one.result() for one in waiting)
        self.compile += time.perf_counter() - began
        return begin

    @staticmethod
    def _tables(envs: Sequence[PushEnv]) -> list[World]:
        return [env.table for env in envs]

    @property
    def spent(self) -> float:
        """Wall clock [s] of this process and of those before it."""
        return self._before + time.perf_counter() - self._began

    def through(self, seconds: float, updates: int, every: float, watch: Watch) -> xr.Dataset:
        """Learn until the time is spent, or the updates are made."""
        reserve = 0.0  # [s] for the last validation
        kept = judged = self.spent
        tables = self._tables(self._envs)

        def over() -> bool:
            late = seconds and self.spent + reserve >= seconds
            return bool(late or (updates and len(self.curve) >= updates))

        while not over():
            self.learner, told = self._update(tables, self.learner)
            watch(self._note({name: float(x) for name, x in jax.device_get(told).items()}))
            if self.spent - kept > every and not over():
                if self.spent - judged > _SPARE * reserve:
                    reserve, judged = self._validate(), self.spent
                self.keep()
                kept = self.spent
        if self.curve and np.isnan(self.curve[-1]["validation"]):
            self._validate()
        self.keep()
        return self.finish()

    def _note(self, told: Told) -> Told:
        """Add an update to the curve."""
        ended = max(told["ended"], 1.0)
        before = self.curve[-1]["simulated"] if self.curve else 0.0
        worlds = self.how.worlds * len(self._envs)
        told["success"] = told.pop("won") / ended if told["ended"] else float("nan")
        told["earned"] = told["earned"] / ended if told["ended"] else float("nan")
        told["simulated"] = before + worlds * self.how.decisions * self.how.hold
        told["time"] = self.spent
        told["validation"] = told["validation_time"] = float("nan")
        self.curve.append({name: told[name] for name in UNITS})
        return self.curve[-1]

    def _validate(self) -> float:
        """Try the law; returns how long that took [s]."""
        began = time.perf_counter()
        actor = self.learner.student.smoothed
        success, took = jax.device_get(self._examine(self._tables(self._exams), actor))
        self.curve[-1]["validation"] = rate = float(np.mean(success))
        if success.any():
            self.curve[-1]["validation_time"] = float(np.mean(took[success]))
        if rate >= self.best.success:
            self.best = _Best(rate, jax.device_get(actor))
        return time.perf_counter() - began

    # --- what is kept ---

    def policy(self) -> Policy:
        """The law that validated best, or the latest before any did."""
        made = provenance.environment()
        how = {
            "success_in_validation": self.best.success if self.best.actor else None,
            "updates": len(self.curve),
            "simulated": self.curve[-1]["simulated"] if self.curve else 0.0,
            "seconds": round(self.spent, 1),
            "how": asdict(self.how),
            **{name: made[name] for name in ("command", "commit", "device", "packages")},
        }
        actor = self.best.actor or jax.device_get(self.learner.student.smoothed)
        return Policy(self.network, actor, learned=how)

    def keep(self) -> None:
        """Write what continues the run, and the law as it is; two such files are kept in turn."""
        leaves = jax.device_get(jax.tree.leaves(self.learner))
        arrays: dict[str, Any] = {f"leaf_{i:04d}": leaf for i, leaf in enumerate(leaves)}
        for name, weight in (self.best.actor or {}).items():
            arrays[f"best_{name}"] = weight
        note = {"curve": self.curve, "spent": self.spent, "compile": self.compile}
        arrays["note"] = np.array(json.dumps(note | {"best": self.best.success}))
        content = io.BytesIO()
        np.savez(content, **arrays)
        self._kept += 1
        Parts(self.folder).put(f"learner-{self._kept % 2}", content.getvalue(), ".npz")
        files.write_bytes(self.folder / "policy.npz", policies.encoded(self.policy()))

    def _restore(self) -> None:
        """Take up what was kept last, if it is sound."""
        found = []
        for name, content in Parts(self.folder).contents().items():
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
            note = json.loads(str(arrays.pop("note")))
            found.append((len(note["curve"]), note["spent"], name, note, arrays))
        if not found:
            return
        *_, name, note, arrays = max(found, key=lambda one: one[:2])
        best = {k.removeprefix("best_"): v for k, v in arrays.items() if k.startswith("best_")}
        leaves = [arrays[key] for key in sorted(arrays) if key.startswith("leaf_")]
        like = jax.tree.leaves(self.learner)
        if [(x.shape, x.dtype) for x in leaves] != [(x.shape, x.dtype) for x in like]:
            raise errors.InputError(
                f"run = {self.folder} cannot be continued: another version made it; choose "
                "another folder."
            )
        own = [jax.device_put(leaf) for leaf in leaves]
        self.learner = jax.tree.unflatten(jax.tree.structure(self.learner), own)
        self.curve, self._before = note["curve"], note["spent"]
        self.compile += note["compile"]
        self.best, self._kept = _Best(note["best"], best or None), int(name[-1])

    def finish(self) -> xr.Dataset:
        """The curve, which is also written, with its figure."""
        variables = {
            name: (
                "update",
                [told[name] for told in self.curve],
                {"units": unit, "long_name": words},
            )
            for name, (unit, words) in UNITS.items()
        }
        took = {"compile": self.compile, "run": self.spent - self.compile}
        curve = xr.Dataset(variables, {"update": np.arange(len(self.curve)) + 1}, took)
        files.write_results(self.folder / "curve.nc", curve)
        figures.learning_curve(curve, self.folder / "curve.png")
        return curve
