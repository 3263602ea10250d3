"""MJX-Warp: what a step computes, what is batched, what is lost.

    pip install '.[dev,warp]' && pytest -n 0 tests/with_warp.py

is no part of the suite: with warp-lang installed, every import of MJX takes twice as long. Users
get the engine on NVIDIA GPUs alone. Its kernels also compile for a processor, where these tests put
its steps beside those of C MuJoCo on the same scene: with a cylinder that touches the base itself.
"""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_fused import FINE, STARTS, TWIST, in_c, start

from rps_jax import engines
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.observation import Twist
from rps_jax.engines import mjx as mjx_engine
from rps_jax.engines import warp
from rps_jax.engines.base import Driven, Motion
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.trials import pushes
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import domain, draws, scene
from rps_jax.world.domain import DOMAINS
from rps_jax.world.objects import FAMILIES
from rps_jax.world.physics import Physics
from rps_jax.world.scene import FRICTION

SHORT = Setting(physics=FINE, rules=Rules(horizon=0.1), engine="warp")


@pytest.fixture(scope="module", autouse=True)
def plain_kernels():
    """Kernels that are quickly compiled, and slow."""
    mjx.warp.warp.init()  # which says that there is no GPU
    config = mjx.warp.warp.config
    before, config.optimization_level = config.optimization_level, 0
    yield
    config.optimization_level = before


@pytest.fixture
def allowed(monkeypatch):
    """As if there were a GPU."""
    monkeypatch.setattr(warp.Warp, "check", lambda self, families=(): None)


def drive(stage, fields, qpos, steps=1):
    """Worlds `Driven` for some steps from rest at qpos (n, 10)."""
    still = jnp.zeros((len(qpos), 9))
    state = Driven(Motion(jnp.asarray(qpos), still, still), jnp.zeros(len(qpos), bool))
    return _drive(stage, jax.tree.map(jnp.asarray, fields), state, steps)


@jax.jit
def _drive(stage, fields, state, steps):
    twists = Twist(*(jnp.full(len(state.motion.qpos), v) for v in TWIST))

    def one(_, now):
        driven = stage.drive(fields, now.motion, twists, FINE)
        return driven._replace(overflowed=driven.overflowed | now.overflowed)

    return jax.lax.fori_loop(0, steps, one, state)


@functools.cache
def pushed(family, cone, steps):
    """Worlds of a family after some steps: in Warp, as one batch, and in C."""
    physics = replace(FINE, cone=cone)
    begun = [start(*s, physics) for s in STARTS if FAMILIES[s[0]] == family]
    stage, fields = engines.get("warp").stage_of_scenes(
        [loaded for loaded, *_ in begun], np.arange(len(begun))
    )
    qpos = np.array([qpos for *_, qpos in begun])
    found = drive(stage, fields, qpos, steps)
    models = [warp.own_cylinder(loaded.physics) for loaded, *_ in begun]
    theirs = [in_c(m, q, steps) for m, q in zip(models, qpos, strict=True)]
    return found, [np.array(x) for x in zip(*theirs, strict=True)]


# --- what a step computes ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("family", "cone"), [("box", "elliptic"), ("box", "pyramidal"), ("cylinder", "elliptic")]
)
def test_a_step_ends_where_c_mujoco_ends_it(family, cone, allowed):
    (qpos, qvel, _, lost), (pose, velocity) = pushed(family, cone, 1)
    # In float32 the normal of a round side is found within 2e-6 rad: of 1 mm and 1 s, 1e-5 m.
    near, slow = (1e-6, 1e-4) if family == "box" else (1e-5, 2e-3)
    np.testing.assert_allclose(qpos, pose, atol=near)
    np.testing.assert_allclose(qvel, velocity, atol=slow)
    assert not lost.any()


@pytest.mark.parametrize("family", ["box", "cylinder"])
def test_a_push_of_half_a_second_ends_where_c_mujoco_ends_it(family, allowed):
    (qpos, *_), (pose, _) = pushed(family, "elliptic", 50)
    np.testing.assert_allclose(qpos, pose, atol=2e-3)


def test_the_physics_that_was_asked_for_is_solved():
    """Warp by itself would end its solver at 1e-6, long before an object's accelerations are."""
    physics = Physics(impratio=7.0, iterations=9, ls_iterations=11)
    loaded = scene.load("box", physics, FRICTION["S2"])
    model = warp.put(loaded.physics)
    assert (model.opt.iterations, model.opt.ls_iterations) == (9, 11)
    assert float(model.opt.tolerance) == pytest.approx(1e-13)
    assert float(model.opt._impl.impratio_invsqrt) == pytest.approx(7**-0.5)
    assert (model.opt.cone, model.opt.solver) == (1, 2)  # elliptic, Newton
    for name in ("pair_friction", "pair_solref", "pair_solimp", "pair_dim"):
        np.testing.assert_allclose(getattr(model, name), getattr(loaded.physics, name), rtol=1e-6)


def test_the_base_touches_the_cylinder_itself_and_not_its_stand_in():
    """Which is a capsule in the place of its side."""
    loaded = scene.load("cylinder").physics
    ground, base, cylinder, side = (
        loaded.geom(name).id for name in ("ground", "base", "object", "object_side")
    )
    model = warp.put(warp.own_cylinder(loaded))
    pairs = {tuple(sorted(map(int, pair))) for pair in model._impl.nxn_geom_pair_filtered}
    assert pairs == {(ground, cylinder), (base, cylinder)}
    assert side in loaded.pair_geom2  # C MuJoCo and MJX still have it
    # Which is seen in C MuJoCo: flat on the base's face, the capsule touches it at one point only.
    with_capsule, _, qpos = start("cylinder", 0.0, 0.08)
    models = with_capsule.physics, warp.own_cylinder(with_capsule.physics)
    one, both = (in_c(m, qpos, 1)[0] for m in models)
    assert np.abs(one - both).max() > 1e-4


# --- what is batched -----------------------------------------------------------------------


def test_what_differs_between_worlds_is_batched_or_not_used_by_warp():
    batched = mjx.warp.types._BATCH_DIM["Model"]
    others = [name for name in mjx_engine.FIELDS if not batched.get(name.removeprefix("."))]
    assert others == [".stat.meaninertia", ".dof_M0"]
    model = warp.put(scene.load("box").physics)
    assert not any(hasattr(model._impl, name) for name in ("meaninertia", "dof_M0"))


@pytest.mark.parametrize("name", ["random_box", "random_cylinder"])
def test_random_worlds_are_stepped_in_a_batch_as_each_is_alone(name, allowed):
    """Alone, that is as MuJoCo compiled it: sizes, masses, inertias and friction differ."""
    family = domain.RANDOM[name]
    count = sum(FAMILIES[s[0]] == family for s in STARTS)  # as in `pushed`: compiled once
    chosen = replace(DOMAINS["wide"], objects=(name,), gap=domain.Range(0, 0))
    drawn = draws.draw(chosen, 3, range(count))
    part = drawn_worlds(chosen, drawn, RPSParams.paper(), SHORT)
    qpos = np.array(part.worlds.qpos)
    qpos[:, 3] -= 5e-4  # sunk, so that they touch
    qpos[:, 5] -= 5e-4
    found, *_ = drive(part.stage, part.worlds.fields, qpos)
    assert np.unique(np.abs(found - qpos).sum(axis=1)).size == count
    for i in range(count):
        one = scene.of_solid(family, drawn.solid, drawn.friction, FINE, i)
        stage, fields = engines.get("warp").stage_of_scenes([one], np.zeros(count, int))
        alone, *_ = drive(stage, fields, qpos[[i] * count])
        np.testing.assert_allclose(alone, jnp.tile(found[i], (count, 1)), atol=1e-6)


def test_double_precision_is_given_back_as_double(allowed):
    with jax.enable_x64(True):
        loaded, _, qpos = start("box", 0.0, 0.0)
        stage, fields = engines.get("warp").stage_of_scenes([loaded], np.zeros(1, int))
        found = drive(stage, fields, qpos[None].astype(float))
        assert {str(x.dtype) for x in found} == {"float64", "bool"}
        np.testing.assert_allclose(found.qpos[0], in_c(loaded.physics, qpos, 1)[0], atol=1e-6)


# --- what is lost --------------------------------------------------------------------------


def test_contacts_without_room_are_counted_and_reported_and_print_nothing(
    allowed, monkeypatch, capfd
):
    cases = [pushes.Case("box", FRICTION["S1"], (2.0, y)) for y in (-1.0, 0.0, 1.0)]
    # The box stands on four points: room for two in each world holds half of them.
    monkeypatch.setattr(warp, "blank", functools.partial(warp.blank, contacts=2))
    with pytest.warns(UserWarning, match="lost contacts for want of room in 3 trials"):
        outcome, _ = pushes.run(cases, SHORT, slots=3, workers=1)
    assert (outcome.overflows >= 5).all()  # control periods
    np.testing.assert_allclose(outcome.time, 0.1, atol=0.02)
    assert capfd.readouterr() == ("", "")
