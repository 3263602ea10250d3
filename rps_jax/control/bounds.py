"""Within which bounds a law's parameters are tuned."""

from __future__ import annotations

from typing import NamedTuple


class Bound(NamedTuple):
    """The interval in which a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # evenly in its logarithm
    of: str = ""  # as a share of this other parameter
