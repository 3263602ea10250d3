"""Trials with an exported law in the loop, and the observations and bags of whole trials."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import rps_jax
from rps_jax import Details, Law, Setting, Twist, register_law
from rps_jax.app.export import program
from rps_jax.app.shadow import shadow
from rps_jax.laws import law_of, resolve_law
from rps_jax.physics import FRICTION
from rps_jax.runs.push import recorded_law
from rps_jax.trials import pushes
from rps_jax.world import paper
from rps_jax.worlds import Case, DomainLike, parse_domain
from sweeps.export.native import TOLERANCE, Native, scale_of
from sweeps.study_base import part_name

ROUNDINGS = (1, -1, 2, -2, 4, -4, 8, -8)  # rounding errors of a twist, in units of 2^-23


def recorded(cases: Sequence[Case], setting: Setting) -> list[Any]:
    """Return the observations of each case in each control step: leaves (T, ...), by trial."""
    law = law_of(cases[0].params)
    worlds = pushes.build(cases, setting)
    period, trials = setting.physics.control_period, []
    for trace in pushes.record_batch(worlds, setting, recorded_law(law), interval=period):
        snapshots = trace.snapshots
        observation = tuple(snapshots.details)[1]  # of `recorded_law`, with taxels
        leaves = jax.tree.leaves(observation.touch if law.senses == "touch" else observation)
        trials.append([np.broadcast_to(x, (len(snapshots.time), *x.shape[1:])) for x in leaves])
    return trials


def in_the_loop(name: str, folder: Path) -> Any:
    """Register a law whose step runs in C with floats; return its parameters."""
    label, params = resolve_law(name)
    law, native = law_of(params), Native(program.program(name), folder, "float")

    def call_native(state: Any, obs: Any) -> Any:
        shape = np.shape(obs[0])[:-1]
        count = int(np.prod(shape))
        flat_state, flat_obs = (
            [np.asarray(x).reshape(count, *np.shape(x)[len(shape) :]) for x in group]
            for group in (state, obs)
        )
        native_state = native.filled("memory", flat_state, count)
        twist, _ = native.step(native_state, native.filled("observation", flat_obs, count))
        next_state = [
            np.asarray(native_state[f.name]).reshape(np.shape(x)).astype(x.dtype) if f.size else x
            for f, x in zip(native.program.groups["memory"], state, strict=True)
        ]
        return next_state, twist.reshape(*shape, 3)

    def step(_: Any, state: Any, obs: Any) -> Any:
        leaves, tree = jax.tree.flatten(state)
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        out = shapes, jax.ShapeDtypeStruct((3,), np.float32)
        inputs = leaves, jax.tree.leaves(obs)
        next_state, twist = jax.pure_callback(
            call_native, out, *inputs, vmap_method="broadcast_all"
        )
        details = Details.from_obs(getattr(obs, "touch", obs))
        return jax.tree.unflatten(tree, next_state), Twist(*twist), details

    return _registered(part_name(label, "in_c"), law, step, params)


def nudged(name: str, roundings: int) -> Any:
    """Register a law with rounding errors added to its twists; return its parameters."""
    label, params = resolve_law(name)
    law = law_of(params)

    def step(params: Any, state: Any, obs: Any) -> Any:
        state, twist, details = law.step(params.law, state, obs)
        changed: list[Any] = [x * np.float32(1 + roundings * 2**-23) for x in twist]
        return state, Twist(*changed), details

    suffix = f"{abs(roundings)}_{'down' if roundings < 0 else 'up'}"
    return _registered(part_name(label, suffix), law, step, params)


def _registered(name: str, law: Law, step: Any, params: Any) -> Any:
    """Register a law with another step; return parameters of a new class."""
    params_class = namedtuple(name, "law d_success")
    wrapped = params_class(params, params.d_success)
    register_law(name, Law(lambda p: law.init(p.law), step, senses=law.senses), wrapped)
    return wrapped


class Outcomes(NamedTuple):
    """Outcomes with the law in JAX, with the law in C, and in JAX with rounding errors."""

    trials: int
    in_jax: int  # successes in JAX
    in_c: int  # successes in C
    nudged: int  # smallest number of successes with rounding errors
    alike: int  # equal outcomes of JAX and C
    nudged_alike: int  # smallest number of equal outcomes with rounding errors
    apart: float  # [s] 99th percentile of the difference in time, if both succeed


def _compare(name: str, folder: Path, run: Any, roundings: Sequence[int]) -> Outcomes:
    """Return the outcomes of `run`, a function of the parameters of a law."""
    laws = [resolve_law(name)[1], in_the_loop(name, folder)]
    outcomes = [run(p) for p in [*laws, *(nudged(name, n) for n in roundings)]]
    succeeded = np.array([np.asarray(outcome.success).ravel() for outcome in outcomes], bool)
    times = [np.asarray(outcome.time).ravel() for outcome in outcomes[:2]]
    both = succeeded[0] & succeeded[1]
    apart = float(np.quantile(np.abs(times[0] - times[1])[both], 0.99)) if both.any() else 0.0
    in_jax, in_c, *nudged_counts = map(int, succeeded.sum(axis=1))
    _, alike, *nudged_alike = map(int, (succeeded == succeeded[0]).sum(axis=1))
    trials = succeeded.shape[1]
    return Outcomes(trials, in_jax, in_c, min(nudged_counts), alike, min(nudged_alike), apart)


def papers_trials(name: str, setting: Setting, folder: Path) -> Outcomes:
    """Return the outcomes of the paper's 144 trials."""
    cases = [
        (o, f, t) for o in parse_domain("paper").objects for f in FRICTION for t in paper.TARGETS
    ]

    def run(params: Any) -> Any:
        return pushes.run([Case(*options, law=params) for options in cases], setting)[0]

    return _compare(name, folder, run, ROUNDINGS)


def random_worlds(
    name: str, domain: DomainLike, worlds: int, setting: Setting, folder: Path
) -> Outcomes:
    """Return the outcomes in random worlds."""

    def run(params: Any) -> Any:
        return rps_jax.sweep({"law": params}, domain, worlds, setting=setting, progress=False)

    return _compare(name, folder, run, ROUNDINGS[:1])


class Bags(NamedTuple):
    """Differences between bags of random worlds and their trials."""

    bags: int
    commands: int
    greatest: float  # largest difference between replayed and recorded commands, as a share
    beyond: int  # commands with a share above 1e-6
    plain: float  # [m/s, rad/s] largest difference
    strange: int  # messages that differ when read by an independent library


def bags(name: str, domain: DomainLike, worlds: int, setting: Setting, folder: Path) -> Bags:
    """Write bags of random worlds, read them with `rosbags`, and feed them to their law."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    law = resolve_law(name)[1]
    rps_jax.sweep({"law": law}, domain, worlds, setting=setting, out=folder / "run", progress=False)
    errors, strange = [], 0
    for world in range(worlds):
        path = folder / f"{world}.mcap"
        rps_jax.replay(run=folder / "run", world=world, bag=path)
        twists_of = shadow(path, law)
        twists = np.stack([twists_of[name].values for name in ("v_x", "v_y", "omega")], -1)
        errors.append(np.abs(twists[1] - twists[0]))
        sent: list[tuple[float, ...]] = []
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, _, raw in reader.messages():
                message: Any = reader.deserialize(raw, connection.msgtype)
                if connection.topic == "/cmd_vel":
                    twist = message.twist
                    sent.append((twist.linear.x, twist.linear.y, twist.angular.z))
        missing = abs(len(sent) - len(twists[0]))
        strange += missing or int((np.array(sent) != twists[0]).any(-1).sum())
    plain = np.concatenate(errors)
    error = (plain / scale_of(law)).max(-1)
    beyond = int((error > TOLERANCE["float"]).sum())
    return Bags(worlds, error.size, float(error.max()), beyond, float(plain.max()), strange)
