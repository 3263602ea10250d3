# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A custom law, from a file to the ladder
#
# A law maps what the base senses to a twist, in every control step. This tutorial writes one,
# watches it push, measures it in random worlds, and compares it with the laws of the package. It
# needs only the package (`pip install` of a wheel), and a folder in which it may write.
#
# ## The file
#
# A class has the parameters. `step` gets them, the law's state (here none) and the observation. It
# returns the next state, a `Twist` in the robot frame, and details for plots. The last line
# registers the law. `l` is the contact offset: the position of the contact along the front of the
# base, positive to the left.

# %%
from pathlib import Path

LAW = '''
"""Push ahead, lean towards an off-centre contact, and turn towards the target."""

from typing import NamedTuple

import jax.numpy as jnp

import rps_jax
from rps_jax import Details, Law, Twist


class LeanParams(NamedTuple):
    v: float = 0.05  # [m/s] speed
    lean: float = 4.0  # [rad/m] direction of motion over contact offset
    turn: float = 5.0  # [rad/m] turning rate over forward speed and heading error
    d_success: float = 0.05  # [m] distance at which the target is reached


def step(params, state, obs):
    """Return the next state, the twist of this control step, and details for plots."""
    details = Details.from_obs(obs)
    direction = jnp.clip(params.lean * details.l, -1.4, 1.4)
    v = jnp.where(obs.in_contact, params.v, 0.2 * params.v)
    v_x, v_y = v * jnp.cos(direction), v * jnp.sin(direction)
    dx, dy = obs.p_world_target - obs.p_world_robot
    x = jnp.cos(obs.yaw) * dx + jnp.sin(obs.yaw) * dy - obs.p_robot_contact[0]
    y = jnp.cos(obs.yaw) * dy - jnp.sin(obs.yaw) * dx - obs.p_robot_contact[1]
    omega = jnp.clip(params.turn * v_x * jnp.arctan2(y, x), -0.15, 0.15)
    return state, Twist(v_x, v_y, jnp.where(obs.in_contact, omega, 0.0)), details


rps_jax.register_law("lean", Law(lambda params: (), step), LeanParams())
'''
_ = Path("my_law.py").write_text(LAW.lstrip())

# %% [markdown]
# ## One push
#
# Every function and command that takes a law takes the file. A mistake in it, such as a twist of
# another shape, is reported in one sentence before anything compiles.

# %%
import rps_jax

rps_jax.use_cache()  # store compiled programs for the next process
trace = rps_jax.push("box", target=(-1.0, 1.5), law="my_law.py", progress=False)
print(trace.summary)
trace.plot()

# %% [markdown]
# ## A score in random worlds
#
# `score` runs the law in test worlds, with the paper's law and RPS+. Here these are 60 boxes of the
# domain `wide`; without `domain` and `worlds` they are 1000 objects of several shapes. The same on
# the command line: `rps score my_law.py`.

# %%
boxes = "wide,objects=random_box"
score = rps_jax.score("my_law.py", domain=boxes, worlds=60, progress=False)
means = score[["success", "contact_lost_time"]].mean("world").to_dataframe().round(2)
lost = means.contact_lost_time
print(
    f"Mean time without contact: {lost['lean']:.0f} s with this law, {lost['rps']:.0f} s with RPS."
)
print(means)

# %% [markdown]
# A law that loses its contact cannot push. Should it lean more, or turn less? A parameter changes
# after the name of the file, without an edit.
#
# ## The ladder
#
# `ladder` compares any laws in the same worlds. Intervals are Wilson 95 % intervals.

# %%
import pandas as pd
from scipy.stats import binomtest

leans = [f"my_law.py:LeanParams,lean={lean}" for lean in (4, 6, 8)]
ladder = rps_jax.ladder(["rps", *leans], domain=boxes, worlds=60, progress=False)
successes, trials = ladder.success.sum("world").to_series(), ladder.sizes["world"]
intervals = {
    law: binomtest(n, trials).proportion_ci(method="wilson") for law, n in successes.items()
}
table = pd.DataFrame(intervals, ["low", "high"]).T.round(2)
table.insert(0, "successes", successes)
print(f"Most successes of this law: {successes.drop('rps').idxmax()}.")
print(table)

# %% [markdown]
# Laws whose intervals overlap are not ordered by 60 worlds. Use more worlds, or count the worlds in
# which only one of two laws succeeds ([08](08_analysis.ipynb)).
#
# ## Next steps
#
# - `Law(..., bounds={"lean": Bound(2.0, 20.0)})` declares the range of a parameter, and
#   `rps tune es --law my_law.py:LeanParams` searches in it (`rps_jax.laws` has `Bound`).
# - `senses="taxels"` gives the law the signal of each taxel.
# - `rps gallery RUN` and `rps replay RUN WORLD` show worlds in which a law fails, and
#   `rps export c --law my_law.py` writes the law as C.
