# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The paper's trials, from a run folder
#
# Three objects, two sets of friction, 24 targets and three strategies: the paper's 432 simulated
# trials. This notebook computes nothing; it reads what `rps table` left in `runs/table` (MJX, two
# processors). Name another folder as `run` to read your own.

# %%
import tempfile
from pathlib import Path

from IPython.display import Image, Markdown

from rps_jax.analysis import figures, tables
from rps_jax.record import files

out = Path(tempfile.mkdtemp())
run = Path("runs/table")
results = files.read_results(run)

# %% [markdown]
# ## Table II
#
# Successes of 24, with Wilson 95 % intervals in percent, and the paper's counts below ours.

# %%
Markdown(tables.markdown(tables.table(results)))

# %% [markdown]
# RPS reaches every target here. The paper's 127 of 144 lies outside our interval, and so do three
# of its six cells: the cylinder under both sets of friction, and the nonuniform box under S1. The
# baselines agree in total, 23 and 8 on both sides, and NPS in every cell too. So what differs is
# not how hard the task is without reaction, but what RPS itself lost there: the README asks
# whether the paper's simulator did that.

# %%
print(tables.summary(results))

# %% [markdown]
# ## Maps over the targets: Fig. 5
#
# The robot starts in the middle, looking to the right, with the object before it. Colour is the
# least distance of the contact to the target, the number counts successes.

# %%
Image(figures.min_distance(results, out / "maps.png"))

# %% [markdown]
# - NPS reaches targets ahead: all but two of its successes lie within 27 degrees of the first
#   course. Targets beside the robot (x = 0) are missed by nearly as much as they lie to the side:
#   it hardly turns the object before it loses it.
# - APS fails near: almost everywhere it comes to within half a metre, and hardly anywhere to the
#   5 cm that count.
# - The maps of RPS have one colour. There is nothing left on this grid to be improved but time.
#
# ## How long a success takes

# %%
Image(figures.time_to_success(results, "rps", out / "time.png"))

# %% [markdown]
# Straight ahead (dark), a metre takes 20 s: the base does its 0.05 m/s all the way. A target
# straight behind (yellow) costs 75 to 80 s more than one ahead, whether it is 1 m or 2 m away:
# that is the price of turning an object that may be lost. Between these, the angle counts for
# more than the distance, and object and friction matter little.
#
# One trial stands apart: the nonuniform box under S1 with its target 2 m to the right takes 256
# s, while its mirror image, 2 m to the left, takes 91 s. The box carries its load on the left,
# and the trial ends 44 s before the horizon. So the 144 of 144 have at least one near miss in
# them.
#
# ## Where the contact sits
#
# The paper sums it up as D, the mean of $|l|$ while pushing [m]; here over the successes.

# %%
distance = results.mean_abs_l.where(results.success == 1).mean("target")
distance.to_series().unstack("strategy").round(3)

# %% [markdown]
# RPS lets the contact wander to about 10 cm with a box and 8 cm with a cylinder. That is where
# Eq. 5 rises, as `01_the_law` shows: the law does not hold the contact in the middle, it holds it
# where the base begins to follow. The baselines' few successes are of easy targets, and their D
# says little.
