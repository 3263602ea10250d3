"""Values and gradients of a score by parameters of laws and by quantities of random worlds.

The exact gradient of the score by the numbers of a world, from the engine, is chained with the
derivative of these numbers by a drawn quantity. Worlds are built on the host in double precision,
so that central differences give this derivative, and a new quantity needs no code here.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import PyTree

from rps_jax import errors
from rps_jax.control import registry, validation
from rps_jax.control.base import LawParams, Leaf, entries, named_leaves, unit_of_leaf
from rps_jax.control.observation import Details, Twist
from rps_jax.control.registry import LawsLike
from rps_jax.engines import device, native
from rps_jax.engines.base import Stage
from rps_jax.errors import InputError
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Bools, Float, Floats, Number
from rps_jax.record import cache, provenance
from rps_jax.record.files import Arrays
from rps_jax.record.options import check_arguments
from rps_jax.robot import base
from rps_jax.robot.robot import RobotLike
from rps_jax.robot.skin import Reading
from rps_jax.trials import trial
from rps_jax.trials.results import WORLD, labelled
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trajectory import control_loop, count_steps
from rps_jax.trials.trial import ControlLoop, Snapshot, Trial, World
from rps_jax.trials.worlds import drawn_worlds, rows, soften_skins
from rps_jax.tuning import gradients
from rps_jax.world import draws, points
from rps_jax.world.domain import (
    QUANTITIES,
    VELOCITY_ERRORS,
    Domain,
    DomainLike,
    name_or_custom,
    parse_domain,
    task_attribute,
    unit_of,
)
from rps_jax.world.draws import Draw
from rps_jax.world.tasks import TaskLike

Score = Callable[..., Any]  # of a trajectory (T, ...) of one world, and other arguments
ScoreLike = Score | Objective
Scored = tuple[Array, PyTree]  # scores, and auxiliary outputs
_STEP = 1e-6  # of differences, relative to a quantity
_SMALLEST = 0.01  # in its unit, below which the step is not relative
_NOISE = 1e-12  # relative change of a number of a world that is rounding
_TESTED = 4  # worlds of an object in which gradients are compared with secants
_MAX_BEND = 0.01  # [1] relative difference of one-sided derivatives beyond which there is none
_USELESS = (
    "Gradients do not predict the effect of a change by 1 % within 10 % in most of the tested "
    "worlds (see useful), so shorten the horizon:"
)
_VECTORS = {"target": "p_world_target", "com": "solid.p_object_com"}  # [m], leaves of a draw
_DISCRETE = ("corners", "sides", "feet_number", "object", "seed", "key_0", "key_1", "world")


class Coordinate(NamedTuple):
    """Scalar by which a score is differentiated."""

    label: str
    unit: str
    name: str  # of a drawn quantity or a vector, or of a leaf of the parameters
    entry: tuple[int, ...] = ()  # of a vector or a leaf
    is_parameter: bool = False

    @property
    def leaf_index(self) -> tuple[Any, ...]:
        """Index of the scalar in a batch of its leaf."""
        return (slice(None), *self.entry) if self.is_parameter else ()


@device.standard_jax()
def value_and_grad(
    score: ScoreLike = Objective(),
    laws: LawsLike = "rps_tuned",
    domain: DomainLike = "wide",
    worlds: int = 32,
    wrt: Sequence[str] | str = ("K_h", "friction_robot", "com", "target"),
    *,
    horizon: float = 2.0,
    smooth: bool = True,
    args: tuple[Any, ...] = (),
    has_aux: bool = False,
    states: bool = False,
    robot: RobotLike | None = None,
    task: TaskLike | None = None,
    setting: Setting = Setting(),
) -> Any:  # `Gradients`, or (`Gradients`, a pytree)
    """Compute a score and its exact gradient in each of several random worlds.

    Gradients are those of the engine's own equations, by the implicit function theorem at the
    solution of each physics step. Where contacts, cones or rules switch they are one-sided, and
    jumps of the score are not in them. Pushes are chaotic: with time fewer gradients predict the
    effect of a small change. `useful` is the share of some worlds in which they do. Law and skin
    have their smooth forms by default, so that what the law feels has derivatives.

    Args:
      score: function of the `Trajectory` (T, ...) of one trial and of `args`, which returns one
        number; or an objective, as of `tune_grad`: the time to the target, softened.
      laws: one law or several, as of `sweep`.
      domain: ranges from which worlds are drawn.
      worlds: number of worlds, of indices 0, 1, ...: those of `sweep` with this seed.
      wrt: names of parameters of the laws (`params.NAME` if a drawn quantity has this name; the
        name of a pytree, as `weights`, means all of its leaves), of quantities that the domain
        draws, and `target` and `com`, both x and y [m]: the centre of
        mass moves without its load, at constant inertia about it.
      horizon: duration of a trial [s].
      smooth: whether law and skin have their smooth forms.
      args: more arguments of the score, pytrees of arrays; other values compile nothing.
      has_aux: whether the score returns a pair: a number, and a pytree of arrays.
      states: whether the trajectory has the states after each step, with velocities, forces, and
        what law, skin, drive and task remember; takes longer.
      robot: its name, as kairos, or a JSON file; None: the domain's.
      task: its name, as path, with changes; None: the domain's. Paths need a function as `score`.
      setting: engine, physics, rules, and the seed of the worlds.

    Returns:
      `value` (law, world); `gradient` (law, world, quantity), with `unit` and `kind` of each
      quantity; `finite`, whether it is finite; its `norm` (law, world); `mean` and its standard
      `error` (law, quantity) over the worlds in which it is finite, NaN if there is none. `secant`
      (law, world, quantity) is the slope of the score along a change of the quantity by 1 % in the
      first worlds, and `useful` (law, quantity) the share of these in which the gradient is within
      10 % of it. `map_error` (quantity) bounds the relative error of the central differences by
      which worlds depend on a quantity. The
      attribute `notes`, also a warning, names quantities without influence, as the mass of what an
      ideal base pushes, and why. `check()` compares the gradients with central differences in
      double precision. With `has_aux` there is also the pytree, with leaves (law, world, ...).

    Raises:
      InputError: an argument is not allowed; the engine or a quantity has no derivatives.

    Examples:
      >>> import rps_jax
      >>> def final_distance(trajectory):  # [m]
      ...     return trajectory.details.distance[-1]
      >>> names = ("K_h", "friction_robot", "com", "target")
      >>> drums = "wide,objects=random_cylinder,gap=0:0"
      >>> inputs = (final_distance, "rps_tuned", drums, 8, names)
      >>> results = rps_jax.value_and_grad(*inputs, horizon=2.0)
      >>> results.gradient.sel(quantity="target_x").dims
      ('law', 'world')
    """
    inputs = dict(locals())
    device.check_eager("value_and_grad", inputs)
    check_arguments(value_and_grad, inputs)
    results, aux = _gradients(inputs)
    return (results, aux) if has_aux else results


def _gradients(
    inputs: Mapping[str, Any], change: float = 0.01, central: bool = False
) -> tuple[Gradients, PyTree]:
    """Return the answer of `value_and_grad`, and the auxiliary outputs (law, world, ...).

    Secants are those of a relative `change` of a quantity, one-sided or `central`.
    """
    i = SimpleNamespace(**inputs)
    device.check_process()
    ranges = parse_domain(i.domain, i.robot, i.task)
    setting = i.setting.with_robot(ranges.robot)
    chosen = registry.resolve_laws(i.laws)
    errors.check_count("worlds", i.worlds, at_most=1_000_000)
    steps, engine = count_steps(i.horizon, setting), setting.simulator
    engine.check_traced()
    engine.check_derivatives("reverse")
    setting.check_domain(ranges, chosen.values())
    loops = [control_loop(params, setting, smooth=i.smooth) for params in chosen.values()]
    coordinates, *others = (coordinates_of(i.wrt, x, ranges) for x in chosen.values())
    if any(x != coordinates for x in others):
        rule = "parameters of wrt must have the same shapes and units in all laws"
        raise errors.not_allowed("laws", ", ".join(chosen), rule)
    if isinstance(i.score, Objective):
        if not all(hasattr(p, "v_max") for p in chosen.values()):
            rule = "a law without a parameter v_max needs a function of the snapshots"
            raise errors.not_allowed("score", "an Objective", rule)
        ranges.task.check_target("task", ranges.task, "give a function as score")
    cache.use_cache_if_requested()
    index, labels = np.arange(i.worlds), [x.label for x in coordinates]
    value, bend = np.empty((len(chosen), i.worlds)), np.empty((i.worlds, len(labels)))
    gradient = np.empty((*value.shape, len(labels)))
    secant, size = np.full_like(gradient, np.nan), np.ones_like(gradient)
    aux = [list[PyTree]() for _ in chosen]
    options = _Options(i.score, steps, replace(setting, seed=0), i.has_aux, i.states)
    used, temperature, order = np.zeros(len(labels), bool), 0.0, list[np.ndarray]()
    for at, drawn in points.draw_by_object(ranges, setting.world_seed, None, index):
        family = drawn_worlds(ranges, drawn, setting)
        if i.smooth:
            family = family._replace(worlds=soften_skins(family.worlds))
            skin: Any = family.worlds.skin
            temperature = float(skin.temperature[0])
        slopes, bend[at] = world_slopes(ranges, drawn, setting, coordinates)
        used |= list(map(bool, slopes))
        names, first = set(itertools.chain(*slopes)), at[:_TESTED]
        order.append(at)
        for law, (params, loop) in enumerate(zip(chosen.values(), loops, strict=True)):
            trees = {"world": family.worlds, "params": family.with_params(params).params}
            leaves = {name: x for name, x in named_leaves(trees).items() if name in names}
            run = partial(_value_and_slopes, family.stage, loop=loop, options=options, args=i.args)
            (value[law, at], extra), by_leaf = jax.device_get(run(trees, leaves))
            aux[law].append(extra)
            for k, (x, slope) in enumerate(zip(coordinates, slopes, strict=True)):
                products = (y * by_leaf[name][x.leaf_index] for name, y in slope.items())
                gradient[law, at, k] = sum(y.reshape(at.size, -1).sum(axis=1) for y in products)
            size[law, first] = change * _sizes(coordinates, drawn, leaves)[: first.size]
            move = partial(_moved_scores, run, trees, leaves, coordinates, slopes)
            above = move(size[law, first])
            below = move(-size[law, first]) if central else value[law, first, None]
            secant[law, first] = (above - below) / (size[law, first] * (1 + central))
    gradient = np.where(bend > _MAX_BEND, np.nan, gradient)
    # Rounding of the score is no change.
    near = (
        np.abs(gradient - secant) <= 0.1 * np.abs(secant) + 3e-6 * np.abs(value)[..., None] / size
    )
    useful = np.where(np.isnan(secant), np.nan, near)
    useful = useful[:, np.concatenate([at[:_TESTED] for at in order])].mean(axis=1)
    useful[:, (bend > _MAX_BEND).any(axis=0)] = np.nan
    mean = gradients.estimate(jnp.asarray(gradient.swapaxes(0, 1)))
    dims, mean_dims = ("law", "world", "quantity"), ("law", "quantity")
    variables = labelled(
        value=(dims[:2], value, "1", "score"),
        gradient=(dims, gradient, "1 / unit", "derivative of the score"),
        finite=(dims, np.isfinite(gradient), "1", "whether the derivative is finite"),
        norm=(dims[:2], np.linalg.norm(gradient, axis=-1), "1 / unit", "norm of the gradient"),
        mean=(mean_dims, mean.gradient, "1 / unit", "mean over finite derivatives"),
        error=(mean_dims, np.sqrt(mean.variance), "1 / unit", "standard error of the mean"),
        secant=(dims, secant, "1 / unit", "slope along a change by 1 %"),
        useful=(mean_dims, useful, "1", "share of worlds with a gradient near the secant"),
    )
    coords: dict[str, Any] = {
        "law": list(chosen),
        "world": ("world", index, {"long_name": WORLD}),
        "quantity": labels,
        "unit": ("quantity", [x.unit for x in coordinates]),
        "kind": ("quantity", ["parameter" if x.is_parameter else "world" for x in coordinates]),
        "map_error": ("quantity", bend.max(axis=0), {"units": "1"}),
    }
    coords |= points.drawn_columns(ranges, setting.world_seed, None, index)
    notes = " ".join(
        _notes(ranges, setting.engine, coordinates, used, value, gradient, bend, useful)
    )
    if notes:
        notes = f"Score {getattr(i.score, '__name__', 'objective')}: {notes}"
        warnings.warn(notes, stacklevel=4)
    attrs = provenance.attributes() | {
        "domain": name_or_custom(i.domain),
        **setting.attributes,
        "horizon": steps * setting.physics.control_period,
        "skin_temperature": temperature,
        "notes": notes,
        **task_attribute(ranges),
    }
    results = Gradients(variables, coords, attrs)
    results.inputs = inputs
    rank = np.argsort(np.concatenate(order))
    by_law = [jax.tree.map(lambda *x: np.concatenate(x)[rank], *parts) for parts in aux]
    return results, jax.tree.map(lambda *x: np.stack(x), *by_law)


class Gradients(xr.Dataset):
    """Gradients of `value_and_grad`, which can be checked."""

    __slots__ = ("inputs",)  # of the call

    def check(self, worlds: int = 2, step: float = 1e-5) -> xr.Dataset:
        """Compare the gradients in the first worlds with central differences.

        Both are of the same trials in double precision.

        Args:
          worlds: number of worlds, at most four of each object.
          step: change of a quantity, relative to its value.

        Returns:
          `gradient`, `differences` and their relative `error` (law, world, quantity).
        """
        with jax.enable_x64(True), warnings.catch_warnings(action="ignore"):
            results, _ = _gradients(self.inputs | {"worlds": worlds}, step, central=True)
        size = np.maximum(np.abs(results.gradient), np.abs(results.secant))
        error = np.abs(results.gradient - results.secant) / size.where(size > 0, 1.0)
        return xr.Dataset(
            {"gradient": results.gradient, "differences": results.secant, "error": error}
        )


# --- the coordinates -----------------------------------------------------------------------------


def coordinates_of(
    wrt: Sequence[str] | str, params: LawParams, domain: Domain
) -> tuple[Coordinate, ...]:
    """Return the coordinates of names, in order.

    Raises:
      InputError: a name is unknown, repeated, or of something without a derivative.
    """
    names = (wrt,) if isinstance(wrt, str) else tuple(wrt)
    errors.check_each_once("wrt", names)
    drawn, leaves = (*QUANTITIES, *VELOCITY_ERRORS, "com_bearing"), named_leaves(params)
    known = {f"params.{x}" if x in (*drawn, *_VECTORS) else x: x for x in leaves}
    coordinates: list[Coordinate] = []
    expanded = [[x for x in known if x.startswith(f"{name}.")] or [name] for name in names]
    for name in itertools.chain(*expanded):
        if name in known:
            leaf = known[name]
            unit = unit_of_leaf(params, leaf)
            several = entries(name, leaves[leaf])
            coordinates += [Coordinate(label, unit, leaf, at, True) for label, at in several]
        elif name in _VECTORS:
            if name == "target":
                domain.task.check_target("wrt", name)
            coordinates += [Coordinate(f"{name}_{x}", "m", name, (i,)) for i, x in enumerate("xy")]
        else:
            rule, quantity = "", QUANTITIES.get(name)
            if name in _DISCRETE or (quantity and (quantity.jumps or quantity.owner == "course")):
                rule = "it has no derivative: worlds change in steps with it, or a path does"
            elif name in domain.idle and name not in ("friction_ground", "friction_robot"):
                rule = f"of the domain, {domain.idle[name]} no {name} to draw"
            elif quantity and domain.range_of(name) is None:
                rule = f"the domain draws none; append ,{name}=LOW:HIGH to its name"
            if rule:
                raise errors.not_allowed("wrt", name, rule)
            errors.check_name("name of wrt", name, (*known, *_VECTORS, *drawn))
            parts = tuple(VELOCITY_ERRORS) if name == "velocity_error" else (name,)
            coordinates += [Coordinate(x, unit_of(x), x) for x in parts]
    errors.check_each_once("wrt", [x.label for x in coordinates])
    return tuple(coordinates)


def world_slopes(
    domain: Domain, drawn: Draw, setting: Setting, coordinates: Sequence[Coordinate]
) -> tuple[list[Arrays], np.ndarray]:
    """Return derivatives of worlds by coordinates: central differences on the host, in float64.

    Returns:
      For each coordinate, derivatives (n, ...) of those leaves of the worlds that depend on it, by
      their names, or ones (n,) for a parameter; and relative differences (n, q) [1] of the
      one-sided derivatives, which bound the relative errors of the central ones.
    """

    def leaves(draw: Draw) -> Arrays:
        worlds = drawn_worlds(domain, draw, setting).worlds._replace(shift=None, key=None)
        return {k: np.asarray(x) for k, x in named_leaves({"world": worlds}).items()}

    def moved(coordinate: Coordinate, step: np.ndarray) -> Draw:
        if coordinate.name not in _VECTORS:
            return draws.draw(domain, setting.world_seed, drawn.indices, {coordinate.name: step})
        path = _VECTORS[coordinate.name]
        value = np.array(named_leaves(drawn)[path])
        value[:, coordinate.entry[0]] += step
        return registry.replace_leaves(drawn, {path: value})

    count = drawn.indices.size
    slopes: list[Arrays] = [{} for _ in coordinates]
    bends = np.zeros((count, len(coordinates)))
    with jax.enable_x64(True):
        middle = leaves(drawn)
        for i, coordinate in enumerate(coordinates):
            if coordinate.is_parameter:
                slopes[i][f"params.{coordinate.name}"] = np.ones(count)
                continue
            value = drawn.values.get(coordinate.name, np.ones(count))
            step = _STEP * np.maximum(np.abs(value), _SMALLEST)
            above, below = (leaves(moved(coordinate, x)) for x in (step, -step))
            for name, leaf in middle.items():
                up, at, down = (x.reshape(count, -1) for x in (above[name], leaf, below[name]))
                change, bend = up - down, up - 2 * at + down
                noise = _NOISE * np.abs(at).max(initial=0.0)
                change[np.abs(change) <= noise] = 0.0
                if change.any():
                    slopes[i][name] = (change / (2 * step[:, None])).reshape(leaf.shape)
                    size = np.maximum(np.abs(change).max(axis=1), noise)
                    bends[:, i] = np.maximum(bends[:, i], np.abs(bend).max(axis=1) / size)
    return slopes, bends


# --- the score -------------------------------------------------------------------------------


class Trajectory(NamedTuple):
    """Snapshots of one trial of T control steps, with its world and parameters."""

    time: Floats  # (T,) [s]
    qpos: Float[Array, "*B 10"]  # (T, 10) as in `Trial`
    reading: Reading  # (T,) of the skin
    twist: Twist  # (T,) [m/s, m/s, rad/s] commanded, robot frame
    details: Details  # (T,)
    done: Bools  # (T,) the trial had ended
    world: World  # constants of the world
    params: LawParams  # parameters of the law
    state: Trial | None = None  # (T, ...) after each step, with `states`

    @property
    def executed(self) -> Array:
        """Twists (T, 3) [m/s, m/s, rad/s] of the base, robot frame."""
        qvel, yaw = self._state.qvel, self._state.qpos[:, 2]
        return jnp.concatenate([planar.rotate(-yaw, qvel[:, :2]), qvel[:, 2:3]], axis=1)

    @property
    def force(self) -> Array:
        """Wrenches (T, 3) [N, N, N m] of the object on the base, about its origin, robot frame.

        They are means over a control period.
        """
        if self._state.load is None:
            raise InputError("this engine computes no contact force: choose fused or mjx.")
        return self._state.load.wrench

    @property
    def _state(self) -> Trial:
        if self.state is None:
            raise errors.not_allowed("states", False, "the score needs states=True")
        return self.state


class _Options(NamedTuple):
    """Static options of scores."""

    score: ScoreLike
    steps: int
    setting: Setting
    has_aux: bool
    states: bool


@partial(jax.jit, static_argnames=("loop", "options"))
def _value_and_slopes(
    stage: Stage,
    inputs: PyTree,
    leaves: Mapping[str, Leaf],
    loop: ControlLoop,
    options: _Options,
    args: tuple[PyTree, ...],
) -> tuple[Scored, dict[str, Array]]:
    """Return the scores (n,) of worlds and laws, and their derivatives (n, ...) by some leaves.

    Auxiliary outputs (n, ...) come with the scores.
    """

    def single(shots: PyTree, world: World, params: LawParams) -> Scored:
        snapshots, state = shots if options.states else (shots, None)
        columns = snapshots._asdict()
        return _score(options, Trajectory(**columns, world=world, params=params, state=state), args)

    def scores(leaves: Mapping[str, Leaf]) -> Scored:
        moved = registry.replace_leaves(inputs, leaves)
        worlds, params = moved["world"], moved["params"]
        trials = trial.start_all(worlds, params, law=loop.law)
        if options.states and options.setting.simulator.computes_force and trials.load is None:
            trials = trials._replace(load=jax.vmap(base.init_load)(worlds.qpos))
        run = stage, worlds, params, trials, loop, options.steps, native.mapped, options.states
        return jax.vmap(single, (1, 0, 0))(trial.unroll(*run)[1], worlds, params)

    values, pull_back, aux = jax.vjp(scores, leaves, has_aux=True)
    try:
        return (values, aux), pull_back(jnp.ones_like(values))[0]
    except ValueError as error:  # of loops of unknown length
        raise InputError(f"the derivative of score or law {validation.fault_of(error)}.") from error


def _score(options: _Options, trajectory: Trajectory, args: tuple[PyTree, ...] = ()) -> Scored:
    """Return the score () of a trajectory (T, ...) and its auxiliary output.

    Raises:
      InputError: the score is no number.
    """
    score, aux = options.score, None
    if isinstance(score, Objective):
        return soft_score(trajectory, trajectory.params, options.setting, score), None
    try:
        value = score(trajectory, *args)
        if options.has_aux:
            value, aux = value
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"score {validation.fault_of(error)}.") from error
    is_array = hasattr(value, "dtype") and hasattr(value, "shape")
    shown = f"{value.dtype}{[*value.shape]}" if is_array else type(value).__name__
    if shown not in ("float32[]", "float64[]", "float"):
        rule = "of the snapshots (T, ...) of one trial it must return one real number"
        raise errors.not_allowed("result of score", shown, rule)
    return jnp.asarray(value), aux


def _sizes(coordinates: Sequence[Coordinate], drawn: Draw, leaves: Mapping[str, Any]) -> np.ndarray:
    """Return the sizes (n, q) of quantities, in their units; small ones count as 0.01."""
    columns = []
    for x in coordinates:
        value: Any = drawn.values.get(x.name, np.ones(drawn.indices.size))
        if x.is_parameter:
            value = leaves[f"params.{x.name}"][x.leaf_index]
        elif x.name in _VECTORS:
            value = np.asarray(named_leaves(drawn)[_VECTORS[x.name]])[:, x.entry[0]]
        columns.append(np.maximum(np.abs(value), _SMALLEST))
    return np.stack(columns, axis=1)


def _moved_scores(
    run: Callable[..., Any],
    inputs: PyTree,
    leaves: Mapping[str, Any],
    coordinates: Sequence[Coordinate],
    slopes: Sequence[Arrays],
    change: np.ndarray,
) -> np.ndarray:
    """Return the scores (m, q) of the first worlds, each with one changed quantity (m, q).

    They run in batches of the size of `leaves`, and so compile nothing. Beyond the first 64
    quantities they are NaN.
    """
    (count, *_), scores = next(iter(leaves.values())).shape, np.full(change.shape, np.nan)
    pairs = np.argwhere(np.ones_like(change[:, :64]))
    for first in range(0, len(pairs), count):
        chunk = pairs[first : first + count]
        index = np.resize(chunk[:, 0], count)
        moved = {name: np.array(leaf[index]) for name, leaf in leaves.items()}
        for slot, (i, k) in enumerate(chunk):
            for name, slope in slopes[k].items():
                moved[name][(slot, *coordinates[k].leaf_index[1:])] += change[i, k] * slope[i]
        (values, _), _ = jax.device_get(run(rows(inputs, index), moved))
        scores[tuple(chunk.T)] = values[: len(chunk)]
    return scores


def soft_score(
    snapshots: Snapshot | Trajectory,
    params: LawParams,
    setting: Setting,
    objective: Objective,
    arrive: float = 0.005,
) -> Array:
    """Return the objective's score () of the snapshots (T, ...) of a softened window.

    The base arrives at a step by a weight: in contact, and nearer than d_success within the
    temperature `arrive` [m]. Later steps count by the weight of not having arrived. At the end
    the remaining distance costs the time to drive it at v_max, because no window is long enough to
    detect a failure.
    """
    period, distance = setting.physics.control_period, snapshots.details.distance
    under_way, lost = soft_times(snapshots, params.d_success, arrive=arrive)
    time = period * jnp.sum(under_way) + under_way[-1] * distance[-1] / params.v_max
    return jnp.asarray(objective.score(1.0, time, period * lost, 0.0, setting.rules))


def soft_times(
    snapshots: Snapshot | Trajectory,
    d_success: Number,
    touched: Array | bool = False,
    live: Number = 1.0,
    arrive: float = 0.005,
) -> tuple[Array, Array]:
    """Return the weights (T,) of the steps before the arrival, and the steps () without contact.

    `touched` says whether the object was touched before the snapshots, and `live` (T,) is 0 where
    a trial has ended.
    """
    contact, distance = 1.0 * snapshots.reading.in_contact, snapshots.details.distance
    arrival = contact * jax.nn.sigmoid((d_success - distance) / arrive)
    under_way = jnp.cumprod(1 - arrival) * live
    touched = jnp.maximum(jax.lax.cummax(contact), touched)
    return under_way, jnp.sum(under_way * touched * (1 - contact))


def _notes(
    domain: Domain,
    engine: str,
    coordinates: Sequence[Coordinate],
    used: np.ndarray,
    value: np.ndarray,
    gradient: np.ndarray,
    bend: np.ndarray,
    useful: np.ndarray,
) -> Iterator[str]:
    """Yield sentences on coordinates whose derivatives are zero, not finite or of no use."""
    if invalid := np.sum(~np.isfinite(value)):
        yield f"The score is not finite in {invalid} of {value.size} trials."
    if engine == "quasistatic":
        yield "Gradients of quasistatic err by up to 1e-3 where a step has not converged."
    is_mass = np.array([x.name == "mass" and not x.is_parameter for x in coordinates])
    is_mass &= not domain.weakest.driven
    if is_mass.any():
        yield (
            "mass has no influence, and its derivative is zero up to rounding, since an ideal base "
            "pushes with any force: limit it by robot='kairos' or domain='real', with an engine "
            "other than quasistatic."
        )
    useless, bent = np.any(useful < 0.5, axis=0), np.any(bend > _MAX_BEND, axis=0)
    is_zero = ~np.any(gradient, axis=(0, 1))
    is_empty = ~np.all(np.any(np.isfinite(gradient), axis=1), axis=0)
    for mask, sentence in (
        (~used & ~is_mass, f"No influence with the engine {engine}, which does not use them:"),
        (used & is_zero & ~is_mass, "Derivatives of zero in every world within the horizon:"),
        (bent, "No derivatives in worlds whose numbers have a kink (see finite):"),
        (is_empty, f"No world of {len(bend)} has a finite derivative, so the mean is NaN:"),
        (useless, _USELESS),
    ):
        labels = [x.label for x, chosen in zip(coordinates, mask, strict=True) if chosen]
        if labels:
            yield f"{sentence} {', '.join(labels)}."
