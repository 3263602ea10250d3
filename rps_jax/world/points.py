"""Worlds as points of the unit cube: every number that a domain draws is one coordinate.

A drawn world is addressed by (domain, seed, index). The same world is the point `u` of its random
numbers, each in [0, 1), of which a domain reads only some. Whoever looks for worlds, instead of
drawing them, moves such points.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry.solid import SIDES
from rps_jax.record import files
from rps_jax.robot.robot import Robot
from rps_jax.world import draws
from rps_jax.world.domain import ERRORS, QUANTITIES, RANDOM, Domain, Range, from_json, named
from rps_jax.world.draws import Draw

Kind = Literal["range", "choice", "shape", "noise"]
FILE = "points.nc"  # of a run folder whose worlds are points
_OF_PRISMS = ("sides", "turn", *(f"corner_{i}" for i in range(SIDES)))
_OF_FEET = ("feet_number", "feet_turn")
_TURN = Range(0, 2 * np.pi)
_MOST = 100_000_000


class Quantity(NamedTuple):
    """One coordinate of the cube, and what it stands for."""

    name: str
    kind: Kind  # a range; a choice from a list; corners or feet; the key of all noise
    range: Range  # of the quantity, or from 0 to how many there are to choose from
    unit: str


def quantities(domain: Domain) -> tuple[Quantity, ...]:
    """The q coordinates of a domain: lists first, then what it draws, shapes and noise with it.

    A range of a single value is no coordinate, nor is one of which the domain draws nothing.
    """
    return tuple(_quantities(domain))


def _quantities(domain: Domain) -> Iterator[Quantity]:
    for name, count in zip(("object", "friction", "target"), _counts(domain), strict=True):
        if count > 1:
            yield Quantity(name, "choice", Range(0, count), "1")
    random = set(domain.objects) & set(RANDOM)
    idle = set(domain.idle) | ({"aspect"} if random == {"random_cylinder"} else set())
    for name in draws.USES:
        if name in (*_OF_PRISMS, *_OF_FEET):
            if domain.feet is not None if name in _OF_FEET else "random_prism" in random:
                yield Quantity(name, "shape", Range(0, 1), "1")
        elif name == "com_bearing":
            if random and domain.com_offset.high > 0:
                yield Quantity(name, "range", _TURN, "rad")
        elif name.startswith("key_"):
            yield Quantity(name, "noise", Range(0, 1), "1")
        else:
            of = getattr(domain, "velocity_error" if name in ERRORS else name)
            if name not in idle and of is not None and of.low < of.high:
                unit = QUANTITIES[name].unit if name in QUANTITIES else "1"
                yield Quantity(name, "range", of, unit)


def names(domain: Domain, *kinds: Kind) -> tuple[str, ...]:
    """The names of a domain's coordinates, of these kinds or of all, in their order."""
    return tuple(one.name for one in quantities(domain) if not kinds or one.kind in kinds)


def check_drawn(field: str, name: str, domain: Domain) -> str:
    """`name` if the domain draws a quantity of this name from a range, or InputError."""
    drawn = names(domain, "range")
    known = (*QUANTITIES, *ERRORS, "com_bearing")
    if name in known and name not in drawn:
        raise InputError(
            f"{field} = {name} is not allowed: this domain does not draw it, but "
            f"{', '.join(drawn)}."
        )
    return errors.check_name(field, name, drawn)


@dataclass(frozen=True, eq=False)
class Points:
    """Points (n, q) of the cube of a domain, all in [0, 1)."""

    u: np.ndarray  # (n, q)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Points) and self.digest == other.digest

    @property
    def digest(self) -> str:
        """SHA-256 of the numbers and of how many each point has."""
        return files.sha256(repr(self.u.shape).encode() + np.ascontiguousarray(self.u).tobytes())

    def cases(self, domain: Domain, index: Any) -> np.ndarray:
        """Which object, friction and target the worlds `index` have, as indices of the domain."""
        rows = dict(zip(names(domain), self.u[np.asarray(index)].T, strict=True))
        found = np.zeros(np.shape(index), np.int64)
        for name, count in zip(("object", "friction", "target"), _counts(domain), strict=True):
            which = np.floor(rows[name] * count).astype(np.int64) if name in rows else 0
            found = found * count + which
        return found

    def draw(self, domain: Domain, index: Any) -> Draw:
        """The worlds `index` (n,), all of one object of the domain."""
        index = np.asarray(index, np.int64)
        cases = self.cases(domain, index)
        numbers = np.full((index.size, draws.COLUMNS), 0.5)
        own = [i for i, name in enumerate(names(domain)) if name in draws.USES]
        at = [draws.USES[name] for name in names(domain) if name in draws.USES]
        numbers[:, at] = self.u[index][:, own]
        return draws.drawn_at(domain, cases, numbers)._replace(number=index)

    def write(self, folder: Path, domain: Domain) -> Path:
        """Keep the points in a run folder."""
        return files.write_results(folder / FILE, _labelled(domain, self.u))

    @staticmethod
    def read(folder: Path, digest: str) -> Points:
        """The points of this digest that a run folder holds; InputError if it does not."""
        if not (folder / FILE).exists():
            raise InputError(f"run = {folder} lacks its {FILE}: run the same command again.")
        kept = files.check_columns(
            files.read_dataset(folder / FILE), folder / FILE, {"u": ("world", "quantity")}, {}
        )
        found = Points(kept.u.values)
        if found.digest != digest:
            raise files.CorruptFileError(folder / FILE, "its points are not those of the run")
        return found


def _counts(domain: Domain) -> tuple[int, int, int]:
    """How many objects, frictions and targets the domain lists; 1 where it lists none."""
    return len(domain.objects), max(1, len(domain.frictions)), max(1, len(domain.targets))


def checked(domain: Domain, u: Any) -> Points:
    """Points of a domain: an array (n, q) in [0, 1), or of `worlds_at`; or InputError."""
    every = names(domain)
    if isinstance(u, xr.Dataset):
        if "u" not in u or "quantity" not in u.coords:
            raise InputError("points are not allowed: the dataset has no u (world, quantity).")
        theirs = tuple(map(str, u.quantity.values))
        if theirs != every or ("domain" in u.attrs and not _tells(u.attrs["domain"], domain)):
            raise InputError(
                "points are not allowed: they are of another domain; give that domain."
            )
        u = u.u.values
    try:
        found = np.array(u, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"u = {u!r} is not allowed: give an array (n, {len(every)}).") from error
    if found.ndim != 2 or found.shape[1] != len(every) or not len(found):
        raise InputError(
            f"u of shape {found.shape} is not allowed: it must be (n, {len(every)}), a row a world "
            f"and a column for each of {', '.join(every)}."
        )
    wrong = np.argwhere(~((found >= 0) & (found < 1)))
    if len(wrong):
        row, column = wrong[0]
        raise InputError(
            f"u[{row}, {column}] = {found[row, column]} ({every[column]}) is not allowed: it must "
            "be at least 0 and below 1."
        )
    errors.check_count("points", len(found), at_most=_MOST)
    return Points(found)


def cases(domain: Domain, points: Points | None, index: Any) -> np.ndarray:
    """Which object, friction and target worlds have, drawn ones or points."""
    return np.asarray(index) if points is None else points.cases(domain, index)


def draw(domain: Domain, seed: int, points: Points | None, index: Any) -> Draw:
    """The worlds `index` of one object, drawn ones or points."""
    return draws.draw(domain, seed, index) if points is None else points.draw(domain, index)


def points_of(domain: Domain | str, index: ArrayLike, seed: int = 0) -> np.ndarray:
    """The points (n, q) of the unit cube at which the drawn worlds `index` (n,) lie.

    `worlds_at` makes the same worlds of them, bit for bit.
    """
    domain = named(domain)
    errors.check_count("seed", seed, at_least=0, at_most=2**32 - 1)
    index = np.atleast_1d(np.asarray(index, np.int64))
    every = draws.numbers_of(seed, index)
    numbers = {name: every[:, column] for name, column in draws.USES.items()}
    objects, frictions, targets = _counts(domain)
    of_lists = {
        "object": (domain.object_of(index) + 0.5) / objects,
        "friction": (index // targets % frictions + 0.5) / frictions,
        "target": (index % targets + 0.5) / targets,
    }
    return np.stack([(numbers | of_lists)[name] for name in names(domain)], axis=-1)


def worlds_at(
    domain: Domain | str, u: ArrayLike | xr.Dataset, *, robot: Robot | str | None = None
) -> xr.Dataset:
    """The worlds at points of the unit cube, which `sweep` and `evaluate` take as `points`.

    A quantity is at `low + u (high - low)`, or at `low (high / low)^u` where its range is even in
    the logarithm. Kinds of quantities are `range`; `choice`, of the object, friction or target from
    the domain's lists; `shape`, of a prism's corners or of feet; and `noise`, the key of all that
    is drawn while a world runs, so that neighbours in it have nothing in common.

    Args:
      domain: ranges of what differs between worlds, or their name, as wide.
      u: (n, q) in [0, 1), a row a world, a column for each quantity of the domain, in order.
      robot: by its name, as kairos, or a JSON file's; None: the domain's.

    Returns:
      `u` (world, quantity); for each quantity its `low`, `high`, `log`, `unit` and `kind`; and
      what the worlds have (world), as coordinates.

    Raises:
      InputError: `u` is not of this domain, or not in [0, 1).

    Example:
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
    domain = named(domain, robot)
    points = checked(domain, u)
    every = np.arange(len(points.u))
    which = domain.object_of(points.cases(domain, every))
    columns = coordinates(domain, which, partial(points.draw, domain))
    return _labelled(domain, points.u).assign_coords(columns)


def coordinates(
    domain: Domain, which: np.ndarray, draw: Callable[[np.ndarray], Draw]
) -> dict[str, Any]:
    """Objects of worlds, and what was drawn for them, as coordinates.

    `which` (n,) of the domain's objects they have, and `draw` makes some of them, by their rows.
    """
    columns: dict[str, Any] = {"object": ("world", np.array(domain.objects)[which])}
    for thing in np.unique(which):
        rows = np.flatnonzero(which == thing)
        for name, (values, unit) in draws.table(draw(rows)).items():
            empty = ("world", np.empty(which.size), {"units": unit})
            columns.setdefault(name, empty)[1][rows] = values
    return columns


def _labelled(domain: Domain, u: np.ndarray) -> xr.Dataset:
    """Points with the names, ranges, units and kinds of their quantities."""
    every = quantities(domain)
    columns: dict[str, Any] = {
        "low": [one.range.low for one in every],
        "high": [one.range.high for one in every],
        "log": np.array([one.range.log for one in every], np.int8),
        "unit": [one.unit for one in every],
        "kind": [one.kind for one in every],
    }
    coordinates = {name: ("quantity", values) for name, values in columns.items()}
    coordinates |= {"quantity": [one.name for one in every], "world": np.arange(len(u))}
    text = {"units": "1", "long_name": "point of the unit cube"}
    return xr.Dataset(
        {"u": (("world", "quantity"), u, text)}, coordinates, {"domain": json.dumps(asdict(domain))}
    )


def _tells(text: Any, domain: Domain) -> bool:
    """Whether a text is of this domain, maybe written before some quantity could be drawn."""
    try:
        return from_json(json.loads(text)) == domain
    except (TypeError, ValueError, AttributeError, RecursionError):
        return False
