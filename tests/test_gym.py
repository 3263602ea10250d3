"""The Gymnasium environment: a `PushEnv` with held actions, single or vectorised."""

import importlib
import sys
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers import (
    NEAR,
    refusals,
    refusing,
    row,
    same,
    setting_of,
    slow,
)
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.runs.evaluate import evaluate
from rps_jax.trials import gym
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules

HOW = {"object": "random_cylinder", "domain": NEAR, "worlds": 6, "hold": 1.0}
HOW |= {"setting": Setting("fused", fidelity="fast", rules=Rules(horizon=20.0))}
COUNT = 4
AHEAD = np.tile(np.float32([1.0, 0.0, 0.0]), (COUNT, 1))


def make_vector(**options):
    return gymnasium.make_vec("rps_jax/Push-v0", num_envs=COUNT, **HOW | options)


def with_programs_of(compiled, envs):
    """Return environments with the compiled programs of others."""
    mine, theirs = (getattr(x.unwrapped, "_vector", x.unwrapped) for x in (envs, compiled))
    for name in ("_start", "_act", "_select"):
        setattr(mine, name, getattr(theirs, name))
    return envs


@pytest.fixture(scope="module")
def single():
    return gymnasium.make("rps_jax/Push-v0", **HOW)


@pytest.fixture(scope="module")
def vector():
    return make_vector()


@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is")
@pytest.mark.filterwarnings("error:.*WARN")
def test_the_checker_of_gymnasium_passes(single):
    check_env(single.unwrapped, skip_render_check=True)
    assert single.observation_space.shape == (44,)
    assert single.action_space == gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    assert single.metadata["render_fps"] == 1  # an action lasts for a second


def test_a_step_is_an_action_of_push_env_held(single):
    obs, info = single.reset(seed=3)
    push, worlds = single.unwrapped.push_env, single.unwrapped._vector
    state = row(worlds._state, 0)
    assert int(state.info["index"]) == info["world"]
    assert_array_equal(obs, state.obs)
    step, total = jax.jit(push.step), 0.0
    for _ in range(round(1.0 / push.dt)):
        state = step(state, AHEAD[0])
        total += float(state.reward)
    obs, reward, terminated, truncated, info = single.step(AHEAD[0])
    assert_allclose(obs, state.obs, atol=1e-4)
    assert reward == pytest.approx(total, abs=1e-4)
    assert not any((terminated, truncated, info["is_success"]))
    assert info["time"] == pytest.approx(1.0)


def test_a_seed_decides_on_worlds_and_noise(single, vector):
    for env, action in ((single, AHEAD[0]), (vector, AHEAD)):
        runs = []
        for seed in (5, 5, 6):
            start, _ = env.reset(seed=seed)
            runs.append((start, *env.step(action)[:2]))
        same(runs[0], runs[1])
        assert not np.array_equal(runs[0][0], runs[2][0])
    start, _ = vector.reset(seed=5)
    assert len(np.unique(start, axis=0)) == COUNT  # the worlds differ


def step_until_success(envs):
    """Step until a trial succeeds."""
    envs.reset(seed=0)
    for _ in range(20):
        obs, rewards, terminated, truncated, infos = envs.step(AHEAD)
        if terminated.any():
            return obs, rewards, terminated, truncated, infos
    raise AssertionError("targets are ahead")


def test_a_success_terminates_and_resets_in_the_next_step(vector):
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    _, rewards, ended, truncated, infos = step_until_success(vector)
    assert infos["is_success"][ended].all()
    assert not truncated[ended].any()
    assert (rewards[ended] > 0.5).all()  # the success, which is worth 1, less what contact costs
    previous = infos["time"]
    obs, rewards, terminated, truncated, infos = vector.step(AHEAD)
    assert (rewards[ended] == 0).all()
    assert not (terminated | truncated)[ended].any()
    assert (infos["time"][ended] == 0).all()
    assert (infos["time"][~ended] >= previous[~ended]).all()
    assert infos["_time"].all()
    start = np.linalg.norm(obs[ended, 42:], axis=1)
    assert_allclose(start, 0.71, atol=0.03)  # far again
    assert (vector.step(AHEAD)[4]["time"][ended] == 1).all()


def test_autoreset_in_the_same_step_is_optional(vector):
    _, rewards, ended, *_ = step_until_success(vector)
    envs = with_programs_of(vector, make_vector(autoreset_mode="SameStep"))
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, same, terminated, _, infos = step_until_success(envs)
    assert_array_equal(terminated, ended)
    assert_array_equal(same, rewards)
    assert_array_equal(infos["_final_obs"], ended)
    assert (infos["time"][ended] == 0).all()
    assert infos["final_info"]["is_success"][ended].all()
    i = int(np.argmax(ended))
    assert np.linalg.norm(infos["final_obs"][i][42:]) < 0.45 < np.linalg.norm(obs[i, 42:])
    assert all(last is None for last in infos["final_obs"][~ended])


def test_who_runs_out_of_time_is_truncated(vector):
    vector.reset(seed=1)
    for second in range(1, 21):
        _, _, terminated, truncated, infos = vector.step(0 * AHEAD)
        assert not terminated.any()
        assert truncated.all() == (second == 20)
    assert not infos["is_success"].any()


def test_images_are_rendered_on_request(single):
    single.reset(seed=0)
    assert single.unwrapped.render() is None
    drawn = gymnasium.make("rps_jax/Push-v0", render_mode="rgb_array", **HOW)
    with_programs_of(single, drawn).reset(seed=0)
    image = drawn.render()
    assert image.shape == (240, 320, 3)
    assert image.std() > 10


test_invalid_options_of_one_environment_are_refused = refusals(
    gym.GymPush,
    ({"hold": 0.001}, r"hold = 0.001 is not allowed"),
    ({"domain": "wild"}, "unknown domain 'wild'"),
)
test_invalid_options_of_several_environments_are_refused = refusals(
    gym.GymPushVector,
    ({"num_envs": 0}, "num_envs = 0 is not allowed"),
    ({"autoreset_mode": "Never"}, "unknown autoreset_mode 'Never': choose from NextStep"),
    ({"render_mode": "ansi"}, "unknown render_mode 'ansi': choose from rgb_array"),
    ({"wolds": 3}, "unknown option 'wolds': .*did you mean 'worlds'"),
    ({"domain": 3}, "domain = 3 is not allowed: give a text, as wide, or a Domain"),
    ({"setting": None}, "setting = None is not allowed: give a Setting"),
)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan, 0, 0], r"action = \[\[nan, 0.0, 0.0\]\] is not allowed: it must be finite"),
        ([np.inf, 0, 0], r"action = \[\[inf, 0.0, 0.0\]\]"),
        ([1, 0], r"action = of shape \(1, 2\) is not allowed: .* of shape \(1, 3\)"),
        ([1, 0, 0, 0], r"action = of shape \(1, 4\)"),
        (1.0, r"action = of shape \(1,\)"),
        ([AHEAD[0]] * 2, r"action = of shape \(1, 2, 3\)"),
        ("left", r"action = \['left'\]"),
        (None, r"action = \[None\]|of shape \(1,\)"),
        ({"v_x": 1}, r"action = \[\{'v_x': 1\}\]"),
        ([[1], [1, 2], 3], "action = "),
    ],
)
def test_invalid_actions_are_refused(single, action, message):
    single.reset(seed=0)
    with refusing(message):
        single.unwrapped.step(action)


def test_greater_actions_are_reduced_to_the_bounds(single):
    far, bounded = [], []
    for action, found in (([9.0, 0.0, -9.0], far), ([1.0, 0.0, -1.0], bounded)):
        single.reset(seed=0)
        found.append(single.step(np.float32(action))[0])
    same(far, bounded)


def test_a_step_needs_a_running_episode(single):
    alone = gymnasium.make_vec("rps_jax/Push-v0", num_envs=1, render_mode="rgb_array", **HOW)
    for call in (lambda: alone.step(AHEAD[:1]), alone.unwrapped.render):
        with refusing("no episode has started: call reset before step"):
            call()
    single.reset(seed=0)
    single.unwrapped._vector._ended[:] = True
    with refusing(r"worlds \[0\] have ended: call reset before step"):
        single.step(AHEAD[0])
    with refusing(r"options = \{'world': 3\} is not allowed"):
        single.reset(options={"world": 3})
    single.reset()
    single.step(AHEAD[0])


def test_each_world_has_its_own_seed(single, vector):
    start, _ = vector.reset(seed=5)
    later = [vector.step(AHEAD)[0] for _ in range(2)]
    shuffled, _ = vector.reset(seed=[8, None, 6, 5])
    same(shuffled[[3, 2, 0]], start[[0, 1, 3]])
    alone, _ = single.reset(seed=7)
    same(alone, start[2], atol=1e-6)
    vector.reset(seed=5)
    same([vector.step(AHEAD)[0] for _ in range(2)], later)
    large = [5 + 2**32, 5, 5 + 2**63, 2**64 - 1]
    distinct, _ = vector.reset(seed=large)
    same(distinct[1], start[0], atol=1e-6)
    assert len(np.unique(distinct, axis=0)) == 4
    unseeded, _ = vector.reset()
    assert not np.array_equal(unseeded, start)


def test_a_mask_restarts_some_worlds(vector):
    start, _ = vector.reset(seed=5)
    moved, *_ = vector.step(AHEAD)
    where = np.array([True, False, False, True])
    options = {"reset_mask": where}
    obs, infos = vector.reset(seed=5, options=options)
    same(obs[where], start[where])
    same(obs[~where], moved[~where])
    same(infos["_time"], where)
    same(infos["time"], np.where(where, 0.0, 1.0))
    assert options["reset_mask"] is where
    same(vector.step(AHEAD)[4]["time"], np.where(where, 1.0, 2.0))


def test_a_mask_restarts_ended_worlds_without_autoreset(vector):
    envs = with_programs_of(vector, make_vector(autoreset_mode="Disabled"))
    _, _, ended, *_ = step_until_success(envs)
    with refusing(rf"worlds \[{np.flatnonzero(ended)[0]}.* have ended"):
        envs.step(AHEAD)
    _, infos = envs.reset(options={"reset_mask": ended})
    assert (infos["time"][ended] == 0).all()
    assert not envs.step(AHEAD)[2][ended].any()


def test_a_forked_worker_says_why_it_cannot_run(single):
    """It lacks the threads of JAX, and would wait for them."""
    single.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python warn of the fork
        envs = gymnasium.vector.AsyncVectorEnv([lambda: single.unwrapped] * 2, context="fork")
        with refusing(r"is a fork .* 'spawn', as multiprocessing.get_con"):
            envs.reset(seed=0)
        envs.close(terminate=True)


@pytest.mark.slow
def test_spawned_workers_run():
    how = HOW | {"setting": setting_of(20.0), "domain": "wide"}
    options = {"vectorization_mode": "async", "vector_kwargs": {"context": "spawn"}}
    envs = gymnasium.make_vec("rps_jax/Push-v0", num_envs=2, **options, **how)
    obs, _ = envs.reset(seed=7)
    alone, _ = gymnasium.make("rps_jax/Push-v0", **how).reset(seed=8)
    same(obs[1], alone, atol=1e-6)
    assert np.isfinite(envs.step(AHEAD[:2])[0]).all()
    envs.close()


STRICT = {
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_transfer_guard": "disallow",
    "jax_debug_infs": True,
    "jax_debug_nans": True,
    "jax_disable_jit": True,
    "jax_check_tracer_leaks": True,
    "jax_legacy_prng_key": "error",
    "jax_no_tracing": True,
    "jax_enable_custom_prng": True,
}


@pytest.mark.parametrize(("option", "value"), STRICT.items())
def test_checks_that_a_user_asks_of_jax_do_not_stop_it(vector, option, value):
    vector.reset(seed=5)
    expected = vector.step(AHEAD)
    case = {"worlds": 2, "setting": setting_of(0.1)}
    default = getattr(jax.config, option)
    jax.config.update(option, value)
    try:
        vector.reset(seed=5)
        found = vector.step(AHEAD)
        scores = evaluate("rps", "wide,objects=random_cylinder", **case, progress=False).score
    finally:
        jax.config.update(option, default)
    same(found[:4], expected[:4])
    assert np.isfinite(scores).all()


@pytest.mark.parametrize("kind", [gymnasium.make, slow(gymnasium.make_vec)])
def test_a_film_is_recorded(kind, single, tmp_path):
    pytest.importorskip("moviepy")
    wrappers = gymnasium.wrappers if kind is gymnasium.make else gymnasium.wrappers.vector
    env = with_programs_of(single, kind("rps_jax/Push-v0", render_mode="rgb_array", **HOW))
    env = wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True, video_length=2)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
    assert next(tmp_path.glob("*.mp4")).stat().st_size > 1000


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        ({"options": {"reset_mask": [True]}}, "reset_mask = .* shape \\(4,\\)"),
        ({"options": {"reset_mask": np.zeros(COUNT, bool)}}, "with a true value"),
        ({"options": {"reset_mask": np.ones(COUNT)}}, "type bool"),
        ({"options": {"mask": 1}}, "unknown option of reset 'mask': choose from reset_mask"),
        ({"seed": [1, 2]}, r"seed = \[1, 2\] is not allowed: .* a list of 4"),
        ({"seed": -1}, "seed = -1"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"seed": [1, 2, 3, 2**64]}, "seed = 18446744073709551616"),
        ({"seed": "abc"}, "seed = abc"),
        ({"seed": [1, 2, 3, "x"]}, "seed = x"),
    ],
)
def test_invalid_resets_are_refused(vector, reset, message):
    vector.reset(seed=0)
    with refusing(message):
        vector.reset(**reset)


def test_without_gymnasium_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "rps_jax.trials.gym")
    with refusing(r"run pip install 'rps_jax\[gym\]'"):
        importlib.import_module("rps_jax.trials.gym")
