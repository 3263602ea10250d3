"""How the 200 worlds of `rps regress` were picked, from points and what laws did there."""

from __future__ import annotations

import numpy as np
import xarray as xr

from rps_jax.trials.score import severity_of
from rps_jax.trials.trial import Rules
from rps_jax.world import points
from rps_jax.world.domain import Domain


def chosen(
    domain: Domain, u: np.ndarray, severity: np.ndarray, count: int, first: np.ndarray
) -> np.ndarray:
    """Choose instructive and different worlds, as indices (count,).

    All of `first` come in; then, again and again, the world that is farthest from those that are
    in. A distance is that of the ranges' coordinates, and of the laws' severities, up to 2.

    Args:
      domain: whose points they are.
      u: points (n, q).
      severity: (laws, n) of each law.
      count: how many.
      first: indices that come in anyway.
    """
    kinds = np.array([one.kind for one in points.coordinates(domain)])
    features = np.concatenate(
        [u[:, (kinds == "range") | (kinds == "choice")], 2 * np.minimum(severity, 2).T], axis=1
    )
    taken = list(map(int, first[:count])) or [int(severity.max(axis=0).argmax())]
    near = np.min([np.linalg.norm(features - features[i], axis=1) for i in taken], axis=0)
    while len(taken) < min(count, len(u)):
        far = int(np.where(np.isin(np.arange(len(u)), taken), -1, near).argmax())
        taken.append(far)
        near = np.minimum(near, np.linalg.norm(features - features[far], axis=1))
    return np.array(taken)


def made(
    domain: Domain, u: np.ndarray, found: xr.Dataset, laws: list[str], rules: Rules = Rules()
) -> xr.Dataset:
    """Make the content of the file, from points and their outcomes (law, world)."""
    severity = np.stack([severity_of(found.sel(law=law), rules) for law in laws])
    success = np.stack([found.success.sel(law=law).values for law in laws]).astype(np.int8)
    return (
        points.worlds_at(domain, u)[["u"]]
        .assign(success=(("known", "world"), success), severity=(("known", "world"), severity))
        .assign_coords(known=laws)
    )
