"""One trial as a pure function of a world and the parameters of a law.

    batch = draw_worlds("wide,objects=random_box", 8)
    trajectory = rollout(rows(batch.worlds, 0), RPSParams.tuned(), batch.stage, horizon=2.0)

`rollout` can be differentiated, mapped and compiled: `jax.grad`, `jax.jacfwd`, `jax.vmap`,
`jax.jit` and `jax.checkpoint`. Under `jax.vmap` an engine steps all worlds at once.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.base import LawParams, freeze_functions, named_leaves
from rps_jax.engines import device, native
from rps_jax.engines.base import Stage
from rps_jax.geometry.arrays import Pytree
from rps_jax.record.options import check_arguments
from rps_jax.robot.robot import RobotLike
from rps_jax.trials import trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Trial, World
from rps_jax.trials.worlds import WorldBatch, drawn_worlds, rows, soften_skins
from rps_jax.world import draws
from rps_jax.world.domain import DomainLike, parse_domain
from rps_jax.world.tasks import TaskLike


@device.standard_jax()
def draw_worlds(
    domain: DomainLike,
    worlds: int = 1,
    *,
    robot: RobotLike | None = None,
    task: TaskLike | None = None,
    setting: Setting = Setting(),
) -> WorldBatch:
    """Return random worlds of one object, staged for an engine, for `rollout`.

    Args:
      domain: ranges from which worlds are drawn, with one object, as wide,objects=random_box.
      worlds: number of worlds n, of indices 0, 1, ...
      robot: its name, as kairos, or a JSON file; None: the domain's.
      task: its name, as path, with changes; None: the domain's.
      setting: engine, physics and the seed of the worlds.

    Returns:
      `worlds`, a pytree whose leaves are (n, ...), and `stage`, which they share.

    Raises:
      InputError: an argument is not allowed, or the domain has several objects.

    Examples:
      >>> import rps_jax
      >>> batch = rps_jax.draw_worlds("wide,objects=random_cylinder", 3)
      >>> batch.worlds.p_world_target.shape
      (3, 2)
    """
    check_arguments(draw_worlds, locals())
    device.check_process()
    ranges = parse_domain(domain, robot, task)
    errors.check_count("worlds", worlds, at_most=10_000_000)
    if len(ranges.objects) != 1:
        rule = "worlds of one program have one object; name it, as wide,objects=random_box"
        raise errors.not_allowed("domain objects", ranges.objects, rule)
    setting = setting.with_robot(ranges.robot)
    setting.simulator.check_traced()
    setting.check_domain(ranges)
    drawn = draws.draw(ranges, setting.world_seed, np.arange(worlds))
    batch = drawn_worlds(ranges, drawn, setting)
    origin = trial.Origin(setting.physics, ranges.task)
    return batch._replace(worlds=batch.worlds._replace(origin=origin))


@device.standard_jax()
def rollout(
    world: World,
    params: LawParams,
    stage: Stage,
    setting: Setting = Setting(),
    *,
    horizon: float = 2.0,
    smooth: bool = False,
    start: Trial | None = None,
    return_state: bool = False,
) -> Pytree:  # `Snapshot`, or (`Snapshot`, `Trial`)
    """Return the trajectory of one world, as a pure function of the world and the law's parameters.

    Derivatives are those of the engine, by any number of the world or of the parameters. They are
    zero or jump where the law, the skin or a rule switches, unless `smooth` is set. Success and the
    end of a trial always switch.

    Args:
      world: one world of `draw_worlds`, without a batch axis; map over worlds by `jax.vmap`.
      params: parameters of a law.
      stage: that of the worlds.
      setting: that with which the worlds were drawn.
      horizon: duration [s].
      smooth: whether law and skin have their smooth forms: `registry.smooth_law` and a temperature
        of the skin, which is `skin.SMOOTH` unless the world has one.
      start: last state of another rollout of this law in this world, which is continued with the
        same bits: poses, velocities, and the states of law, skin, odometry and drive. (Programs
        that differ in more than the horizon may round differently.) A state of the law itself also
        starts its smooth form. None: the trial starts.
      return_state: whether the last state is returned, too.

    Returns:
      Snapshots (T, ...), one for each control step; after the trial's end they repeat the last one.
      With `return_state`, these and the last state.

    Raises:
      InputError: an argument is not allowed, the law has no smooth form, or the engine is not
        traced by JAX, or is differentiated and has no derivatives.
      NotImplementedError: it is differentiated twice.

    Examples:
      >>> import jax
      >>> import rps_jax
      >>> setting, law = rps_jax.Setting("quasistatic"), rps_jax.RPSParams.tuned()
      >>> batch = rps_jax.draw_worlds("wide,objects=random_cylinder", 3, setting=setting)
      >>> def final_distance(world):  # [m]; `jax.grad` differentiates it
      ...     trajectory = rps_jax.rollout(world, law, batch.stage, setting, horizon=0.5)
      ...     return trajectory.details.distance[-1]
      >>> jax.vmap(final_distance)(batch.worlds).shape
      (3,)
    """
    check_arguments(rollout, locals())
    if world.robot is not None:
        setting = setting.with_robot(world.robot)
        registry.check_drive(params, world.robot.drive)
    engine = setting.simulator
    engine.check_traced()
    steps, loop = count_steps(horizon, setting), control_loop(params, setting, smooth=smooth)
    if np.ndim(world.p_world_target) != 1:
        rule = "give one world, and map over several by jax.vmap"
        raise errors.not_allowed("world", f"of shape {np.shape(world.p_world_target)}", rule)
    params = freeze_functions(params)
    _check_scalars(params)
    engine.check_stage(stage)
    if world.origin is not None:
        world.origin.task.check_law(params)
        for name, value in vars(world.origin.physics).items():
            if (given := getattr(setting.physics, name)) != value:
                rule = f"the worlds were drawn with {value}; give their setting"
                raise errors.not_allowed(name, given, rule)
    world = soften_skins(world) if smooth else world
    world, params, start = engine.guard_derivatives((world, params, start))
    fresh = trial.start(world, params, loop.law)
    first = fresh if start is None else _resumed(start, fresh)
    inputs = jax.tree.map(lambda x: jnp.asarray(x)[None], (world, params, first))
    last, snapshots = trial.unroll(stage, *inputs, loop=loop, steps=steps, mapped=native.mapped)
    snapshots = rows(snapshots, np.s_[:, 0])
    return (snapshots, rows(last, 0)) if return_state else snapshots


def _resumed(start: Trial, fresh: Trial) -> Trial:
    """Return a state with the number types of a fresh one, or raise InputError."""
    shapes = [[np.shape(x) for x in jax.tree.leaves(state)] for state in (start, fresh)]
    if jax.tree.structure(start) != jax.tree.structure(fresh) or shapes[0] != shapes[1]:
        rule = "give the last state of a rollout of the same law in the same world"
        raise errors.not_allowed("start", f"a state of shapes {shapes[0]}", rule)
    return jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), start, fresh)


def _check_scalars(params: LawParams) -> None:
    """Raise InputError for parameters that are no numbers, or arrays where the law has scalars."""
    known = named_leaves(registry.preset_of(params) or params)
    for name, leaf in named_leaves(params).items():
        if np.shape(leaf) and not np.shape(known.get(name, leaf)):
            rule = "give one number, and map over several by jax.vmap"
            raise errors.not_allowed(f"params.{name}", f"of shape {np.shape(leaf)}", rule)
    if not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(params)):
        registry.check_params(params)


def control_loop(params: LawParams, setting: Setting, *, smooth: bool) -> ControlLoop:
    """Return the control loop of a law, or of its smooth form; or raise InputError."""
    law = registry.law_of(params)
    law = registry.smooth_law(law) if smooth else law
    return ControlLoop(setting.physics, setting.rules, law)


def count_steps(horizon: float, setting: Setting) -> int:
    """Return the number of control steps of a horizon [s], or raise InputError."""
    period = setting.physics.control_period
    longest = float(setting.rules.horizon)
    errors.check_finite("horizon", horizon, at_least=period, at_most=longest, unit="s")
    return round(horizon / period)
