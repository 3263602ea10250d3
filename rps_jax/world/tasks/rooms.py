"""Rooms: a map with obstacles that neither base nor object may touch, and a planned path.

The map has metres and a frame of its own. The world is the frame of the base at its start: it is at
the origin and looks along x. The path is the shortest of a visibility graph around the corners of
the walls, by Dijkstra's algorithm of `scipy.sparse.csgraph`; in a map of more than 128 walls, that
of a grid, straightened. With a heading, it ends in a straight line along this. Points are complex
numbers here.
"""

from __future__ import annotations

import functools
import io
import warnings
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import contourpy
import jax.numpy as jnp
import numpy as np
import scipy
from PIL import Image

from rps_jax import errors
from rps_jax.geometry import polyline
from rps_jax.geometry.arrays import Entries, Number, Pytree
from rps_jax.geometry.polyline import Polyline, distances, is_inside, to_segment
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.robot.shell import Shell
from rps_jax.world.quantity import Quantity, Range
from rps_jax.world.tasks.base import CourseInputs
from rps_jax.world.tasks.corridor import Corridor, CorridorCourse
from rps_jax.world.tasks.path import APPROACH, LOOKAHEAD, Following, PathCourse

# Fields of a ROS map, and those that Nav2 ignores.
_ROS = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
_IGNORED = ("map_type", "frame_id")
_UNKNOWN = 205  # grey of unknown cells, as maps are saved
_MAP = "give polygons, an outline or a map.yaml in a file, as --task map.yaml,goal=4:2"
_OUTSIDE = "it lies in an obstacle or outside of the room (of an image, try a smaller tolerance)"
_MAX_WALLS = 4096
_NEAR = 128  # walls of a world: those nearest to its path, if the map has more
_MAX_CELLS = 1_000_000  # of the grid on which a path between more walls is planned
_MAX_PIXELS = 16_000_000
# Vertices of a path around a corner, by the clearance: up to 1.08 times the clearance from it. An
# arc is longer than the shortest by at most 5.5 %.
_TURN = np.exp(2j * np.pi * np.arange(8) / 8) / np.cos(np.pi / 8)


@dataclass(frozen=True)
class Rooms(Following):
    """Follow a planned path between the obstacles of a map.

    Instead of walls, a mapping has `polygons`, each with its corners [m], the `outline` of a room,
    or the fields of a ROS map, with a `tolerance` [m], an area of `specks` [m^2] and a `crop`.
    """

    kind: str = "rooms"
    OUTCOMES = Corridor.OUTCOMES
    ROOM_OPTIONS = ("base_radius", "object_radius")
    FAILURES = Corridor.FAILURES
    MARKS = ("polygons", "outline", *_ROS, "tolerance", "specks", "crop", *_IGNORED)
    NUMBERS = ("route",)

    lookahead: Annotated[Range, LOOKAHEAD] = Corridor.lookahead
    scale: Annotated[Range, Quantity("1", "scale of the map", 0.1, 10, owner="course")] = Range(
        1, 1
    )
    # [m] both ends of each edge of closed outlines
    walls: tuple[tuple[float, float], ...] = option((), -1000, 1000, unit="m")
    # [m, m, rad] of the base, and [m] of the contact; of several, each world draws one of each
    start: tuple[tuple[float, float, float], ...] = option(((0.0, 0.0, 0.0),), -1000, 1000)
    goal: tuple[tuple[float, float], ...] = option((), -1000, 1000, unit="m")
    # The path keeps the sum of both radii from all walls; that of the object is a guess.
    base_radius: float = option(0.5, 0.1, 5, unit="m")
    object_radius: float = option(0.25, 0, 5, unit="m")

    @classmethod
    def read(cls, file: JsonObject, values: JsonObject) -> dict[str, Any]:
        """Return the walls of polygons, an outline and an image."""
        polygons: Any = file.get("polygons", ())
        polygons = polygons if np.iterable(polygons) else [polygons]
        corners = {f"task polygon {i}": polygon for i, polygon in enumerate(polygons)}
        corners |= {"task outline": file["outline"]} if "outline" in file else {}
        starts, rings = values.get("start", cls.start), list[np.ndarray]()
        poses = [("start", x) for x in starts] + [("goal", x) for x in values.get("goal", ())]
        _check_count(3 * len(corners))
        for name in corners:
            rings.append(ring := _ring(name, corners[name]))
            for end, value in poses:  # ring by ring, since polygons may overlap
                point = complex(*value[:2])
                is_outside = is_inside(point, ring, np.roll(ring, -1)) != (name == "task outline")
                if is_outside and abs(point) < 1000:
                    raise errors.not_allowed(f"task {end}", value, _OUTSIDE)
        if file.keys() - {"polygons", "outline", *_IGNORED}:
            if "outline" in file:
                rule = "the image defines the outline: give polygons with it"
                raise errors.not_allowed("task outline", file["outline"], rule)
            rings += _read_image(file, starts)
        if file.keys() - {"polygons"}:  # walls around the room make its outside an obstacle
            points = np.concatenate(rings)
            x, y = ([f.min() - 0.1, f.max() + 0.1] for f in (points.real, points.imag))
            rings.append(np.add.outer(x, np.multiply(1j, y)).ravel()[[0, 2, 3, 1]])
        edges = [np.stack([ring, np.roll(ring, -1)], axis=1).ravel().tolist() for ring in rings]
        walls = tuple((point.real, point.imag) for points in edges for point in points)
        return {"walls": (*values.get("walls", ()), *walls)} if file else {}

    @property
    def shape(self) -> Hashable:
        """Shape of a goal, of the routes, and number of ends of walls: one more in large maps."""
        return super().shape, self._routes.shape, min(len(self.walls), 2 * _NEAR + 1)

    @property
    def idle(self) -> frozenset[str]:
        """Names of the numbers that are not drawn."""
        return super().idle | (set() if len(self._routes) > 1 else {"route"})

    @property
    def _last_lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Both ends (G,) [m] in the map of the last straight lines of paths; equal by default."""
        goals = np.array(self.goal) @ (1, 1j)
        last = APPROACH / self.scale.low * np.exp(1j * self.heading.low) if self.heading else 0.0
        return goals - last, goals

    @property
    def _routes(self) -> np.ndarray:
        """Vertices (R, N) [m] of the paths from each start to each goal in the map."""
        first, goals = self._last_lines
        points = tuple(zip(first.real.tolist(), first.imag.tolist(), strict=True))
        map_ = *(tuple(map(tuple, x)) for x in (self.walls, self.start)), points
        radii = self.base_radius / self.scale.low, self.object_radius / self.scale.low
        routes = _plan(*map_, *radii)
        last = np.tile(goals, len(self.start))[:, None]
        return np.append(routes, last, axis=1) if self.heading else routes

    @property
    def _near(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Ends (R, 2 W) [m] of the walls nearest to each route, and how far others are (R,) [m].

        The latter is None if there are no others.
        """
        walls = np.array(self.walls) @ (1, 1j)
        if walls.size <= 2 * _NEAR:
            return np.tile(walls, (len(self._routes), 1)), None
        pairs = walls.reshape(-1, 2)
        lines = self._routes[:, :, None]
        away = [distances(x[:-1], x[1:], *pairs.T).min(axis=0) for x in lines]
        order = np.argsort(away, axis=1, kind="stable")
        reach = np.take_along_axis(np.array(away), order[:, _NEAR, None], axis=1)
        return pairs[order[:, :_NEAR]].reshape(len(order), -1), reach[:, 0]

    def check(self) -> None:
        """Raise InputError for a map without a way from each start to each goal."""
        count = len(self.walls) / 2
        _check_count(count)
        for is_bad, name, value, rule in (
            (not count or count % 1, "walls", count or "()", _MAP),
            (not len(self.start), "start", "()", "give x, y and yaw in the map, as [1, 2, 0]"),
            (not len(self.goal), "goal", "()", "give x and y in the map, as [4, 2]"),
        ):
            if is_bad:
                raise errors.not_allowed(f"task {name}", value, rule)
        if self.heading:
            if self.heading.low != self.heading.high:
                rule = "give one heading in the map, so that a path can be planned"
                raise errors.not_allowed("task heading", self.heading, rule)
            clearance = self.free_room / self.scale.low
            first, goals = self._last_lines
            pairs = (np.array(self.walls) @ (1, 1j)).reshape(-1, 2).T
            away = distances(first[:, None], goals[:, None], *pairs).min()
            if away < clearance:
                rule = (
                    f"the last {APPROACH:g} m to a goal are a straight line along it, which keeps "
                )
                rule += f"{clearance:.2f} m from walls, and one is {away:.2f} m away"
                raise errors.not_allowed("task heading", f"{self.heading.low:g}", rule)
        for _, _, yaw in self.start:
            errors.check_angle("yaw of task start", yaw)
        _, reach = self._near
        least = 2 * self.free_room
        if reach is not None and reach.min() < least:
            rule = f"the {_NEAR} nearest to the path reach {reach.min():.2g} m from it, and must "
            fix = f"reach {least:.2g} m: give a larger tolerance [m] of an image, or specks [m2]"
            raise errors.not_allowed("task walls", f"{count:g}", rule + fix)

    @property
    def free_room(self) -> float:
        return self.base_radius + self.object_radius

    def check_room(self, shell: Shell, object_width: Callable[[], float]) -> None:
        """Raise InputError for a path that is narrower than the base, or a wall at its start."""
        if self.base_radius < float(shell.half[1]):
            rule = f"give at least {shell.half[1]} m: half of the base's width"
            raise errors.not_allowed("task base_radius", self.base_radius, rule)
        for start in self.start:
            walls = _placed(np.array(self.walls) @ (1, 1j), np.array([start]), self.scale.low)
            walls = jnp.asarray(walls.reshape(-1, 2, 2))
            if polyline.clearance(shell.outline, walls)[0] <= 0:
                raise errors.not_allowed("task start", start, "the base touches a wall there")

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Pytree]:
        """Return the ends, paths and walls of worlds."""
        route = np.floor(inputs.u["route"] * len(self._routes)).astype(int)
        starts = np.array(self.start)[route // len(self.goal)]
        scale, lookahead = (getattr(self, x).at(inputs.u[x]) for x in ("scale", "lookahead"))
        vertices = _placed(self._routes[route], starts, scale)
        # The first two are at the start, and straight ahead: the path begins at the base's front.
        vertices[:, :2, 0] = np.maximum(vertices[:, :2, 0], inputs.front[:, None])
        near, reach = self._near
        walls: Entries = _placed(near[route], starts, scale).reshape(route.size, -1, 2, 2)
        targets, goals = vertices[:, -1], self.goals(inputs, vertices[:, -1])
        goals = goals and goals._replace(heading=goals.heading - starts[:, 2])
        path = PathCourse(Polyline.through(vertices), lookahead, goals)
        course = CorridorCourse(path, walls, reach=None if reach is None else reach[route] * scale)
        return targets, course


def _placed(points: np.ndarray, starts: np.ndarray, scale: Number) -> np.ndarray:
    """Return points (..., K) of the map in worlds (n, K, 2) [m] of starts (n, 3)."""
    moved = points - (starts @ (1, 1j, 0))[:, None]
    moved = moved * (scale * np.exp(-1j * starts[:, 2]))[:, None]
    return np.stack([moved.real, moved.imag], axis=-1)


# --- maps ----------------------------------------------------------------------------------------


def _ring(name: str, corners: object) -> np.ndarray:
    """Return the corners (N,) [m] of a simple polygon, or raise InputError."""
    points = errors.check_array(name, corners, ("N", 2)) @ (1, 1j)
    points = points[: -1 if points[0] == points[-1] else None]
    _check_count(points.size)
    following, i = np.roll(points, -1), np.arange(points.size)
    touched = distances(points[:, None], following[:, None], points, following) < 1e-9
    touched &= (i - i[:, None] + 1) % max(i.size, 1) > 2  # of edges that do not follow each other
    for is_bad, rule in (
        (i.size < 3, "a polygon has three corners or more, each as x, y [m]"),
        ((abs(following - points) < 1e-3).any(), "corners are repeated: give each once"),
        (touched.any(), "its edges cross or touch: divide it into polygons that do not"),
    ):
        if is_bad:
            raise errors.not_allowed(name, corners, rule)
    return points


def _read_image(file: JsonObject, starts: object) -> list[np.ndarray]:
    """Return the outlines (N,) [m] of the part of a ROS map that starts (S, 3) can reach."""
    check = functools.partial(errors.check_finite, at_least=0)
    resolution = check("task resolution", file.get("resolution"), at_least=1e-3, unit="m")
    tolerance = check("task tolerance", file.get("tolerance", resolution), unit="m")
    high = check("task occupied_thresh", file.get("occupied_thresh", 0.65), at_most=1)
    low = check("task free_thresh", file.get("free_thresh", 0.196), at_most=1)
    x, y, yaw = errors.check_array("task origin", file.get("origin", (0, 0, 0)), (3,))
    errors.check_angle("yaw of task origin", yaw)
    texts = dict[str, str]()
    for name, allowed in {"negate": ("0", "1", "false", "true"), "mode": ("trinary",)}.items():
        texts[name] = str(file.get(name, allowed[0])).lower().removesuffix(".0")
        if texts[name] not in allowed:
            raise errors.not_allowed(f"task {name}", file[name], f"give one of {list(allowed)}")
    shades = shades_of(file)
    occupied = shades if texts["negate"] in ("1", "true") else 1 - shades
    # Unknown cells, and those outside, are walls.
    free = (occupied < low) & (occupied <= high)
    unit, origin = resolution * np.exp(1j * yaw), complex(x, y)
    if "crop" in file:
        left, bottom, right, top = errors.check_array("task crop", file["crop"], (4,))
        rows, columns = np.indices(free.shape)
        cells = origin + unit * (columns + 0.5 + 1j * (rows + 0.5))
        free &= (left <= cells.real) & (cells.real <= right)
        free &= (bottom <= cells.imag) & (cells.imag <= top)
    labelled: Any = scipy.ndimage.label(free)
    labels = np.pad(labelled[0], 1)
    cells = (errors.check_array("task start", starts, ("N", 3)) @ (1, 1j, 0) - origin) / unit + 1
    indices = np.floor([cells.imag, cells.real]).astype(int)
    reached = labels[tuple(np.clip(indices, 0, np.array(labels.shape)[:, None] - 1))]
    if not reached.all():
        rule = "it lies in an obstacle, in unknown cells or outside of the image"
        raise errors.not_allowed("task start", starts, rule)
    free = np.isin(labels, reached)
    obstacles: Any = scipy.ndimage.label(~free, np.ones((3, 3)))
    specks = check("task specks", file.get("specks", 0), at_most=10, unit="m2") / resolution**2
    areas = np.bincount(obstacles[0].ravel())[1:]
    free |= np.append(False, areas <= specks)[obstacles[0]]
    _check_count(2 * int((areas > specks).sum()))  # each has two walls or more
    if share := 100 * np.mean(abs(255 * np.pad(shades, 1)[free] - _UNKNOWN) < 0.5):
        _warn_once(
            f"{share:.2g} % of the free cells of the map have the grey {_UNKNOWN} of unknown "
            f"cells, which free_thresh = {low:g} counts as free: write free_thresh: 0.196, and "
            "they are walls"
        )
    rings = list[np.ndarray]()
    lines: Any = contourpy.contour_generator(z=free.astype(float)).lines(0.5)
    for line in lines:
        # Contours cut the corners of cells: a corner has the halves of both its neighbours.
        points = (np.where(line[:-1] % 1 == 0.5, line[:-1], line[1:]) - 0.5) @ (1, 1j)
        points = np.roll(points, -int(abs(points - points.mean()).argmax()))
        far = int(abs(points - points[0]).argmax())
        halves = points[: far + 1], np.append(points[far:], points[0])
        ring = np.concatenate([_simplify(x, tolerance / resolution)[:-1] for x in halves])
        rings.append(origin + unit * ring)
    return rings


@functools.cache  # a command reads its map several times
def _warn_once(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=3)


def shades_of(file: JsonObject) -> np.ndarray:
    """Return the brightness (rows from below, columns) of the image of a map, from 0 to 1."""
    path = Path(str(file.get("image", "an image")))
    content = io.BytesIO(files.read_regular(path, "image"))
    try:
        with warnings.catch_warnings(action="ignore"):  # a large image is an error
            image = Image.open(content, formats=("PPM", "PNG", "BMP"))
        if image.width * image.height > _MAX_PIXELS:
            raise ValueError(f"it has {image.width} x {image.height} pixels")
        if image.mode.startswith("I"):
            return np.asarray(image)[::-1] / 65535
        colours = image.convert("RGBA" if image.has_transparency_data else "RGB")
        return np.asarray(colours)[::-1].mean(axis=2) / 255
    except Exception as error:  # of any kind, by Pillow on damaged files
        rule = f"give a PGM, PNG or BMP file of at most 16 million pixels ({error})"
        raise errors.not_allowed("task image", path, rule) from error


def _simplify(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Return corners of a line (N,), with its ends, from which no point is beyond a tolerance."""
    corners, i = [0, len(points) - 1], 0
    while i < len(corners) - 1:
        part = points[corners[i] : corners[i + 1] + 1]
        away = to_segment(part, part[0], part[-1])
        if away.max() <= tolerance:
            i += 1
        else:
            corners.insert(i + 1, corners[i] + int(away.argmax()))
            _check_count(len(corners))
    return points[corners]


def _check_count(count: float) -> None:
    """Raise InputError for too many walls."""
    if count > _MAX_WALLS:
        fewer = "give a larger tolerance [m] of an image, specks=0.1 [m2] to leave out small ones"
        rule = f"at most {_MAX_WALLS} are allowed: {fewer}, or crop=LEFT:BOTTOM:RIGHT:TOP [m]"
        raise errors.not_allowed("task walls", f"at least {count:g}", rule)


# --- planner -------------------------------------------------------------------------------------


@functools.lru_cache(64)
def _plan(walls: Any, starts: Any, goals: Any, base_radius: float, radius: float) -> np.ndarray:
    """Return paths (R, N) [m] from each start to each goal; shorter ones repeat their end.

    They begin at the start and `base_radius` ahead of it, from where on they keep both radii from
    walls.
    """
    a, b = np.transpose((np.array(walls) @ (1, 1j)).reshape(-1, 2))
    clearance, goal = base_radius + radius, np.array(goals) @ (1, 1j)
    begin, yaw = np.array(starts) @ (1, 1j, 0), np.array(starts)[:, 2]
    nodes = np.append(begin + base_radius * np.exp(1j * yaw), goal)
    needed = f"the path keeps {clearance:.2f} m from walls (base_radius + object_radius)"
    for i, (value, point) in enumerate(zip((*starts, *goals), (*begin, *goal), strict=True)):
        away = distances(nodes[i], nodes[i], a, b).min()
        is_start = i < begin.size
        for is_bad, rule in (
            (is_inside(point, a, b), _OUTSIDE),
            (away < clearance, f"{needed}, and one is {away:.2f} m away"),
            (not is_start and abs(begin - point).min() < base_radius, "the base starts there"),
        ):
            if is_bad:
                raise errors.not_allowed(f"task {'start' if is_start else 'goal'}", value, rule)
    is_large = a.size > _NEAR
    nodes, graph = (_grid if is_large else _sight_lines)(nodes, a, b, clearance)
    result: Any = scipy.sparse.csgraph.dijkstra(
        graph, False, range(begin.size), return_predecessors=True
    )
    routes = list[np.ndarray]()
    for i, j in np.ndindex(begin.size, goal.size):
        route = [begin.size + j]
        if np.isinf(result[0][i, route[0]]):
            rule = f"{needed}, and no path leads there from {starts[i]}"
            fix = "give a goal in the same room, smaller radii or wider doors"
            raise errors.not_allowed("task goal", goals[j], f"{rule}: {fix}")
        while route[-1] != i:
            route.append(int(result[1][i, route[-1]]))
        path = nodes[route[::-1]]
        routes.append(np.append(begin[i], _straighten(path, a, b, clearance) if is_large else path))
    size = max(map(len, routes))
    return np.array([np.pad(route, (0, size - len(route)), "edge") for route in routes])


def _sight_lines(
    nodes: np.ndarray, a: Entries, b: Entries, clearance: float
) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """Return nodes with those about the corners of walls, and the graph of their sight lines."""
    around = (np.unique([a, b])[:, None] + clearance * _TURN).ravel()
    is_clear = distances(around[:, None], around[:, None], a, b).min(axis=1) > clearance
    nodes = np.append(nodes, around[is_clear])
    lengths = np.full((nodes.size, nodes.size), np.inf)
    for i, node in enumerate(nodes):
        is_clear = distances(node, nodes[:i, None], a, b).min(axis=1) > clearance - 1e-9
        lengths[i, :i] = np.where(is_clear, abs(nodes[:i] - node), np.inf)
    return nodes, scipy.sparse.csgraph.csgraph_from_dense(lengths, np.inf)


def _grid(
    nodes: np.ndarray, a: Entries, b: Entries, clearance: float
) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """Return nodes with the clear points of a grid, and the graph of their eight neighbours."""
    low, size = complex(a.real.min(), a.imag.min()), (np.ptp(a.real), np.ptp(a.imag))
    cell = max(clearance / 5, np.sqrt(np.prod(size) / _MAX_CELLS))
    x, y = (np.arange(0, n, cell) for n in size)
    points = low + x[:, None] + 1j * y
    # Between two neighbours, a wall may be nearer by the second term.
    free = _away_from_walls(points, a, b, clearance) > clearance + cell**2 / (4 * clearance)
    indices = np.where(free, nodes.size + np.cumsum(free).reshape(free.shape) - 1, -1)
    edges = list[np.ndarray]()
    for first, second in (
        (indices[1:], indices[:-1]),
        (indices[:, 1:], indices[:, :-1]),
        (indices[1:, 1:], indices[:-1, :-1]),
        (indices[1:, :-1], indices[:-1, 1:]),
    ):
        edges.append(np.stack([first, second])[:, (first >= 0) & (second >= 0)])
    inner = points[free]
    for i, node in enumerate(nodes):
        near = np.argsort(abs(inner - node))[:32]
        is_clear = distances(node, inner[near, None], a, b).min(axis=1) > clearance - 1e-9
        near = near[is_clear] + nodes.size
        edges.append(np.stack([np.full_like(near, i), near]))
    vertices, (first, second) = np.append(nodes, inner), np.concatenate(edges, axis=1)
    lengths = abs(vertices[first] - vertices[second])
    return vertices, scipy.sparse.csr_array((lengths, (first, second)), shape=2 * (vertices.size,))


def _away_from_walls(points: np.ndarray, a: Entries, b: Entries, clearance: float) -> np.ndarray:
    """Return lower bounds [m] of the distances of points from walls, infinite beyond twice this.

    They are lower by at most a hundredth of the clearance.
    """
    step = np.sqrt(0.08) * clearance
    marks = [np.linspace(p, q, 2 + int(abs(q - p) / step)) for p, q in zip(a, b, strict=True)]
    tree = scipy.spatial.KDTree(np.concatenate(marks).view(float).reshape(-1, 2))
    pairs = np.ascontiguousarray(points).view(float).reshape(-1, 2)
    away = tree.query(pairs, distance_upper_bound=2 * clearance)[0].reshape(points.shape)
    return np.sqrt(np.maximum(away**2 - step**2 / 4, 0))


def _straighten(path: np.ndarray, a: np.ndarray, b: np.ndarray, clearance: float) -> np.ndarray:
    """Return those points (N,) of a path that straight lines clear of walls join."""
    corners, i = [0], 0
    while i < path.size - 1:
        low, high = i + 1, path.size  # the line to the point `low` is clear
        while high - low > 1:
            middle = (low + high) // 2
            is_clear = distances(path[i], path[middle], a, b).min() > clearance - 1e-9
            low, high = (middle, high) if is_clear else (low, middle)
        corners.append(i := low)
    return path[corners]


TASK = Rooms
