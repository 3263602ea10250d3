"""What the paper ran and what it reports, as data."""

from __future__ import annotations

from rps_jax.control.aps import APSParams
from rps_jax.control.law import RPSParams

TARGETS = tuple(
    (float(x), float(y)) for x in (2, 1, 0, -1, -2) for y in (2, 1, 0, -1, -2) if (x, y) != (0, 0)
)  # [m] Sec. III-B: a grid of 1 m, without the robot's place

PARAMS = {"rps": RPSParams.paper(), "nps": RPSParams.nps(), "aps": APSParams()}
STRATEGIES = tuple(PARAMS)
SKIN = {"default": "ideal", "paper_gazebo": "thin"}  # that goes with each physics

# Table II: successes of 24, keyed by strategy, object and friction set.
TABLE_II = {
    ("rps", "box", "S1"): 23,
    ("rps", "box", "S2"): 24,
    ("rps", "cylinder", "S1"): 19,
    ("rps", "cylinder", "S2"): 19,
    ("rps", "nonuniform_box", "S1"): 19,
    ("rps", "nonuniform_box", "S2"): 23,
    ("nps", "box", "S1"): 2,
    ("nps", "box", "S2"): 5,
    ("nps", "cylinder", "S1"): 2,
    ("nps", "cylinder", "S2"): 2,
    ("nps", "nonuniform_box", "S1"): 6,
    ("nps", "nonuniform_box", "S2"): 6,
    ("aps", "box", "S1"): 2,
    ("aps", "box", "S2"): 2,
    ("aps", "cylinder", "S1"): 2,
    ("aps", "cylinder", "S2"): 2,
    ("aps", "nonuniform_box", "S1"): 0,
    ("aps", "nonuniform_box", "S2"): 0,
}
