# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Gradients through contact
#
# The engine `fused` has exact derivatives. This notebook shows the gradient of a push, the effect
# of chaos on it, and its uses. One call gives a score and its gradient in each random world:

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import rps_jax
from rps_jax.tuning import gradients


def final_distance(trajectory):  # [m] from the contact to the target
    return trajectory.details.distance[-1]


boxes, names = "wide,objects=random_box,gap=0:0", ("K_h", "beta", "friction_robot", "target")
results = rps_jax.value_and_grad(final_distance, "rps", boxes, 32, names, horizon=1.0)
results[["mean", "error"]].squeeze("law").to_dataframe()[["unit", "mean", "error"]]

# %% [markdown]
# In plain JAX a push is a function of one world and the parameters of a law. For the first world:

# %%
batch, law = rps_jax.draw_worlds(boxes, 32), rps_jax.RPSParams.paper()


@jax.jit
@jax.value_and_grad
def distance(beta, world):
    changed = law._replace(beta=beta)
    return final_distance(rps_jax.rollout(world, changed, batch.stage, horizon=1.0, smooth=True))


world = jax.tree.map(lambda leaf: leaf[0], batch.worlds)
(above, _), (_, slope), (below, _) = (distance(law.beta + x, world) for x in (1e-3, 0.0, -1e-3))
print(f"derivative {slope:.4f}, central difference {(above - below) / 2e-3:.4f}")

# %% [markdown]
# ## Chaos
#
# Forward mode gives derivatives at all times at once. Left: their median norm in 32 worlds, and
# dashed the largest. Right: their error in predicting the effect of `K_h` and `beta` 1 % larger
# and smaller.


# %%
def path(numbers, world):
    """Return distance (T,) [m] and pose of the object (T, 7), twice: JAX differentiates one."""
    world = world._replace(fields=world.fields._replace(friction_robot=numbers[2]))
    changed = law._replace(K_h=numbers[0], beta=numbers[1])
    steps = rps_jax.rollout(world, changed, batch.stage, horizon=8.0, smooth=True)
    return ((steps.details.distance, steps.qpos[:, 3:]),) * 2


def inputs(worlds, temperature):  # [1] of the taxels: the width of their switches
    numbers = np.c_[np.full((32, 2), [law.K_h, law.beta]), worlds.fields.friction_robot]
    return numbers, worlds._replace(skin=worlds.skin._replace(temperature=np.full(32, temperature)))


push = jax.jit(jax.vmap(jax.jacfwd(path, has_aux=True)))
drums = rps_jax.draw_worlds(boxes.replace("box", "cylinder"), 32).worlds
cases = {
    "boxes": (batch.worlds, 0.03),
    "cylinders": (drums, 0.03),
    "boxes, wider": (batch.worlds, 0.1),
}
time, slopes = 0.02 * np.arange(25, 401), {}
fig, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for i, (name, case) in enumerate(cases.items()):
    numbers, worlds = inputs(*case)
    slopes[name] = np.asarray(push(numbers, worlds)[0][0])[:, 24:, :2]
    above, below = (push(numbers * [x, x, 1], worlds)[1][0][:, 24:] for x in (1.01, 0.99))
    predicted = 0.02 * slopes[name] @ numbers[0, :2]
    error = np.abs(above - below - predicted) / (np.abs(above - below) + 1e-6)
    norm = np.linalg.norm(slopes[name], axis=-1)
    axes[0].semilogy(time, np.median(norm, axis=0), f"C{i}", time, norm.max(axis=0), f"C{i}--")
    axes[1].semilogy(time, np.median(error, axis=0), label=f"{name}, {case[1]}")
axes[0].set(xlabel="horizon [s]", ylabel="norm of the gradient [m]")
axes[1].set(xlabel="horizon [s]", ylabel="median relative error [1]")
_ = axes[0].legend(*axes[1].get_legend_handles_labels(), title="temperature of taxels")

# %% [markdown]
# A change grows in this loop: the contact point moves along the face, the law turns the base, and
# the object turns. A few worlds then dominate a mean over worlds. A bound on their norms (`clipped`) is
# biased, wider taxels are another skin, and short windows lack later effects. Mean derivatives by
# `K_h`, with their standard errors:

# %%
for seconds in (2, 8):
    samples = {name: x[:, 50 * seconds - 25] for name, x in slopes.items()}
    norm = np.linalg.norm(samples["boxes"], axis=1, keepdims=True)
    samples["boxes, clipped"] = samples["boxes"] * np.minimum(1.0, 2.0 * np.median(norm) / norm)
    for name, (mean, variance, _) in ((k, gradients.estimate(x)) for k, x in samples.items()):
        print(f"{seconds} s, {name}: {mean[0]:.4f} +- {variance[0] ** 0.5:.4f}")

# %% [markdown]
# ## Identification
#
# What was the friction in a push? The poses of the box are recorded for 2 s with noise (0.001 m,
# and 0.001 in the quaternion). Gauss-Newton answers for each of 32 boxes. Bars: two standard
# deviations, if poses changed linearly with friction. Orange: the answer does not fit the record.

# %%
numbers, worlds = inputs(batch.worlds, 0.1)
noise, prior, truth, rng = 1e-3, 0.2, numbers[:, 2].copy(), np.random.default_rng(0)
record = push(numbers, worlds)[1][1][:, :100] + rng.normal(scale=noise, size=(32, 100, 7))
numbers[:, 2] = 0.45
for _ in range(10):
    (_, slope), (_, poses) = push(numbers, worlds)
    slope, rest, answer = slope[:, :100, :, 2], record - poses[:, :100], numbers[:, 2].copy()
    precision = np.sum(slope**2, axis=(1, 2)) / noise**2 + prior**-2
    step = np.sum(slope * rest, axis=(1, 2)) / noise**2 / precision
    numbers[:, 2] = np.clip(answer + np.clip(step, -0.1, 0.1), 0.05, 1.0)
fig, ax = plt.subplots(figsize=(4, 3.5))
ax.errorbar(truth, answer, 2 * precision**-0.5, fmt="none", elinewidth=0.8)
ax.scatter(truth, answer, c=np.where(np.std(rest, axis=(1, 2)) < 1.1 * noise, "C0", "C1"))
ax.axline((0.5, 0.5), slope=1, color="grey", linewidth=0.8)
ax.set(xlabel="friction", ylabel="friction by the record", xlim=(0, 1), ylim=(0, 1.1))
error = np.abs(answer - truth)
print(f"median error {np.median(error):.4f}, in {np.sum(error < 2 * precision**-0.5)} bars of 32")

# %% [markdown]
# Most pushes determine their friction precisely, and some hardly depend on it within 2 s. The bars
# are too short where contacts break or close as the friction changes.

# %% [markdown]
# ## Tuning
#
# Derivatives of short windows alone do not tune a law: windows do not contain whether a push fails
# later. `rps tune grad` adds a value function of their last states, which is fitted to whole trials
# with their failures, and after some steps it follows slopes of whole trials along random steps.
# [The race](../sweeps/gradients/README.md) compares it with these slopes alone and with evolution.
# Success in held-out worlds after equal simulated time, by number of tuned parameters and method:
#
# - 2,048, after 100,000 s: derivatives <!-- cell: gradients_race | 2048 | 100,000 s | derivatives | success -->83.9 %<!-- end -->
# - slopes <!-- cell: gradients_race | 2048 | 100,000 s | slopes | success -->70.9 %<!-- end -->
# - evolution <!-- cell: gradients_race | 2048 | 100,000 s | evolution | success -->70.9 %<!-- end -->
# - 64, after 300,000 s: derivatives <!-- cell: gradients_race | 64 | 300,000 s | derivatives | success -->85.4 %<!-- end -->
# - slopes <!-- cell: gradients_race | 64 | 300,000 s | slopes | success -->85.9 %<!-- end -->
# - evolution <!-- cell: gradients_race | 64 | 300,000 s | evolution | success -->83.1 %<!-- end -->
