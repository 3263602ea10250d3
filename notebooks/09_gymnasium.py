# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Gymnasium and Stable-Baselines3
#
# `rps_jax/Push-v0` is a Gymnasium environment of random worlds: the base has to push an unknown
# object to a target, and observes its skin and the target. It needs the extra `gym` (`pip install
# 'rps_jax[gym]'`), and the training at the end needs Stable-Baselines3.

# %%
import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import rps_jax
import rps_jax.trials.gym  # registers rps_jax/Push-v0

rps_jax.use_cache()  # store compiled programs for the next process
rules = rps_jax.Rules(horizon=60.0, max_lost=20.0)
options = {
    "object": "random_cylinder",
    "domain": "wide,distance=0.7:1,bearing=-0.3:0.3",
    "hold": 0.5,
    "setting": rps_jax.Setting(fidelity="fast", rules=rules),
}
env = gymnasium.make("rps_jax/Push-v0", render_mode="rgb_array", **options)
obs, info = env.reset(seed=0)
print(env.observation_space, env.action_space, info)

# %% [markdown]
# The last two numbers of an observation are the target (x, y) [m] in the robot frame, the others
# the signals of the taxels. An action is a twist in units of its limits, from -1 to 1, and lasts
# `hold` [s]. Here a policy drives ahead and turns towards the target:


# %%
def towards(obs):
    """Return actions (..., 3) that drive ahead and turn towards the target."""
    x, y = obs[..., -2], obs[..., -1]
    turn = np.clip(np.arctan2(y, x), -1, 1)
    return np.stack([np.ones_like(turn), np.zeros_like(turn), turn], axis=-1)


total, ended = 0.0, False
while not ended:
    obs, reward, terminated, truncated, info = env.step(towards(obs))
    total, ended = total + reward, terminated or truncated
print(f"return {total:.2f}, {info}")
plt.imshow(env.render())
_ = plt.axis("off")

# %% [markdown]
# ## Many worlds in one program
#
# `make_vec` steps all worlds in one compiled program; it needs no processes. An ended trial starts
# again in another world, and that step has the reward 0 (`autoreset_mode`).

# %%
envs = gymnasium.make_vec("rps_jax/Push-v0", num_envs=64, **options)


def evaluate(policy, steps=130):
    """Return whether each ended trial succeeded."""
    obs, _ = envs.reset(seed=1)
    successes = []
    for _ in range(steps):
        obs, _, terminated, truncated, infos = envs.step(policy(obs))
        successes += infos["is_success"][terminated | truncated].tolist()
    return np.array(successes)


rng = np.random.default_rng(0)
policies = {
    "random": lambda obs: rng.uniform(-1, 1, (len(obs), 3)),
    "towards the target": towards,
}
for name, policy in policies.items():
    successes = evaluate(policy)
    print(f"{name}: {successes.sum()} of {len(successes)} trials succeed")

# %% [markdown]
# ## Training with Stable-Baselines3
#
# `pip install stable-baselines3`, and wrap the vector environment. `SameStep` restarts a trial in
# its last step, as Stable-Baselines3 expects.
#
# ```python
# import gymnasium
# import numpy as np
# import rps_jax
# import rps_jax.trials.gym
# from stable_baselines3 import PPO
# from stable_baselines3.common.vec_env import VecEnv, VecMonitor
#
#
# class PushVecEnv(VecEnv):
#     """The vector environment with the interface of Stable-Baselines3."""
#
#     def __init__(self, envs):
#         self.envs, self.render_mode = envs, None
#         super().__init__(
#             envs.num_envs, envs.single_observation_space, envs.single_action_space
#         )
#
#     def reset(self):
#         return self.envs.reset(seed=0)[0]
#
#     def step_async(self, actions):
#         self.actions = actions
#
#     def step_wait(self):
#         obs, rewards, terminated, truncated, infos = self.envs.step(self.actions)
#         done = terminated | truncated
#         rows = [{} for _ in done]
#         for i in np.flatnonzero(done):
#             rows[i] = {
#                 "terminal_observation": infos["final_obs"][i],
#                 "TimeLimit.truncated": bool(truncated[i]),
#                 "is_success": bool(infos["final_info"]["is_success"][i]),
#             }
#         return obs, rewards.astype(np.float32), done, rows
#
#     def close(self):
#         self.envs.close()
#
#     def get_attr(self, name, indices=None):
#         return [getattr(self.envs, name, None)] * self.num_envs
#
#     def set_attr(self, name, value, indices=None):
#         raise NotImplementedError
#
#     def env_method(self, name, *args, indices=None, **kwargs):
#         raise NotImplementedError
#
#     def env_is_wrapped(self, wrapper, indices=None):
#         return [False] * self.num_envs
#
#
# rules = rps_jax.Rules(horizon=60.0, max_lost=20.0)
# options = {
#     "object": "random_cylinder", "domain": "wide,distance=0.7:1,bearing=-0.3:0.3",
#     "hold": 0.5, "setting": rps_jax.Setting(fidelity="fast", rules=rules),
# }
# envs = gymnasium.make_vec(
#     "rps_jax/Push-v0", num_envs=256, autoreset_mode="SameStep", **options
# )
# model = PPO("MlpPolicy", VecMonitor(PushVecEnv(envs)), n_steps=32, batch_size=2048, verbose=1)
# model.learn(total_timesteps=1_000_000)
# model.save("policy_sb3")
# ```
#
# Targets near and ahead are learned in minutes: `sweeps/learned` of the repository measures the
# success over a minute of such a training. `rps learn` trains for targets all around, in one
# program on a GPU, and writes a law that every `--law` accepts.
