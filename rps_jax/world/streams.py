"""Random numbers of worlds: one stream for each name, addressed by (seed, name, index).

The number of a name in world i depends on the seed, the name and i alone: a name that is added
changes no other number. Bits come from Philox, a counter-based generator, keyed by the seed and a
hash of the name. Names of version 0.4 and earlier have columns of one table instead, which is
frozen, so that published worlds stay as they are.
"""

from hashlib import blake2b

import numpy as np

from rps_jax import errors
from rps_jax.record.files import Arrays

_COUNT = 64  # columns of the frozen table
_TABLE = """
mass size aspect height com_offset com_bearing friction_ground friction_robot
lateral yaw gap distance bearing noise gain_spread dead_share
pose_noise yaw_noise pose_latency command_delay v_x_error v_y_error omega_error
key_0 key_1 sides turn
corner_0 corner_1 corner_2 corner_3 corner_4 corner_5 corner_6 corner_7
robot_force robot_traction robot_lag robot_acceleration boundary
foam time_constant robot_slip feet feet_number feet_turn load_size
robot_slip_sideways robot_slip_yaw lookahead length turns
turn_angle_0 turn_angle_1 turn_angle_2 turn_angle_3 turn_angle_4 turn_angle_5 turn_angle_6
width door_width slope slope_bearing boundary_factor
"""
_COLUMNS = _TABLE.split()
# Tasks share columns: a world has one task.
_SHARED = {"route": "turn_angle_6", "scale": "width"}
_INDICES = {x: _COLUMNS.index(_SHARED.get(x, x)) for x in (*_COLUMNS, *_SHARED)}
# Columns of the frozen table by name, in their order.
COLUMNS: dict[str, int] = dict(sorted(_INDICES.items(), key=lambda item: item[1]))
_OWNERS: dict[str, str] = {}  # of all names that worlds use, in words


def claim(owner: str, *names: str) -> None:
    """Reserve names of random numbers, or of columns of results, for one owner.

    Raises:
      InputError: another owner has a name.
    """
    for name in names:
        if not name.isidentifier():
            raise errors.not_allowed(f"name of {owner}", repr(name), "write a name of Python")
        if (known := _OWNERS.get(name, owner)) != owner:
            rule = f"{known} has this name; choose another one"
            raise errors.not_allowed(f"name of {owner}", name, rule)
    _OWNERS.update(dict.fromkeys(names, owner))


def key_of(seed: int, name: str) -> int:
    """Return the key of Philox for a name: the seed below, a hash of the name above."""
    return int(seed) + (int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big") << 64)


def stream(seed: int, name: str, index: np.ndarray) -> np.ndarray:
    """Return the numbers (n,) in [0, 1) of a name in the worlds `index` (n,)."""
    if name in COLUMNS:
        return random_numbers(seed, index)[:, COLUMNS[name]]
    return _rows(key_of(seed, name), index, 4)[:, 0]


def random_numbers(seed: int, index: np.ndarray) -> np.ndarray:
    """Return the frozen table (n, 64) in [0, 1) of the worlds `index` (n,): see `COLUMNS`."""
    return _rows(seed, index, _COUNT)


def _rows(key: int, index: np.ndarray, count: int) -> np.ndarray:
    """Return `count` numbers, a multiple of four, for each of the worlds `index` (n,)."""
    rows = np.empty((index.size, count))
    order = np.argsort(index)
    far = np.flatnonzero(np.diff(index[order]) > 100) + 1
    for near in np.split(order, far):
        first, last = int(index[near[0]]), int(index[near[-1]])
        # Philox counts in steps of four numbers.
        bits = np.random.Philox(key=key).advance(first * count // 4)
        block = np.random.Generator(bits).random((last - first + 1, count))
        rows[near] = block[index[near] - first]
    return rows


def numbers(seed: int, index: np.ndarray, names: tuple[str, ...]) -> Arrays:
    """Return the numbers (n,) in [0, 1) of some names in the worlds `index` (n,)."""
    table = random_numbers(seed, index)
    return {x: table[:, COLUMNS[x]] if x in COLUMNS else stream(seed, x, index) for x in names}
