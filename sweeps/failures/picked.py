"""Selection of the 200 worlds of `rps regress` from points and the outcomes of laws."""

from __future__ import annotations

import numpy as np
import xarray as xr

from rps_jax.trials.score import severity_of
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import Domain


def select(
    domain: Domain, u: np.ndarray, severity: np.ndarray, count: int, first: np.ndarray
) -> np.ndarray:
    """Select diverse worlds by farthest-point sampling; return indices (count,).

    All of `first` are selected; then, repeatedly, the world farthest from the selected ones. The
    distance is that of the coordinates of ranges, and of the severities of laws up to 2.

    Args:
      domain: domain of the points.
      u: points (n, q).
      severity: (laws, n) of each law.
      count: number of worlds.
      first: indices that are always selected.
    """
    kinds = np.array([coordinate.kind for coordinate in points.coordinates(domain)])
    features = np.concatenate(
        [u[:, (kinds == "range") | (kinds == "choice")], 2 * np.minimum(severity, 2).T], axis=1
    )
    selected = list(map(int, first[:count])) or [int(severity.max(axis=0).argmax())]
    near = np.min([np.linalg.norm(features - features[i], axis=1) for i in selected], axis=0)
    while len(selected) < min(count, len(u)):
        far = int(np.where(np.isin(np.arange(len(u)), selected), -1, near).argmax())
        selected.append(far)
        near = np.minimum(near, np.linalg.norm(features - features[far], axis=1))
    return np.array(selected)


def build_dataset(
    domain: Domain, u: np.ndarray, results: xr.Dataset, laws: list[str], rules: Rules = Rules()
) -> xr.Dataset:
    """Return the dataset of the file, from points and their outcomes (law, world)."""
    severity = np.stack([severity_of(results.sel(law=law), rules) for law in laws])
    success = np.stack([results.success.sel(law=law).values for law in laws]).astype(np.int8)
    return (
        points.worlds_at(domain, u)[["u"]]
        .assign(success=(("known", "world"), success), severity=(("known", "world"), severity))
        .assign_coords(known=laws)
    )
