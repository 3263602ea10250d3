"""Worlds as points of the unit cube: each drawn quantity of a domain is one coordinate.

A drawn world is addressed by (domain, seed, index). The same world is the point `u` of its random
numbers in [0, 1), of which a domain reads only some. A search for worlds moves such points.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry.solid import SIDES
from rps_jax.record import files
from rps_jax.record.files import Arrays
from rps_jax.robot.robot import Robot
from rps_jax.world import draws
from rps_jax.world.domain import (
    LABELS,
    QUANTITIES,
    RANDOM,
    VELOCITY_ERRORS,
    Domain,
    Range,
    from_json,
    number_names,
    parse_domain,
    to_json,
    unit_of,
)
from rps_jax.world.draws import Draw
from rps_jax.world.tasks import UNRANGED, TaskLike

CoordinateKind = Literal["range", "choice", "shape", "path", "noise"]
FILE = "points.nc"  # in a run folder whose worlds are points
_CHOICES = ("object", "friction", "target")  # from the lists of a domain
_OF_PRISMS = ("sides", "turn", *(f"corner_{i}" for i in range(SIDES)))
_OF_FEET = ("feet_number", "feet_turn")
_MAX_POINTS = 100_000_000


class Coordinate(NamedTuple):
    """Coordinate of the cube."""

    name: str
    # A range; a choice of a list; corners or feet; turns of a path; the key of all noise.
    kind: CoordinateKind
    range: Range  # of the quantity, or from 0 to the length of the list
    unit: str


def coordinates(domain: Domain) -> tuple[Coordinate, ...]:
    """Return the q coordinates of a domain: lists first, then drawn quantities, shapes and noise.

    Unused ranges and ranges of a single value are no coordinates.
    """
    lists = zip(_CHOICES, domain.counts, strict=True)
    labels = [Coordinate(name, "choice", Range(0, n), "1") for name, n in lists if n > 1]
    random = set(domain.objects) & set(RANDOM)
    idle = set(domain.idle) | ({"aspect"} if random == {"random_cylinder"} else set())
    if not random or domain.com_offset.high == 0:
        idle |= {"com_bearing", "load_size"}
    for name in number_names():
        if name in idle:
            continue
        if name in UNRANGED:
            if name in domain.task.NUMBERS and name not in domain.task.idle:
                labels.append(Coordinate(name, "path", Range(0, 1), "1"))
        elif name in (*_OF_PRISMS, *_OF_FEET):
            if domain.feet is not None if name in _OF_FEET else "random_prism" in random:
                labels.append(Coordinate(name, "shape", Range(0, 1), "1"))
        elif name == "com_bearing":
            labels.append(Coordinate(name, "range", Range(0, 2 * np.pi), "rad"))
        elif name.startswith("key_"):
            labels.append(Coordinate(name, "noise", Range(0, 1), "1"))
        else:
            interval = domain.range_of("velocity_error" if name in VELOCITY_ERRORS else name)
            if interval is not None and interval.low < interval.high:
                labels.append(Coordinate(name, "range", interval, unit_of(name)))
    return tuple(labels)


def names(domain: Domain, *kinds: CoordinateKind) -> tuple[str, ...]:
    """Return the names of a domain's coordinates, of some kinds or of all, in their order."""
    return tuple(item.name for item in coordinates(domain) if not kinds or item.kind in kinds)


def check_drawn(name: str, domain: Domain) -> str:
    """Return a name if the domain draws this quantity from a range, or raise InputError."""
    drawn = names(domain, "range")
    known = (*QUANTITIES, *VELOCITY_ERRORS, "com_bearing")
    if name in known and name not in drawn:
        rule = f"this domain does not draw it; it draws {', '.join(drawn)}"
        raise errors.not_allowed("axes", name, rule)
    return errors.check_name("axes", name, drawn)


@dataclass(frozen=True, eq=False)
class Points:
    """Points (n, q) of the cube of a domain, in [0, 1)."""

    u: np.ndarray  # (n, q)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Points) and self.digest == other.digest

    @property
    def digest(self) -> str:
        """SHA-256 of the coordinates and their shape."""
        return files.sha256(repr(self.u.shape).encode() + np.ascontiguousarray(self.u).tobytes())

    def write(self, folder: Path, domain: Domain) -> Path:
        """Write the points into a run folder."""
        return files.write_results(folder / FILE, _labelled(domain, self.u))

    @staticmethod
    def read(folder: Path, digest: str) -> Points:
        """Return the points of a run folder if they have this digest, or raise InputError."""
        path, dims = folder / FILE, {"u": ("world", "quantity")}
        if not path.exists():
            raise InputError(f"run = {folder} lacks its {FILE}: run the same command again.")
        points = Points(files.check_columns(files.read_dataset(path), path, dims, {}).u.values)
        if points.digest != digest:
            raise files.CorruptFileError(path, "its points are not those of the run")
        return points


def check_points(domain: Domain, u: object) -> Points:
    """Return the points of an array (n, q) or of a dataset of `worlds_at`; or InputError."""
    expected = names(domain)
    if isinstance(u, xr.Dataset):
        if "u" not in u or "quantity" not in u.coords:
            raise InputError("points are not allowed: the dataset has no u (world, quantity).")
        theirs = tuple(map(str, u.quantity.values))
        text = u.attrs.get("domain")
        if theirs != expected or not (text is None or _is_json_of(text, domain)):
            raise InputError("points are not allowed: they are of another domain; give it.")
        u = u.u.values
    try:
        values = np.array(u, float)
    except (TypeError, ValueError) as error:
        raise errors.not_allowed("u", u, f"give an array (n, {len(expected)})") from error
    if values.ndim != 2 or values.shape[1] != len(expected) or not len(values):
        rule = f"it must be (n, {len(expected)}), with the columns {', '.join(expected)}"
        raise errors.not_allowed("shape of u", values.shape, rule)
    for row, column in np.argwhere(~((values >= 0) & (values < 1))):
        value = f"{values[row, column]} ({expected[column]})"
        raise errors.not_allowed(f"u[{row}, {column}]", value, "it must be at least 0 and below 1")
    errors.check_count("points", len(values), at_most=_MAX_POINTS)
    return Points(values)


def cases(domain: Domain, points: Points | None, index: ArrayLike) -> np.ndarray:
    """Return indices with the object, friction and target of worlds, drawn ones or points."""
    if points is None:
        return np.asarray(index)
    rows = dict(zip(names(domain), points.u[np.asarray(index)].T, strict=True))
    nothing = np.zeros(np.shape(index))
    counts = zip(_CHOICES, domain.counts, strict=True)
    choices = [np.floor(rows.get(x, nothing) * n).astype(np.int64) for x, n in counts]
    return np.asarray(np.ravel_multi_index(choices, domain.counts))


def draw(domain: Domain, seed: int, points: Points | None, index: ArrayLike) -> Draw:
    """Return the worlds `index` (n,) of one object, drawn ones or points."""
    if points is None:
        return draws.draw(domain, seed, index)
    index = np.asarray(index, np.int64)
    u = dict.fromkeys(number_names(), np.full(index.size, 0.5))
    u |= dict(zip(names(domain), points.u[index].T, strict=True))
    return draws.draw_at(domain, cases(domain, points, index), u)._replace(indices=index)


def draw_by_object(
    domain: Domain, seed: int, points: Points | None, index: np.ndarray
) -> Iterator[tuple[np.ndarray, Draw]]:
    """Yield the worlds of each object: their positions in `index` (n,), and their draw."""
    objects = domain.object_of(cases(domain, points, index))
    for chosen in np.unique(objects):
        at = np.flatnonzero(objects == chosen)
        yield at, draw(domain, seed, points, index[at])


def points_of(domain: Domain | str, index: ArrayLike, seed: int = 0) -> np.ndarray:
    """Return the points (n, q) of the unit cube of the drawn worlds `index` (n,).

    `worlds_at` returns the same worlds for them, bit for bit.
    """
    domain = parse_domain(domain)
    errors.check_count("seed", seed, at_least=0, at_most=2**63)
    index = np.atleast_1d(np.asarray(index, np.int64))
    numbers = draws.numbers(seed, index)
    positions = zip(_CHOICES, domain.choices(index), domain.counts, strict=True)
    of_lists = {name: (choice + 0.5) / count for name, choice, count in positions}
    return np.stack([(numbers | of_lists)[name] for name in names(domain)], axis=-1)


def worlds_at(
    domain: Domain | str,
    u: ArrayLike | xr.Dataset,
    *,
    robot: Robot | str | None = None,
    task: TaskLike | None = None,
) -> xr.Dataset:
    """Return the worlds at points of the unit cube, as `sweep` and `evaluate` take them.

    A quantity is `low + u (high - low)`, or `low (high / low)^u` if its range is uniform in the
    logarithm. Kinds of coordinates are `range`; `choice`, of the object, friction or target from
    the domain's lists; `shape`, of a prism's corners or of feet; `path`, of its turns; and `noise`,
    the key of the noise of a trial: worlds close to each other in it have unrelated noise.

    Args:
      domain: ranges of the quantities that differ between worlds, or their name, as wide.
      u: (n, q) in [0, 1), a row for each world, a column for each coordinate, in order.
      robot: its name, as kairos, or a JSON file; None: the domain's.
      task: its name, as path, with changes; None: the domain's.

    Returns:
      `u` (world, quantity); for each quantity its `low`, `high`, `log`, `unit` and `kind`; and
      the drawn quantities (world), as coordinates.

    Raises:
      InputError: `u` is of another domain, or outside of [0, 1).

    Examples:
      >>> import numpy as np
      >>> import rps_jax
      >>> from rps_jax.world.points import points_of, worlds_at
      >>> drums = rps_jax.Domain(("random_cylinder",))
      >>> u = points_of(drums, np.arange(4))
      >>> worlds = worlds_at(drums, u)
      >>> float(worlds.high.sel(quantity="mass"))
      60.0
      >>> setting = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> found = rps_jax.sweep("rps", drums, points=worlds, setting=setting)
      >>> drawn = rps_jax.sweep("rps", drums, worlds=4, setting=setting)
      >>> bool((found.mass == drawn.mass).all())
      True
    """
    domain = parse_domain(domain, robot, task)
    points = check_points(domain, u)
    columns = drawn_columns(domain, 0, points, np.arange(len(points.u)))
    return _labelled(domain, points.u).assign_coords(columns)


def drawn_columns(
    domain: Domain, seed: int, points: Points | None, index: np.ndarray
) -> dict[str, xr.Variable]:
    """Return objects and drawn quantities of worlds as coordinates of a dataset."""
    columns: Arrays = {}
    for rows, drawn in draw_by_object(domain, seed, points, index):
        for name, (values, _) in draws.table(drawn).items():
            columns.setdefault(name, np.empty(index.size))[rows] = values
    return drawn_variables(domain, domain.object_of(cases(domain, points, index)), columns)


def drawn_variables(
    domain: Domain, objects: np.ndarray, columns: Mapping[str, np.ndarray]
) -> dict[str, xr.Variable]:
    """Return objects (n,) and drawn quantities (n,) of worlds with names, units and meanings."""
    names = np.array([domain.objects[i] for i in objects.tolist()])
    variables = {"object": xr.Variable("world", names, {"long_name": "name of the object"})}
    for name, values in columns.items():
        label = LABELS.get(name, name.replace("_", " "))
        variables[name] = xr.Variable("world", values, {"units": unit_of(name), "long_name": label})
    return variables


def _labelled(domain: Domain, u: np.ndarray) -> xr.Dataset:
    """Return points with the names, ranges, units and kinds of their coordinates."""
    quantities, kinds, ranges, units = map(list, zip(*coordinates(domain), strict=True))
    low, high, log = map(list, zip(*ranges, strict=True))
    columns = {"low": low, "high": high, "log": np.array(log, np.int8), "unit": units}
    coords: dict[str, object] = {
        name: ("quantity", values) for name, values in (columns | {"kind": kinds}).items()
    }
    coords |= {"quantity": quantities, "world": np.arange(len(u))}
    words = {"units": "1", "long_name": "point of the unit cube"}
    data = {"u": (("world", "quantity"), u, words)}
    return xr.Dataset(data, coords, {"domain": files.json_text(to_json(domain))})


def _is_json_of(text: str, domain: Domain) -> bool:
    """Whether a text is this domain's JSON, also of a version without some quantities."""
    try:
        return from_json(json.loads(text)) == domain
    except (TypeError, ValueError, AttributeError, RecursionError):
        return False
