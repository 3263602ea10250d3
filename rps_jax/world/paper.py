"""The paper's experiments and results, as data."""

import math
from itertools import product
from typing import NamedTuple

TARGETS = tuple(
    (float(x), float(y)) for x in (2, 1, 0, -1, -2) for y in (2, 1, 0, -1, -2) if (x, y) != (0, 0)
)  # [m] Sec. III-B: a grid of 1 m, without the robot's position

FEW_TARGETS = ((2.0, 0.0), (1.0, 1.0), (0.0, -2.0), (-2.0, 1.0))  # a subset, for quick runs

LAWS = ("rps", "nps", "aps")
SKIN = {"elliptic": "ideal", "pyramidal": "thin"}  # by the friction cone of the physics

_SUCCESSES = {  # of 24, with box, cylinder and nonuniform_box, each under S1 and S2
    "rps": (23, 24, 19, 19, 19, 23),
    "nps": (2, 5, 2, 2, 6, 6),
    "aps": (2, 2, 2, 2, 0, 0),
}
_COLUMNS = tuple(product(("box", "cylinder", "nonuniform_box"), ("S1", "S2")))
# Table II, keyed by law, object and friction set.
TABLE_II: dict[tuple[str, str, str], int] = {
    (law, *column): successes
    for law, row in _SUCCESSES.items()
    for column, successes in zip(_COLUMNS, row, strict=True)
}

# Sec. III-C, on the robot itself.
HARDWARE_OBJECTS = ("hardware_box", "hardware_cylinder")
_REACH = 2.1  # [m]
_ANGLES = [k * math.pi / 4 for k in range(8)]
HARDWARE_LAYOUTS = {
    "circle": tuple((_REACH * math.cos(a), _REACH * math.sin(a)) for a in _ANGLES),
    "grid": tuple((x, y) for x, y in product((_REACH, 0, -_REACH), repeat=2) if x or y),
}  # both are readings of the paper's "8 different target points at 2.1 m intervals apart"
HARDWARE_GROUND = (0.2, 0.35, 0.5, 0.65)  # [1] object-ground
# [1] object-robot: polyurethane foam coated with ink. The box's results tell that its friction is
# above 0.6 (`sweeps/paper_reading`: 5 to 95 % of the posterior); the cylinder's tell nothing.
HARDWARE_ROBOT = (0.6, 0.9, 1.2)


class HardwareResult(NamedTuple):
    """Results that the paper reports for one object, over eight targets."""

    success: int
    mean_abs_l: float  # [m] D
    time: float  # [s]


HARDWARE_RESULTS = {
    "hardware_box": HardwareResult(8, 0.032, 89.0),
    "hardware_cylinder": HardwareResult(8, 0.059, 88.0),
}
