"""One law at points of a domain's unit cube, again and again, through the same programs.

The severity of a trial is one number that is below 1 for a success and at least 1 for a failure:

  success   the greatest of time / horizon, time without contact / what the rules allow of it, and
            the tilt of the object between 2 mrad, which is every push's, and a fall, in logarithms
  failure   1 + the least distance of the contact point to the target [m]; never touched: the whole

A slow push that nearly loses contact, or lifts a foot of the object, is close to failing, and a
failure that missed by more is farther from succeeding. Severity less 1 is the margin by which the
law failed.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import engines
from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.errors import InputError
from rps_jax.record.checkpoint import Parts
from rps_jax.trials import batch
from rps_jax.trials.batch import Job, Part
from rps_jax.trials.setting import InTurn, Report, Setting, unheard
from rps_jax.trials.trial import Outcome, Rules
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import points
from rps_jax.world.domain import Domain
from rps_jax.world.points import Points

_SLOTS = 64  # of a program, at least
_KEPT = ("success", "time", "min_distance", "contact_lost_time", "tilt")
_STILL = 0.002  # [rad] tilt that says nothing: half of all pushes tilt their object by more


def severity(success: Any, took: Any, left: Any, lost: Any, tilt: Any, rules: Rules) -> np.ndarray:
    """Severity (...) [1] of trials: below 1 for a success, 1 and more for a failure.

    Args:
      success: (...) [1] 0 or 1.
      took: (...) [s] until the trial's end.
      left: (...) [m] least distance to the target; of an object never touched, the whole way.
      lost: (...) [s] without contact.
      tilt: (...) [rad] greatest tilt of the object.
      rules: when a trial ends.
    """
    took, lost = np.asarray(took, float), np.asarray(lost, float)
    slow = np.maximum(took / rules.horizon, lost / max(float(rules.max_lost), 1e-6))
    leant = np.log(np.maximum(np.asarray(tilt, float), _STILL) / _STILL)
    leant /= np.log(max(float(rules.max_tilt) / _STILL, 2.0))
    won = np.minimum(np.maximum(slow, leant), np.nextafter(1, 0))
    return np.where(np.asarray(success) > 0, won, 1 + np.asarray(left, float))


def severity_of(results: xr.Dataset, rules: Rules) -> np.ndarray:
    """Severity (..., world) of a sweep's outcomes."""
    near = results.min_distance.values
    left = np.where(np.isfinite(near), near, results.distance.values)
    lost = results.contact_lost_time.values
    told = results.success.values, results.time.values, left, lost, results.tilt.values
    return severity(*told, rules)


def need(module: str, package: str) -> ModuleType:
    """A module of the optional packages.

    Raises:
      InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"package {package} is missing: pip install 'rps_jax[failures]'."
        ) from error


@dataclass
class Probe:
    """Tries one law at points, and keeps what came of each call in a run folder, if it has one.

    Each shape family has a program of 64 slots, one of 256 and so on, for any number of points.
    Whoever asks for the same points in the same order after being killed is answered from the
    folder: a search then goes on as if it had never been stopped.
    """

    domain: Domain
    params: Params
    setting: Setting = Setting(engine="fused")
    folder: Path | None = None
    slots: int | None = None
    workers: int | None = None
    report: Report = unheard
    calls: int = 0
    trials: int = 0  # of all calls, those answered from the folder too
    simulated: float = 0.0  # [s] of all these trials
    _heard: InTurn = field(init=False)

    def __post_init__(self) -> None:
        """Raises InputError unless the engine can step these worlds with this law."""
        strategies.of(self.params).check(self.params)
        engine = engines.get(self.setting.engine)
        engine.check(self.domain.families)
        engine.check_robot(self.domain.weakest)
        batch.check_shape(self.slots, self.workers)
        self._heard = InTurn(self.report)

    def configuration(self) -> dict[str, Any]:
        """What the answers depend on, as JSON."""
        return {
            "domain": asdict(self.domain),
            "law": strategies.recorded(self.params),
            "physics": asdict(self.setting.physics),
            "rules": strategies.as_json(self.setting.rules),
            "engine": self.setting.engine,
        }

    def __call__(self, u: np.ndarray) -> xr.Dataset:
        """Outcomes and `severity` (world) at points `u` (n, q).

        Raises:
          InputError: the folder holds an answer for other points.
        """
        at, name = points.checked(self.domain, u), f"{self.calls:06d}"
        found = None
        if self.folder is not None:
            found = Parts(self.folder).results(name, lambda: self._try(at))
            if not np.array_equal(found.u.values, at.u):
                raise InputError(
                    f"run = {self.folder} was searched otherwise from step {self.calls} on: use "
                    "the version and the device that made it, or choose another folder."
                )
        else:
            found = self._try(at)
        self.calls += 1
        self.trials += len(at.u)
        self.simulated += float(found.time.sum())
        self._heard.ended(len(at.u))
        return found

    def _try(self, at: Points) -> xr.Dataset:
        which = self.domain.object_of(at.cases(self.domain, np.arange(len(at.u))))
        away, found = np.empty(len(at.u)), {name: np.empty(len(at.u)) for name in _KEPT}
        jobs = [self._job(at, np.flatnonzero(which == one), away) for one in np.unique(which)]

        def collect(numbers: np.ndarray, outcome: Outcome) -> None:
            for name, values in found.items():
                values[numbers] = getattr(outcome, name)

        shape = {"slots": self.slots, "workers": self.workers, "report": self._heard}
        began = time.perf_counter()
        batch.run(jobs, self.setting, collect=collect, **shape)
        near = found.pop("min_distance")
        found["left"] = np.where(np.isfinite(near), near, away)
        told = [found[name] for name in ("success", "time", "left", "contact_lost_time", "tilt")]
        found["severity"] = severity(*told, rules=self.setting.rules)
        columns = {name: ("world", values) for name, values in found.items()}
        wall = time.perf_counter() - began
        return xr.Dataset({"u": (("world", "quantity"), at.u), **columns}, attrs={"wall": wall})

    def _job(self, at: Points, rows: np.ndarray, away: np.ndarray) -> Job:
        """Points of one object; `away` takes the targets' distances from the start."""
        drawn = at.draw(self.domain, rows)
        away[rows] = np.linalg.norm(drawn.p_world_target, axis=1)

        def made() -> Iterator[Part]:
            yield drawn_worlds(self.domain, drawn, self.params, self.setting)

        # Few different sizes, since each is a program of its own: powers of four.
        size = _SLOTS
        while size < rows.size:
            size *= 4
        return Job(strategies.of(self.params), size, made())
