"""Gradients by laws and worlds: exact, labelled, and refused where they do not exist."""

import contextlib
import re
import warnings
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOT, refusals, refusing, row, slow
from numpy.testing import assert_allclose

import rps_jax
from rps_jax import engines
from rps_jax.control import registry
from rps_jax.control.base import Bound
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.registry import LAWS, law_of
from rps_jax.engines import quasistatic
from rps_jax.errors import InputError
from rps_jax.trials import trajectory, trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trajectory import control_loop
from rps_jax.tuning import derivatives
from rps_jax.tuning.space import Space
from rps_jax.world import draws
from rps_jax.world.domain import PERFECT, QUANTITIES, VELOCITY_ERRORS, Range, parse_domain

README = (ROOT / "rps_jax" / "README.md").read_text().partition("### Gradients\n")[2]
QUASISTATIC = Setting("quasistatic")
TOUCHING = replace(
    parse_domain("wide,objects=random_cylinder,com_offset=0.1:0.4"),
    **PERFECT | {"lateral": Range(0.02, 0.12), "yaw": Range(-0.6, 0.6)},
    gap=Range(0.0, 0.002),
)
TOUCHING = replace(TOUCHING, noise=Range(0.01, 0.05))
NAMES = ("v_max", "friction_robot", "com_offset", "noise", "distance", "target", "com", "mass")


def final_distance(trajectory):
    """Distance [m] of the contact to the target at the end."""
    return trajectory.details.distance[-1]


def halved(trajectory):
    """Distance at the end, halved until it is below a millimetre: a loop of unknown length."""
    return jax.lax.while_loop(lambda x: x > 1e-3, lambda x: x / 2, final_distance(trajectory))


CONVERGED = partial(mock.patch.multiple, quasistatic, _ITERATIONS=14, _SHARP=7)


def gradients_of(domain, law="rps_tuned"):
    """The gradient in double precision; equal shapes share one program.

    By default three percent of the quasi-static steps do not converge, and err by some 1e-3.
    """
    options = {"horizon": 1.0, "setting": QUASISTATIC}
    with warnings.catch_warnings(action="ignore"), jax.enable_x64(True), CONVERGED():
        return rps_jax.value_and_grad(final_distance, law, domain, 4, NAMES, **options)


@pytest.fixture(scope="module")
def results():
    return gradients_of(TOUCHING)


def slope(results, name):
    return results.gradient.sel(quantity=name).values[0]


@pytest.mark.parametrize(
    "name", ["v_max", "com_offset", *map(slow, ("friction_robot", "noise", "distance"))]
)
def test_gradients_are_central_differences(results, name):
    h = 1e-5
    if name == "v_max":
        sides = [(TOUCHING, f"rps_tuned,v_max={0.05 + s * h}") for s in (1, -1)]
    else:
        low, high, _ = getattr(TOUCHING, name)
        ranges = [Range(low + s * h, high + s * h) for s in (1, -1)]
        sides = [(replace(TOUCHING, **{name: x}), "rps_tuned") for x in ranges]
    up, down = (gradients_of(*side).value.values[0] for side in sides)
    differences = (up - down) / (2 * h)
    assert np.abs(differences).max() > 1e-4
    assert_allclose(slope(results, name), differences, rtol=1e-5, atol=1e-8)


def test_vectors_agree_with_the_quantities_that_turn_and_stretch_them(results):
    bearing = results.bearing.values
    along = np.cos(bearing) * slope(results, "target_x")
    along += np.sin(bearing) * slope(results, "target_y")
    assert_allclose(along, slope(results, "distance"), rtol=1e-6)
    drawn = draws.draw(TOUCHING, 0, np.arange(4))
    x, y, _ = drawn.solid.p_object_com.T
    along = x * slope(results, "com_x") + y * slope(results, "com_y")
    # The quasi-static engine uses no inertia, which a moving load changes.
    assert_allclose(along, drawn.values["com_offset"] * slope(results, "com_offset"), 1e-6)


def test_the_mirrored_world_has_mirrored_gradients():
    numbers = draws.numbers

    def mirrored(seed, index):
        u = numbers(seed, index)
        return u | {"com_bearing": 1 - u["com_bearing"]}

    def domain(sign):
        turned = {"lateral": 0.08 * sign, "yaw": 0.3 * sign, "bearing": 0.7 * sign}
        fixed = {name: Range(value, value) for name, value in turned.items()}
        return replace(TOUCHING, **PERFECT | fixed)

    plain = gradients_of(domain(1))
    with mock.patch.object(draws, "numbers", mirrored):
        mirror_image = gradients_of(domain(-1))
    assert_allclose(plain.value, mirror_image.value, rtol=1e-9)
    for name, sign in {"target_x": 1, "target_y": -1, "com_x": 1, "com_y": -1, "v_max": 1}.items():
        assert np.abs(slope(plain, name)).max() > 1e-5, name
        assert_allclose(slope(plain, name), sign * slope(mirror_image, name), rtol=1e-6, atol=1e-9)


def test_the_results_are_labelled(results):
    assert results.gradient.dims == ("law", "world", "quantity")
    assert results.value.dims == results.norm.dims == ("law", "world")
    assert results["mean"].dims == results.error.dims == ("law", "quantity")
    units = dict(zip(results.quantity.values, results.unit.values, strict=True))
    assert units == {
        "v_max": "m/s",
        "friction_robot": "1",
        "com_offset": "1",
        "noise": "1",
        "distance": "m",
        "target_x": "m",
        "target_y": "m",
        "com_x": "m",
        "com_y": "m",
        "mass": "kg",
    }
    assert (results.kind == "parameter").values.tolist() == [True] + [False] * 9
    assert results.map_error.values.max() < 3e-4
    attrs = {"engine": "quasistatic", "horizon": 1.0, "seed": 0}
    assert attrs.items() <= results.attrs.items()
    assert results.attrs["skin_temperature"] == pytest.approx(0.03)
    assert {"mass", "friction_robot", "object"} <= set(results.coords)
    assert (results.finite == 1).all()
    norm = np.linalg.norm(results.gradient.values, axis=-1)
    assert_allclose(results.norm, norm)
    assert_allclose(results["mean"], results.gradient.mean("world"), rtol=1e-6)
    spread = results.gradient.std("world", ddof=1) / 2
    assert_allclose(results.error, spread, rtol=1e-5)


def test_a_mass_without_influence_is_told(results):
    assert (slope(results, "mass") == 0).all()
    assert re.search("mass has no influence.*robot='kairos'.*domain='real'", results.notes)
    notes = lambda name, domain, value=np.zeros((1, 2)), engine="fused": " ".join(  # noqa: E731
        derivatives._notes(
            parse_domain(domain),
            engine,
            derivatives.coordinates_of(name, RPSParams(), TOUCHING),
            np.array([True]),
            value,
            np.ones((1, 2, 1)),
            np.zeros((2, 1)),
            np.ones((1, 1)),
        )
    )
    assert "mass has no influence" in notes("mass", "wide")
    assert not notes("mass", "real")
    assert not notes("friction_ground", "wide")
    assert "not finite in 1 of 2 trials" in notes("mass", "real", np.array([[1.0, np.nan]]))
    assert "has not converged" in notes("friction_ground", "wide", engine="quasistatic")


def test_a_kink_of_the_world_has_no_derivative_and_is_told():
    """The principal axes of a square box are any."""
    square = parse_domain("wide,objects=random_box,aspect=1:1,com_offset=0:0")
    drawn = draws.draw(square, 0, np.arange(3))
    coordinates = derivatives.coordinates_of(("aspect", "height"), RPSParams(), square)
    slopes, bends = derivatives.world_slopes(square, drawn, Setting("fused"), coordinates)
    assert (bends[:, 0] > 0.1).all()
    assert bends[:, 1].max() < 1e-5
    assert ["world.fields.height" in slope for slope in slopes] == [False, True]
    gradient = np.where(bends > 0.01, np.nan, 1.0)[None]
    notes = derivatives._notes(
        square, "fused", coordinates, np.ones(2, bool), bends, gradient, bends, np.ones((1, 2))
    )
    notes = list(notes)
    assert "No world of 3 has a finite derivative, so the mean is NaN: aspect." in notes
    assert [x for x in notes if "kink" in x] == [
        "No derivatives in worlds whose numbers have a kink (see finite): aspect."
    ]


def test_the_table_of_names_is_that_of_the_code():
    table = re.findall(
        r"^\| (?:object|floor|task|skin|base|robot) \| (.*?) \|", README, re.MULTILINE
    )
    names = {name for line in table for name in re.findall(r"`(\w+)`", line)}
    smooth = {
        name
        for name, quantity in QUANTITIES.items()
        if not (quantity.jumps or quantity.owner == "course")
    }
    assert names == {*smooth, *VELOCITY_ERRORS, "com_bearing", "target", "com"}


def test_the_front_page_has_the_first_example_of_the_page():
    example = re.search(r"```python\n.*?```", README, re.DOTALL)[0]
    assert example in (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_examples_of_the_page_agree():
    """Reverse mode of the call, and forward mode of the plain JAX route, with the same worlds."""
    call, route = re.findall(r"```python\n(.*?)```", README, re.DOTALL)[:2]
    assert len([line for line in call.splitlines() if line]) <= 8
    assert len([line for line in route.splitlines() if line]) <= 10
    space = {}
    exec(call, space)
    exec(route, space)
    expected = space["results"].gradient.sel(quantity="K_h").values[0]
    assert np.isfinite(expected).all()
    assert_allclose(space["slopes"], expected, rtol=0.05, atol=1e-4)


def test_worlds_are_those_of_a_sweep_and_one_object_each():
    batch = rps_jax.draw_worlds("wide,objects=random_cylinder", 3, setting=Setting(seed=5))
    drawn = draws.draw(parse_domain("wide,objects=random_cylinder"), 5, np.arange(3))
    assert_allclose(batch.worlds.p_world_target, drawn.p_world_target, rtol=1e-6)
    with refusing("worlds of one program have one object"):
        rps_jax.draw_worlds("wide", 3)


BATCH = trajectory.draw_worlds(TOUCHING, 2, setting=QUASISTATIC)
ROUTE = {"world": row(BATCH.worlds, 0), "params": RPSParams(), "stage": BATCH.stage}
ROUTE |= {"setting": QUASISTATIC}
test_invalid_rollouts_are_refused = refusals(
    rps_jax.rollout,
    (
        ROUTE | {"horizon": 0.0},
        r"horizon = 0.0 .* at least 0.02 .*\[s\]",
    ),
    (ROUTE | {"horizon": "long"}, "horizon = long"),
    (ROUTE | {"horizon": 301.0}, r"horizon = 301.0 .* at most 300 \[s\]"),
    (ROUTE | {"world": BATCH.worlds}, "give one world, and map over several by jax.vmap"),
    (ROUTE | {"world": None}, "world = None is not allowed: give a World"),
    (ROUTE | {"world": BATCH}, "world = a WorldBatch is not allowed: give a World"),
    (ROUTE | {"setting": Setting("mujoco")}, "engine = mujoco is not allowed"),
    (ROUTE | {"setting": Setting()}, "engine = fused .* worlds were drawn for quasistatic"),
    (
        ROUTE | {"setting": Setting("quasistatic", "default,support=even")},
        "support = even is not allowed: the worlds were drawn with corners",
    ),
    (
        ROUTE
        | {
            "params": LAWS["pose"],
            "world": row(
                trajectory.draw_worlds(TOUCHING, task="path", setting=QUASISTATIC).worlds, 0
            ),
        },
        "task = path with the law pose is not allowed",
    ),
    (ROUTE | {"params": 3.0}, "params = 3.0"),
    (
        ROUTE | {"params": RPSParams(K_h=np.ones(4))},
        r"params.K_h = of shape \(4,\) .* give one number, and map over several by jax.vmap",
    ),
    (ROUTE | {"params": RPSParams(K_h=None)}, "rps.K_h = None"),
    (ROUTE | {"params": RPSParams(K_h=float("nan"))}, "rps.K_h = nan"),
    (
        ROUTE | {"params": rps_jax.control.registry.LAWS["pursuit"], "smooth": True},
        "smooth = True .* has no smooth form; choose .*rps_plus, .*or smooth=False",
    ),
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wrt": ("corners",)}, "wrt = corners .* worlds change in steps with it"),
        ({"wrt": "seed"}, "wrt = seed .* change in steps"),
        ({"wrt": "pose_latency"}, "wrt = pose_latency .* change in steps"),
        ({"wrt": ("dead_share",)}, "wrt = dead_share .* change in steps"),
        ({"wrt": ("friction",)}, r"unknown name of wrt 'friction': .*did you mean"),
        ({"wrt": ()}, "wrt = .* name each once, at least one"),
        ({"wrt": ("K_h", "K_h")}, "name each once"),
        ({"wrt": ("velocity_error", "v_x_error")}, "name each once"),
        ({"wrt": "robot_force"}, "wrt = robot_force .* append ,robot_force=LOW:HIGH"),
        ({"wrt": "feet"}, "wrt = feet .* append ,feet=LOW:HIGH"),
        ({"wrt": "mass", "domain": "paper"}, "wrt = mass .* leave no mass to draw"),
        ({"wrt": "distance", "domain": "paper"}, "wrt = distance .* its targets leave no distance"),
        ({"wrt": 3}, "wrt = 3"),
        ({"laws": "pursuit", "wrt": "K_v"}, "smooth = True .* this law has no smooth form"),
        ({"laws": ("rps", "rps_plus")}, "unknown name of wrt 'K_h'.*law.K_h"),
        ({"laws": "straight"}, "unknown law 'straight'"),
        ({"domain": "wild"}, "unknown domain 'wild'"),
        ({"worlds": 0}, "worlds = 0"),
        ({"horizon": -1.0}, "horizon = -1"),
        ({"score": "time"}, "score = 'time' is not allowed"),
        ({"score": halved}, "the derivative of score or law raises ValueError .*lax.while_loop"),
        ({"setting": Setting("mujoco")}, "engine = mujoco is not allowed: JAX must trace it"),
        ({"smooth": "yes"}, "smooth = 'yes'"),
    ],
)
def test_what_has_no_gradient_is_refused(changes, message):
    options = {"score": final_distance, "laws": "rps_tuned", "domain": TOUCHING, "worlds": 2}
    options |= {"wrt": "K_h", "horizon": 0.1, "setting": QUASISTATIC}
    with refusing(message):
        rps_jax.value_and_grad(**options | changes)


@pytest.mark.parametrize(
    ("score", "message"),
    [
        (lambda snapshots: None, "result of score = NoneType .* return one real number"),
        (lambda snapshots: {"low": 1.0}, "result of score = dict .* return one real number"),
        (lambda snapshots: 1, "result of score = int .* return one real number"),
        (lambda snapshots: jax.jit(float)(1.0), "score converts a traced value to a number: keep"),
        (lambda snapshots: snapshots.speed, r"score raises AttributeError .*speed"),
        (lambda snapshots: snapshots.done[-1], r"result of score = bool\[\]"),
        (lambda snapshots: np.float32(snapshots.done), r"result of score = float32\[5\]"),
    ],
)
def test_a_score_must_return_a_number(score, message):
    snapshots = SimpleNamespace(done=np.zeros(5, bool))
    options = derivatives._Options(score, 5, QUASISTATIC, False, False)
    with pytest.raises(rps_jax.InputError, match=message):
        derivatives._score(options, snapshots)


@pytest.mark.parametrize(
    "transform",
    [
        lambda call: jax.jit(lambda: call(RPSParams()))(),
        lambda call: jax.jit(lambda x: call(RPSParams(K_h=x)))(0.5),
        lambda call: jax.vmap(lambda x: call(RPSParams(K_h=x)))(np.ones(2)),
        lambda call: jax.grad(lambda x: call(RPSParams(K_h=x)))(0.5),
    ],
)
def test_functions_that_return_numbers_of_the_host_cannot_be_transformed(transform, compiled):
    words = "call it outside of jit, vmap and grad, or transform a function that calls rps_jax.roll"
    with refusing(f"value_and_grad returns .*{words}"):
        transform(lambda law: rps_jax.value_and_grad(final_distance, law).value.values)
    with refusing(f"evaluate returns .*{words}"):
        transform(lambda law: rps_jax.evaluate(law).score.values)
    with refusing(f"push returns .*{words}"):
        transform(lambda law: rps_jax.push(law=law).outcome.time)
    with refusing(f"sweep returns .*{words}"):
        transform(lambda law: rps_jax.sweep({"mine": law}).time.values)
    assert not compiled


def test_an_engine_without_a_mode_is_refused_before_anything_compiles(monkeypatch, compiled):
    monkeypatch.setattr("rps_jax.engines.fused.Fused.modes", ("forward",))
    with refusing(r"engine = fused .* it has no reverse-mode"):
        rps_jax.value_and_grad(setting=Setting("fused"))
    assert not compiled


def test_a_law_with_arrays_has_a_number_for_each_entry():
    network = rps_jax.control.registry.LAWS["rps"]._replace(K_h=np.ones((2, 1)))
    labels = [x.label for x in derivatives.coordinates_of(("K_h", "L"), network, TOUCHING)]
    assert labels == ["K_h[0,0]", "K_h[1,0]", "L"]
    units = [x.unit for x in derivatives.coordinates_of(("K_h", "L", "K_v"), RPSParams(), TOUCHING)]
    assert units == ["1", "m", "1/s"]


@jax.tree_util.register_pytree_node_class
class Module:
    """A module as those of Equinox: one of its leaves is a function."""

    d_success = 0.05

    def __init__(self, weight, activation=jnp.tanh):
        self.weight, self.activation = weight, activation

    def __call__(self, x):
        return self.activation(self.weight * x)

    def tree_flatten(self):
        return (self.weight, self.activation), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls(*leaves)


@pytest.fixture
def module():
    """A law that drives ahead at 1 cm/s x activation(weight); its leaves have no names."""

    def step(params, state, obs):
        return state, rps_jax.Twist(0.01 * params(1.0), 0.0, 0.0), rps_jax.Details.from_obs(obs)

    law = rps_jax.Law(lambda params: (), step, bounds={"0": Bound(0.1, 2.0)})
    rps_jax.register_law("module", law, Module(0.5))
    yield Module(0.5)
    registry.LAWS.pop("module")
    del registry._LAWS_BY_CLASS[Module]


def test_functions_in_the_parameters_of_a_law_are_static(module, monkeypatch):
    monkeypatch.setenv("RPS_COMPILER", "none")  # XLA alone compiles them faster
    speed = lambda trajectory: trajectory.twist.v_x[-1]  # noqa: E731
    expected, domain = 0.01 * (1 - np.tanh(0.5) ** 2), "wide,objects=random_cylinder"
    options = {"domain": domain, "worlds": 2, "setting": QUASISTATIC, "horizon": 0.1}
    results = rps_jax.value_and_grad(speed, module, wrt="0", smooth=False, **options)
    np.testing.assert_allclose(results.gradient, expected, rtol=1e-5)
    batch = rps_jax.draw_worlds(domain, 1, setting=QUASISTATIC)

    @partial(jax.jit, static_argnums=1)
    def value(weight, activation):
        inputs = row(batch.worlds, 0), Module(weight, activation), batch.stage, QUASISTATIC
        return speed(rps_jax.rollout(*inputs, horizon=0.1))

    squared = jax.value_and_grad(value)(0.5, jnp.square)
    np.testing.assert_allclose(squared, (0.01 * 0.25, 0.01), rtol=1e-5)
    assert Space(("0",), registry.LAWS["module"]).params(np.zeros(1)).weight == pytest.approx(1.05)


# --- scores and checks -----------------------------------------------------------------------

DRUMS = {"domain": TOUCHING, "worlds": 4, "setting": QUASISTATIC, "horizon": 0.2}


def test_a_gradient_is_useful_if_it_predicts_a_change_of_one_percent():
    # v^2 changes by 2.01 %, and v^40 by 48.9 % where its gradient says 40 %.
    def score(trajectory, power):
        return (20 * trajectory.params.v_max) ** power

    for power, useful, ratio in ((2, 1.0, 2.01 / 2), (40, 0.0, 48.886 / 40)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            results = rps_jax.value_and_grad(score, wrt="v_max", args=(power,), **DRUMS)
        assert results.useful.values.tolist() == [[useful]]
        np.testing.assert_allclose(results.secant / results.gradient, ratio, rtol=1e-3)
        assert any("do not predict the effect" in str(x.message) for x in caught) == (not useful)


def detailed(x, goal):
    """Return distance driven ahead and to go, less that of the goal, and what a score sees."""
    seen = {"executed": x.executed, "qpos": x.state.qpos, "l_th": x.state.law_state.l_th}
    seen |= {"end": x.qpos[-1], "radius": x.world.footprint.radius}
    seen |= {} if x.state.load is None else {"force": x.force}
    return jnp.sum(x.executed[:, 0]) + final_distance(x) - goal["distance"], seen


def detailed_value(setting=QUASISTATIC, goal=0.0):
    """Return the results of `detailed`, and what it saw."""
    options = DRUMS | {"setting": setting, "horizon": 0.4, "has_aux": True, "states": True}
    return rps_jax.value_and_grad(detailed, wrt="v_max", args=({"distance": goal},), **options)


def test_other_arguments_and_another_seed_compile_nothing_and_more_is_returned():
    first, aux = detailed_value()
    count = derivatives._value_and_slopes._cache_size()
    np.testing.assert_allclose(detailed_value(goal=0.5)[0].value, first.value - 0.5, rtol=1e-5)
    assert (detailed_value(Setting("quasistatic", seed=1))[0].value != first.value).all()
    assert derivatives._value_and_slopes._cache_size() == count
    assert aux["end"].shape == (1, 4, 10)
    assert (aux["radius"] > 0).all()


@pytest.mark.parametrize("engine", ["quasistatic", slow("fused")])
def test_a_score_sees_velocities_forces_and_the_state_of_the_law(engine):
    results, aux = detailed_value(Setting(engine))
    steps = np.diff(aux["qpos"][0], axis=1)
    way = np.linalg.norm(steps[..., :2], axis=-1) / 0.02
    speed = np.linalg.norm(aux["executed"][0][..., :2], axis=-1)[:, 1:]
    np.testing.assert_allclose(way, speed, atol=3e-4)
    assert (results.gradient > 0).all()
    if engine == "fused":
        assert aux["force"][0, ..., 0].min(axis=1).max() < -1.0  # [N] each object resists
    assert (aux["l_th"] > 0).all()
    with pytest.raises(InputError, match=r"states = False .* the score needs states=True"):
        rps_jax.value_and_grad(lambda x: x.executed[-1, 0], wrt="v_max", **DRUMS)


def test_a_check_compares_with_central_differences_in_double_precision(results):
    """It enables double precision; in single precision these differences are rounding."""
    with CONVERGED(), warnings.catch_warnings(action="ignore"):
        checked = results.check(4)
    assert checked.error.shape == (1, 4, 10)
    assert checked.error.max() < 1e-4
    assert_allclose(checked.gradient, results.gradient, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_a_check_agrees_with_gradients_in_single_precision():
    with CONVERGED(), warnings.catch_warnings(action="ignore"):
        results = rps_jax.value_and_grad(final_distance, wrt=("v_max", "target", "noise"), **DRUMS)
        checked = results.check(2)
    same = results.gradient.isel(world=[0, 1])
    np.testing.assert_allclose(checked.gradient, same, rtol=2e-2, atol=1e-5)


# --- continued rollouts --------------------------------------------------------------------

TRACED = [name for name in engines.names() if engines.get(name).traced]
NOISY = "wide,objects=random_cylinder,gap=0:0.01"  # with latencies and drift of the odometry
BY_CLASS = {type(params): name for name, params in LAWS.items()}


def halves_and_whole(setting, domain, law, smooth=False):
    """Return the trajectories of two joined halves of 0.6 s, and of one whole of 1.2 s."""
    batch = rps_jax.draw_worlds(domain, 2, setting=setting)

    @partial(jax.jit, static_argnums=2)
    def run(worlds, state, horizon):
        options = {"horizon": horizon, "smooth": smooth, "return_state": True}
        route = partial(rps_jax.rollout, stage=batch.stage, setting=setting, **options)
        return jax.vmap(lambda world, x: route(world, law, start=x))(worlds, state)

    loop = control_loop(law, setting, smooth=smooth)
    fresh = jax.vmap(lambda world: trial.start(world, law, loop.law))(batch.worlds)
    first, state = run(batch.worlds, fresh, 0.6)
    second, last = run(batch.worlds, state, 0.6)
    joined = jax.tree.map(lambda *x: np.concatenate(x, axis=1), first, second)
    return (joined, last), run(batch.worlds, fresh, 1.2)


@pytest.mark.slow  # the next test rolls one law
@pytest.mark.parametrize("name", BY_CLASS.values())
def test_a_continued_rollout_of_any_law_is_the_whole_one_bit_for_bit(name):
    law = LAWS[name]
    engine = "fused" if law_of(law).senses == "force" else "quasistatic"
    halves, whole = halves_and_whole(rps_jax.Setting(engine), NOISY, law)
    jax.tree.map(np.testing.assert_array_equal, halves, whole)


@pytest.mark.parametrize(
    ("engine", "smooth"),
    [(x, False) if x == "quasistatic" else slow(x, False) for x in TRACED] + [slow("fused", True)],
)
def test_a_continued_rollout_in_any_engine_is_the_whole_one_bit_for_bit(engine, smooth):
    domain = "real,objects=random_box,gap=0:0.01" if engine != "quasistatic" else NOISY
    law = LAWS["rps_plus"]
    halves, whole = halves_and_whole(rps_jax.Setting(engine), domain, law, smooth)
    jax.tree.map(np.testing.assert_array_equal, halves, whole)


def test_a_state_of_another_law_is_refused():
    setting = rps_jax.Setting("quasistatic")
    batch = rps_jax.draw_worlds(NOISY, 1, setting=setting)
    world, pursuit = row(batch.worlds, 0), LAWS["pursuit"]
    start = trial.start(world, LAWS["rps"])
    message = "start = .* is not allowed: give the last state of a rollout of the same law"
    with pytest.raises(InputError, match=message):
        rps_jax.rollout(world, pursuit, batch.stage, setting, start=start)


# --- the page of environments --------------------------------------------------------------


@pytest.mark.slow
def test_the_programs_of_the_page_push_boxes():
    """Raw MJX, its engine and the fused one; the latter two step the same worlds."""
    page = (ROOT / "docs" / "environments.md").read_text()
    names = {}
    with contextlib.chdir(ROOT):
        for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
            exec(code, names)
    poses, v_max = np.asarray(names["poses"]), names["law"].v_max
    longest = 0.02 * 49 * v_max  # [m] the way of the base at its greatest speed
    base, box = (poses[:, -1, i : i + 2] - poses[:, 0, i : i + 2] for i in (0, 3))
    share = np.linalg.norm(base, axis=1) / longest
    assert ((share > 0.5) & (share < 1.01)).all()  # it approaches, and then drives at v_max
    # Contact can but push, and lasts: the law feels it within 1 mm, and the base turns little.
    assert (box[:, 0] > 0).all()
    np.testing.assert_allclose(box[:, 0], base[:, 0], atol=2e-3)
    for distances in (names["in_mjx"], names["in_fused"]):
        assert (np.abs(distances[:, -1] - distances[:, 0]) < 1.01 * longest).all()
    np.testing.assert_allclose(names["in_mjx"], names["in_fused"], atol=1e-3)
