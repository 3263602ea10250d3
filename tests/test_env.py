"""The environment for reinforcement learning steps trials as the control loop does."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    FAST,
    NEAR,
    advance,
    refusals,
    refusing,
    row,
)
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.control.base import Law
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.observation import Details
from rps_jax.engines.fused import Fused
from rps_jax.robot.shell import Shell
from rps_jax.trials import trial
from rps_jax.trials.env import PushEnv, Reward
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws
from rps_jax.world.domain import DOMAINS, Range

COUNT, STEPS = 4, 50
AHEAD, BACK = jnp.array([1.0, 0.0, 0.0]), jnp.array([-1.0, 0.0, 0.0])
PERIOD = FAST.control_period


def build_env(**options):
    setting = Setting("fused", FAST, rules=Rules(horizon=20.0))
    return PushEnv("random_cylinder", NEAR, setting=setting, worlds=6, **options)


class Pushing:
    """An environment with a batch of initial states and a compiled rollout."""

    def __init__(self):
        self.env = build_env()
        self.reset = jax.jit(jax.vmap(self.env.reset))
        self.start = self.reset(jax.random.split(jax.random.key(0), COUNT))

        def scan_step(state, actions):
            state = jax.vmap(self.env.step)(state, actions)
            return state, state

        scan = partial(jax.lax.scan, scan_step, length=STEPS)
        self._steps = jax.jit(lambda state, actions: scan(state, xs=actions)[1])

    def go(self, state, actions, times=1):
        """Return states (times * STEPS, COUNT, ...) under actions (COUNT, 3), or (3,) for all."""
        actions = jnp.broadcast_to(actions, (STEPS, COUNT, 3))
        parts = []
        for _ in range(times):
            parts.append(self._steps(state, actions))
            state = last(parts[-1])
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def last(states):
    return row(states, -1)


@pytest.fixture(scope="module")
def pushing():
    return Pushing()


def test_the_spaces_are_those_of_the_skin_the_target_and_the_twist(pushing):
    push, state = pushing.env, pushing.start
    assert (push.observation_size, push.action_size) == (Shell().count + 2, 3)
    assert state.obs.shape == (COUNT, 44)
    assert push.dt == 0.02
    assert PushEnv.setting.engine == "fused"  # the default


def test_step_keeps_the_structure_of_the_state_so_that_scan_works(pushing):
    push, state = pushing.env, pushing.start
    world_state = row(state, 0)
    next_state = jax.eval_shape(push.step, world_state, AHEAD)
    assert jax.tree.structure(next_state) == jax.tree.structure(world_state)
    states = (jax.tree.leaves(x) for x in (next_state, world_state))
    kinds = [[(leaf.shape, leaf.dtype) for leaf in leaves] for leaves in states]
    assert kinds[0] == kinds[1]
    # Entries that a wrapper adds stay.
    info, metrics = world_state.info | {"steps": jnp.zeros(())}, world_state.metrics | {"x": 0.0}
    noted = world_state.replace(info=info, metrics=metrics)
    result = jax.eval_shape(push.step, noted, AHEAD)
    assert "steps" in result.info
    assert "x" in result.metrics


def test_a_key_determines_world_and_noise(pushing):
    twice = pushing.reset(jax.vmap(jax.random.key)(jnp.array([1, 1, 2, 3])))
    assert_array_equal(twice.obs[0], twice.obs[1])
    assert len({bytes(np.asarray(row)) for row in twice.obs}) == 3
    batches = jax.random.split(jax.random.key(4), (15, COUNT))
    indices = [pushing.reset(keys).info["index"] for keys in batches]
    assert set(np.ravel(indices)) == set(range(6))


def test_worlds_are_those_of_the_domain(pushing):
    state = pushing.start
    index = np.asarray(state.info["index"])
    drawn = draws.draw(replace(NEAR, objects=("random_cylinder",)), 0, index)
    assert_allclose(state.info["world"].footprint.radius, drawn.solid.radius, rtol=1e-6)
    assert_allclose(state.obs[:, 42:], drawn.p_world_target, rtol=1e-6)
    assert_allclose(state.data.qpos[:, 4], drawn.values["lateral"], rtol=1e-6)


def test_an_action_is_a_share_of_the_greatest_twist():
    push = build_env(params=RPSParams(v_max=0.04, omega_max=0.2))
    for action, twist in (
        ((0.5, -0.5, 0.25), (0.02, -0.02, 0.05)),
        ((3, 4, -9), (0.024, 0.032, -0.2)),
    ):
        assert_allclose(push.twist(jnp.array(action, float)), twist, rtol=1e-6)


def test_the_return_is_progress_minus_the_cost_of_time_without_contact(pushing):
    start, states = pushing.start, pushing.go(pushing.start, AHEAD, times=14)
    succeeded = np.flatnonzero(states.data.success[-1])
    assert succeeded.size >= 2, "targets are ahead: most arrive"
    touch = states.metrics["in_contact"] > 0
    for i in succeeded:
        end = int(np.argmax(states.done[:, i]))
        felt = states.data.law_state[:, i]
        gained = felt[np.argmax(touch[:, i])] - felt[end]
        without = PERIOD * (~touch[: end + 1, i]).sum()
        assert states.reward[:, i].sum() == pytest.approx(gained - 0.05 * without + 1, abs=1e-4)
        assert felt[end] < pushing.env.params.d_success
        # After the end nothing moves and the reward is 0.
        assert (states.done[end:, i] == 1).all()
        assert (states.reward[end + 1 :, i] == 0).all()
        assert_array_equal(states.data.qpos[-1, i], states.data.qpos[end, i])
        # The base went straight ahead at v_max; observations agree with that.
        x = states.data.qpos[:, i, 0]
        assert x[end] == pytest.approx(0.05 * PERIOD * (end + 1), rel=1e-3)
        assert_allclose(states.obs[:, i, 42], start.obs[i, 42] - x, atol=1e-5)
        assert states.obs[end, i, 15:27].max() > 0.25  # the skin's threshold, of front taxels


def test_lost_contact_costs_and_progress_resumes_where_it_was_lost(pushing):
    touching = last(pushing.go(pushing.start, AHEAD, times=2))
    assert (touching.metrics["in_contact"] == 1).all()
    away = pushing.go(touching, BACK)
    no_contact = away.metrics["in_contact"] == 0
    assert no_contact[-1].all()
    assert_allclose(away.reward[no_contact], -0.05 * PERIOD, rtol=1e-5)
    again = pushing.go(last(away), AHEAD, times=2)
    progress = np.concatenate([away.metrics["progress"], again.metrics["progress"]]).sum(axis=0)
    lasting = touching.data.law_state - last(again).data.law_state
    assert_allclose(progress, lasting, atol=1e-5)


def test_the_rules_end_a_trial_and_its_start_can_be_put_back(pushing):
    """Like the auto-reset wrapper of mujoco_playground, which restores data and observation."""
    start = pushing.start
    late = start.replace(data=start.data._replace(steps=start.data.steps + 999))
    over = last(pushing.go(late, AHEAD))
    assert (over.done == 1).all()
    assert not over.data.success.any()
    assert (over.data.steps == 1000).all()
    back = over.replace(data=start.data, obs=start.obs, done=0 * over.done)
    restarted, reference = (pushing.go(state, AHEAD) for state in (back, start))
    assert_array_equal(restarted.data.qpos, reference.data.qpos)
    assert_array_equal(restarted.reward, reference.reward)
    assert (restarted.done == 0).all()


def test_a_nan_action_ends_only_its_world(pushing):
    actions = jnp.tile(AHEAD, (COUNT, 1)).at[1].set(jnp.nan)
    trajectory = pushing.go(pushing.start, actions)
    for states in (row(trajectory, 0), last(trajectory)):
        assert states.done.tolist() == [0, 1, 0, 0]
        assert states.metrics["diverged"].tolist() == [0, 1, 0, 0]
    assert (trajectory.reward[:, 1] == 0).all()
    assert np.isfinite(trajectory.obs).all()


def test_a_step_equals_a_trial_with_the_same_twist(pushing):
    """A law with a constant twist, in the control loop of trials."""
    push, state, action = pushing.env, pushing.start, jnp.array([0.8, 0.2, 0.3])
    mine = last(pushing.go(state, action))
    constant = push.twist(action)
    dull = Law(
        lambda params: (), lambda params, state, obs: (state, constant, Details.from_obs(obs))
    )
    worlds = state.info["world"]
    params = jax.tree.map(lambda x: jnp.full(mine.done.shape, x), push.params)
    trials = trial.start_all(worlds, params, np.ones(mine.done.size, bool), law=dull)
    loop = trial.ControlLoop(FAST, push.setting.rules, dull)
    alone = replace(NEAR, objects=(push.object,))
    drawn = draws.draw(alone, 0, np.arange(1))
    stage = drawn_worlds(alone, drawn, push.setting).stage
    theirs = advance(stage, worlds, params, trials, loop, STEPS)
    assert_array_equal(mine.data.steps, STEPS)
    assert_allclose(mine.data.qpos, theirs.qpos, atol=2e-5)
    assert (theirs.contact_steps > 0).all()
    # The environment has one more reading, after the last step.
    sensed_more = mine.data.contact_steps - theirs.contact_steps
    assert_array_equal(sensed_more, mine.metrics["in_contact"])


def test_states_are_drawn_each_in_its_own_world(pushing):
    push, state = pushing.env, pushing.start
    index = np.asarray(state.info["index"])
    different = [0, int(np.argmax(index != index[0]))]
    assert index[different[0]] != index[different[1]]
    states = [row(state, i) for i in different]
    images = push.render(states, 60, 80)
    assert [image.shape for image in images] == [(60, 80, 3)] * 2
    assert (abs(images[0].astype(int) - images[1]) > 20).any()
    again = push.render(states[1], 60, 80)  # rendering is not exactly repeatable
    assert_allclose(again.astype(int), images[1].astype(int), atol=2)


QUASISTATIC = Setting("quasistatic", FAST, rules=Rules(horizon=20.0))


@pytest.mark.slow
def test_what_is_felt_and_rewarded_has_derivatives_by_action_and_state():
    """Central differences in double precision, of the smooth environment while contact is lost."""
    near = replace(NEAR, gap=Range(0.008, 0.008), noise=Range(0, 0))  # the foam is 10 mm thick
    with jax.enable_x64(True):
        push = PushEnv("random_cylinder", near, setting=QUASISTATIC, worlds=2, smooth=True)

        def step(state, action):
            state = push.step(state, action)
            return state, (state.reward, state.obs.sum(), state.metrics["in_contact"])

        def total(inputs, start):
            """Return the sum of rewards and observations, from a start that is moved along x."""
            moved = start.data._replace(qpos=start.data.qpos.at[3].add(inputs[3]))
            actions = jnp.stack([AHEAD] * 10 + [BACK] * 10) + inputs[:3]
            _, terms = jax.lax.scan(step, start.replace(data=moved), actions)
            return terms[0].sum() + terms[1].sum(), terms[2]

        run = jax.jit(jax.value_and_grad(total, has_aux=True))
        start = push.reset(jax.random.key(1))
        (_, contact), slopes = run(inputs := jnp.array([-0.5, 0.1, 0.1, -0.001]), start)
        assert contact.max() > 0.9, contact
        assert ((contact > 0.05) & (contact < 0.95)).sum() >= 2  # a weight
        h = 1e-6
        values = [[run(inputs + s * h * e, start)[0][0] for s in (1, -1)] for e in np.eye(4)]
        differences = np.diff(np.array(values)[:, ::-1])[:, 0] / (2 * h)
        assert (np.abs(differences) > 1e-3).sum() >= 3
        assert_allclose(slopes, differences, rtol=1e-5, atol=1e-7)


def test_an_engine_without_derivatives_is_refused_where_they_are_taken(pushing, monkeypatch):
    monkeypatch.setattr(Fused, "modes", ())
    reward = lambda action, state: pushing.env.step(state, action).reward  # noqa: E731
    state = row(pushing.start, 0)
    jax.eval_shape(jax.grad(lambda a, s: reward(jax.lax.stop_gradient(a), s)), AHEAD, state)
    for function, action in (
        (jax.grad(reward), AHEAD),
        (jax.jacfwd(reward), AHEAD),
        (jax.vmap(jax.grad(reward), (0, None)), AHEAD[None]),
    ):
        with refusing(r"engine = fused .* it has no forward-mode deriv"):
            jax.eval_shape(function, action, state)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (jnp.ones(2), r"action = float32\[2\] is not allowed: it must be 3 numbers"),
        (jnp.ones((5, 3)), r"action = float32\[5, 3\] .* by jax.vmap"),
        (jnp.ones(3, complex), r"action = complex64\[3\]"),
        (1.0, r"action = float32\[\]"),
        ("left", "action = 'left'"),
        (None, "action = None"),
    ],
)
def test_actions_of_another_shape_or_type_are_refused(pushing, action, message):
    with refusing(message):
        jax.eval_shape(lambda state: pushing.env.step(state, action), row(pushing.start, 0))


def test_a_step_needs_a_state_and_a_reset_one_key(pushing):
    for state in (None, AHEAD, (1, 2)):
        with refusing(r"state = .*: give the State that reset returned"):
            pushing.env.step(state, AHEAD)
    for key in (None, "key", jax.random.split(jax.random.key(0)), np.zeros(3)):
        with refusing(r"rng = .*: give one key, as jax.random.key"):
            pushing.env.reset(key)
    with refusing(r"trajectory = None .*: give one State or a list"):
        pushing.env.render(None)


test_invalid_environments_are_refused = refusals(
    PushEnv,
    ({"object": "ball"}, "unknown domain object 'ball'"),
    ({"worlds": 0}, "worlds = 0"),
    ({"setting": Setting(engine="mujoco")}, "engine = mujoco is not allowed"),
    ({"domain": DOMAINS["paper"]}, "skin of an environment 'ideal': choose from capacitive"),
    ({"params": RPSParams(v_max=-1.0)}, "v_max = -1.0"),
    ({"weights": Reward(success=float("nan"))}, "success = nan"),
    ({"weights": 1.0}, "weights = 1.0 is not allowed: give a Reward"),
    ({"domain": None}, "domain = None is not allowed: give a Domain or a text"),
    ({"domain": "wild"}, "unknown domain 'wild'"),
)
