"""Functions of one world that a C compiler compiles have the results of XLA."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import same, setting_of, slow
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax import Details, Law, Twist, replay, sweep
from rps_jax.control import registry
from rps_jax.engines import native
from rps_jax.engines.base import ControlPeriod
from rps_jax.lowering import builder, compounds, walk, writer
from rps_jax.trials import law_check, trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws
from rps_jax.world.domain import DOMAINS, Range

pytestmark = pytest.mark.skipif(native.target() is None, reason="there is no C compiler")


@pytest.fixture
def cache(tmp_path):
    """Return an empty cache folder; no compiled function is loaded."""
    previous, loaded = jax.config.jax_compilation_cache_dir, dict(native.libraries)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    native.libraries.clear()
    yield tmp_path / "native"
    native.libraries.update(loaded)
    jax.config.update("jax_compilation_cache_dir", previous)


def batch(
    shape, skin="capacitive", count=21, law="rps_tuned", engine="fused", domain="wide", **drawn
):
    """Return stage, (worlds, params) and loop of random objects at different positions."""
    _, params = registry.resolve_law(law)
    domain = replace(DOMAINS[domain], objects=(f"random_{shape}",), skin=skin, **drawn)
    setting = Setting(engine)
    part = drawn_worlds(domain, draws.draw(domain, 3, np.arange(count)), setting)
    _, worlds, stage, params = jax.tree.map(jnp.asarray, part.with_params(params))
    loop = ControlLoop(setting.physics, setting.rules, registry.law_of(params))
    return stage, (worlds, params), loop


def advance(stage, loop, steps):
    """Return the function of (worlds, params) and trials that steps them."""
    return lambda w, p, t: trial.advance([(stage, w, p, t)], loop, steps)[0]


def advanced(stage, inputs, trials, loop, steps):
    """Return trials after `steps` control steps of a batch."""
    return jax.device_get(jax.jit(advance(stage, loop, steps))(*inputs, trials))


def start_trials(inputs, loop):
    start = jax.jit(trial.start_all, static_argnums=3)
    return start(*inputs, np.ones(len(inputs[0].qpos), bool), loop.law)


def build_push(*arguments, **drawn):
    """Return the values of `batch`, and trials in the middle of a push, after 8 s."""
    stage, inputs, loop = batch(*arguments, **drawn)
    step, pushing = jax.jit(advance(stage, loop, 1)), start_trials(inputs, loop)
    for _ in range(400):  # a program of one step, which the tests compile anyway
        pushing = step(*inputs, pushing)
    assert np.mean(pushing.contact_steps > 0) > 0.5
    return stage, inputs, loop, pushing


def close(actual, desired, warm, rest):
    """Assert that trials agree; accelerations [m/s^2] to the solver's tolerance of 1e-4."""
    assert_allclose(actual.warmstart, desired.warmstart, atol=warm)
    pairs = zip(*(jax.tree.leaves(x._replace(warmstart=0)) for x in (actual, desired)), strict=True)
    for a, b in pairs:
        assert_allclose(a, b, rtol=1e-4, atol=rest)


@pytest.mark.slow  # below, a whole sweep agrees with XLA
@pytest.mark.parametrize(
    ("shape", "skin"), [("cylinder", "ideal"), ("box", "capacitive"), ("prism", "capacitive")]
)
def test_a_control_step_agrees_with_xla(shape, skin, monkeypatch):
    stage, inputs, loop, pushing = build_push(shape, skin)
    computed = advanced(stage, inputs, pushing, loop, 1)
    monkeypatch.setenv("RPS_COMPILER", "none")
    expected = advanced(stage, inputs, pushing, loop, 1)
    close(computed, expected, warm=4e-3, rest=2e-5)


@pytest.mark.parity
@pytest.mark.parametrize("shape", ["cylinder", slow("prism")])
def test_the_bits_of_a_world_depend_on_no_other_world(shape):
    stage, inputs, loop = batch(shape)
    together = advanced(stage, inputs, start_trials(inputs, loop), loop, 300)
    for order in (np.arange(20, -1, -1), np.array([17]), np.resize([5, 17, 5], 21)):
        subset = jax.tree.map(lambda x, order=order: np.asarray(x)[order], inputs)
        computed = advanced(stage, subset, start_trials(subset, loop), loop, 300)
        same(computed, jax.tree.map(lambda x, order=order: x[order], together))


@pytest.mark.slow
def test_a_drive_is_compiled_and_its_derivative_is_xlas(monkeypatch):
    stage, inputs, loop = batch("box", count=3)
    start = trial.motion(start_trials(inputs, loop))
    still = jnp.zeros(3)

    def moved(speed):
        twist = trial.Twist(speed, still, still)
        period = ControlPeriod(twist, loop.physics)
        return stage.drive(inputs[0].fields, start, period).motion.qpos[:, 0]

    def slope():
        return jax.jit(lambda x: jax.jvp(moved, (x,), (jnp.ones(3),)))(still + 0.05)

    def lowered():
        return jax.jit(lambda x: moved(x)).lower(still).as_text()

    assert "rps_native" in lowered()
    computed = slope()
    monkeypatch.setenv("RPS_COMPILER", "none")
    assert "rps_native" not in lowered()
    same(computed, slope())


def test_without_a_compiler_batches_share_one_loop(monkeypatch):
    batches = (batch(shape, count=2) for shape in ("box", "prism"))
    stages, inputs, loops = zip(*batches, strict=True)
    trials = tuple(start_trials(subset, loops[0]) for subset in inputs)
    monkeypatch.setenv("RPS_COMPILER", "none")
    run = jax.make_jaxpr(
        lambda *leaves: trial.advance(list(zip(stages, *leaves, strict=True)), loops[0], 3)
    )
    primitives = [eqn.primitive.name for eqn in run(*zip(*inputs, strict=True), trials).eqns]
    assert primitives.count("while") == 1


def executable(path, script):
    path.write_text(f"#!/bin/sh\n{script}")
    path.chmod(0o755)
    return path


def test_a_failing_compiler_warns_once_and_xla_compiles(monkeypatch, tmp_path, cache):
    script = 'case "$*" in *-dM*) exit 0;; esac\necho it is broken >&2\nexit 1\n'
    monkeypatch.setenv("RPS_COMPILER", str(executable(tmp_path / "broken", script)))
    run = native.batched(lambda x: 2 * x, lambda x: 3 * x)
    with pytest.warns(UserWarning, match="fails, so XLA compiles: it is broken") as caught:
        results = [jax.jit(lambda x: run(x))(jnp.ones(n)).tolist() for n in (2, 3)]
    assert len({str(warning.message) for warning in caught}) == 1
    assert results == [[3.0] * 2, [3.0] * 3]


def test_a_gpu_without_a_compiler_warns(monkeypatch):
    monkeypatch.setattr(native, "target", lambda: None)
    assert not native.is_available()  # a processor without a compiler is common
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.warns(UserWarning, match="a C compiler .* is not installed, so XLA compiles"):
        assert not native.is_available()
    monkeypatch.setenv("RPS_COMPILER", "none")
    assert not native.is_available()  # the user chose XLA


@pytest.mark.parametrize("damage", ["cut", "turned", "empty"])
def test_a_damaged_function_is_dropped_with_one_line(damage, cache, monkeypatch):
    x, more = jnp.arange(5.0), float(len(damage))  # a different function for each case
    expected = (2 * x + more).tolist()

    def run():
        return np.asarray(jax.jit(native.batched(lambda x: 2 * x + more, None))(x)).tolist()

    assert run() == expected
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda *_, **__: None)  # once a process
    (cached,) = cache.iterdir()
    content = cached.read_bytes()
    changed = {
        "cut": content[:100],
        "empty": b"",
        "turned": content[:-1] + b"%c" % (content[-1] ^ 1),
    }
    cached.write_bytes(changed[damage])
    native.libraries.clear()
    with pytest.warns(UserWarning, match="is dropped, and compiled again: its checksum") as caught:
        assert run() == expected
    assert len(caught) == 1
    native.libraries.clear()
    assert run() == expected
    assert cached.read_bytes() == content


def halvings(x):
    """Return the number of halvings until x is below 1, which differs between worlds."""
    return jax.lax.while_loop(lambda c: c[1] >= 1, lambda c: (c[0] + 1, c[1] / 2), (0, x))


def drawn(x):
    raw = jnp.stack([x.astype(jnp.uint32), jnp.uint32(7)])
    key = jax.random.fold_in(raw, x.astype(jnp.uint32))
    return jax.random.normal(key, (5,)), jax.random.bits(jax.random.split(key)[1])


# Further operations are in test_lowering.
OPERATIONS = {
    "a loop": halvings,
    "a scan": lambda x: jax.lax.scan(
        lambda c, y: (c + y * x, (c, y)), jnp.zeros(2), jnp.arange(6.0).reshape(3, 2)
    ),
    "draws": drawn,
    "a slice of many": lambda x: jnp.concatenate(
        [x * jnp.arange(20.0), jnp.full(20, 5.0), x[None]]
    )[15:35],
    "products of matrices": lambda x: (
        (x * jnp.arange(12.0).reshape(4, 3)) @ (x - jnp.arange(3.0)),
        jnp.arange(3.0) @ (x * jnp.arange(6.0).reshape(3, 2)),
        jnp.einsum("bij,bjk->bik", jnp.ones((2, 2, 3)) * x, jnp.arange(24.0).reshape(2, 3, 4)),
    ),
    "rows": lambda x: jnp.argmax((x.astype(int) * jnp.arange(6) % 5).reshape(2, 3), axis=1),
    "inverse error function": lambda x: jax.lax.erf_inv((x - 9) * jnp.array([0.0, 0.1, 0.111111])),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_an_operation_agrees_with_jax(name):
    x, function = jnp.arange(19.0), OPERATIONS[name]
    run = native.batched(function, lambda _: pytest.fail("it was not compiled"))
    for a, b in zip(*map(jax.tree.leaves, (jax.jit(run)(x), jax.vmap(function)(x))), strict=True):
        assert a.dtype == b.dtype
        assert_allclose(a, b, rtol=3e-6, atol=1e-6)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_scan_with_a_large_body_is_a_loop(reverse, monkeypatch):
    monkeypatch.setattr(walk, "_MAX_UNROLLED", 0)

    def function(x):
        rows = jnp.arange(6.0).reshape(3, 2), x * jnp.arange(3.0)
        step = lambda c, y: (c + y[0] * x, (c, y[1] + c[0], y[0] > x))  # noqa: E731
        return jax.lax.scan(step, jnp.ones(2), rows, reverse=reverse)

    x = jnp.arange(5.0)
    run = native.batched(function, lambda _: pytest.fail("it was not compiled"))
    for a, b in zip(*map(jax.tree.leaves, (jax.jit(run)(x), jax.vmap(function)(x))), strict=True):
        assert_allclose(a, b, rtol=1e-6)


def test_constants_are_moved_as_jax_moves_them():
    def function(x):
        parts = jnp.split(x, [1, 3], axis=1)
        rows = jnp.pad(x, ((1, 0), (0, 2)), constant_values=7), x[:, ::-1], x.T, *parts
        return [*rows, jax.lax.pad(x, jnp.float32(3), ((1, 0, 1), (-1, 0, 0))), *x]

    x = np.arange(12, dtype=np.float32).reshape(3, 4)
    results = walk.walk(jax.make_jaxpr(function)(x), [x], builder.SimdBuilder())
    for a, b in zip(results, function(jnp.asarray(x)), strict=True):
        assert_array_equal(a, b)


def test_a_scan_of_worlds_is_that_of_jax_and_so_are_its_derivatives(monkeypatch):
    """By what varies alone; constants, integers and stored numbers are not differentiated."""
    compiled = []

    def recorded(functions, original=native._compiled):
        compiled.append(functions)
        return original(functions)

    monkeypatch.setattr(native, "_compiled", recorded)

    def step(state, constants, saved):
        (x, count), (a, b) = state, constants
        root = saved or (jnp.sqrt(1 + x * x),)  # stored numbers are constant
        x = x + a * jnp.sin(x) * b["k"].sum() + 0.1 * root[0]
        return ((x, count + 1), {"x": x * count}), root

    def score(x, a, k, scan):
        end, out = scan(step, (x, jnp.arange(4)), (a, {"k": k}), 5)
        return (end[0] ** 2).sum() + (out["x"] * jnp.arange(1.0, 6)[:, None]).sum()

    def by_jax(step, state, constants, length):
        def whole(state, _):
            state = state[0], state[1]
            fixed = jax.vmap(lambda *x: step(*x, ())[1])(state, constants)
            fixed = jax.lax.stop_gradient(fixed)
            return jax.vmap(lambda *x: step(*x)[0])(state, constants, fixed)

        return jax.lax.scan(whole, state, length=length)

    inputs = jnp.linspace(0.1, 1, 4), jnp.linspace(0.2, 0.5, 4), jnp.full((4, 3), 0.3)
    for transform in (
        lambda f: jax.grad(f, argnums=(0, 1, 2)),
        lambda f: jax.grad(f, argnums=1),
        lambda f: jax.jacfwd(f, argnums=2),
        lambda f: f,
    ):
        native_result, expected = (
            jax.jit(transform(lambda *x, scan=scan: score(*x, scan)))(*inputs)
            for scan in (native.scan, by_jax)
        )
        for a, b in zip(*map(jax.tree.leaves, (native_result, expected)), strict=True):
            assert_allclose(a, b, rtol=1e-5)
    assert len(compiled) == 7  # forward, and backward or a tangent map


SLIPS = dict.fromkeys(("robot_slip", "robot_slip_sideways", "robot_slip_yaw"), Range(0, 0.5))


@pytest.mark.parametrize(
    ("law", "options"),
    [
        slow("rps", {"skin": "ideal"}),
        *((x, {}) for x in ("rps", "rps_plus", "pursuit")),
        *(slow(x, {}) for x in ("aps", "dipole")),
        slow("rps", {"domain": "real", **SLIPS}),
    ],
)
def test_the_loop_of_an_equation_is_compiled_as_a_whole(law, options, monkeypatch):
    monkeypatch.setattr(native, "load", lambda name: True)  # no compiler runs
    stage, inputs, loop = batch("box", count=2, law=law, **options)
    primitives = str(jax.make_jaxpr(advance(stage, loop, 3))(*inputs, start_trials(inputs, loop)))
    assert "rps_native" in primitives
    assert "while" not in primitives


def test_the_physics_of_a_learned_law_is_differentiated_natively(monkeypatch):
    """XLA compiles the law alone: it would take very long for a whole control step."""
    monkeypatch.setattr(native, "load", lambda name: True)  # no compiler runs
    stage, (worlds, params), loop = batch("cylinder", count=2, law="learned_small")
    trials = start_trials((worlds, params), loop)

    def path_length(params):
        run = stage, worlds, params, trials, loop, 2, native.mapped
        return jnp.sum(trial.unroll(*run)[0].path_length)

    program = jax.make_jaxpr(jax.grad(path_length))(params)
    assert "rps_native" in str(program)


UNSUPPORTED = (
    "operation `lgamma` cannot be translated; use arithmetic, comparisons, jnp.where and "
    "elementary functions. XLA compiles this law, which is some ten times slower."
)
FALLBACKS = {
    "large products, as of a learned law": (lambda x: jnp.ones((99, 3)) * x @ jnp.ones(3), []),
    "an unsupported operation": (lambda x: jax.lax.lgamma(x + 1) * 3 * x, [UNSUPPORTED]),
}


@pytest.mark.parametrize("name", FALLBACKS)
def test_xla_compiles_other_functions_and_the_reason_is_named_once(name, recwarn):
    function, reasons = FALLBACKS[name]
    run = native.batched(function, lambda x: 3 * x)
    for _ in range(2):
        assert np.asarray(run(jnp.arange(2.0))).tolist() == [0.0, 3.0]
    for warning, reason in zip(recwarn, reasons, strict=True):
        assert reason in str(warning.message)


@pytest.mark.parametrize("owner", [builder, writer.Writer])
def test_an_error_of_the_compiler_itself_is_raised(owner, monkeypatch):
    """A fault of a builder or a pass must not make a run ten times slower in silence."""
    name = "walk" if owner is builder else "_next_group"
    monkeypatch.setattr(owner, name, lambda *_: {}["num_consts"])
    run = native.batched(jnp.sin, lambda x: pytest.fail("XLA compiled it"))
    with pytest.raises(KeyError, match="num_consts"):
        run(jnp.arange(2.0))


@pytest.mark.parametrize("engine", ["fused", "quasistatic", slow("mjx")])
def test_only_the_fused_engine_calls_compiled_functions(engine, monkeypatch):
    monkeypatch.setattr(native, "load", lambda name: True)
    stage, inputs, loop = batch("box", "ideal", 2, "rps", engine)
    run = jax.make_jaxpr(advance(stage, loop, 1))
    assert ("rps_native" in str(run(*inputs, start_trials(inputs, loop)))) == (engine == "fused")


class MineParams(NamedTuple):
    """Parameters of a custom law, which chooses by bools and sorts."""

    v: float = 0.05
    d_success: float = 0.05


def mine_step(params, state, obs):
    count, past, empty = state
    past = past.at[count % 5].set(obs.l)
    left, touches = obs.l > 0.01, obs.in_contact
    v_y = jnp.select([touches > left, touches], [-0.01, 0.01], 0.0)
    w = jnp.array([0.2, -0.2, 0.0])[jnp.argmax(jnp.stack([jnp.median(past) > 0, left, touches]))]
    w = w * jax.lax.cond(touches & (count % 3 == 0), lambda: 0.5, lambda: 1.0)
    return (count + 1, past, empty), Twist(params.v, v_y, w), Details.from_obs(obs)


@pytest.fixture
def mine(registries):
    """Register a custom law and return its parameters."""
    state = jnp.zeros((), jnp.int32), jnp.zeros(5), jnp.zeros((2, 0))
    law = Law(lambda params: state, mine_step)
    registry.register_law("mine", law, MineParams())
    return MineParams()


@pytest.mark.parity
def test_a_custom_law_is_compared_with_xla_before_a_run_once(mine, cache, monkeypatch, recwarn):
    setting, domain = Setting("fused"), replace(DOMAINS["wide"], objects=("box",))
    part = drawn_worlds(domain, draws.draw(domain, 3, np.arange(2)), setting)
    law_check.warn_of_difference(part.with_params(mine), setting)
    assert not recwarn.list
    monkeypatch.setitem(compounds.COMPOUNDS, "gt_b", lambda x, y: ~x & y)
    for _ in range(2):
        with pytest.warns(UserWarning, match="law of MineParams gives other results as compiled"):
            law_check.warn_of_difference(part.with_params(mine), setting)
        monkeypatch.setattr(native, "batched", None)  # the result is cached


def test_a_sweep_of_a_custom_law_is_a_push_in_xla(mine, tmp_path, monkeypatch):
    setting = setting_of(8.0, "fused")
    swept = sweep("mine", "wide,objects=cylinder,gap=0.01", worlds=2, setting=setting, out=tmp_path)
    monkeypatch.setenv("RPS_COMPILER", "none")
    pushed = replay(tmp_path, 1)
    ends = swept.isel(world=1).squeeze()
    assert float(ends.path_length) > 0.3
    for name in ("path_length", "min_distance", "mean_abs_l", "contact_lost_time"):
        error = abs(float(ends[name]) - float(getattr(pushed.outcome, name)))
        assert error < 1e-4, (name, error)


def test_another_compiler_shares_no_cached_function(tmp_path, monkeypatch):
    """Its flags may differ, and with them the last bits of results."""
    default = native.target()
    wrapper = executable(tmp_path / "cc", 'exec cc "$@" -O1\n')
    monkeypatch.setenv("RPS_COMPILER", str(wrapper))
    assert native.target() not in (None, default)
