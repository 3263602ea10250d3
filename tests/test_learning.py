"""A law learned from touch: its network, its file, the algorithm, and runs that are continued."""

import io
import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import (
    CYLINDERS,
    jitted,
    moved,
    printed,
    refusing,
    row,
    rps,
    same,
    slow,
)
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax import learn
from rps_jax import sweep as run_sweep
from rps_jax.app.cli import flags
from rps_jax.control import registry
from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned import policy as policies
from rps_jax.control.learned.features import TouchState
from rps_jax.control.learned.network import Network, PolicyState
from rps_jax.control.learned.policy import Policy
from rps_jax.control.observation import Observation, TaxelObservation
from rps_jax.record import files
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import Boards
from rps_jax.runs.plan import Plan, load_plan, open_run
from rps_jax.trials.env import PushEnv, Reward
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning import collection, ppo
from rps_jax.tuning.learn import METRICS, Learn
from rps_jax.tuning.ppo import PPO, TrainState, Transition

SMALL = {"width": 6, "hold": 0.1}
KINDS = ("mlp", "gru")


def network_of(kind, **changes):
    return Network(kind, **(SMALL | changes))


def weights_of(network, seed=0):
    """Return random weights, none of them small."""
    init = jitted(partial(networks.init_weights, network.shapes))
    drawn = init(jax.random.PRNGKey(seed))
    return {name: np.asarray(weight, np.float32) for name, weight in drawn.items()}


def random_obs(seed, mirror=False):
    """Return a random observation, or its mirror image."""
    rng = default_rng(seed)
    yaw, signal = rng.uniform(-3, 3), rng.uniform(0, 2, 42)
    robot, lateral, target = rng.uniform(-1, 1, 2), rng.uniform(-0.2, 0.2), rng.uniform(-2, 2, 2)
    touching, contact = np.asarray(seed % 3 > 0), np.array([0.36, lateral])
    touch = moved(Observation(robot, yaw, contact, touching, target, 0.02), mirror=mirror)
    obs = TaxelObservation(touch, signal[::-1] if mirror else signal, np.asarray(seed % 2 > 0))
    return jax.tree.map(jnp.asarray, obs)


def law_of(network, scale=1.0):
    """Return the step of a policy with random weights, and its parameters."""
    weights = {name: scale * weight for name, weight in weights_of(network).items()}
    _, _, params = policies.build_law(Policy(network, weights_of(network)))
    return partial(jax.jit(partial(networks.step, network, weights)), params)


# --- network -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirrored_observation_gives_the_mirrored_twist(kind):
    """This holds for random weights and over several steps, including the memory."""
    law, memories = law_of(network_of(kind)), [PolicyState.init(network_of(kind))] * 2
    twists = []
    for seed in range(12):
        for i, mirror in enumerate((False, True)):
            memories[i], twist, _ = law(memories[i], random_obs(seed, mirror))
            twists.append(np.array(twist))
    plain, mirrored = np.array(twists).reshape(12, 2, 3).swapaxes(0, 1)
    assert_allclose(mirrored, plain * [1, -1, -1], atol=1e-7)
    assert np.abs(plain[:, 1:]).max() > 1e-3  # it does turn


def test_an_action_is_held_and_bounded():
    law, memory = law_of(network_of("mlp"), scale=30), PolicyState.init(network_of("mlp"))
    twists = []
    for seed in range(20):
        memory, twist, _ = law(memory, random_obs(seed))
        twists.append(np.array(twist))
    twists = np.array(twists).reshape(4, 5, 3)
    assert_array_equal(twists, twists[:, :1].repeat(5, axis=1))
    assert len(np.unique(twists[:, 0], axis=0)) == 4
    speeds = np.linalg.norm(twists[..., :2], axis=-1)
    assert speeds.max() == pytest.approx(0.05, rel=1e-5)
    assert np.abs(twists[..., 2]).max() <= 0.15 + 1e-7


def test_the_position_of_a_lost_contact_is_remembered():
    """Touch at (1, 0.1) in the world; then the base is at (0.5, 0.1), turned left."""
    touch = random_obs(1).touch._replace(
        p_world_robot=jnp.array([0.6, 0.0]),
        yaw=jnp.zeros(()),
        in_contact=jnp.array(True),
        p_robot_contact=jnp.array([0.4, 0.1]),
        p_world_target=jnp.array([1.0, 1.1]),
    )
    obs = random_obs(1)._replace(touch=touch)
    felt = TouchState.initial().update(obs)
    assert_allclose(felt.p_robot_contact(obs), [0.4, 0.1], atol=1e-6)
    away = touch._replace(
        p_world_robot=jnp.array([0.5, 0.1]), yaw=jnp.array(np.pi / 2), in_contact=jnp.array(False)
    )
    later = obs._replace(touch=away)
    felt = felt.update(later)
    assert_allclose(felt.p_robot_contact(later), [0.0, -0.5], atol=1e-6)
    assert float(felt.time_since_contact) == pytest.approx(0.02)
    values = features.compute_features(felt, jnp.zeros(3), later)[42:]
    # No contact now, no line, contact earlier; its position; 1 m to the target ahead of it.
    assert_allclose(values[:3], [0, 0, 1])
    assert_allclose(values[4:6], [0, -0.5 / 0.36], atol=1e-6)
    assert_allclose(values[6:9], [1, 0, np.log(20) / np.log(60)], atol=1e-6)


# --- files ---------------------------------------------------------------------------------


def written(path, kind="gru", **changes):
    policy = Policy(network_of(kind), weights_of(network_of(kind)), **changes)
    path.write_bytes(policies.encode(policy))
    return policy


@pytest.mark.parametrize("kind", KINDS)
def test_a_law_loaded_from_a_file_equals_the_saved_law(kind, tmp_path, registries):
    path = tmp_path / "policy.npz"
    policy = written(path, kind, learned={"how": "by chance"})
    loaded = policies.decode(path.read_bytes(), "policy.npz")
    assert loaded._replace(weights={}) == policy._replace(weights={})
    name, params = registry.parse_law(str(path))
    assert name.startswith(f"learned_{kind}_")
    law = registry.law_of(params)
    assert law.senses == "taxels"
    step = jax.jit(law.step)
    reference_step = jax.jit(partial(networks.step, policy.network, policy.weights))
    memory, reference = law.init(params), PolicyState.init(policy.network)
    for seed in range(12):
        memory, twist, _ = step(params, memory, random_obs(seed))
        reference, expected, _ = reference_step(params, reference, random_obs(seed))
        assert_array_equal(np.array(twist), np.array(expected))
    again = registry.params_to_json(params)
    assert again["file"] == str(path)
    assert registry.params_from_json(json.loads(json.dumps(again))) == params


def repacked(content, about=(), has_old_digest=False, **changes):
    """Return a policy's file with another description and other arrays."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = dict(file)
    digest, described = arrays.pop("digest"), json.loads(str(arrays["about"])) | dict(about)
    arrays |= {"about": np.array(json.dumps(described))} | changes
    digest = digest if has_old_digest else policies._digest(arrays)
    return files.encode_arrays(digest=np.array(digest), **arrays)


def pickled(content):
    archive = io.BytesIO()
    np.savez(archive, about=np.array([{"a": 1}], object), digest=np.array(""))
    return archive.getvalue()


def about(**changes):
    """Return a change of a policy's description."""
    return partial(repacked, about=changes)


def network_as(kind, **changes):
    return about(network=network_of("mlp")._asdict() | {"kind": kind} | changes)


BIAS, NAN = ({"action.b": np.full(3, value, np.float32)} for value in (1e-3, np.nan))
UNREADABLE = "give a file that `rps learn` wrote"
BAD = {
    "truncated": (lambda c: c[: len(c) // 2], UNREADABLE),
    "empty": (lambda c: b"", UNREADABLE),
    "text": (lambda c: b"hello", UNREADABLE),
    "pickled": (pickled, UNREADABLE),
    "bit": (partial(repacked, has_old_digest=True, **BIAS), "its digest does not match"),
    "version": (about(version=7), "version 7"),
    "format": (about(format="other"), "its format is other"),
    "network": (network_as("mlp"), "memory.gates.w has the shape .*, and its network None"),
    "kind": (network_as("cnn", width=0), "unknown network 'cnn': choose from mlp, gru"),
    "width": (network_as("gru", width=7), "has the shape .* and its network "),
    "nan": (partial(repacked, **NAN), "action.b must hold finite numbers of 32 bits"),
    "task": (about(task={"v_max": 1.0}), "d_success"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_invalid_policy_file_is_refused_in_one_sentence(name, tmp_path):
    written(tmp_path / "policy.npz")
    damage, words = BAD[name]
    path = tmp_path / "policy.npz"
    path.write_bytes(damage(path.read_bytes()))
    with refusing(words) as error:
        registry.parse_law(str(path))
    assert "\n" not in str(error.value)


def test_a_run_of_a_policy_is_loaded_with_its_copy_of_a_changed_file(tmp_path, registries):
    path = tmp_path / "policy.npz"
    written(path)
    name, params = registry.parse_law(str(path))
    setting = Setting("fused", fidelity="fast")
    open_run(tmp_path / "run", Plan(CYLINDERS, 4, {name: params}, setting))
    assert load_plan(tmp_path / "run").laws == {name: params}
    new_policy = Policy(network_of("gru"), weights_of(network_of("gru"), seed=1))
    path.write_bytes(policies.encode(new_policy))
    with pytest.warns(UserWarning, match="has changed since the run: its copy"):
        assert load_plan(tmp_path / "run").laws == {name: params}


# --- the algorithm -------------------------------------------------------------------------


def transitions_of(obs, privileged, flags, **columns):
    """Return transitions (T, n) of observations; the columns that are not given are zero."""
    zero = jnp.zeros(flags.shape)
    blank = Transition(
        obs, privileged, flags, jnp.zeros((*flags.shape, 3)), *[zero] * 4, flags, flags
    )
    return blank._replace(**columns)


def test_advantages_by_hand():
    """Gamma 0.5, lambda 0.5. The third trial ends by a success, the second by the clock.

    delta_4 = 1 - 3 = -2, nothing after it. delta_3 = 2 + 0.5 * 8 - 1 = 5, ended, so it stands
    alone. delta_2 = 0 + 0.5 * 1 - 2 = -1.5, and A_2 = -1.5 + 0.25 * 5 = -0.25. delta_1 =
    1 + 0.5 * 2 - 1 = 1, and A_1 = 1 + 0.25 * -0.25 = 0.9375.
    """
    columns = {
        "reward": [1.0, 0.0, 2.0, 1.0],
        "value": [1.0, 2.0, 1.0, 3.0],
        "next_value": [2.0, 1.0, 8.0, 9.0],
        "done": [False, False, True, True],
        "terminated": [False, False, False, True],
    }
    blank = jnp.zeros((4, 1))
    columns = {name: jnp.array(values)[:, None] for name, values in columns.items()}
    advantages = ppo.advantages(transitions_of(blank, blank, blank > 0, **columns), 0.5, 0.5)
    assert_allclose(advantages[:, 0], [0.9375, -0.25, 5.0, -2.0])


def test_the_surrogate_is_that_of_the_paper():
    ratio, advantage = jnp.array([1.0, 1.5, 0.5, 1.5, 0.5]), jnp.array([2.0, 1.0, 1.0, -1.0, -1.0])
    surrogate = ppo.surrogate(ratio, advantage, 0.2)
    assert_allclose(surrogate, [2.0, 1.2, 0.5, -1.5, -0.8], rtol=1e-6)


def init_state(config, network):
    return jax.jit(partial(TrainState.init, config, network))(jax.random.PRNGKey(0))


def batch(network, state, seed=0, steps=5, worlds=4):
    """Return random transitions with actions of the policy."""
    rng = default_rng(seed)
    size, extra = features.feature_count(network.taxels), ppo.PRIVILEGED_SIGNS.size
    obs = jnp.asarray(rng.normal(size=(steps, worlds, size)), jnp.float32)
    privileged = jnp.asarray(rng.normal(size=(steps, worlds, extra)), jnp.float32)
    fresh = jnp.asarray(rng.uniform(size=(steps, worlds)) < 0.2)
    hidden = jnp.asarray(
        rng.normal(size=(worlds, *PolicyState.init(network).hidden.shape)), jnp.float32
    )
    transitions = transitions_of(obs, privileged, fresh)
    means = jitted(partial(ppo.means, network))
    mean = means(state.weights["actor"], hidden, transitions)
    action = mean + 0.5 * jnp.asarray(rng.normal(size=mean.shape), mean.dtype)
    log_prob = jitted(ppo.log_prob)(action, mean, state.weights["log_std"])
    return hidden, transitions._replace(action=action, log_prob=log_prob)


@pytest.mark.parametrize("kind", KINDS)
def test_the_loss_of_the_policy_that_acted(kind):
    """Ratios are 1: the surrogate is the mean advantage, nothing is clipped, nothing diverges."""
    config, network = PPO(network=kind, width=6, ent_coef=0.0), network_of(kind)
    state = init_state(config, network)
    hidden, transitions = batch(network, state)
    advantage = jnp.arange(20.0).reshape(5, 4)
    value = networks.critic(
        state.weights["critic"], ppo.critic_inputs(transitions.obs, transitions.privileged)
    )
    loss, kl = jax.jit(partial(ppo.loss, config, network))(
        state.weights, hidden, transitions, advantage, value + 2
    )
    assert float(loss) == pytest.approx(0.5 * 2**2 - 9.5, rel=1e-5)
    assert float(kl) == pytest.approx(0, abs=1e-6)

    def policy_alone(weights):
        return ppo.loss(config, network, weights, hidden, transitions, advantage, value)[0]

    # So its slope is that of the policy gradient, sum of advantages times log probabilities.
    def gradient(weights):
        mean = ppo.means(network, weights["actor"], hidden, transitions)
        return -jnp.mean(advantage * ppo.log_prob(transitions.action, mean, weights["log_std"]))

    slope, expected = (jax.jit(jax.grad(f))(state.weights) for f in (policy_alone, gradient))
    for name in network.shapes:
        assert_allclose(slope["actor"][name], expected["actor"][name], atol=2e-5)


def test_a_mirrored_world_has_an_equal_value():
    config, network = PPO(network="mlp", width=6), network_of("mlp")
    state = init_state(config, network)
    _, rows = batch(network, state)
    mirrored = features.mirror(rows.obs), ppo.PRIVILEGED_SIGNS * rows.privileged
    value, mirrored_value = (
        networks.critic(state.weights["critic"], ppo.critic_inputs(*pair))
        for pair in ((rows.obs, rows.privileged), mirrored)
    )
    assert_allclose(value, mirrored_value, atol=1e-6)
    assert np.std(value) > 0.01


def test_an_update_of_a_frozen_policy_changes_the_value_function_alone():
    config, network = PPO(network="mlp", width=6, num_minibatches=2), network_of("mlp")
    state, key = init_state(config, network), jax.random.PRNGKey(0)
    update = jax.jit(partial(ppo.update_policy, config, network, frozen=True))
    weights = update(state, key, *batch(network, state))[0].weights
    same(weights["actor"], state.weights["actor"])
    assert any((weights["critic"][x] != old).any() for x, old in state.weights["critic"].items())


@pytest.mark.parametrize("kind", ["mlp", slow("gru")])
def test_the_best_action_of_one_step_is_learned(kind):
    """The reward of an action falls with its distance to a function of the observation."""
    options = {"update_epochs": 4, "num_minibatches": 2, "learning_rate": 3e-3, "target_kl": 0.02}
    config, network = PPO(network=kind, width=6, ent_coef=0.0, **options), network_of(kind)
    state = init_state(config, network)
    flags, privileged = jnp.ones((4, 64), bool), jnp.zeros((4, 64, ppo.PRIVILEGED_SIGNS.size))
    blank = jnp.zeros((4, 64, features.feature_count(network.taxels)))

    def best(obs):
        forward, lateral = 0.8 * jnp.sign(obs[..., 0] + obs[..., 41]), obs[..., 47]
        return jnp.stack([forward, 0.5 * jnp.sign(lateral), 0 * lateral], axis=-1)

    @jax.jit
    def update(state, key):
        key_seen, key_act, key_pass = jax.random.split(key, 3)
        obs = blank.at[..., [0, 41, 47]].set(jax.random.normal(key_seen, (4, 64, 3)))
        hidden = jnp.zeros((64, *PolicyState.init(network).hidden.shape))
        transitions = transitions_of(obs, privileged, flags)
        mean = ppo.means(network, state.weights["actor"], hidden, transitions)
        noise = jax.random.normal(key_act, mean.shape)
        action = mean + jnp.exp(state.weights["log_std"]) * noise
        transitions = transitions._replace(
            action=action,
            log_prob=ppo.log_prob(action, mean, state.weights["log_std"]),
            value=networks.critic(state.weights["critic"], ppo.critic_inputs(obs, privileged)),
            reward=-jnp.sum((action - best(obs)) ** 2, axis=-1),
        )
        wrong = jnp.mean(jnp.sum((mean - best(obs)) ** 2, axis=-1))
        return ppo.update_policy(config, network, state, key_pass, hidden, transitions)[0], wrong

    wrong = []
    for key in jax.random.split(jax.random.PRNGKey(1), 150):
        state, error = update(state, key)
        wrong.append(float(error))
    assert wrong[0] == pytest.approx(0.8**2 + 0.5**2, rel=0.05)
    assert np.mean(wrong[-10:]) < 0.2 * wrong[0]


# --- runs ----------------------------------------------------------------------------------

TINY = {
    "network": "gru",
    "width": 6,
    "num_envs": 6,
    "num_steps": 4,
    "update_epochs": 2,
    "num_minibatches": 2,
    "hold": 0.1,
    "minutes": 0,
    "drawn": 6,
    "validation": 3,
    "setting": Setting("fused", fidelity="fast", rules=Rules(horizon=4.0, max_lost=30.0)),
}


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A run of four updates in a folder with a damaged checkpoint: its folder and curve."""
    folder = tmp_path_factory.mktemp("learn") / "whole"
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "learner-0123456789abcdef.npz").write_bytes(b"damaged")
    return folder, learn(CYLINDERS, **TINY, updates=4, out=folder)


@pytest.mark.slow
def test_a_killed_and_resumed_run_equals_an_uninterrupted_one(learned, tmp_path):
    folder, whole = learned
    out, rounds = tmp_path / "parts", []
    options = TINY | {"every": 1e-6, "out": out}  # a checkpoint after each update

    def kill(progress):  # in the third update, before its checkpoint
        if progress.rounds == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learn(CYLINDERS, **options, updates=9, report_to=kill)
    again = learn(CYLINDERS, **options, updates=4, report_to=lambda x: rounds.append(x.rounds))
    assert rounds == [3, 4]
    for name in ("ended", "reward", "value", "kl", "learning_rate", "spread", "simulated"):
        assert_array_equal(again[name], whole[name], err_msg=name)
    mine, theirs = (policies.decode((f / "policy.npz").read_bytes(), f) for f in (out, folder))
    same(mine.weights, theirs.weights)


@pytest.mark.slow
def test_the_value_function_of_an_initial_law_is_learned_first(learned, tmp_path):
    """The first two updates do not change the law."""
    initial = policies.read(str(learned[0] / "policy.npz"))
    options = TINY | {"initial": str(learned[0] / "policy.npz"), "value_updates": 2}
    options |= {"prioritised": 0.5, "anneal": 0.5, "ema_updates": 1}
    options |= {"failure": 1.0, "success": 2.0}
    curve = learn(CYLINDERS, **options, updates=4, out=tmp_path / "run")
    policy = policies.read(str(tmp_path / "run" / "policy.npz"))
    assert np.abs(policy.weights["action.w"] - initial.weights["action.w"]).max() > 0
    assert curve.level.values.tolist() == [1.0] * 4
    assert curve.kl.values[:2].max() < 1e-7 < curve.kl.values[2:].min()
    assert np.isfinite(curve.value).all()


def test_former_names_of_options_are_accepted_with_a_warning():
    message = "average of learn will be removed: write ema_updates"
    with pytest.warns(FutureWarning, match=message), refusing("ema_updates"):
        learn(CYLINDERS, average=0)
    words = ["--hard", "0.5", "--average=7", "--enough", "0.6", "--spread", "0.3", "--level=0.2"]
    with pytest.warns(FutureWarning, match="hard of learn will be removed: write prioritised"):
        question, _ = flags.parse(Learn, "learn", words)
    assert (question.prioritised, question.ema_updates) == (0.5, 7)
    assert (question.success_threshold, question.action_std) == (0.6, 0.3)
    assert question.initial_level == 0.2


def test_an_initial_law_has_the_network_of_the_options(learned, tmp_path):
    path = str(learned[0] / "policy.npz")
    with refusing(r"initial = .* is not allowed: its network needs .*width = 6"):
        learn(CYLINDERS, **TINY | {"initial": path, "width": 7}, updates=4, out=tmp_path)
    with refusing("no_such_law"):
        learn(CYLINDERS, **TINY | {"initial": "no_such_law"}, updates=4, out=tmp_path)
    front = replace(CYLINDERS, robot=Robot(boards=(Boards("front", 3),)))
    with refusing(r"its network needs .*robots with 42 taxels"):
        learn(front, **TINY | {"initial": path}, updates=4, out=tmp_path)


def test_worlds_that_sometimes_fail_are_drawn_most():
    options = PPO(prioritised=0.5)
    rates = collection.failure_rates(
        jnp.array([0.0, 0.5, 1.0, 0.0]),
        jnp.array([3, 3, 2]),
        jnp.array([True, False, False]),
        jnp.array([False, False, False]),
    )
    assert_allclose(rates, [0, 0.5, 1, 0.3], atol=1e-6)
    key, shape = jax.random.PRNGKey(0), (200, 50)
    draw = partial(collection.draw_indices, failures=rates, key=key, shape=shape)
    counts = np.bincount(np.array(draw(options)).ravel(), minlength=4) / 10_000
    weights = np.array([0, 0.275, 0.05, 0.225])
    assert_allclose(counts, 0.125 + 0.5 * weights / weights.sum(), atol=0.02)
    uniform = np.bincount(np.array(draw(PPO())).ravel()) / 10_000
    assert_allclose(uniform, 0.25, atol=0.02)


def test_options_fall_at_the_end_of_a_run():
    schedule = PPO(anneal=0.5).schedule
    shares = [float(schedule(jnp.array(x), jnp.array(0))[0]) for x in (0.0, 0.5, 0.75, 1.0)]
    assert shares == pytest.approx([1, 1, 0.5, 0.05])
    assert list(map(float, PPO().schedule(jnp.array(0.9), jnp.array(0)))) == [1, 0]


def test_the_results_of_a_run_and_their_table(learned):
    folder, curve = learned
    assert curve.sizes == {"update": 4}
    assert curve.simulated.values.tolist() == pytest.approx([2.4, 4.8, 7.2, 9.6])
    assert np.isfinite(curve.reward).all()
    assert (curve.spread.values > 0).all()
    assert files.read_results(folder).identical(curve)
    policy = policies.decode((folder / "policy.npz").read_bytes(), folder)
    assert policy.network == Network("gru", 6, 42, 0.1)
    assert policy.learned["updates"] == 4
    table = pd.read_csv(folder / "curve.csv", index_col="update")
    assert table.index.tolist() == curve["update"].values.tolist() == [1, 2, 3, 4]
    assert list(table) == list(METRICS)
    for name in table:
        assert_array_equal(table[name], curve[name], err_msg=name)
    assert table.validation.isna().tolist() == [True, True, True, False]


def test_a_folder_of_another_run_and_damaged_parts(learned):
    folder, curve = learned
    setting = replace(TINY["setting"], seed=1)
    with refusing("holds another run"):
        learn(CYLINDERS, **TINY | {"setting": setting}, updates=4, out=folder)
    assert curve.sizes == {"update": 4}  # learned from the start
    assert len(list((folder / "parts").glob("*.corrupt"))) == 1


@pytest.mark.slow
def test_a_sweep_agrees_with_the_environment(learned, registries):
    """Both have equal worlds, actions and sensing, and so equal outcomes."""
    name, params = registry.parse_law(str(learned[0] / "policy.npz"))
    setting = Setting("fused", fidelity="fast", rules=Rules(horizon=12.0), seed=5)
    results = run_sweep({name: params}, CYLINDERS, worlds=4, setting=setting)
    policy = policies.decode((learned[0] / "policy.npz").read_bytes(), "policy")
    env = PushEnv("random_cylinder", CYLINDERS, setting=setting, worlds=4)
    run = jax.jit(partial(collection.run_policy, policy.network, [env]))
    (states,) = run([env.table], policy.weights)
    assert_array_equal(states.data.steps * env.dt, np.float32(results.time[0]))
    assert_array_equal(states.data.success, results.success[0] > 0)
    assert_allclose(states.data.qpos[:, :3], results.base_pose[0], atol=2e-4)
    assert np.ptp(results.base_pose.values[0], axis=0).max() > 1e-3  # they did not stand still


def test_an_easier_world_has_its_target_nearer_and_more_ahead():
    env = PushEnv("random_cylinder", CYLINDERS, setting=Setting(engine="fused"), worlds=3)
    world = row(jax.device_get(env.table), 0)._replace(p_world_target=jnp.array([0.0, 2.0]))
    half = collection.ease(world, jnp.array(0.5)).p_world_target
    assert_allclose(half, 1.4 * np.array([1, 1]) / np.sqrt(2), rtol=1e-6)
    assert_array_equal(collection.ease(world, jnp.array(1.0)).p_world_target, [0.0, 2.0])


def test_rewards_of_privileged_quantities():
    """The rewards are the changes of distance to the target and of the alignment of the base."""
    env = PushEnv(
        "random_cylinder",
        CYLINDERS,
        worlds=3,
        setting=Setting("fused", fidelity="fast"),
        weights=Reward(progress=0.0, no_contact=0.0, success=0.0, object=1.0, behind=0.0),
    )
    state = jax.jit(env.begin)(row(jax.device_get(env.table), 0), jnp.array(0))
    previous = state.data
    shift = jnp.array([0.01, -0.02])
    current = previous._replace(qpos=previous.qpos.at[3:5].add(shift))
    touches = [state.info["observation"].touch] * 2
    nearer, together = env._true_state_terms(state.info["world"], previous, current, *touches)
    target = state.info["world"].p_world_target
    far = [float(jnp.linalg.norm(target - s.qpos[3:5])) for s in (previous, current)]
    assert float(nearer) == pytest.approx(far[0] - far[1], abs=1e-6)

    def cosine(s):
        ways = np.array([s.qpos[3:5] - s.qpos[:2], target - s.qpos[:2]])
        return ways[0] @ ways[1] / np.linalg.norm(ways, axis=1).prod()

    assert float(together) == pytest.approx(cosine(current) - cosine(previous), abs=1e-6)


@pytest.mark.slow
def test_the_ladder_runs_the_policy_of_the_command(learned, tmp_path, capsys, registries):
    """The command learns the policy of the call."""
    out = tmp_path / "learn"
    values = {name: value for name, value in TINY.items() if name != "setting"}
    options = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in values.items())
    drums = "wide,objects=random_cylinder,distance=0.7:0.8,bearing=-0.5:0.5,gap=0:0.01"
    setting = f"--domain {drums} --engine fused --fidelity fast --horizon 4"
    output = printed(capsys, f"learn {setting} --max-lost 30 {options} --updates 4 --out", out)
    assert "Compile" in output
    assert (out / "curve.png").stat().st_size > 10_000
    assert "success in validation" in output
    mine, theirs = (policies.decode((f / "policy.npz").read_bytes(), f) for f in (out, learned[0]))
    same(mine.weights, theirs.weights)
    options = f"--worlds 2 --slots 2 --workers 1 --laws pursuit {out / 'policy.npz'}"
    assert rps(f"ladder {setting} {options} --out", tmp_path / "ladder") == 0
    assert "learned_gru_" in capsys.readouterr().out
