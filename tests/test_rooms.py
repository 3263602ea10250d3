"""Tests of rooms: maps, planned paths against shapely and lengths by hand, and bad input."""

import dataclasses
import json
import time
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refusal, refusing, rps, setting_of
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from shapely import LineString, MultiLineString, MultiPoint, Point, Polygon, box

import rps_jax
from rps_jax import Observation
from rps_jax.geometry import footprint
from rps_jax.record import files
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.world import draws, points, tasks
from rps_jax.world.domain import from_json, parse_domain, task_in_words, to_json
from rps_jax.world.tasks.base import Positions
from rps_jax.world.tasks.rooms import Rooms

DOMAIN = "wide,objects=random_cylinder"
PILLAR = [[3, 2], [4, 2], [4, 3.5], [3, 3.5]]
ROOM: dict[str, Any] = {
    "outline": [[0, 0], [8, 0], [8, 4], [6, 4], [6, 6], [0, 6]],
    "polygons": [PILLAR],
    "start": [1, 1, 0.3],
    "goal": [7, 2],
}
HALL = {"outline": [[0, 0], [9, 0], [9, 4], [0, 4]], "start": [1.5, 2, 0], "goal": [7, 2]}
DOOR = [[[4, 0], [4.2, 0], [4.2, 1.3], [4, 1.3]], [[4, 4], [4, 2.7], [4.2, 2.7], [4.2, 4]]]


def room(**changes: Any) -> Rooms:
    """Return the task of a room, with changes."""
    task = tasks.parse_task(ROOM | changes)
    assert isinstance(task, Rooms)
    return task


def lines_of(task: Rooms) -> list[LineString]:
    """Return the walls of a map."""
    return [LineString(ends) for ends in zip(task.walls[::2], task.walls[1::2], strict=True)]


def edges(task: Rooms) -> set[frozenset[tuple[float, ...]]]:
    """Return the walls of a map, of any direction and order."""
    ends = np.round(np.array(task.walls), 6).reshape(-1, 2, 2).tolist()
    return {frozenset(map(tuple, pair)) for pair in ends}


def world(task: Rooms, count: int = 1) -> tuple[np.ndarray, np.ndarray, draws.Draw]:
    """Return paths (n, N, 2) and walls (n, W, 2, 2) of drawn worlds, and the draw."""
    drawn = draws.draw(parse_domain(DOMAIN, task=task), 0, np.arange(count))
    lines = drawn.course.lines()
    return lines["path"], lines["walls"], drawn


# --- maps ----------------------------------------------------------------------------------------


def cells(shape: Polygon, unit: float, width: int, height: int) -> np.ndarray:
    """Return whether the middles of cells are within a shape, rows from above."""
    y, x = unit * (np.mgrid[:height, :width] + 0.5)
    inside = shape.contains(list(map(Point, zip(x.ravel(), y.ravel(), strict=True))))
    return np.asarray(inside).reshape(height, width)[::-1]


FREE = Polygon(ROOM["outline"], [PILLAR])
IS_FREE = cells(FREE, 0.125, 66, 50)
GREY = np.where(IS_FREE, 254, 205).astype(np.uint8)
GREY[-27:-18, 26:30] = 0  # of the pillar
IMAGES: dict[str, tuple[Any, dict[str, Any]]] = {
    "room.pgm": (GREY, {}),
    "room.png": (np.stack([GREY] * 3, axis=2), {"occupied_thresh": 0.65, "free_thresh": 0.196}),
    "alpha.png": (
        np.dstack([np.where(IS_FREE, 254, 0)] * 3 + [0 * GREY + 255]).astype(np.uint8),
        {"mode": "trinary"},
    ),
    "white.png": (255 - GREY, {"negate": 1}),
    "text.png": (255 - GREY, {"negate": "'1'", "mode": "Trinary"}),
    "rtabmap.pgm": (GREY, {"map_type": "occupancy", "frame_id": "map", "negate": "false"}),
    "deep.png": (GREY.astype(np.uint16) * 257, {"negate": 0}),
    "turned.pgm": (GREY, {"origin": [3.0, -1.0, 0.5]}),
}


@pytest.mark.parametrize("name", IMAGES)
def test_a_ros_map_and_polygons_of_a_room_have_equal_walls(name, tmp_path):
    pixels, fields = IMAGES[name]
    Image.fromarray(pixels).save(tmp_path / name)
    x, y, yaw = origin = fields.get("origin", [0.0, 0.0, 0.0])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

    def placed(corners: Any) -> Any:
        return (np.array(corners) @ turn + [x, y]).tolist()

    start = [*placed(ROOM["start"][:2]), ROOM["start"][2] + yaw]
    changes = {"start": start, "goal": placed(ROOM["goal"])}
    yaml = {"image": name, "resolution": 0.125, "origin": origin} | fields
    path = tmp_path / "map.yaml"
    path.write_text("# map\n" + "".join(f"{name}: {value}\n" for name, value in yaml.items()))
    texts = (f"{key}={':'.join(map(str, value))}" for key, value in changes.items())
    task = tasks.parse_task(",".join([str(path), *texts]))
    polygons = {"outline": placed(ROOM["outline"]), "polygons": [placed(PILLAR)]}
    assert isinstance(task, Rooms)
    assert edges(task) == edges(room(**polygons, **changes))
    assert task.start == (tuple(start),)


def test_walls_of_an_image_are_within_the_tolerance(tmp_path):
    rng = default_rng(3)
    blob = MultiPoint(rng.uniform(2, 6, (12, 2))).buffer(0.7).union(box(0.5, 3, 7, 5))
    (blob,) = (part for part in getattr(blob, "geoms", [blob]) if part.contains(Point(2, 4)))
    free = cells(blob, 0.05, 170, 170)
    Image.fromarray(np.where(free, 255, 0).astype(np.uint8)).save(tmp_path / "blob.png")
    counts = []
    for tolerance in (0.05, 0.1, 0.2):
        task = tasks.parse_task(
            {
                "image": str(tmp_path / "blob.png"),
                "resolution": 0.05,
                "tolerance": tolerance,
                "start": [2, 4, 0],
                "goal": [5, 4],
                "object_radius": 0.1,
            }
        )
        walls = MultiLineString(lines_of(task)[:-4]).segmentize(0.02)
        assert walls.hausdorff_distance(blob.boundary.segmentize(0.02)) < tolerance + 0.1
        counts.append(len(task.walls) // 2)
    assert counts[0] > counts[1] > counts[2]


def test_a_part_of_a_map_without_the_start_is_a_wall(tmp_path):
    pixels = np.full((80, 160), 255, np.uint8)
    pixels[:, 100] = 0
    pixels[20:25, 120:125] = 0  # in the other part
    Image.fromarray(pixels).save(tmp_path / "two.png")
    fields = {"image": str(tmp_path / "two.png"), "resolution": 0.05, "start": [1, 2, 0]}
    task = tasks.parse_task(fields | {"goal": [4, 2]})
    assert len(edges(task)) == 8
    with refusing(r"goal = \(7.0, 2.0\) .*a goal in the same room"):
        tasks.parse_task(fields | {"goal": [7, 2]})


@pytest.mark.parametrize("free_thresh", [0.196, 0.25])
def test_unknown_cells_that_count_as_free_are_named_once(free_thresh, tmp_path):
    """Nav2 Humble writes free_thresh: 0.25, with which the grey 205 is free."""
    pixels = np.full((60, 100), 254, np.uint8)
    pixels[:, 90:] = 205
    pixels[10, 10] = 0
    Image.fromarray(pixels).save(tmp_path / "map.pgm")
    fields = {"image": str(tmp_path / "map.pgm"), "resolution": 0.1, "start": [2, 3, 0]}
    with warnings.catch_warnings(record=True) as caught:
        for _ in range(2):
            task = tasks.parse_task(fields | {"goal": [7, 3], "free_thresh": free_thresh})
    assert isinstance(task, Rooms)
    sentences = [str(x.message) for x in caught]
    assert len(sentences) == (free_thresh > 0.2)
    for sentence in sentences:
        assert sentence.startswith("10 % of the free cells of the map have the grey 205 of unknown")
        assert "write free_thresh: 0.196, and they are walls" in sentence
    assert max(x for x, _ in task.walls[:-8]) == pytest.approx(10 if sentences else 9)


# --- paths ---------------------------------------------------------------------------------------


def test_a_free_way_is_straight():
    (path,), _, _ = world(room(**HALL, polygons=[]))
    assert path[-1] == pytest.approx([5.5, 0])
    assert path[:, 1] == pytest.approx(0)
    assert LineString(path).length == pytest.approx(5.5 - 0.3625)


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_goal_at_the_end_of_the_way_ahead_is_as_far_as_that(yaw):
    """A plan of an edge without length; 5.3 m, if that were no edge."""
    ahead = 0.5 * np.exp(1j * yaw)
    start = [1.5, 2, yaw]
    goal = [1.5 + ahead.real, 2 + ahead.imag]
    for ends in ({"goal": goal}, {"goal": [goal, [7, 2], goal]}):
        paths, _, _ = world(room(**HALL | {"start": start} | ends, polygons=[]), 20)
        lengths = [LineString([(0, 0), *path[1:]]).length for path in paths]
        assert min(lengths) == pytest.approx(0.5)
        assert max(lengths) == pytest.approx(0.5 if ends["goal"] is goal else 5.5, abs=0.25)


def test_starts_goals_and_corners_may_coincide():
    """Two starts at one point, and a goal at a vertex of the path around a corner."""
    polygons = [[[4, 0], [4.2, 0], [4.2, 2], [4, 2]]]
    hall = HALL | {"outline": [[0, 0], [9, 0], [9, 8], [0, 8]], "polygons": polygons}
    whole = room(**hall)
    ((_, *path),) = world(whole)[0]
    middle = [path[2][0] + 1.5, path[2][1] + 2]
    task = room(**hall | {"start": [[1.5, 2, 0]] * 2, "goal": [middle, [7, 2]]})
    paths = world(task, 30)[0]
    lengths = np.round([LineString(path).length for path in paths], 6)
    through = LineString(world(whole)[0][0]).length
    assert set(lengths) == {np.round(through, 6), min(lengths)}
    assert min(lengths) == pytest.approx(LineString(world(whole)[0][0][:4]).length, abs=1e-6)


def test_a_path_around_a_wall_is_almost_the_shortest():
    """Two tangents and an arc about each end of a wall of no more than 1 mm."""
    wall = [[5, -1], [5.001, -1], [5.001, 1], [5, 1]]
    task = room(
        outline=[[-9, -9], [19, -9], [19, 9], [-9, 9]],
        polygons=[wall],
        start=[0, 0, 0],
        goal=[10, 0],
    )
    (path,), _, _ = world(task)
    ahead, clearance = 0.5, 0.75
    tangents = [np.sqrt((5 - x) ** 2 + 1 - clearance**2) for x in (ahead, 0)]
    angles = [np.arctan2(1, 5 - x) + np.arcsin(clearance / np.hypot(5 - x, 1)) for x in (ahead, 0)]
    shortest = ahead + sum(tangents) + clearance * sum(angles)
    length = LineString([(0, 0), *path[1:]]).length
    assert shortest - 1e-3 < length < 1.02 * shortest
    assert len(np.unique(path, axis=0)) <= 7


def test_a_path_keeps_the_clearance_and_no_corner_can_be_left_out():
    rng = default_rng(5)
    for k in range(4):
        corners = [
            2 + 2.5 * np.array([i, j]) + rng.uniform(-0.4, 0.4, (3, 2))
            for i in range(4)
            for j in range(3)
        ]
        hulls = [MultiPoint(c).convex_hull for c in corners]
        polygons = [np.array(h.exterior.coords).tolist() for h in hulls]
        task = room(
            outline=[[-2, -2], [13, -2], [13, 10], [-2, 10]],
            polygons=polygons,
            start=[-1, -1, 0.7],
            goal=[12, 8.9 - k],
            object_radius=0.2,
        )
        (path,), (walls,), _ = world(task)
        path = path[: len(np.unique(path, axis=0))]
        obstacles = MultiLineString(list(walls))
        assert LineString(path[1:]).distance(obstacles) > 0.7 - 1e-9
        for i in range(2, len(path) - 1):
            assert LineString(path[[i - 1, i + 1]]).distance(obstacles) < 0.7


def hall_of_pillars(**changes: Any) -> Rooms:
    """Return a map of 28 x 20 m with 143 pillars, which have 572 walls."""
    grid = [(2.2 * i, 1.8 * j) for i in range(13) for j in range(11)]
    pillars = [box(x, y, x + 0.3, y + 0.3).exterior.coords[:-1] for x, y in grid]
    outline = [[-1, -2], [28, -2], [28, 20], [-1, 20]]
    task = {"outline": outline, "polygons": pillars, "start": [-0.2, -1, 0.9], "goal": [27.3, 19.2]}
    return room(**task | {"base_radius": 0.4, "object_radius": 0.2} | changes)


def test_a_path_in_a_large_map_is_clear_and_short_and_a_world_has_the_walls_near_it():
    task = hall_of_pillars(goal=[[27.3, 19.2], [1.9, 19.2]])
    near, reach = task._near
    assert reach is not None
    assert near.shape == (2, 256)
    for path, ends, limit in zip(task._routes, near, reach, strict=True):
        line = LineString(np.stack([path.real, path.imag], axis=1)[1:])
        assert line.distance(MultiLineString(lines_of(task))) > 0.6 - 1e-9
        assert line.length < 1.1 * abs(path[-1] - path[1])
        known = {
            frozenset(map(tuple, np.round(pair, 6)))
            for pair in np.stack([ends.real, ends.imag], axis=1).reshape(-1, 2, 2)
        }
        line = LineString(np.stack([path.real, path.imag], axis=1))
        away = {wall: LineString(list(wall)).distance(line) for wall in edges(task)}
        assert {wall for wall in away if away[wall] < limit - 1e-6} <= known
        assert min(away[wall] for wall in away.keys() - known) == pytest.approx(limit)
    _, walls, drawn = world(task, 8)
    assert walls.shape == (8, 128, 2, 2)
    assert set(np.round(drawn.course.reach, 6)) == set(np.round(reach, 6))


def test_the_room_left_in_a_large_map_has_exact_derivatives():
    course = jax.tree.map(lambda x: jnp.asarray(x[0], float), world(hall_of_pillars())[2].course)
    at, zero = course.path.line.vertices[1], jnp.zeros(())
    disc = footprint.Footprint(jnp.zeros((1, 2)), jnp.asarray(0.2))
    box = footprint.rectangle(0.2, 0.15)

    @jax.jit
    @jax.value_and_grad
    def clearance(at):
        positions = Positions(at, at, zero > 0, jnp.append(at, 0.3), box, at, zero, disc)
        return course.step(course.start(), positions)[0].clearance

    value, gradient = clearance(at)
    assert 0 < value < 1
    assert_allclose(jnp.linalg.norm(gradient), 1, rtol=1e-5)  # towards the nearest wall
    assert_allclose(clearance(at + 0.01 * gradient)[0] - value, 0.01, rtol=0.05)


def test_small_obstacles_and_what_a_crop_leaves_out_vanish(tmp_path):
    image = GREY.copy()
    image[20, 10] = 0  # a cell of 0.0156 m2 in free space
    Image.fromarray(image).save(tmp_path / "room.png")
    given = ROS | {"image": str(tmp_path / "room.png")}
    with_speck, without = (tasks.parse_task(given | x) for x in ({}, {"specks": 0.02}))
    assert isinstance(with_speck, Rooms)
    assert isinstance(without, Rooms)
    Image.fromarray(GREY).save(tmp_path / "room.png")
    clean = tasks.parse_task(given)
    assert without == clean
    assert len(with_speck.walls) == len(without.walls) + 4  # its tolerance is a cell
    cropped = tasks.parse_task(given | {"crop": [0, 0, 8, 4]})
    assert isinstance(cropped, Rooms)
    assert np.max(cropped.walls, axis=0)[1] == pytest.approx(4.1)


def test_the_world_is_the_frame_of_the_base_at_its_start():
    (path,), (walls,), drawn = world(room())
    yaw, start = 0.3, np.array([1, 1])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    assert path[0] == pytest.approx([0.3625, 0])
    assert path[1] == pytest.approx([0.5, 0])
    assert path[-1] @ turn.T + start == pytest.approx([7, 2])
    assert drawn.p_world_target[0] == pytest.approx(path[-1])
    assert (walls @ turn.T + start).reshape(-1, 2) == pytest.approx(np.array(room().walls))


def test_worlds_draw_start_goal_and_scale():
    task = room(start=[[1, 1, 0], [1, 5, 0]], goal=[[7, 2], [5, 5]], scale=[1.0, 2.0])
    paths, walls, drawn = world(task, 40)
    sizes = drawn.values["scale"]
    assert ((sizes >= 1) & (sizes < 2)).all()
    assert len(np.unique(np.round(paths[:, -1] / sizes[:, None], 6), axis=0)) == 4
    for path, lines in zip(paths, walls, strict=True):
        away = LineString(path[1:]).distance(MultiLineString(list(lines)))
        assert away > 0.75 - 1e-9
    table = draws.table(drawn)
    assert table["scale"][0] == pytest.approx(sizes)
    assert table["length"][0] == pytest.approx([LineString(path).length for path in paths])


def test_a_room_is_a_point_of_the_cube_and_has_a_text_and_a_json():
    task = room(start=[[1, 1, 0], [1, 5, 0]], scale=[1, 1.5])
    assert tasks.parse_task(str(task)) == task
    domain, index = parse_domain(DOMAIN, task=task), np.arange(6)
    assert from_json(json.loads(json.dumps(to_json(domain)))) == domain
    assert {"scale", "route"} <= set(points.names(domain))
    assert "route" not in points.names(parse_domain(DOMAIN, task=room()))
    at = points.check_points(domain, points.points_of(domain, index))
    drawn, again = (points.draw(domain, 0, x, index).course.lines() for x in (None, at))
    for name in ("path", "walls"):
        assert_array_equal(drawn[name], again[name])


# --- trials --------------------------------------------------------------------------------------

SETTING = setting_of(40.0)


def test_a_trial_ends_at_a_wall_and_a_wide_door_lets_it_pass(tmp_path):
    wide = files.write_json(tmp_path / "map.json", HALL | {"polygons": DOOR, "object_radius": 0.15})
    low = [[3.2, 0], [3.3, 0], [3.3, 2.5], [3.2, 2.5]]
    far = [[8.5, 3.5], [8.6, 3.5], [8.6, 3.6], [8.5, 3.6]]  # for equal numbers of walls
    task = HALL | {"polygons": [low, far], "base_radius": 0.3, "object_radius": 0}
    cases = [Case("cylinder", task=x, skin="ideal") for x in (f"rooms,{wide}", task)]
    outcome, _ = pushes.run(cases, SETTING)
    assert (outcome.task["wall_touch"] > 0).tolist() == [False, True]
    assert 0.1 < outcome.task["clearance"][0] < 0.6
    assert not outcome.success[1]
    point = Point(outcome.task["touch_x"][1] + 1.5, outcome.task["touch_y"][1] + 2)
    assert Polygon(low).boundary.distance(point) < 1e-5


class Sideways(NamedTuple):
    """Parameters of a law that moves to the right."""

    d_success: float = 0.05


def test_a_trial_ends_where_the_walls_are_not_known(registries):
    """The base leaves a straight path of a hall sideways: other walls are 3 m from the path."""
    rows = [[[x, y], [x + 0.1, y], [x, y + 0.1]] for x in np.arange(0.3, 9, 0.4) for y in (3, 4)]
    outline = [[-1, -9], [10, -9], [10, 9], [-1, 9]]
    twist = rps_jax.Twist(jnp.float32(0.0), jnp.float32(-0.2), jnp.float32(0.0))

    def step(params: Sideways, state: tuple[()], obs: Observation) -> Any:
        return state, twist, rps_jax.Details.from_obs(obs)

    law = rps_jax.Law(lambda params: (), step)
    rps_jax.register_law("sideways", law, Sideways())
    far = [[[x, y + 5.5] for x, y in triangle] for triangle in rows[::2]]  # as many walls as before
    task = {"outline": outline, "start": [0, 0, 0], "goal": [8, 0]}
    cases = [
        Case("box", law="sideways", task=task | {"polygons": polygons}, skin="ideal")
        for polygons in (rows, rows[:20] + far)
    ]
    outcome, _ = pushes.run(cases, setting_of(30.0))
    parsed = room(**task, polygons=rows)
    y, further = outcome.base_pose[:, 1]
    reach = parsed._near[1]
    assert reach is not None
    assert outcome.task["wall_touch"].tolist() == [1, 0]
    assert further < -5
    assert y == pytest.approx(0.46 - reach[0], abs=0.2)


@pytest.mark.slow
def test_a_sweep_of_rooms_is_stored_and_replayed(tmp_path):
    path = files.write_json(
        tmp_path / "map.json", HALL | {"polygons": DOOR, "scale": [1.0, 1.4], "object_radius": 0.1}
    )
    out = tmp_path / "run"
    options = f"--domain {DOMAIN} --engine quasistatic --horizon 40 --laws rps --worlds 4"
    assert rps(f"sweep --task {path} {options} --out {out}") == 0
    path.unlink()  # the run has its own walls
    results = rps_jax.load(out)
    assert results.scale.values.max() > 1
    assert rps_jax.replay(out, 0).data.outcome_wall_touch == results.wall_touch[0, 0]


# --- bad input -----------------------------------------------------------------------------------

SQUARE = [[4, 1], [5, 1], [5, 3], [4, 3]]
OVERLAP = [[[3, 0.5], [7, 0.5], [7, 3.5], [3, 3.5]], [[3.2, 0.6], [6.8, 0.6], [7.2, 3.4], [3.2, 3]]]
ROS = {"image": "room.png", "resolution": 0.125, "start": [1, 1, 0.3], "goal": [7, 2]}
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "empty": ({"kind": "rooms", "goal": [1, 1]}, "give polygons, an outline or a map.yaml"),
    "no goal": ({"polygons": [SQUARE]}, "task goal = () is not allowed: give x and y"),
    "two points": (HALL | {"polygons": [[[4, 1], [5, 1]]]}, "three corners or more"),
    "closed two": (HALL | {"polygons": [[[4, 1], [5, 1], [4, 1]]]}, "three corners or more"),
    "crossing": (HALL | {"polygons": [[[4, 1], [5, 2], [5, 1], [4, 2]]]}, "cross or touch"),
    "touching": (
        HALL | {"polygons": [[[4, 1], [6, 1], [6, 3], [5, 1], [4, 3]]]},
        "cross or touch",
    ),
    "repeated": (HALL | {"polygons": [[[4, 1], [4, 1], [5, 2], [4, 2]]]}, "corners are repeated"),
    "nan": (HALL | {"polygons": [[[4, 1], [float("nan"), 1], [5, 2]]]}, "finite numbers"),
    "nan start": (HALL | {"start": [float("nan"), 2, 0]}, "task start = nan is not allowed"),
    "nan goal": (HALL | {"goal": [float("nan"), 2]}, "task goal = nan is not allowed"),
    "no yaw": (HALL | {"start": [1.5, 2]}, "write x, y, yaw"),
    "3-D goal": (HALL | {"goal": [[7, 2, 0], [1, 2, 0]]}, "write pairs of x, y"),
    "millimetres": (HALL | {"goal": [7000, 2000]}, "at most 1000 [m]"),
    "flat": (HALL | {"polygons": SQUARE}, "task polygon 0 = of shape (2,)"),
    "number": (HALL | {"polygons": 5}, "task polygon 0 = 5"),
    "text": (HALL | {"polygons": "square"}, "task polygon 0"),
    "start in polygon": (
        HALL | {"polygons": [SQUARE], "start": [4.5, 2, 0]},
        "task start = (4.5, 2.0, 0.0) is not allowed: it lies in an obstacle",
    ),
    "start at wall": (
        HALL | {"start": [0.2, 2, 0], "object_radius": 0.1},
        "the base touches a wall",
    ),
    "goal in polygon": (HALL | {"polygons": [SQUARE], "goal": [4.5, 2]}, "task goal = (4.5, 2.0)"),
    "goal outside": (HALL | {"goal": [12, 2]}, "it lies in an obstacle or outside of the room"),
    "both outside": (
        HALL | {"start": [20, 2, 0], "goal": [25, 2]},
        "task start = (20.0, 2.0, 0.0)",
    ),
    "overlap": (
        HALL | {"polygons": OVERLAP, "start": [4.5, 2, 0], "goal": [5.5, 2], "base_radius": 0.3},
        "task start = (4.5, 2.0, 0.0) is not allowed: it lies in an obstacle",
    ),
    "goal in an overlap": (HALL | {"polygons": OVERLAP, "goal": [5.5, 2]}, "task goal = (5.5, 2"),
    "degrees": (
        HALL | {"start": [1.5, 2, 90]},
        "yaw of task start = 90 is not allowed: it is beyond 2 pi",
    ),
    "degrees of a map": (ROS | {"origin": [0, 0, 180]}, "yaw of task origin = 180 is"),
    "an outline of an image": (
        ROS | {"outline": [[0, 0], [9, 0], [9, 6], [0, 6]]},
        "the image defines the outline",
    ),
    "many polygons": (HALL | {"polygons": [SQUARE] * 20_000}, "at most 4096 are allowed"),
    "many corners": (
        HALL | {"polygons": [[[4 + np.cos(x), np.sin(x)] for x in np.linspace(0, 6.28, 20_000)]]},
        "at most 4096 are allowed",
    ),
    "goal at wall": (HALL | {"goal": [8.8, 2]}, "and one is 0.20 m away"),
    "goal at start": (HALL | {"goal": [1.5, 2]}, "the base starts there"),
    "unreachable": (HALL | {"polygons": [[[4, 0], [5, 0], [5, 4], [4, 4]]]}, "no path leads there"),
    "narrow": (
        HALL | {"polygons": [[[4, 0], [5, 0], [5, 3.5], [4, 3.5]]]},
        "no path leads there from (1.5, 2.0, 0.0): give a goal in the same room, smaller",
    ),
    "narrow base": (HALL | {"base_radius": 0.2}, "half of the base's width"),
    "many": (
        HALL | {"outline": [[9 * np.cos(x), 9 * np.sin(x)] for x in np.linspace(0, 6.28, 5000)]},
        "at most 4096 are allowed: give a larger tolerance",
    ),
    "typo": (HALL | {"polygon": []}, "did you mean 'polygons'?"),
    "drawn turns": (HALL | {"turns": 2}, "task quantity of rooms"),
    "waypoints": (
        HALL | {"waypoints": [[0, 0], [1, 1]], "kind": "rooms"},
        "task quantity of rooms",
    ),
    "no resolution": (
        {"image": "room.png", "start": [1, 1, 0], "goal": [7, 2]},
        "task resolution = None is not allowed: it must be a number and at least 0.001 [m]",
    ),
    "zero resolution": (ROS | {"resolution": 0}, "task resolution = 0"),
    "text resolution": (ROS | {"resolution": "5 cm"}, "task resolution = 5 cm"),
    "no image": ({k: v for k, v in ROS.items() if k != "image"}, "an image cannot be read"),
    "missing image": (ROS | {"image": "none.pgm"}, "none.pgm cannot be read"),
    "folder": (ROS | {"image": "."}, "it is no regular file"),
    "huge": (ROS | {"image": "huge.pgm"}, "at most 16 million pixels (Image size (1000000000"),
    "large": (
        ROS | {"image": "large.pgm"},
        "at most 16 million pixels (it has 5000 x 5000 pixels)",
    ),
    "cut": (ROS | {"image": "cut.pgm"}, "give a PGM, PNG or BMP file"),
    "no picture": (ROS | {"image": "map.json"}, "give a PGM, PNG or BMP file"),
    "large noise": (ROS | {"image": "specks.png", "start": [4, 4, 0]}, "specks=0.1"),
    "dense": (
        HALL | {"polygons": [[[x, 3.3], [x + 0.03, 3.3], [x, 3.4]] for x in np.arange(3, 6, 0.05)]},
        "task walls = 188 is not allowed: the 128 nearest to the path reach 1.3",
    ),
    "specks": (ROS | {"specks": 20}, "task specks = 20 is not allowed: it must"),
    "crop": (ROS | {"crop": [1, 2]}, "task crop"),
    "crop without the start": (ROS | {"crop": [2, 0, 8, 6]}, "outside of the image"),
    "tolerance beyond the room": (
        ROS | {"tolerance": 50},
        "outside of the room (of an image, try a smaller tolerance)",
    ),
    "noise": (
        ROS | {"image": "noise.png", "start": [4, 4, 0]},
        "at most 4096 are allowed: give a larger tolerance",
    ),
    "scale": (ROS | {"mode": "scale"}, "task mode = scale is not allowed: give one of ['trinary']"),
    "negate": (ROS | {"negate": 2}, "task negate = 2"),
    "origin": (ROS | {"origin": [0, 0]}, "task origin"),
    "threshold": (ROS | {"free_thresh": 25}, "task free_thresh = 25"),
    "tolerance": (ROS | {"tolerance": -1}, "task tolerance = -1"),
    "start off image": (ROS | {"start": [-3, 1, 0]}, "outside of the image"),
    "start unknown": (ROS | {"start": [7, 5, 0]}, "in unknown cells"),
    "goal off image": (ROS | {"goal": [20, 1]}, "a goal in the same room"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of good and bad images."""
    path = tmp_path_factory.mktemp("maps")
    Image.fromarray(GREY).save(path / "room.png")
    noise = default_rng(0).uniform(size=(250, 250)) < 0.9
    specks = default_rng(0).uniform(size=(2000, 2000)) < 0.9
    for name, cells_ in (("specks", specks), ("noise", noise)):
        Image.fromarray(np.where(cells_, 255, 0).astype(np.uint8)).save(path / f"{name}.png")
    for name, size in (("huge", "40000 25000"), ("large", "5000 5000"), ("cut", "50 50")):
        (path / f"{name}.pgm").write_bytes(f"P5\n{size}\n255\n".encode() + b"0" * 100)
    return path


@pytest.mark.parametrize("name", BAD)
def test_bad_maps_are_one_sentence(name, folder, capsys, recwarn):
    fields, message = BAD[name]
    start = time.perf_counter()
    path = files.write_json(folder / "map.json", fields)
    assert message in refusal(capsys, f"push --task {path}")
    assert message in refusal(capsys, f"sweep --domain {DOMAIN} --task rooms,{path}")
    assert not [x for x in recwarn if "Decompression" in str(x.category)]
    assert time.perf_counter() - start < 15  # 2 s for a noisy map on a quiet processor


YAML = {
    "": "map.yaml is no YAML mapping (it holds no names with values): write name: value",
    "# nothing\n": "map.yaml is no YAML mapping (it holds no names with values)",
    "image: room.png\nresolution: [0.1\n": "is no YAML mapping",
    "- image\n- resolution\n": "is no YAML mapping",
    "\x00": "is no YAML mapping",
    "image: room.png\n": "task resolution = None",
    "image: none.png\nresolution: 0.05\norigin: [0, 0, 0]\n": "none.png cannot be read",
    "image: room.png\nresolution: .nan\n": "task resolution = nan",
}


@pytest.mark.parametrize("text", YAML)
def test_bad_yaml_is_one_sentence(text, folder, capsys):
    (folder / "map.yaml").write_text(text)
    assert YAML[text] in refusal(capsys, f"push --task {folder}/map.yaml,goal=2:2")


def test_a_task_without_a_map_is_refused_and_types_are_checked(capsys):
    assert "give polygons, an outline or a map.yaml" in refusal(capsys, "push --task rooms")
    for walls in (((0.0, 0.0),), ((0.0,), (1.0,))):
        with refusing("task walls"):
            Rooms(walls=walls, goal=((1.0, 1.0),))  # pyright: ignore[reportArgumentType]
    task = Rooms(walls=[*map(list, room().walls)], start=[ROOM["start"]], goal=[ROOM["goal"]])  # pyright: ignore[reportArgumentType]
    assert task.shape == room().shape
    assert dataclasses.replace(room(), object_radius=0.1).object_radius == 0.1


def test_a_report_leaves_out_the_coordinates_of_walls():
    domain = parse_domain("wide", task=room())
    words = task_in_words(domain)
    assert words.startswith(", task rooms,walls=...,start=")
    assert str(domain.task).count(":") > 16 > words.count(":")
    assert tasks.parse_task(str(domain.task)) == domain.task
