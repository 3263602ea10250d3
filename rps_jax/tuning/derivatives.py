"""Values and gradients of a score by parameters of laws and by quantities of random worlds.

The exact gradient of the score by the numbers of a world, from the engine, is chained with the
derivative of these numbers by a drawn quantity. Worlds are built on the host in double precision,
so that central differences give this derivative, and a new quantity needs no code here.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.control import registry, validation
from rps_jax.control.base import LawParams, Leaf, named_leaves, unit_of_leaf
from rps_jax.control.registry import LawsLike
from rps_jax.engines import device, native
from rps_jax.engines.base import Stage
from rps_jax.errors import InputError
from rps_jax.record import cache, provenance
from rps_jax.record.files import Arrays
from rps_jax.record.options import check_arguments
from rps_jax.robot.robot import RobotLike
from rps_jax.trials import trial
from rps_jax.trials.results import WORLD, labelled
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trajectory import control_loop, count_steps
from rps_jax.trials.trial import ControlLoop, Snapshot
from rps_jax.trials.worlds import drawn_worlds, soften_skins
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

Score = Callable[[Snapshot], Any]  # of a trajectory (T, ...) of one world: one number ()
ScoreLike = Score | Objective
_STEP = 1e-6  # of differences, relative to a quantity
_SMALLEST = 0.01  # in its unit, below which the step is not relative
_NOISE = 1e-12  # relative change of a number of a world that is rounding
_MAX_BEND = 0.01  # [1] relative difference of one-sided derivatives beyond which there is none
_VECTORS = {"target": "p_world_target", "com": "solid.p_object_com"}  # [m], leaves of a draw
_DISCRETE = ("corners", "sides", "feet_number", "object", "seed", "key_0", "key_1", "world")


class Coordinate(NamedTuple):
    """Scalar by which a score is differentiated."""

    label: str
    unit: str
    name: str  # of a drawn quantity or a vector, or of a leaf of the parameters
    entry: tuple[int, ...] = ()  # of a vector or a leaf
    is_parameter: bool = False


@device.standard_jax()
def value_and_grad(
    score: ScoreLike = Objective(),
    laws: LawsLike = "rps_tuned",
    domain: DomainLike = "wide",
    worlds: int = 32,
    wrt: Sequence[str] | str = ("K_h", "friction_robot", "com", "target"),
    *,
    horizon: float = 5.0,
    smooth: bool = True,
    robot: RobotLike | None = None,
    task: TaskLike | None = None,
    setting: Setting = Setting(),
) -> xr.Dataset:
    """Compute a score and its exact gradient in each of several random worlds.

    Gradients are those of the engine's own equations, by the implicit function theorem at the
    solution of each physics step. Where contacts, cones or rules switch they are one-sided, and
    jumps of the score are not in them. Beyond some 8 s most pushes are chaotic: gradients are then
    finite, huge and of no use for an optimiser; `norm` shows it. Law and skin have their smooth
    forms by default, so that what the law feels has derivatives.

    Args:
      score: function of the snapshots (T, ...) of one trial, which returns one number; or an
        objective, as of `tune_grad`: the time to the target, softened.
      laws: one law or several, as of `sweep`.
      domain: ranges from which worlds are drawn.
      worlds: number of worlds, of indices 0, 1, ...: those of `sweep` with this seed.
      wrt: names of parameters of the laws (`params.NAME` if a drawn quantity has this name), of
        quantities that the domain draws, and `target` and `com`, both x and y [m]: the centre of
        mass moves without its load, at constant inertia about it.
      horizon: duration of a trial [s].
      smooth: whether law and skin have their smooth forms.
      robot: its name, as kairos, or a JSON file; None: the domain's.
      task: its name, as path, with changes; None: the domain's. Paths need a function as `score`.
      setting: engine, physics, rules, and the seed of the worlds.

    Returns:
      `value` (law, world); `gradient` (law, world, quantity), with `unit` and `kind` of each
      quantity; `finite`, whether it is finite; its `norm` (law, world); `mean` and its standard
      `error` (law, quantity) over the worlds in which it is finite. `map_error` (quantity) bounds
      the relative error of the central differences by which worlds depend on a quantity. The
      attribute `notes`, also a warning, names quantities without influence, as the mass of what an
      ideal base pushes, and why.

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
    device.check_eager("value_and_grad", locals())
    check_arguments(value_and_grad, locals())
    device.check_process()
    ranges, chosen = parse_domain(domain, robot, task), registry.resolve_laws(laws)
    errors.check_count("worlds", worlds, at_most=1_000_000)
    steps, engine = count_steps(horizon, setting), setting.simulator
    engine.check_traced()
    engine.check_derivatives("reverse")
    setting.check_domain(ranges, chosen.values())
    loops = [control_loop(params, setting, smooth=smooth) for params in chosen.values()]
    several = [coordinates_of(wrt, params, ranges) for params in chosen.values()]
    if any(coordinates != several[0] for coordinates in several):
        rule = "parameters of wrt must have the same shapes and units in all laws"
        raise errors.not_allowed("laws", ", ".join(chosen), rule)
    if isinstance(score, Objective) and not all(hasattr(p, "v_max") for p in chosen.values()):
        rule = "a law without a parameter v_max needs a function of the snapshots"
        raise errors.not_allowed("score", "an Objective", rule)
    if isinstance(score, Objective):
        ranges.task.check_target("task", ranges.task, "give a function as score")
    cache.use_cache_if_requested()
    coordinates, index = several[0], np.arange(worlds)
    value, bend = np.empty((len(chosen), worlds)), np.empty((worlds, len(coordinates)))
    gradient = np.empty((*value.shape, len(coordinates)))
    used, temperature = np.array([x.is_parameter for x in coordinates]), 0.0
    for at, drawn in points.draw_by_object(ranges, setting.world_seed, None, index):
        batch = drawn_worlds(ranges, drawn, setting)
        if smooth:
            batch = batch._replace(worlds=soften_skins(batch.worlds))
            skin: Any = batch.worlds.skin
            temperature = float(skin.temperature[0])
        slopes, bend[at] = world_slopes(ranges, drawn, setting, coordinates)
        used |= list(map(bool, slopes))
        names = {name for slope in slopes for name in slope}
        names |= {f"params.{x.name}" for x in coordinates if x.is_parameter}
        for i, (params, loop) in enumerate(zip(chosen.values(), loops, strict=True)):
            inputs = {"world": batch.worlds, "params": batch.with_params(params).params}
            leaves = {name: x for name, x in named_leaves(inputs).items() if name in names}
            results = _value_and_slopes(batch.stage, inputs, leaves, loop, score, steps, setting)
            value[i, at], by_leaf = jax.device_get(results)
            for k, (x, slope) in enumerate(zip(coordinates, slopes, strict=True)):
                products = [y * by_leaf[name] for name, y in slope.items()]
                if x.is_parameter:
                    products = [by_leaf[f"params.{x.name}"][(slice(None), *x.entry)]]
                gradient[i, at, k] = sum(y.reshape(at.size, -1).sum(axis=1) for y in products)
    gradient = np.where(bend > _MAX_BEND, np.nan, gradient)
    mean = [gradients.estimate(jnp.asarray(x)) for x in gradient]
    dims, mean_dims = ("law", "world", "quantity"), ("law", "quantity")
    error = [np.sqrt(x.variance) for x in mean]
    variables = labelled(
        value=(dims[:2], value, "1", "score"),
        gradient=(dims, gradient, "1 / unit", "derivative of the score"),
        finite=(dims, np.isfinite(gradient), "1", "whether the derivative is finite"),
        norm=(dims[:2], np.linalg.norm(gradient, axis=-1), "1 / unit", "norm of the gradient"),
        mean=(mean_dims, [x.gradient for x in mean], "1 / unit", "mean over finite derivatives"),
        error=(mean_dims, error, "1 / unit", "standard error of the mean"),
    )
    coords: dict[str, Any] = {
        "law": list(chosen),
        "world": ("world", index, {"long_name": WORLD}),
        "quantity": [x.label for x in coordinates],
        "unit": ("quantity", [x.unit for x in coordinates]),
        "kind": ("quantity", ["parameter" if x.is_parameter else "world" for x in coordinates]),
        "map_error": ("quantity", bend.max(axis=0), {"units": "1"}),
    }
    coords |= points.drawn_columns(ranges, setting.world_seed, None, index)
    notes = " ".join(_notes(ranges, setting.engine, coordinates, used, value, gradient, bend))
    if notes:
        warnings.warn(notes, stacklevel=3)
    attrs = provenance.attributes() | {
        "domain": name_or_custom(domain), **setting.attributes,
        "horizon": steps * setting.physics.control_period,
        "skin_temperature": temperature, "notes": notes, **task_attribute(ranges),
    }  # fmt: skip
    return xr.Dataset(variables, coords, attrs)


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
    for name in names:
        if name in known:
            leaf = known[name]
            for at in np.ndindex(np.shape(leaves[leaf])):
                label = f"{name}[{','.join(map(str, at))}]" if at else name
                coordinates.append(Coordinate(label, unit_of_leaf(params, leaf), leaf, at, True))
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
      their names; and relative differences (n, q) [1] of the one-sided derivatives, which bound
      the relative errors of the central ones.
    """

    def leaves(draw: Draw) -> dict[str, Any]:
        worlds = drawn_worlds(domain, draw, setting).worlds._replace(shift=None, key=None)
        return named_leaves({"world": worlds})

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


@partial(jax.jit, static_argnums=(3, 4, 5, 6))
def _value_and_slopes(
    stage: Stage,
    inputs: Any,
    leaves: Mapping[str, Leaf],
    loop: ControlLoop,
    score: ScoreLike,
    steps: int,
    setting: Setting,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the scores (n,) of worlds and laws, and their derivatives (n, ...) by some leaves."""

    def scores(leaves: Mapping[str, Leaf]) -> jax.Array:
        moved = registry.replace_leaves(inputs, leaves)
        worlds, params = moved["world"], moved["params"]
        running = np.ones(len(worlds.qpos), bool)
        trials = trial.start_all(worlds, params, running, law=loop.law)
        _, snapshots = trial.unroll(stage, worlds, params, trials, loop, steps, native.mapped)
        return jax.vmap(partial(_score, score, setting), (1, 0))(snapshots, params)

    values, pull_back = jax.vjp(scores, leaves)
    try:
        return values, pull_back(jnp.ones_like(values))[0]
    except ValueError as error:  # of loops of unknown length
        raise InputError(f"the derivative of score or law {validation.fault_of(error)}.") from error


def _score(score: ScoreLike, setting: Setting, snapshots: Snapshot, params: LawParams) -> jax.Array:
    """Return the score () of a trajectory (T, ...), or raise InputError if it is no number."""
    if isinstance(score, Objective):
        return soft_score(snapshots, params, setting, score)
    try:
        value = score(snapshots)
    except Exception as error:
        raise InputError(f"score {validation.fault_of(error)}.") from error
    is_array = hasattr(value, "dtype") and hasattr(value, "shape")
    shown = f"{value.dtype}{[*value.shape]}" if is_array else type(value).__name__
    if shown not in ("float32[]", "float64[]", "float"):
        rule = "of the snapshots (T, ...) of one trial it must return one real number"
        raise errors.not_allowed("result of score", shown, rule)
    return jnp.asarray(value)


def soft_score(
    snapshots: Snapshot,
    params: LawParams,
    setting: Setting,
    objective: Objective,
    arrive: float = 0.005,
) -> jax.Array:
    """Return the objective's score () of the snapshots (T, ...) of a softened window.

    The base arrives at a step by a weight: in contact, and nearer than d_success within the
    temperature `arrive` [m]. Later steps count by the weight of not having arrived. At the end
    the remaining distance costs the time to drive it at v_max, because no window is long enough to
    detect a failure.
    """
    period = setting.physics.control_period
    contact, distance = 1.0 * snapshots.reading.in_contact, snapshots.details.distance
    arrival = contact * jax.nn.sigmoid((params.d_success - distance) / arrive)
    under_way = jnp.cumprod(1 - arrival)
    touched = jax.lax.cummax(contact)
    time = period * jnp.sum(under_way) + under_way[-1] * distance[-1] / params.v_max
    lost = period * jnp.sum(under_way * touched * (1 - contact))
    return jnp.asarray(objective.score(1.0, time, lost, 0.0, setting.rules))


def _notes(
    domain: Domain,
    engine: str,
    coordinates: Sequence[Coordinate],
    used: np.ndarray,
    value: np.ndarray,
    gradient: np.ndarray,
    bend: np.ndarray,
) -> Iterator[str]:
    """Yield sentences on coordinates without influence and on worlds without finite numbers."""
    if invalid := np.sum(~np.isfinite(value)):
        yield f"The score is not finite in {invalid} of {value.size} trials."
    is_mass = np.array([x.name == "mass" and not x.is_parameter for x in coordinates])
    is_mass &= not domain.weakest.driven
    if is_mass.any():
        yield (
            "mass has no influence, and its derivative is zero up to rounding, since an ideal base "
            "pushes with any force: limit it by robot='kairos' or domain='real', with an engine "
            "other than quasistatic."
        )
    is_zero: Any = ~gradient.any(axis=(0, 1))
    bent: Any = (bend > _MAX_BEND).any(axis=0)
    is_empty: Any = ~np.isfinite(gradient).any(axis=1).all(axis=0)
    for mask, sentence in (
        (~used & ~is_mass, f"No influence with the engine {engine}, which does not use them:"),
        (used & is_zero & ~is_mass, "Derivatives of zero in every world within the horizon:"),
        (bent, "No derivatives in worlds whose numbers have a kink (see finite):"),
        (is_empty, "No world has a finite derivative, so the mean is NaN:"),
    ):
        labels = [x.label for x, chosen in zip(coordinates, mask, strict=True) if chosen]
        if labels:
            yield f"{sentence} {', '.join(labels)}."
