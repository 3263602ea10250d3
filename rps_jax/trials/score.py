"""Scores of trials: objective of tuners, severity of failures, and costs of plans.

All three use the distance by which a trial missed its target (`missed`).

Tuners minimise the `Objective`.

`severity` ranks failures in searches. It is below 1 for a success and at least 1 for a failure:

  success   the greatest of time / horizon, time without contact / what the rules allow of it, and
            the tilt of the object between 2 mrad, which is every push's, and a fall, in logarithms
  failure   1 + the least distance of the contact point to the target [m]; never touched: the whole

A slow push that nearly loses contact, or lifts a foot of the object, is close to failing, and a
failure that missed by more is farther from succeeding. Severity minus 1 is the margin of failure.

The planner of `rps ceiling` minimises `plan_costs`.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.analysis import statistics
from rps_jax.geometry.arrays import Array, Number
from rps_jax.record.files import JsonObject
from rps_jax.record.options import check_fields, option
from rps_jax.trials.trial import Outcome, Rules

_STILL = 0.002  # [rad] tilt without meaning: half of all pushes tilt their object by more


@dataclass(frozen=True)
class Objective:
    """Objective of tuners: the score of a trial, and its mean over worlds.

    A success scores its time; a failure scores one more, and the distance by which it missed the
    target. Both score the time without contact.
    """

    time: float = option(0.1, at_least=0)
    """[1] Score of a trial that takes the whole horizon."""
    lost: float = option(0.1, at_least=0)
    """[1] Score of as much time without contact as the rules allow."""
    miss: float = option(0.5, at_least=0)
    """[1/m] Score of each metre by which a failure missed, up to one metre."""

    def __post_init__(self) -> None:
        check_fields(self)

    def score(
        self,
        success: Number,  # (...) [1] 0 or 1, or between for a softened trial
        time: Number,  # (...) [s] until the trial's end
        lost: Number,  # (...) [s] without contact
        missed: Number,  # (...) [m] least distance to the target
        rules: Rules,
    ) -> Number:
        """Return scores (...) [1] of trials, from about 0 to 2; lower is better."""
        failed = 1 + self.miss * jnp.minimum(missed, 1.0)
        duration = self.time * time / rules.horizon
        contact_loss = self.lost * lost / max(float(rules.max_lost), 1e-6)
        return duration + contact_loss + (1 - success) * failed

    def scores(self, outcome: Outcome, distance: np.ndarray, rules: Rules) -> np.ndarray:
        """Return scores (...) [1] of outcomes (...) on the host.

        A trial without contact missed by the `distance` (...) [m] of the target from the start.
        """
        fields = (outcome.success, outcome.time, outcome.contact_lost_time)
        success, time, lost = (np.asarray(leaf, float) for leaf in fields)
        missed = statistics.miss_distance(outcome.min_distance, distance)
        return np.asarray(self.score(success, time, lost, missed, rules), float)

    def value(self, scores: ArrayLike) -> Array:
        """Return the mean (...) of scores (..., W) over their worlds."""
        return jnp.mean(jnp.asarray(scores), axis=-1)

    def to_json(self) -> JsonObject:
        """Return the fields, with those of version 0.4, so that its runs are continued."""
        return {"risk": "mean", "tail": 0.1} | asdict(self)


def severity(
    trials: Mapping[str, ArrayLike] | xr.Dataset, missed: ArrayLike, rules: Rules
) -> np.ndarray:
    """Return the severity (...) [1] of trials: below 1 for a success, else at least 1.

    `trials` has variables of outcomes (...) by name; `missed` (...) [m] is the distance by which
    each missed the target.
    """
    names = ("success", "time", "contact_lost_time", "tilt")
    success, time, lost, tilt = (np.asarray(trials[name], float) for name in names)
    slow = np.maximum(time / rules.horizon, lost / max(float(rules.max_lost), 1e-6))
    lean = np.log(np.maximum(tilt, _STILL) / _STILL)
    lean /= np.log(max(float(rules.max_tilt) / _STILL, 2.0))
    succeeded = np.minimum(np.maximum(slow, lean), np.nextafter(1, 0))
    return np.where(success > 0, succeeded, 1 + np.asarray(missed, float))


def severity_of(results: xr.Dataset, rules: Rules) -> np.ndarray:
    """Return the severity (..., world) of the outcomes of a sweep."""
    return severity(results, statistics.distance_left(results), rules)


def plan_costs(outcome: Outcome, rules: Rules) -> np.ndarray:
    """Return the costs S (n,) [1] of trials: below 1 for a success, which costs its time.

    The unit of time is the horizon. A failure costs 1, the least distance of the contact point to
    the target [m] (5 m if nothing was touched), a tenth of the final distance between base and
    object [m], and if the object fell over the share of the horizon that was left.
    """
    time = np.asarray(outcome.time, float) / float(rules.horizon)
    gap = np.asarray(outcome.object_pose, float)[:, :2] - np.asarray(outcome.base_pose)[:, :2]
    gap = np.minimum(np.nan_to_num(np.linalg.norm(gap, axis=1), nan=5.0), 5.0)
    ended_early = np.asarray(outcome.tipped) | np.asarray(outcome.diverged)
    missed = np.minimum(statistics.miss_distance(outcome.min_distance, 5.0), 5.0)
    failed = 1 + missed + 0.1 * gap + ended_early * (1 - time)
    return np.where(np.asarray(outcome.success), np.minimum(time, 1.0), failed)
