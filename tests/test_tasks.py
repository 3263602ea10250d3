"""Tests of tasks: paths, corridors and their geometry, against shapely."""

import itertools
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jitted, refusing, setting_of
from numpy.random import default_rng
from shapely import LineString, Point, Polygon
from shapely.affinity import translate

import rps_jax
from rps_jax.errors import InputError
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import polyline
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.polyline import Polyline
from rps_jax.runs.push import Push
from rps_jax.spec import Spec
from rps_jax.world import draws, tasks
from rps_jax.world.domain import Range, parse_domain
from rps_jax.world.tasks import corridor, path
from rps_jax.world.tasks.base import Aim, CourseInputs, Positions, Task
from rps_jax.world.tasks.path import Path

clearance, nearest, nearest_on_wall, at_arc = map(
    jitted, (polyline.clearance, polyline.nearest, polyline.nearest_on_wall, polyline.at_arc)
)
place, object_pose = jitted(fp.place), jitted(rps_jax.trials.trial.object_pose)
BRIEF = setting_of(40.0)


def random_walls(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return walls (count, 2, 2) [m] about the origin."""
    return rng.uniform(-1.5, 1.5, (count, 2, 2))


def outlines(rng: np.random.Generator) -> list[tuple[Footprint, Any]]:
    """Return a circle, a rectangle and a polygon with a repeated corner, and shapely's of each."""
    circle = Footprint(jnp.array([[0.1, -0.2]]), jnp.asarray(0.3))
    corners = np.array([[0.5, 0.3], [-0.4, 0.4], [-0.5, -0.2], [0.3, -0.5], [0.3, -0.5]])
    shapes = [(circle, Point(0.1, -0.2).buffer(0.3, quad_segs=2000))]
    turned = fp.place(fp.rectangle(0.4, 0.2), jnp.asarray(rng.uniform(-0.3, 0.3, 2)), 0.7)
    for vertices in (np.asarray(turned.vertices), corners):
        shapes.append((Footprint(jnp.asarray(vertices), jnp.zeros(())), Polygon(vertices)))
    return shapes


def test_the_clearance_from_walls_is_exact():
    rng = default_rng(0)
    crossings = 0
    for outline, shape in outlines(rng):
        for _ in range(60):
            walls = random_walls(rng, 3)
            distance_found, wall = clearance(outline, walls)
            point = nearest_on_wall(outline, walls[wall])
            lines = [LineString(wall) for wall in walls]
            distance = min(shape.distance(line) for line in lines)
            crosses = any(shape.intersects(line) for line in lines)
            crossings += crosses
            assert (distance_found <= 1e-6) == crosses
            if not crosses:
                assert distance_found == pytest.approx(distance, abs=2e-6)
                assert shape.distance(Point(point)) == pytest.approx(distance, abs=2e-6)
            assert lines[wall].distance(Point(point)) < 1e-6
    assert 30 < crossings < 150


def test_the_way_out_of_a_wall_ends_its_crossing():
    rng = default_rng(1)
    _, (outline, shape), _ = outlines(rng)
    inside = 0
    for _ in range(40):
        walls = random_walls(rng, 1)
        depth, _ = clearance(outline, walls)
        if depth < -1e-3:
            inside += 1
            turns, wall = np.linspace(0, 2 * np.pi, 181), LineString(walls[0])

            def crosses(share: float, a: float, way: Any = -depth, wall: Any = wall) -> bool:
                moved = translate(shape, share * way * np.cos(a), share * way * np.sin(a))
                return moved.intersects(wall)

            assert not all(crosses(1.01, a) for a in turns)
            assert all(crosses(0.98, a) for a in turns)
    assert inside > 5


def test_points_of_a_path_are_shapelys():
    rng = default_rng(2)
    for vertices in np.cumsum(rng.normal(size=(30, 6, 2)), axis=1):
        line, whole = Polyline.through(vertices), LineString(vertices)
        assert line.arcs[-1] == pytest.approx(whole.length)
        point = rng.normal(size=2)
        arc, distance = nearest(line, point, 0.0, 100.0)
        assert distance == pytest.approx(whole.distance(Point(point)), abs=1e-5)
        assert at_arc(line, arc) == pytest.approx(
            np.ravel(whole.interpolate(float(arc)).coords), abs=1e-5
        )
        start, _ = nearest(line, vertices[-1], 0.0, 0.5)
        assert 0 <= start <= 0.5


def drawn(task: str, count: int = 200, domain: str = "wide,objects=random_box") -> draws.Draw:
    """Return worlds of a task."""
    return draws.draw(parse_domain(domain, task=task), 3, np.arange(count))


def test_drawn_paths_start_at_the_front_and_never_turn_back():
    worlds = drawn("path,turns=0:4,turn_angle=0.2:1.2,length=4:8")
    steps = np.diff(worlds.course.line.vertices, axis=1)
    headings = np.arctan2(steps[..., 1], steps[..., 0])
    shown = np.linalg.norm(steps, axis=2) > 0
    assert (np.abs(headings) <= np.pi / 2 + 1e-9).all()
    assert (headings[:, 0] == 0).all()
    turns = shown.sum(axis=1) - 1
    assert set(turns) == {0, 1, 2, 3, 4}
    assert worlds.course.line.vertices[:, 0] == pytest.approx(
        np.stack([worlds.robot.half_length, np.zeros(200)], axis=1)
    )
    assert worlds.p_world_target == pytest.approx(worlds.course.line.vertices[:, -1])
    lengths = worlds.course.line.arcs[:, -1]
    assert ((lengths > 4 - 1e-9) & (lengths < 9.5)).all()
    two = draws.draw(parse_domain("wide,objects=random_box", task="path"), 3, np.array([5, 7]))
    again = drawn("path")
    assert (two.course.line.vertices == again.course.line.vertices[[5, 7]]).all()


def test_walls_are_at_half_the_width():
    worlds = drawn("corridor,width=1.5,turns=1", 40)
    for vertices, walls in zip(worlds.course.path.line.vertices, worlds.course.walls, strict=True):
        whole = LineString(vertices)
        sides = [LineString(wall) for wall in walls]
        assert min(side.distance(whole) for side in sides) == pytest.approx(0.75, abs=1e-9)
        assert not any(side.intersects(whole) for side in sides)
        inner = sides[2].interpolate(0.5, normalized=True)
        assert whole.distance(inner) == pytest.approx(0.75, abs=0.2)


def test_doors_leave_an_opening():
    worlds = drawn("corridor,width=1.6,doors=2,door_width=0.75,turns=0", 5)
    for vertices, walls in zip(worlds.course.path.line.vertices, worlds.course.walls, strict=True):
        whole, doors = LineString(vertices), [LineString(wall) for wall in walls[-4:]]
        assert [door.distance(whole) for door in doors] == pytest.approx([0.6] * 4)


def positions_at(contact: tuple[float, float], touches: bool = True) -> Positions:
    """Return positions with a contact point, and a base and an object about the origin."""
    return Positions(
        jnp.zeros(2),
        jnp.array(contact),
        jnp.asarray(touches),
        jnp.zeros(3),
        fp.rectangle(0.3, 0.2),
        jnp.array([0.8, 0.0]),
        0.0,
        fp.rectangle(0.2, 0.2),
    )


def test_cross_track_errors_are_those_of_the_contact_points():
    line = Polyline.through(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]))
    course = path.PathCourse(jax.tree.map(jnp.asarray, line), jnp.asarray(0.5))
    rng = default_rng(4)
    errors = np.abs(rng.normal(0, 0.08, 400))
    progress, step = course.start(), jax.jit(course.step)
    for x, y in zip(np.linspace(0, 3, 400), errors, strict=True):
        progress, aim = step(progress, positions_at((x, y)))
        assert aim.p_world_target == pytest.approx([min(x + 0.5, 4), max(x - 3.5, 0)], abs=1e-5)
        assert not aim.at_end
    progress, _ = step(progress, positions_at((0.0, 3.0), touches=False))
    outcomes = progress.outcomes()
    assert outcomes["error_mean"] == pytest.approx(errors.mean(), rel=1e-4)
    assert outcomes["error_max"] == pytest.approx(errors.max(), rel=1e-5)
    assert outcomes["error_95"] == pytest.approx(np.quantile(errors, 0.95), rel=0.15)
    assert outcomes["progress"] == pytest.approx(3 / 8, abs=1e-5)
    _, aim = step(progress._replace(arc=jnp.asarray(7.8)), positions_at((4.0, 3.9)))
    assert aim.at_end
    assert aim.p_world_target == pytest.approx([4.0, 4.0], abs=1e-5)
    untouched = course.start().outcomes()
    assert np.isnan(untouched["error_mean"])
    assert untouched["progress"] == 0


def test_a_straight_path_with_a_long_lookahead_is_a_target():
    options = {"skin": "ideal", "setting": BRIEF}
    reach = rps_jax.push("cylinder", target=(2.0, 0.5), **options)
    task = "path,waypoints=0.3625:0:2:0.5,lookahead=5"
    along = Path(waypoints=((0.3625, 0.0), (2.0, 0.5)), lookahead=Range(5, 5))
    assert tasks.parse_task(task) == along
    # As many points as in the next test, which shares the program.
    straight = np.linspace(*along.waypoints, 5).tolist()
    followed = rps_jax.push("cylinder", task=replace(along, waypoints=straight), **options)
    for name in ("qpos", "v_x", "omega"):
        assert followed.data[name].values == pytest.approx(reach.data[name].values, abs=2e-3)
    assert followed.outcome.task["progress"] > 0.9


def test_the_end_of_a_path_that_is_passed_early_is_not_called_near():
    points = [[0.3625, 0], [1.5, 0], [1.5, 1], [0.5, 1], [0.5, 0.05]]
    task = {"waypoints": points, "lookahead": 5}
    trace = rps_jax.push("cylinder", task=task, skin="ideal", setting=BRIEF)
    least, share = float(trace.outcome.min_distance), 100 * trace.outcome.task["progress"]
    assert least < 0.25
    assert share < 50
    assert f"least distance {least:.3f} m, " in trace.summary
    assert trace.summary.endswith(f", {share:.0f} % of the path passed")
    trials = trace.data.drop_vars(["outcome_touch_x"], errors="ignore")
    assert trials.outcome_progress < 0.5


@pytest.mark.slow
def test_walls_change_nothing_until_they_are_touched():
    domain = parse_domain("wide,objects=random_box")
    wide, narrow, free = (
        rps_jax.sweep("rps", domain, task=task, worlds=8, setting=BRIEF)
        for task in (
            "corridor,width=19,turns=0",
            "corridor,width=1.42",
            "path,turns=0,lookahead=0.6",
        )
    )
    for name in ("time", "path_length", "error_mean", "success"):
        assert wide[name].values == pytest.approx(free[name].values, rel=1e-3, abs=1e-3)
    assert (wide.wall_touch == 0).all()
    assert wide.clearance.values == pytest.approx(wide.clearance.values.clip(7, 9.5))
    touched = narrow.wall_touch.values > 0
    assert touched.any()
    assert (narrow.success.values[touched] == 0).all()
    assert (narrow.clearance.values[touched] <= 0).all()
    assert np.isfinite(narrow.touch_x.values[touched]).all()
    assert np.isnan(narrow.touch_x.values[~touched]).all()


def test_a_trial_ends_at_the_first_touch_of_the_exact_outlines():
    task = "corridor,width=0.62,turns=1,turn_angle=1.2,length=2,lookahead=1.2"
    trace = rps_jax.push("box", task=task, skin="ideal", setting=setting_of(90.0, "mujoco"))
    data, world = trace.data, trace.world
    walls = [LineString(x) for x in data.walls.values]
    half = float(data.half_length), float(data.half_width)
    assert data.outcome_wall_touch in (corridor.BASE, corridor.OBJECT)

    def crosses(i: int) -> bool:
        x, y, yaw = data.qpos.values[i, :3]
        base = place(fp.rectangle(*half), np.array([x, y]), yaw)
        item = place(world.footprint, *object_pose(data.qpos.values[i]))
        shapes = Polygon(np.asarray(base.vertices)), Polygon(np.asarray(item.vertices))
        return any(shape.intersects(wall) for shape in shapes for wall in walls)

    assert not any(crosses(i) for i in range(0, data.sizes["time"] - 1, 20))
    point = Point(float(data.outcome_touch_x), float(data.outcome_touch_y))
    assert min(wall.distance(point) for wall in walls) < 1e-5


class Timer(NamedTuple):
    """Course and progress of a task that fails after ten control steps."""

    count: Any = 0.0

    def start(self) -> "Timer":
        return Timer(jnp.zeros(()))

    def step(self, progress: "Timer", positions: Positions) -> tuple["Timer", Aim]:
        later = Timer(progress.count + 1.0)
        return later, Aim(positions.p_world_goal, failed=later.count >= 10)

    def outcomes(self) -> dict[str, Any]:
        return {"count": self.count}

    def lines(self) -> dict[str, np.ndarray]:
        return {}


@dataclass(frozen=True)
class Timed(Task):
    """A task that is not in the package."""

    kind: str = "timed"
    HAS_TARGET: ClassVar[bool] = True
    OUTCOMES: ClassVar[dict[str, Spec]] = {"count": Spec("1", "control steps")}

    def courses(self, inputs: CourseInputs) -> tuple[np.ndarray, Timer]:
        return inputs.p_world_target, Timer(np.zeros(inputs.front.size))


def test_a_task_is_one_declaration(registries):
    rps_jax.register_task(Timed)
    domain = replace(parse_domain("wide,objects=random_cylinder"), task=Timed())
    results = rps_jax.sweep("rps", domain, worlds=3, setting=setting_of(1.0, "mujoco"))
    assert results["count"].values.tolist() == [[10, 10, 10]]
    assert not results.success.any()
    assert results["count"].attrs["long_name"] == "control steps"


REFUSED = {
    "hall": "unknown task 'hall'",
    "path,width=2": "task quantity of path",
    "path,lookahead=0": "task lookahead (low) = 0",
    "path,length=6:3": "task length = 6 to 3",
    "corridor,width=0.5": "task width (low) = 0.5 m is not allowed",
    "corridor,doors=1,door_width=0.3": "task width (low)",
    "corridor,doors=9": "task doors = 9",
    "corridor,width=3,turns=4": "task width (high)",
    "path,spline=true": "task spline",
    "path,waypoints=0.4:0:2:1,length=5:9": "length = 5 to 9 is not allowed: its waypoints",
    "path,turns=0,turn_angle=0.1": "no turn_angle to draw",
    "corridor,door_width=0.7": "without doors leaves no door_width to draw",
}


@pytest.mark.parametrize("task", REFUSED)
def test_bad_tasks_are_refused(task):
    with pytest.raises(InputError) as error:
        parse_domain("wide", task=task)
    assert REFUSED[task].lower() in str(error.value).lower()
    with pytest.raises(InputError):
        Push(task=task).validate()


def strips(points: np.ndarray, half: float) -> list[Polygon]:
    """Return the parts of a corridor about each two segments, with the walls before and after."""
    steps = np.diff(points, axis=0)
    units = steps / np.linalg.norm(steps, axis=1)[:, None]
    ends = [points[0] - 1.5 * units[0], *points[1:-1], points[-1] + 1.5 * units[-1]]
    shape = {"cap_style": "flat", "join_style": "mitre", "mitre_limit": 1e4}
    return [LineString(ends[i : i + 3]).buffer(half, **shape) for i in range(len(ends) - 2)]


def test_a_corridor_is_accepted_exactly_if_its_walls_leave_its_width():
    """Of random paths; in a refused one, parts that do not follow each other overlap."""
    rng, counts = default_rng(1), {True: 0, False: 0}
    one = np.zeros(1)
    u = {"width": one, "door_width": one, "lookahead": one}
    while min(counts.values()) < 50:
        bends = rng.uniform(-1.9, 1.9, rng.integers(1, 7)).cumsum()
        steps = rng.uniform(1, 4, bends.size + 1) * np.exp(1j * np.append(0, bends))
        points = (0.4 + np.append(0, steps.cumsum())).view(float).reshape(-1, 2)
        half, doors = rng.uniform(0.35, 1.0), int(rng.integers(0, 2))
        fields = {"kind": "corridor", "waypoints": points.tolist(), "width": 2 * half}
        try:
            task = tasks.parse_task(fields | ({"doors": 1, "door_width": 1.0} if doors else {}))
            walls = task.courses(CourseInputs(u, np.zeros((1, 2)), one))[1].walls[0]
            walls = walls[: len(walls) - 2 * doors]
            away = min(LineString(points).distance(LineString(wall)) for wall in walls)
            assert away > half * (1 - 1e-4)
        except InputError as error:
            if "walls of another part of the corridor" not in str(error):
                continue  # too long for its corners
            parts = strips(points, half)
            lines = [LineString(x) for x in itertools.pairwise(points)]
            others = (
                part.intersection(line.buffer(1.5 * half, cap_style="flat")).area
                for i, part in enumerate(parts)
                for j, line in enumerate(lines)
                if j not in (i, i + 1)
            )
            assert max(others) > 0
            counts[False] += 1
        else:
            counts[True] += 1


@pytest.mark.parametrize(
    "waypoints",
    [
        [[0.4, 0], [4, 0], [4, 3], [2, 3], [2, -3]],  # it crosses itself
        [[0.4, 0], [4, 0], [4, 3], [-0.8, 3], [-0.8, 0.8]],  # it ends in the walls behind
        [[0.4, 0], [4, 0], [4, 3], [2, 3], [2, 1]],  # the walls beyond its end cross it
    ],
)
def test_a_corridor_that_meets_itself_is_refused(waypoints):
    fields = {"waypoints": waypoints, "kind": "corridor", "width": 1.4}
    with refusing("walls of another part of the corridor are"):
        tasks.parse_task(fields)
    assert isinstance(tasks.parse_task({"waypoints": waypoints, "kind": "path"}), Path)


def test_walls_of_drawn_corridors_leave_their_width():
    ranges = "width=1.1:1.5,turns=1:6,turn_angle=0.2:1.5,length=10:30,doors=3,door_width=1"
    lines = drawn(f"corridor,{ranges}", 400).course.lines()
    for vertices, walls in zip(lines["path"], lines["walls"], strict=True):
        line, sides = vertices @ (1, 1j), (walls @ (1, 1j))[:-6]
        half = polyline.distances(*sides[:1].T[..., None], line[:1], line[1:2]).min()
        away = polyline.distances(*sides.T[..., None], line[:-1], line[1:])
        assert away.min() > half * (1 - 1e-6)


def test_a_failure_says_who_touched_a_wall():
    words = [tasks.failures_of({"wall_touch": np.float32(value)}) for value in (0, 1, 2)]
    assert words == [[], ["the base touched a wall"], ["the object touched a wall"]]


def test_a_path_must_start_at_the_base():
    far = tasks.parse_task({"kind": "path", "waypoints": [(3.0, 0.0), (4.0, 0.0)]})
    with refusing(r"must start within 0.5 m of the base's front"):
        rps_jax.push("box", task=far, setting=BRIEF)


def test_a_task_with_its_own_end_takes_no_target():
    with refusing("has its own end"):
        rps_jax.push("box", task="path", target=(1.0, 1.0), setting=BRIEF)
    assert parse_domain("paper", task="path").targets == ()
