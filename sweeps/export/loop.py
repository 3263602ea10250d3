"""Trials with an exported law in the loop, and what whole trials and their bags give back."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import rps_jax
from rps_jax.app.export import program
from rps_jax.app.shadow import shadow
from rps_jax.control import registry
from rps_jax.control.base import Law
from rps_jax.control.observation import Details, Twist
from rps_jax.lowering.routine import identifier
from rps_jax.runs.push import recorded_law
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.scene import FRICTION
from sweeps.export.native import TOLERANCE, Native, scale_of

OFF = (1, -1, 2, -2, 4, -4, 8, -8)  # roundings of a twist, of 2^-23 each


def recorded(cases: Sequence[Case], setting: Setting) -> list[Any]:
    """What the law of each case observed in each control step: leaves (T, ...), by trial."""
    law = registry.law_of(cases[0].params)
    part = pushes.build(cases, setting)
    period, found = setting.physics.control_period, []
    for followed in pushes.record_batch(part, recorded_law(law), setting, interval=period):
        seen = followed.snapshots
        observed = tuple(seen.details)[1]  # of `recorded_law`, with taxels
        leaves = jax.tree.leaves(observed.touch if law.senses == "touch" else observed)
        found.append([np.broadcast_to(x, (len(seen.time), *x.shape[1:])) for x in leaves])
    return found


def in_the_loop(name: str, where: Path) -> Any:
    """Parameters of a law of this process whose step is that in C, in float."""
    label, params = registry.resolve_law(name)
    law, native = registry.law_of(params), Native(program.program(name), where, "float")

    def called(memory: Any, seen: Any) -> Any:
        shape = np.shape(jax.tree.leaves(seen)[0])[:-1]
        count, given = int(np.prod(shape)), native.filled
        flat = [
            [np.asarray(x).reshape(count, *np.shape(x)[len(shape) :]) for x in group]
            for group in (memory, seen)
        ]
        mine = given("memory", flat[0], count)
        twist, _ = native.step(mine, given("observation", flat[1], count))
        after = [
            np.asarray(mine[f.name]).reshape(np.shape(x)).astype(x.dtype) if f.size else x
            for f, x in zip(native.program.groups["memory"], memory, strict=True)
        ]
        return after, twist.reshape(*shape, 3)

    def step(_: Any, memory: Any, seen: Any) -> Any:
        tree = jax.tree.structure(memory)
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jax.tree.leaves(memory)]
        out = (shapes, jax.ShapeDtypeStruct((3,), np.float32))
        after, twist = jax.pure_callback(
            called, out, jax.tree.leaves(memory), jax.tree.leaves(seen),
            vmap_method="broadcast_all",
        )  # fmt: skip
        return (
            jax.tree.unflatten(tree, after),
            Twist(*twist),
            Details.from_obs(getattr(seen, "touch", seen)),
        )

    return _registered(f"{identifier(label)}_in_c", law, step, params)


def nudged(name: str, roundings: int) -> Any:
    """Parameters of a law of this process whose every twist is greater by some roundings."""
    label, params = registry.resolve_law(name)
    law = registry.law_of(params)

    def step(own: Any, memory: Any, seen: Any) -> Any:
        memory, twist, details = law.step(own.law, memory, seen)
        more: list[Any] = [x * np.float32(1 + roundings * 2**-23) for x in twist]
        return memory, Twist(*more), details

    off = f"{abs(roundings)}_{'down' if roundings < 0 else 'up'}"
    return _registered(f"{identifier(label)}_{off}", law, step, params)


def _registered(name: str, law: Law, step: Any, params: Any) -> Any:
    """Parameters, of a class of their own, of a law with another step."""
    kind = namedtuple(name, "law d_success")
    mine = kind(params, params.d_success)
    registry.register_law(name, Law(lambda p: law.init(p.law), step, senses=law.senses), mine)
    return mine


class Ends(NamedTuple):
    """How trials end with a law of JAX, with that of C in the loop, and with JAX roundings off."""

    trials: int
    in_jax: int  # succeed
    in_c: int
    nudged: int  # the least of JAX with every twist off by some roundings
    alike: int  # succeed with JAX and C, or with neither
    nudged_alike: int  # the least of JAX, and of JAX roundings off
    apart: float  # [s] 99th percentile of the difference of the times of those that both succeed in


def _ends(name: str, where: Path, run: Any, roundings: Sequence[int]) -> Ends:
    """Ends of the trials that `run` makes with a law's parameters."""
    laws = [registry.resolve_law(name)[1], in_the_loop(name, where)]
    outcomes = [run(p) for p in [*laws, *(nudged(name, n) for n in roundings)]]
    won = [np.asarray(one.success).astype(bool).ravel() for one in outcomes]
    times = [np.asarray(one.time).ravel() for one in outcomes[:2]]
    both = won[0] & won[1]
    apart = np.abs(times[0] - times[1])[both]
    counts = [int(one.sum()) for one in won]
    alike = [int((won[0] == one).sum()) for one in won]
    most = float(np.quantile(apart, 0.99)) if both.any() else 0.0
    return Ends(won[0].size, counts[0], counts[1], min(counts[2:]), alike[1], min(alike[2:]), most)


def papers_trials(name: str, setting: Setting, where: Path) -> Ends:
    """How the paper's 144 trials end."""
    cases = [(o, f, t) for o in PAPER_OBJECTS for f in FRICTION for t in paper.TARGETS]

    def run(params: Any) -> Any:
        return pushes.run([Case(*one, law=params) for one in cases], setting)[0]

    return _ends(name, where, run, OFF)


def random_worlds(name: str, domain: str, worlds: int, setting: Setting, where: Path) -> Ends:
    """How random worlds end."""

    def run(params: Any) -> Any:
        return rps_jax.sweep({"law": params}, domain, worlds, setting=setting, progress=False)

    return _ends(name, where, run, OFF[:1])


class Bags(NamedTuple):
    """What bags of random worlds give back."""

    bags: int
    commands: int
    greatest: float  # difference of the law that is fed the bag from what it commanded, as a share
    beyond: int  # commands whose share is more than 1e-6
    plain: float  # [m/s, rad/s] greatest difference
    strange: int  # messages that a reader which we did not write finds otherwise than they were


def bags(name: str, domain: str, worlds: int, setting: Setting, where: Path) -> Bags:
    """Write bags of random worlds, read them with `rosbags`, and feed them to their law."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    law = registry.resolve_law(name)[1]
    rps_jax.sweep({"law": law}, domain, worlds, setting=setting, out=where / "run", progress=False)
    errors, strange = [], 0
    for world in range(worlds):
        path = where / f"{world}.mcap"
        rps_jax.replay(run=where / "run", world=world, bag=path)
        found = shadow(path, law)
        twists = np.stack([found[one].values for one in ("v_x", "v_y", "omega")], -1)
        errors.append(np.abs(twists[1] - twists[0]))
        sent: list[tuple[float, ...]] = []
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, _, raw in reader.messages():
                message: Any = reader.deserialize(raw, connection.msgtype)
                if connection.topic == "/cmd_vel":
                    twist = message.twist
                    sent.append((twist.linear.x, twist.linear.y, twist.angular.z))
        lost = abs(len(sent) - len(twists[0]))
        strange += lost or int((np.array(sent) != twists[0]).any(-1).sum())
    plain = np.concatenate(errors)
    error = (plain / scale_of(law)).max(-1)
    beyond = int((error > TOLERANCE["float"]).sum())
    return Bags(worlds, error.size, float(error.max()), beyond, float(plain.max()), strange)
