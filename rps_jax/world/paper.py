"""What the paper ran and what it reports, as data."""

from __future__ import annotations

import math
from typing import NamedTuple

from rps_jax.control.strategies import PAPER as PARAMS

TARGETS = tuple(
    (float(x), float(y)) for x in (2, 1, 0, -1, -2) for y in (2, 1, 0, -1, -2) if (x, y) != (0, 0)
)  # [m] Sec. III-B: a grid of 1 m, without the robot's place

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

# Sec. III-C, on the robot itself.
HARDWARE_OBJECTS = ("hardware_box", "hardware_cylinder")
_REACH = 2.1  # [m]
HARDWARE_LAYOUTS = {
    "circle": tuple(
        (_REACH * math.cos(k * math.pi / 4), _REACH * math.sin(k * math.pi / 4)) for k in range(8)
    ),
    "grid": tuple(
        (x, y) for x in (_REACH, 0, -_REACH) for y in (_REACH, 0, -_REACH) if (x, y) != (0, 0)
    ),
}  # the paper's "8 different target points at 2.1 m intervals apart" may be read either way
HARDWARE_GROUND = (0.2, 0.35, 0.5, 0.65)  # [1] object-ground
HARDWARE_ROBOT = (0.3, 0.5, 0.7)  # [1] object-robot: polyurethane foam coated with ink


class HardwareResult(NamedTuple):
    """What the paper reports of one object, over eight targets."""

    success: int
    mean_abs_l: float  # [m] D
    time: float  # [s]


HARDWARE_RESULTS = {
    "hardware_box": HardwareResult(8, 0.032, 89.0),
    "hardware_cylinder": HardwareResult(8, 0.059, 88.0),
}
