"""What is wanted of a trial, as one graded number, and of many trials, as their risk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.trials.trial import Outcome, Rules

Risk = Literal["mean", "cvar"]


@dataclass(frozen=True)
class Objective:
    """What is minimised: the score of every trial, and the risk over worlds.

    A success scores its time, a failure scores one more and how far it missed the target; both
    score the time without contact.
    """

    risk: Risk = "mean"
    """The risk is the mean over all worlds, or (cvar) the mean over the worst `tail` of them."""
    tail: float = 0.1
    """[1] The share of the worlds that cvar looks at."""
    time: float = 0.1
    """[1] The score of a trial that takes the whole horizon."""
    lost: float = 0.1
    """[1] The score of as much time without contact as the rules allow."""
    miss: float = 0.5
    """[1/m] The score of each metre by which a failure missed, up to one metre."""

    def __post_init__(self) -> None:
        """Raises InputError for weights or a risk that mean nothing."""
        errors.check_name("risk", self.risk, get_args(Risk))
        errors.check_finite("tail", self.tail, above=0, at_most=1)
        for name in ("time", "lost", "miss"):
            errors.check_finite(name, getattr(self, name), at_least=0)

    def score(self, success: Any, time: Any, lost: Any, missed: Any, rules: Rules) -> Any:
        """Scores (...) [1] of trials, from about 0 to 2; less is better.

        Args:
          success: (...) [1] 0 or 1, or between for a softened trial.
          time: (...) [s] until the trial's end.
          lost: (...) [s] without contact.
          missed: (...) [m] least distance to the target.
          rules: when a trial ends.
        """
        failed = 1 + self.miss * jnp.minimum(missed, 1.0)
        return (
            self.time * time / rules.horizon
            + self.lost * lost / max(float(rules.max_lost), 1e-6)
            + (1 - success) * failed
        )

    def scores(self, outcome: Outcome, distance: np.ndarray, rules: Rules) -> np.ndarray:
        """Scores (...) [1] of outcomes on the host; a trial without contact missed by `distance`.

        Args:
          outcome: how the trials ended, leaves (...).
          distance: (...) [m] of the target from the start.
          rules: when a trial ends.
        """
        near = np.asarray(outcome.min_distance)
        told = (outcome.success, outcome.time, outcome.contact_lost_time)
        success, time, lost = (np.asarray(leaf, float) for leaf in told)
        missed = np.where(np.isfinite(near), near, distance)
        return np.asarray(self.score(success, time, lost, missed, rules), float)

    def value(self, scores: ArrayLike) -> jax.Array:
        """The risk (...) of scores (..., W) over their worlds."""
        scores = jnp.asarray(scores)
        if self.risk == "mean":
            return jnp.mean(scores, axis=-1)
        worst = max(1, round(self.tail * scores.shape[-1]))
        return jnp.mean(jnp.sort(scores, axis=-1)[..., -worst:], axis=-1)
