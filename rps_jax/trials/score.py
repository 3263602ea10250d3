"""What a trial came to, as one graded number: for tuning, for searching failures, for planning.

All three begin with how far a trial missed its target (`missed`).

`Objective` is what tuners minimise.

`severity`, by which failures are searched, is below 1 for a success and at least 1 for a failure:

  success   the greatest of time / horizon, time without contact / what the rules allow of it, and
            the tilt of the object between 2 mrad, which is every push's, and a fall, in logarithms
  failure   1 + the least distance of the contact point to the target [m]; never touched: the whole

A slow push that nearly loses contact, or lifts a foot of the object, is close to failing, and a
failure that missed by more is farther from succeeding. Severity less 1 is the margin by which the
law failed.

`plan_costs` is what the planner of `rps ceiling` minimises.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.analysis import statistics
from rps_jax.record.options import check_fields, option
from rps_jax.trials.trial import Outcome, Rules

_STILL = 0.002  # [rad] tilt that says nothing: half of all pushes tilt their object by more


@dataclass(frozen=True)
class Objective:
    """What is minimised: the score of every trial, and the risk over worlds.

    A success scores its time, a failure scores one more and how far it missed the target; both
    score the time without contact.
    """

    risk: Literal["mean", "cvar"] = "mean"
    """The risk is the mean over all worlds, or (cvar) the mean over the worst `tail` of them."""
    tail: float = option(0.1, above=0, at_most=1)
    """[1] The share of the worlds that cvar looks at."""
    time: float = option(0.1, at_least=0)
    """[1] The score of a trial that takes the whole horizon."""
    lost: float = option(0.1, at_least=0)
    """[1] The score of as much time without contact as the rules allow."""
    miss: float = option(0.5, at_least=0)
    """[1/m] The score of each metre by which a failure missed, up to one metre."""

    def __post_init__(self) -> None:
        check_fields(self)

    def score(
        self,
        success: Any,  # (...) [1] 0 or 1, or between for a softened trial
        time: Any,  # (...) [s] until the trial's end
        lost: Any,  # (...) [s] without contact
        missed: Any,  # (...) [m] least distance to the target
        rules: Rules,
    ) -> Any:
        """Scores (...) [1] of trials, from about 0 to 2; less is better."""
        failed = 1 + self.miss * jnp.minimum(missed, 1.0)
        return (
            self.time * time / rules.horizon
            + self.lost * lost / max(float(rules.max_lost), 1e-6)
            + (1 - success) * failed
        )

    def scores(self, outcome: Outcome, distance: np.ndarray, rules: Rules) -> np.ndarray:
        """Scores (...) [1] of outcomes (...) on the host.

        A trial without contact missed by the `distance` (...) [m] of the target from the start.
        """
        told = (outcome.success, outcome.time, outcome.contact_lost_time)
        success, time, lost = (np.asarray(leaf, float) for leaf in told)
        away = statistics.miss_distance(outcome.min_distance, distance)
        return np.asarray(self.score(success, time, lost, away, rules), float)

    def value(self, scores: ArrayLike) -> jax.Array:
        """The risk (...) of scores (..., W) over their worlds."""
        scores = jnp.asarray(scores)
        if self.risk == "mean":
            return jnp.mean(scores, axis=-1)
        worst = max(1, round(self.tail * scores.shape[-1]))
        return jnp.mean(jnp.sort(scores, axis=-1)[..., -worst:], axis=-1)


def severity(
    success: Any,  # (...) [1] 0 or 1
    took: Any,  # (...) [s] until the trial's end
    left: Any,  # (...) [m] by which it `missed`
    lost: Any,  # (...) [s] without contact
    tilt: Any,  # (...) [rad] greatest tilt of the object
    rules: Rules,
) -> np.ndarray:
    """Severity (...) [1] of trials: below 1 for a success, 1 and more for a failure."""
    took, lost = np.asarray(took, float), np.asarray(lost, float)
    slow = np.maximum(took / rules.horizon, lost / max(float(rules.max_lost), 1e-6))
    leant = np.log(np.maximum(np.asarray(tilt, float), _STILL) / _STILL)
    leant /= np.log(max(float(rules.max_tilt) / _STILL, 2.0))
    won = np.minimum(np.maximum(slow, leant), np.nextafter(1, 0))
    return np.where(np.asarray(success) > 0, won, 1 + np.asarray(left, float))


def severity_of(results: xr.Dataset, rules: Rules) -> np.ndarray:
    """Severity (..., world) of a sweep's outcomes."""
    left = statistics.miss_distance(results.min_distance.values, results.distance.values)
    lost = results.contact_lost_time.values
    told = results.success.values, results.time.values, left, lost, results.tilt.values
    return severity(*told, rules)


def plan_costs(outcome: Outcome, rules: Rules) -> np.ndarray:
    """S (n,) [1] of trials: below 1 the time of a success, in horizons; above, how far it failed.

    A failure costs 1, the least distance of the contact point to the target [m], 5 m if nothing
    was touched, a tenth of the distance that is left between base and object [m], and if the object
    fell over as much of the horizon as it fell early.
    """
    time = np.asarray(outcome.time, float) / float(rules.horizon)
    apart = np.asarray(outcome.object_pose, float)[:, :2] - np.asarray(outcome.base_pose)[:, :2]
    apart = np.minimum(np.nan_to_num(np.linalg.norm(apart, axis=1), nan=5.0), 5.0)
    ended = np.asarray(outcome.tipped) | np.asarray(outcome.diverged)
    missed = np.minimum(statistics.miss_distance(outcome.min_distance, 5.0), 5.0)
    failed = 1 + missed + 0.1 * apart + ended * (1 - time)
    return np.where(np.asarray(outcome.success), np.minimum(time, 1.0), failed)
