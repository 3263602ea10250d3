"""Plan pushes to a pose: exact derivatives beside differences and samples.

A plan of ten twists brings an object to a pose that a random plan reaches. Methods with exact
derivatives of the engine and methods that sample rollouts get the same processor time. A second
table repeats the planning during the push, with a model that knows the shape of the object alone.

    rps sweeps/planning --quick
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Domain, Range, Setting, draw_worlds
from rps_jax.analysis.figures.style import Figure, base_patch, tiles, words
from rps_jax.physics import PHYSICS, EngineName, Motion, get_engine
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.trials.trial import World, object_pose
from rps_jax.worlds import parse_domain
from sweeps.planning import plans
from sweeps.planning.plans import KNOTS, METHODS, Method, Problem, Simulator, Start
from sweeps.study_base import RANDOM_OBJECTS, QuickStudy, Rows, Table

TOUCHING = replace(parse_domain("wide"), gap=Range(0, 0))
# All that the model of the second table does not know has one value.
_NOMINAL = {
    "com_offset": Range(0, 0),
    "friction_ground": Range(0.4, 0.4),
    "friction_robot": Range(0.4, 0.4),
    "mass": Range(15, 15),
}
_REPLANNED = {
    "gauss_newton": (8, 2),
    "mppi": (3, 1),
}  # iterations before and at each knot, of equal time
_DRAWN = 3  # pushes of each object in the figure
_CORNERS = 40  # points of an outline


@dataclass(frozen=True)
class Planning(QuickStudy[xr.Dataset]):
    """Plan pushes to a pose with exact derivatives, differences or samples.

    The answer has, by case (an object and a duration), method and processor time, the share of
    `solved` pushes and the `rollouts` of each push. With a model that knows the shape alone, `once`
    (case, push) and `replanned` (case, method, push) are 1 if a push ends at its target.
    """

    TITLE = "Plans of pushes to a pose"
    QUICK: ClassVar = {"objects": ("random_box",), "horizons": (5.0,), "pushes": 8, "budget": 0.02}
    CHOICES: ClassVar = {"objects": RANDOM_OBJECTS, "methods": METHODS}
    DIMENSION = "case"
    PRESETS: ClassVar = {"physics": PHYSICS["default"]}

    objects: tuple[str, ...] = RANDOM_OBJECTS
    """Objects to push: random_box, random_cylinder and random_prism."""
    horizons: tuple[float, ...] = option((5.0, 20.0), 0.2, 60, unit="s")
    """Durations of the pushes [s]."""
    methods: tuple[str, ...] = tuple(METHODS)
    """gauss_newton (exact derivatives of the three errors), differences (the same with forward
    differences), adam (exact gradient), cma (CMA-ES) or mppi; by default all."""
    pushes: int = option(64, 1, 100_000)
    """Number of pushes of each case."""
    budget: float = option(0.08, above=0, at_most=100, unit="s")
    """Processor time of a method for each push [s]."""
    engine: EngineName = "fused"
    """Engine of the pushes, with derivatives in reverse mode."""
    seed: int = option(3, 0, 2**32 - 1)
    """Seed of the worlds and of the targets."""

    def check(self) -> None:
        """Check the names, and that the engine has derivatives."""
        super().check()
        get_engine(self.engine).check_derivatives("reverse")

    def parts(self, run: Run) -> Mapping[str, Any]:
        """Return the function that computes each case."""
        return {
            f"{name}, {horizon:g} s": partial(self._case, name, horizon)
            for name, horizon in itertools.product(self.objects, self.horizons)
        }

    def _case(self, name: str, horizon: float) -> xr.Dataset:
        """Run all methods in the pushes of one object and one horizon."""
        physics = Setting(self.engine).physics
        hold = max(1, round(horizon / KNOTS / physics.control_period))
        worlds, stage = worlds_of(TOUCHING, name, self.pushes, self.seed, self.engine)
        simulator = Simulator(stage, physics, hold)
        start = still(worlds)
        target = reached(simulator, worlds.fields, start, self.seed)
        problem = Problem(simulator, worlds.fields, start, target)
        curves, best = zip(
            *(race(METHODS[name], problem, self.budget) for name in self.methods), strict=True
        )
        nominal = replace(TOUCHING, **_NOMINAL)
        model = worlds_of(nominal, name, self.pushes, self.seed, self.engine)[0].fields
        closed = {x: replan(x, problem, model) for x in self.methods if x in _REPLANNED}
        nothing = np.full(self.pushes, np.nan), np.nan
        replanned = [closed.get(method, nothing) for method in self.methods]
        once = predicted(problem, model)
        return xr.Dataset(
            {
                "solved": (("planner", "time"), np.array([x for x, _ in curves])),
                "rollouts": (("planner", "time"), np.array([x for _, x in curves])),
                "replanned": (("planner", "push"), np.array([x for x, _ in replanned])),
                "replan_time": ("planner", [x for _, x in replanned]),
                "once": ("push", once),
                "qpos": (("knot", "drawn", "coordinate"), path(problem, best[0])[:, :_DRAWN]),
                "outline": (("drawn", "corner", "axis"), outlines(worlds)[:_DRAWN]),
                "target": (("drawn", "pose"), np.asarray(target)[:_DRAWN]),
                "object": name,
                "horizon": horizon,
            },
            {"planner": list(self.methods), "time": self.budget * 2.0 ** np.arange(-4, 1)},
        )

    def intro(self, results: xr.Dataset) -> str:
        """Describe the pushes."""
        return (
            f"{self.pushes} pushes of each object. A push is solved if the object ends within 5 mm "
            "and 2 degrees of a pose that a random plan reaches."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return shares of solved pushes by processor time, and those of repeated planning."""
        picture = Picture("pushes", partial(figure_of, results))
        return [
            Table(plan_rows(results), _NOTE, name="plans", title="One plan", picture=picture),
            Table(replan_rows(results), name="replans", title="Repeated planning"),
        ]


planning = call_of(Planning)


_NOTE = "Times are processor time of each push, without compilation."


def worlds_of(
    domain: Domain, name: str, count: int, seed: int, engine: EngineName
) -> tuple[World, Any]:
    """Return the first worlds (count, ...) of one object, and their stage."""
    domain = replace(domain, objects=(name,))
    part = draw_worlds(domain, count, setting=Setting(engine, seed=seed))
    worlds = jax.tree.map(lambda x: jnp.asarray(x, float), part.worlds._replace(key=None))
    return worlds, part.stage


def still(worlds: World) -> Motion:
    """Return the motion of worlds (n, ...) at rest."""
    zero = jnp.zeros((len(worlds.qpos), 9))
    return Motion(worlds.qpos, zero, zero)


def reached(simulator: Simulator, fields: Any, start: Motion, seed: int) -> jax.Array:
    """Return the poses (n, 3) that random plans reach: forward, with a turn and noise."""
    random = np.random.default_rng(seed)
    noise = random.uniform(-1, 1, (len(start.qpos), KNOTS, 3))
    turn = random.normal(size=(len(noise), 1))
    entries = [0.6 + 0.4 * noise[..., 0], 0.4 * noise[..., 1], 0.6 * turn + 0.6 * noise[..., 2]]
    theta = np.arctanh(np.clip(np.stack(entries, axis=-1), -0.95, 0.95))
    first = jnp.zeros(len(theta), int)
    zero = jnp.zeros((len(theta), 3))
    errors = simulator.samples(
        Start(fields, start, zero, first), jnp.asarray(theta, float)[:, None]
    )
    return errors[:, 0] * plans.TOLERANCE


def race(method: Method, problem: Problem, budget: float) -> tuple[Any, np.ndarray]:
    """Return the shares of solved pushes and rollouts (2, 5) of a method, and its last plans.

    They are those after 1/16, 1/8, 1/4, 1/2 and all of the `budget` [s] of processor time of each
    push. A first run compiles.
    """
    count = len(problem.start.qpos)
    for _ in itertools.islice(method(problem, plans.straight(count)), 2):
        pass
    times, rows = [0.0], [(0.0, 0.0)]
    start_time, plan = time.process_time(), plans.straight(count)
    for theta, errors, rollouts in method(problem, plan):
        plan = theta
        times.append((time.process_time() - start_time) / count)
        if times[-1] > budget:
            break
        rows.append((float(plans.solved(errors).mean()), float(rollouts)))
    at = np.searchsorted(times[: len(rows)], budget * 2.0 ** np.arange(-4, 1), side="right") - 1
    return np.array(rows)[at].T, plan


def replan(method: str, problem: Problem, model: Any) -> tuple[np.ndarray, float]:
    """Return whether pushes end at their targets, and the processor time [s] of each push.

    Before each knot the method improves the rest of the plan from the true state, with the fields
    of a `model`; the knot is then executed in the true worlds.
    """
    first, later = _REPLANNED[method]
    count, motion, used = len(problem.start.qpos), problem.start, 0.0
    theta = plans.straight(count)
    for knot in range(KNOTS):
        start_time = time.process_time()
        planned = problem._replace(fields=model, start=motion, first=knot)
        theta = _improved(METHODS[method], planned, theta, later if knot else first)
        used += time.process_time() - start_time
        entries = jnp.asarray(theta[:, knot], float)
        motion = problem.simulator.knot(problem.fields, motion, entries)
    return _at_target(problem, motion), used / count


def predicted(problem: Problem, model: Any) -> np.ndarray:
    """Return whether pushes end at their targets with one plan of a `model`."""
    start = plans.straight(len(problem.start.qpos))
    theta = _improved(plans.gauss_newton, problem._replace(fields=model), start, 20)
    return plans.solved(problem.samples(theta[:, None])[:, 0]).astype(float)


def _improved(method: Method, problem: Problem, theta: np.ndarray, iterations: int) -> np.ndarray:
    """Return plans after some iterations of a method."""
    *_, (theta, _, _) = itertools.islice(method(problem, theta), iterations)
    return theta


def _at_target(problem: Problem, motion: Motion) -> np.ndarray:
    """Return 1 for pushes that end at their targets, 0 for the rest."""
    position, yaw = jax.vmap(object_pose)(motion.qpos)
    pose = jnp.concatenate([position, yaw[:, None]], axis=-1)
    return plans.solved(np.asarray(plans.errors_of(pose, problem.target))).astype(float)


def path(problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Return the positions (KNOTS + 1, n, 10) at the start and after each knot."""
    motions = [problem.start]
    for entries in jnp.moveaxis(jnp.asarray(theta, float), 1, 0):
        motions.append(problem.simulator.knot(problem.fields, motions[-1], entries))
    return np.stack([motion.qpos for motion in motions])


def outlines(worlds: World) -> np.ndarray:
    """Return points (n, _CORNERS, 2) [m] on the outlines of objects, in their frames."""
    vertices, radius = (np.asarray(x) for x in worlds.footprint)
    angle = np.linspace(0, 2 * np.pi, _CORNERS)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nearest = np.linspace(0, vertices.shape[1] - 1, _CORNERS).round().astype(int)
    return vertices[:, nearest] + radius[:, None, None] * ring


def plan_rows(results: xr.Dataset) -> Rows:
    """Return a header and a row for each case and method, with the best of each case."""
    times = [f"{1e3 * t:.0f} ms" for t in results.time.values]
    rows = [["object", "duration", "method", *times, "rollouts"]]
    for case in results.case.values:
        for method in results.planner.values:
            row = results.sel(case=case, planner=method)
            shares = [f"{100 * x:.0f} %" for x in row.solved.values]
            label = [words(str(row.object.values)), f"{float(row.horizon):g} s", words(str(method))]
            rows.append([*label, *shares, f"{float(row.rollouts[-1]):,.0f}"])
    return rows


def replan_rows(results: xr.Dataset) -> Rows:
    """Return a header and a row for each case: one plan, and repeated planning by two methods."""
    methods = [x for x in map(str, results.planner.values) if x in _REPLANNED]
    names = [f"repeated, {words(x)}" for x in methods]
    times = [f"time, {words(x)}" for x in methods]
    rows = [["object", "duration", "one plan", *names, *times]]
    for case in results.case.values:
        row = results.sel(case=case)
        shares = [row.once, *(row.replanned.sel(planner=x) for x in methods)]
        shares = [f"{100 * float(x.mean()):.0f} %" for x in shares]
        spent = [f"{1e3 * float(row.replan_time.sel(planner=x)):.0f} ms" for x in methods]
        label = [words(str(row.object.values)), f"{float(row.horizon):g} s"]
        rows.append([*label, *shares, *spent])
    return rows


def figure_of(results: xr.Dataset) -> Figure:
    """Draw some plans: outlines of the object along the way, its target, and the base's path."""
    longest = results.isel(case=results.horizon.values == results.horizon.values.max())
    size = longest.sizes["case"] * longest.sizes["drawn"]
    sheet, axes = tiles(size, longest.sizes["drawn"], (3.6, 3.0), (0.4, 0.4))
    pairs = itertools.product(range(longest.sizes["case"]), range(longest.sizes["drawn"]))
    for ax, (i, j) in zip(axes.ravel(), pairs, strict=False):
        push = longest.isel(case=i, drawn=j)
        outline = push.outline.values
        for k in range(0, KNOTS + 1, 2):
            q = push.qpos.values[k]
            pose = [*q[3:5], 2 * np.arctan2(q[9], q[6])]
            ax.plot(*_placed(outline, pose).T, color="C0", lw=1, alpha=0.25 + 0.075 * k)
        ax.plot(*_placed(outline, push.target.values).T, "k--", lw=1.2)
        for k, fill in ((0, False), (KNOTS, True)):
            patch = base_patch(push.qpos.values[k, :3], fill=fill)
            patch.set_alpha(0.5)
            ax.add_patch(patch)
        ax.plot(*push.qpos.values[:, :2].T, color="C1", marker=".", ms=4, lw=1)
        ax.set_aspect("equal")
        ax.autoscale_view()
        label = f"{words(str(push.object.values))}, {float(push.horizon):g} s"
        ax.set_title(label, fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("y [m]", fontsize=9)
    return sheet


def _placed(outline: np.ndarray, pose: Sequence[float]) -> np.ndarray:
    """Return an outline (N, 2) [m], closed, at a pose [m, m, rad]."""
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    world = outline @ np.array([[c, s], [-s, c]]) + [x, y]
    return np.vstack([world, world[:1]])
