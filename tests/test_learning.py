"""A law learned from touch: its network, its file, the algorithm, and runs that are continued."""

import io
import json
import shutil
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import CYLINDERS, refusal, rps

from rps_jax import InputError, learn
from rps_jax import sweep as run_sweep
from rps_jax.control import registry
from rps_jax.control.learned import features
from rps_jax.control.learned import network as networks
from rps_jax.control.learned import policy as policies
from rps_jax.control.learned.features import TouchState
from rps_jax.control.learned.network import Network, PolicyState
from rps_jax.control.learned.policy import Policy
from rps_jax.control.observation import Observation, TaxelObservation
from rps_jax.record import files
from rps_jax.runs.plan import Plan, load_plan, open_run
from rps_jax.trials.env import PushEnv, Reward
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning import ppo, rollout
from rps_jax.tuning.learn import UNITS
from rps_jax.tuning.ppo import PPO, TrainState, Transition

SMALL = {"width": 6, "hold": 0.1}
KINDS = ("mlp", "gru")


def network_of(kind, **changes):
    return Network(kind, **(SMALL | changes))


def weights_of(network, seed=0):
    """Return random weights, none of them small."""
    drawn = networks.init_weights(network.shapes, jax.random.PRNGKey(seed))
    return {name: np.asarray(weight, np.float32) for name, weight in drawn.items()}


def random_obs(seed, mirror=False):
    """Return a random observation, or its mirror image."""
    rng = np.random.default_rng(seed)
    side = np.array([1, -1 if mirror else 1])
    yaw, signal = rng.uniform(-3, 3), rng.uniform(0, 2, 42)
    touch = Observation(
        side * rng.uniform(-1, 1, 2),
        side[1] * yaw,
        side * np.array([0.36, rng.uniform(-0.2, 0.2)]),
        np.asarray(seed % 3 > 0),
        side * rng.uniform(-2, 2, 2),
        0.02,
    )
    signal = signal[::-1] if mirror else signal
    obs = TaxelObservation(touch, signal, np.asarray(seed % 2 > 0))
    return jax.tree.map(jnp.asarray, obs)


# --- network -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirrored_observation_gives_the_mirrored_twist(kind):
    """This holds for random weights and over several steps, including the memory."""
    network = network_of(kind)
    _, params = _registered(network)
    law = jax.jit(partial(networks.step, network, weights_of(network)))
    memories = [PolicyState.init(network)] * 2
    twists = []
    for seed in range(12):
        for i, mirror in enumerate((False, True)):
            memories[i], twist, _ = law(params, memories[i], random_obs(seed, mirror))
            twists.append(np.array(twist))
    plain, mirrored = np.array(twists).reshape(12, 2, 3).swapaxes(0, 1)
    np.testing.assert_allclose(mirrored, plain * [1, -1, -1], atol=1e-7)
    assert np.abs(plain[:, 1:]).max() > 1e-3  # it does turn


def test_an_action_is_held_and_bounded():
    network = network_of("mlp")
    _, params = _registered(network)
    weights = {name: 30 * weight for name, weight in weights_of(network).items()}
    law = jax.jit(partial(networks.step, network, weights))
    memory, twists = PolicyState.init(network), []
    for seed in range(20):
        memory, twist, _ = law(params, memory, random_obs(seed))
        twists.append(np.array(twist))
    twists = np.array(twists).reshape(4, 5, 3)
    np.testing.assert_array_equal(twists, twists[:, :1].repeat(5, axis=1))
    assert len(np.unique(twists[:, 0], axis=0)) == 4
    speeds = np.linalg.norm(twists[..., :2], axis=-1)
    assert speeds.max() == pytest.approx(0.05, rel=1e-5)
    assert np.abs(twists[..., 2]).max() <= 0.15 + 1e-7


def test_the_position_of_a_lost_contact_is_remembered():
    """Touch at (1, 0.1) in the world; then the base is at (0.5, 0.1), turned left."""
    touch = random_obs(1).touch._replace(
        p_world_robot=jnp.array([0.6, 0.0]), yaw=jnp.zeros(()), in_contact=jnp.array(True),
        p_robot_contact=jnp.array([0.4, 0.1]), p_world_target=jnp.array([1.0, 1.1]),
    )  # fmt: skip
    obs = random_obs(1)._replace(touch=touch)
    felt = TouchState.initial().update(obs)
    np.testing.assert_allclose(felt.p_robot_contact(obs), [0.4, 0.1], atol=1e-6)
    away = touch._replace(
        p_world_robot=jnp.array([0.5, 0.1]), yaw=jnp.array(np.pi / 2), in_contact=jnp.array(False)
    )
    later = obs._replace(touch=away)
    felt = felt.update(later)
    np.testing.assert_allclose(felt.p_robot_contact(later), [0.0, -0.5], atol=1e-6)
    assert float(felt.time_since_contact) == pytest.approx(0.02)
    values = features.compute_features(felt, jnp.zeros(3), later)[42:]
    # No contact now, no line, contact earlier; its position; 1 m to the target ahead of it.
    np.testing.assert_allclose(values[:3], [0, 0, 1])
    np.testing.assert_allclose(values[4:6], [0, -0.5 / 0.36], atol=1e-6)
    np.testing.assert_allclose(values[6:9], [1, 0, np.log(20) / np.log(60)], atol=1e-6)


# --- files ---------------------------------------------------------------------------------


def _registered(network, seed=0):
    """Register a random policy; return its law name and parameters."""
    policy = Policy(network, weights_of(network, seed))
    label, _, params = policies.build_law(policy)
    return label, params


def written(path, kind="gru", **changes):
    policy = Policy(network_of(kind), weights_of(network_of(kind)), **changes)
    path.write_bytes(policies.encode(policy))
    return policy


@pytest.mark.parametrize("kind", KINDS)
def test_a_law_loaded_from_a_file_equals_the_saved_law(kind, tmp_path, registries):
    policy = written(tmp_path / "policy.npz", kind, learned={"how": "by chance"})
    loaded = policies.decode((tmp_path / "policy.npz").read_bytes(), "policy.npz")
    assert (loaded.network, loaded.task, loaded.learned) == (
        policy.network,
        policy.task,
        policy.learned,
    )
    name, params = registry.parse_law(str(tmp_path / "policy.npz"))
    assert name.startswith(f"learned_{kind}_")
    law = registry.law_of(params)
    assert law.senses == "taxels"
    reference = jax.jit(partial(networks.step, policy.network, policy.weights))
    memories = law.init(params), PolicyState.init(policy.network)
    for seed in range(12):
        (law_memory, twist, _), (reference_memory, reference_twist, _) = (
            step(params, memory, random_obs(seed))
            for step, memory in zip((jax.jit(law.step), reference), memories, strict=True)
        )
        np.testing.assert_array_equal(np.array(twist), np.array(reference_twist))
        memories = law_memory, reference_memory
    again = registry.params_to_json(params)
    assert again["file"] == str(tmp_path / "policy.npz")
    assert registry.params_from_json(json.loads(json.dumps(again))) == params


def damaged(content, **changes):
    """Return the archive with changed arrays and, by default, their digest."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    about = json.loads(str(arrays["about"])) | changes.pop("about", {})
    arrays |= {"about": np.array(json.dumps(about))} | changes
    arrays.pop("digest")
    digest = np.array(policies._digest(arrays))
    archive = io.BytesIO()
    np.savez(archive, digest=digest, **arrays)
    return archive.getvalue()


def with_changed_bit(content):
    """Return a valid archive with a changed weight and the old digest."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["action.b"] = arrays["action.b"] + np.float32(1e-3)
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    return archive.getvalue()


def pickled(content):
    archive = io.BytesIO()
    np.savez(archive, about=np.array([{"a": 1}], object), digest=np.array(""))
    return archive.getvalue()


BAD = {
    "truncated": (lambda c: c[: len(c) // 2], "give a file that `rps learn` wrote"),
    "empty": (lambda c: b"", "give a file that `rps learn` wrote"),
    "text": (lambda c: b"hello", "give a file that `rps learn` wrote"),
    "pickled": (pickled, "give a file that `rps learn` wrote"),
    "bit": (with_changed_bit, "its digest does not match"),
    "version": (partial(damaged, about={"version": 7}), "version 7"),
    "format": (partial(damaged, about={"format": "other"}), "its format is other"),
    "network": (
        partial(damaged, about={"network": network_of("mlp")._asdict()}),
        "memory.gates.w has the shape .*, and its network None",
    ),
    "kind": (
        partial(damaged, about={"network": network_of("mlp", width=0)._asdict() | {"kind": "cnn"}}),
        "unknown network 'cnn': choose from mlp, gru",
    ),
    "width": (
        partial(damaged, about={"network": network_of("gru", width=7)._asdict()}),
        "has the shape .* and its network ",
    ),
    "nan": (
        partial(damaged, **{"action.b": np.full(3, np.nan, np.float32)}),
        "action.b must hold finite numbers of 32 bits",
    ),
    "task": (partial(damaged, about={"task": {"v_max": 1.0}}), "d_success"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_invalid_policy_file_is_refused_in_one_sentence(name, tmp_path):
    written(tmp_path / "policy.npz")
    damage, words = BAD[name]
    path = tmp_path / "policy.npz"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=words) as error:
        registry.parse_law(str(path))
    assert "\n" not in str(error.value)


def test_commands_refuse_bad_policies_before_anything_compiles(tmp_path, capsys, compiled):
    (tmp_path / "bad.npz").write_bytes(b"hello")
    error = refusal(capsys, "ladder", "--laws", tmp_path / "bad.npz", "--out", tmp_path / "run")
    assert "give a file that `rps learn` wrote" in error
    error = refusal(capsys, "sweep", "--laws", tmp_path / "none.npz", "--out", tmp_path / "run")
    assert "cannot be read (No such file or directory)" in error
    for options, words in {
        "--domain wid": "did you mean 'wide'",
        "--domain paper": "skin of a domain to learn in 'ideal'",
        "--hold 0.001": "hold = 0.001 is not allowed",
        "--minutes 0": "minutes = 0 is not allowed without updates",
        "--domain wide,objects=ball": "unknown domain object 'ball'",
        "--num-envs 1 --num-minibatches 4": "num_minibatches = 4 is not allowed: there are only 3",
        "--ent-coef nan": "ent_coef = nan",
        "--engine mujoco": "engine = mujoco is not allowed",
    }.items():
        out = tmp_path / "learn"
        assert words in refusal(capsys, "learn", *options.split(), "--out", out), options
        assert not (out / "parts").exists()
    assert sum(compiled) < 5.0


def test_a_run_of_a_policy_needs_its_unchanged_file(tmp_path, registries):
    path = tmp_path / "policy.npz"
    written(path)
    name, params = registry.parse_law(str(path))
    setting = Setting("fused", fidelity="fast")
    open_run(tmp_path / "run", Plan(CYLINDERS, 4, {name: params}, setting))
    assert load_plan(tmp_path / "run").laws == {name: params}
    new_policy = Policy(network_of("gru"), weights_of(network_of("gru"), seed=1))
    path.write_bytes(policies.encode(new_policy))
    with pytest.raises(InputError, match="has changed since the run"):
        load_plan(tmp_path / "run")


# --- the algorithm -------------------------------------------------------------------------


def steps_of(reward, value, next_value, done, terminated):
    """Return transitions of one world with the columns (T,) that advantages need."""
    blank = jnp.zeros((len(reward), 1))
    columns = [jnp.asarray(x)[:, None] for x in (value, next_value, reward, done, terminated)]
    return Transition(blank, blank, blank > 0, blank, blank, *columns)


def test_advantages_by_hand():
    """Gamma 0.5, lambda 0.5. The third trial ends by a success, the second by the clock.

    delta_4 = 1 - 3 = -2, nothing after it. delta_3 = 2 + 0.5 * 8 - 1 = 5, ended, so it stands
    alone. delta_2 = 0 + 0.5 * 1 - 2 = -1.5, and A_2 = -1.5 + 0.25 * 5 = -0.25. delta_1 =
    1 + 0.5 * 2 - 1 = 1, and A_1 = 1 + 0.25 * -0.25 = 0.9375.
    """
    advantages = ppo.advantages(
        steps_of(
            [1.0, 0.0, 2.0, 1.0],
            [1.0, 2.0, 1.0, 3.0],
            [2.0, 1.0, 8.0, 9.0],
            [False, False, True, True],
            [False, False, False, True],
        ),
        0.5,
        0.5,
    )
    np.testing.assert_allclose(advantages[:, 0], [0.9375, -0.25, 5.0, -2.0])


def test_the_surrogate_is_that_of_the_paper():
    ratio, advantage = jnp.array([1.0, 1.5, 0.5, 1.5, 0.5]), jnp.array([2.0, 1.0, 1.0, -1.0, -1.0])
    surrogate = ppo.surrogate(ratio, advantage, 0.2)
    np.testing.assert_allclose(surrogate, [2.0, 1.2, 0.5, -1.5, -0.8], rtol=1e-6)


def batch(network, state, seed=0, steps=5, worlds=4):
    """Return random transitions with actions of the policy."""
    rng = np.random.default_rng(seed)
    size, extra = features.feature_count(network.taxels), ppo.PRIVATE_SIGNS.size
    obs = jnp.asarray(rng.normal(size=(steps, worlds, size)), jnp.float32)
    private = jnp.asarray(rng.normal(size=(steps, worlds, extra)), jnp.float32)
    fresh = jnp.asarray(rng.uniform(size=(steps, worlds)) < 0.2)
    hidden = jnp.asarray(rng.normal(size=network.initial_hidden((worlds,)).shape), jnp.float32)
    zero = jnp.zeros((steps, worlds))
    transitions = Transition(
        obs, private, fresh, jnp.zeros((steps, worlds, 3)), *[zero] * 4, *[fresh] * 2
    )
    mean = ppo.means(network, state.weights["actor"], hidden, transitions)
    action = mean + 0.5 * jnp.asarray(rng.normal(size=mean.shape), mean.dtype)
    log_prob = ppo.log_prob(action, mean, state.weights["log_std"])
    return hidden, transitions._replace(action=action, log_prob=log_prob)


@pytest.mark.parametrize("kind", KINDS)
def test_the_loss_of_the_policy_that_acted(kind):
    """Ratios are 1: the surrogate is the mean advantage, nothing is clipped, nothing diverges."""
    config, network = PPO(network=kind, width=6, ent_coef=0.0), network_of(kind)
    state = TrainState.init(config, network, jax.random.PRNGKey(0))
    hidden, transitions = batch(network, state)
    advantage = jnp.arange(20.0).reshape(5, 4)
    value = networks.critic(
        state.weights["critic"], ppo.critic_inputs(transitions.obs, transitions.private)
    )
    loss, kl = ppo.loss(config, network, state.weights, hidden, transitions, advantage, value + 2)
    assert float(loss) == pytest.approx(0.5 * 2**2 - 9.5, rel=1e-5)
    assert float(kl) == pytest.approx(0, abs=1e-6)

    def policy_alone(weights):
        return ppo.loss(config, network, weights, hidden, transitions, advantage, value)[0]

    # So its slope is that of the policy gradient, sum of advantages times log probabilities.
    def gradient(weights):
        mean = ppo.means(network, weights["actor"], hidden, transitions)
        return -jnp.mean(advantage * ppo.log_prob(transitions.action, mean, weights["log_std"]))

    slope, expected = jax.grad(policy_alone)(state.weights), jax.grad(gradient)(state.weights)
    for name in network.shapes:
        np.testing.assert_allclose(slope["actor"][name], expected["actor"][name], atol=2e-5)


def test_a_mirrored_world_has_an_equal_value():
    config, network = PPO(network="mlp", width=6), network_of("mlp")
    state = TrainState.init(config, network, jax.random.PRNGKey(0))
    _, transitions = batch(network, state)
    mirrored = ppo.critic_inputs(
        features.mirror(transitions.obs), ppo.PRIVATE_SIGNS * transitions.private
    )
    pairs = ppo.critic_inputs(transitions.obs, transitions.private)
    value, mirrored_value = (networks.critic(state.weights["critic"], x) for x in (pairs, mirrored))
    np.testing.assert_allclose(value, mirrored_value, atol=1e-6)
    assert np.std(value) > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_action_of_one_step_is_learned(kind):
    """The reward of an action falls with its distance to a function of the observation."""
    config = PPO(
        network=kind, width=6, update_epochs=4, num_minibatches=2, ent_coef=0.0,
        learning_rate=3e-3, target_kl=0.02,
    )  # fmt: skip
    network = network_of(kind)
    state = TrainState.init(config, network, jax.random.PRNGKey(0))

    def best(obs):
        forward, lateral = 0.8 * jnp.sign(obs[..., 0] + obs[..., 41]), obs[..., 47]
        return jnp.stack([forward, 0.5 * jnp.sign(lateral), 0 * lateral], axis=-1)

    @jax.jit
    def update(state, key):
        key_seen, key_act, key_pass = jax.random.split(key, 3)
        shape = (4, 64, features.feature_count(network.taxels))
        obs = (
            jnp.zeros(shape).at[..., [0, 41, 47]].set(jax.random.normal(key_seen, (*shape[:2], 3)))
        )
        flags = jnp.ones(shape[:2], bool)
        blank = jnp.zeros((*shape[:2], ppo.PRIVATE_SIGNS.size))
        zero = jnp.zeros(shape[:2])
        hidden = network.initial_hidden((64,))
        transitions = Transition(
            obs, blank, flags, jnp.zeros((4, 64, 3)), *[zero] * 4, flags, flags
        )
        mean = ppo.means(network, state.weights["actor"], hidden, transitions)
        noise = jax.random.normal(key_act, mean.shape)
        action = mean + jnp.exp(state.weights["log_std"]) * noise
        transitions = transitions._replace(
            action=action,
            log_prob=ppo.log_prob(action, mean, state.weights["log_std"]),
            value=networks.critic(state.weights["critic"], ppo.critic_inputs(obs, blank)),
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
    "network": "gru", "width": 6, "num_envs": 6, "num_steps": 4, "update_epochs": 2,
    "num_minibatches": 2, "hold": 0.1, "minutes": 0, "drawn": 6, "validation": 3,
    "setting": Setting("quasistatic", fidelity="fast", rules=Rules(horizon=4.0, max_lost=30.0)),
}  # fmt: skip


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A run of four updates: its folder and curve."""
    folder = tmp_path_factory.mktemp("learn") / "whole"
    return folder, learn(CYLINDERS, **TINY, updates=4, out=folder)


def test_a_killed_and_resumed_run_equals_an_uninterrupted_one(learned, tmp_path):
    folder, whole = learned
    out = tmp_path / "parts"

    def kill(progress):
        raise KeyboardInterrupt

    learn(CYLINDERS, **TINY, updates=2, out=out)
    with pytest.raises(KeyboardInterrupt):  # in the third update, before its checkpoint
        learn(CYLINDERS, **TINY, updates=9, out=out, report_to=kill)
    again = learn(CYLINDERS, **TINY, updates=4, out=out)
    for name in ("ended", "reward", "value", "kl", "learning_rate", "spread", "simulated"):
        np.testing.assert_array_equal(again[name], whole[name], err_msg=name)
    mine, theirs = (policies.decode((f / "policy.npz").read_bytes(), f) for f in (out, folder))
    for name in mine.weights:
        np.testing.assert_array_equal(mine.weights[name], theirs.weights[name])


def test_the_results_of_a_run(learned):
    folder, curve = learned
    assert curve.sizes == {"update": 4}
    assert curve.simulated.values.tolist() == pytest.approx([2.4, 4.8, 7.2, 9.6])
    assert np.isfinite(curve.validation.values[-1])
    assert np.isfinite(curve.reward).all()
    assert (curve.spread.values > 0).all()
    assert files.read_results(folder).identical(curve)
    policy = policies.decode((folder / "policy.npz").read_bytes(), folder)
    assert policy.network == Network("gru", 6, 42, 0.1)
    assert policy.learned["updates"] == 4


def test_the_curve_is_a_table_that_pandas_reads(learned):
    folder, curve = learned
    table = pd.read_csv(folder / "curve.csv", index_col="update")
    assert table.index.tolist() == curve["update"].values.tolist() == [1, 2, 3, 4]
    assert list(table) == list(UNITS)
    for name in table:
        np.testing.assert_array_equal(table[name], curve[name], err_msg=name)
    assert table.validation.isna().tolist() == [True, True, True, False]


def test_a_folder_of_another_run_and_damaged_parts(learned, tmp_path):
    folder, _ = learned
    setting = replace(TINY["setting"], seed=1)
    with pytest.raises(InputError, match="holds another run"):
        learn(CYLINDERS, **TINY | {"setting": setting}, updates=4, out=folder)
    out = shutil.copytree(folder, tmp_path / "run")
    (part,) = (out / "parts").iterdir()
    part.write_bytes(part.read_bytes()[:-1])
    curve = learn(CYLINDERS, **TINY, updates=1, out=out)  # learned again
    assert curve.sizes == {"update": 1}
    assert len(list((out / "parts").glob("*.corrupt"))) == 1


def test_a_sweep_agrees_with_the_environment(learned, registries):
    """Both have equal worlds, actions and sensing, and so equal outcomes."""
    name, params = registry.parse_law(str(learned[0] / "policy.npz"))
    setting = Setting("fused", fidelity="fast", rules=Rules(horizon=12.0), seed=5)
    results = run_sweep({name: params}, CYLINDERS, worlds=4, setting=setting)
    policy = policies.decode((learned[0] / "policy.npz").read_bytes(), "policy")
    env = PushEnv("random_cylinder", CYLINDERS, setting=setting, worlds=4)
    run = jax.jit(partial(rollout.rollout, policy.network, env))
    states = run(env.table, policy.weights)
    np.testing.assert_array_equal(states.data.steps * env.dt, np.float32(results.time[0]))
    np.testing.assert_array_equal(states.data.success, results.success[0] > 0)
    np.testing.assert_allclose(states.data.qpos[:, :3], results.base_pose[0], atol=2e-4)
    assert np.ptp(results.base_pose.values[0], axis=0).max() > 1e-3  # they did not stand still


def test_an_easier_world_has_its_target_nearer_and_more_ahead():
    env = PushEnv("random_cylinder", CYLINDERS, setting=Setting(engine="fused"), worlds=3)
    world = jax.tree.map(lambda leaf: leaf[0], env.table)._replace(
        p_world_target=jnp.array([0.0, 2.0])
    )
    half = rollout.ease(world, jnp.array(0.5)).p_world_target
    np.testing.assert_allclose(half, 1.4 * np.array([1, 1]) / np.sqrt(2), rtol=1e-6)
    np.testing.assert_array_equal(rollout.ease(world, jnp.array(1.0)).p_world_target, [0.0, 2.0])


def test_rewards_of_privileged_quantities():
    """The rewards are the changes of distance to the target and of the alignment of the base."""
    env = PushEnv(
        "random_cylinder", CYLINDERS, worlds=3,
        setting=Setting("fused", fidelity="fast"),
        weights=Reward(progress=0.0, no_contact=0.0, success=0.0, object=1.0, behind=0.0),
    )  # fmt: skip
    state = env.begin(jax.tree.map(lambda leaf: leaf[0], env.table), jnp.array(0))
    previous = state.data
    shift = jnp.array([0.01, -0.02])
    current = previous._replace(qpos=previous.qpos.at[3:5].add(shift))
    nearer, together = env._true_state_terms(state.info["world"], previous, current)
    target = state.info["world"].p_world_target
    far = [float(jnp.linalg.norm(target - s.qpos[3:5])) for s in (previous, current)]
    assert float(nearer) == pytest.approx(far[0] - far[1], abs=1e-6)

    def cosine(s):
        ways = np.array([s.qpos[3:5] - s.qpos[:2], target - s.qpos[:2]])
        return ways[0] @ ways[1] / np.linalg.norm(ways, axis=1).prod()

    assert float(together) == pytest.approx(cosine(current) - cosine(previous), abs=1e-6)


def test_the_ladder_runs_the_policy_of_the_command(tmp_path, capsys, registries):
    out = tmp_path / "learn"
    options = ["--domain", "wide,objects=random_cylinder", "--network", "mlp"]
    options += ["--width", 4, "--num-envs", 4, "--drawn", 4, "--validation", 2, "--num-steps", 2]
    options += ["--num-minibatches", 1, "--minutes", 0, "--updates", 2, "--engine", "quasistatic"]
    assert rps("learn", *options, "--out", out) == 0
    output = capsys.readouterr().out
    assert "Compile" in output
    assert (out / "curve.png").stat().st_size > 10_000
    assert "success in validation" in output
    options = ["ladder", *options[:2], "--worlds", 2, "--engine", "quasistatic", "--slots", 2]
    options += [
        "--laws",
        "pursuit",
        out / "policy.npz",
        "--workers",
        1,
        "--out",
        tmp_path / "ladder",
    ]
    assert rps(*options) == 0
    assert "learned_mlp_" in capsys.readouterr().out
