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
# The paper simulates 432 trials: three objects, two sets of friction, 24 targets and three
# laws. This notebook computes nothing; it reads what `rps table` left in `runs/table` (MJX,
# two processors). Name another folder as `run` to read your own.

# %%
import drawing
from IPython.display import Markdown

import rps_jax
from rps_jax.analysis import figures, tables

run = "runs/table"
results = rps_jax.load(run)

# %% [markdown]
# ## Table II
#
# Successes of 24, with Wilson 95 % intervals in percent, and the paper's counts below ours.

# %%
Markdown(tables.markdown(tables.table_ii(results)))

# %% [markdown]
# RPS reaches every target here. The paper's 127 of 144 lies outside our interval, and so do three
# of its six cells: the cylinder under both sets of friction, and the nonuniform box under S1. The
# baselines agree in total, 23 and 8 on both sides, and NPS agrees in every cell too. So the task
# is as hard without reaction here as there, and only the trials that RPS lost there differ.
# `sweeps/ambiguities` asks whether the paper's simulator lost them.

# %%
print(tables.summary(results))

# %% [markdown]
# ## Maps over the targets: Fig. 5
#
# The robot starts in the middle, looking to the right, with the object before it. The colour shows
# the least distance of the contact to the target, and the number counts successes.

# %%
figures.min_distance(results)

# %% [markdown]
# - NPS reaches targets ahead: all but two of its successes lie within 27 degrees of the first
#   course. Targets beside the robot (x = 0) are missed by nearly as much as they lie to the side:
#   it hardly turns the object before it loses it.
# - APS fails near its targets: almost everywhere it comes to within half a metre, and hardly
#   anywhere to the 5 cm that count.
# - The maps of RPS have one colour. On this grid nothing but time is left to be improved.
#
# ## How long a success takes

# %%
drawing.time_to_success(results, "rps")

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
# The paper sums this up as D, the mean of $|l|$ while pushing [m]. It is averaged here over the
# successes.

# %%
distance = results.mean_abs_l.where(results.success == 1).mean("target")
distance.to_series().unstack("law").round(3)

# %% [markdown]
# RPS lets the contact wander to about 10 cm with a box and 8 cm with a cylinder. That is where Eq.
# 5 rises, as `01_the_law` shows: the law does not hold the contact in the middle, but where the
# base begins to follow it. The few successes of the baselines are of easy targets, so their D says
# little.
#
# ## What the paper leaves open, and what we chose
#
# Each choice is a parameter, so that another reading is one option away. `rps sweeps/ambiguities`
# runs the readings one by one: 24 of 27 give 144 of 144 (its page has the table).
#
# The law:
#
# - $\tan\gamma$ beyond $\pm\pi/2$ changes sign and turns the robot away: $\gamma$ is held within
#   $\pm 1.56$ rad, and `inf` gives the tangent as printed (`gamma_max`).
# - The end of the middle region is 0.15 m (`l_mr`).
# - The adaptive rate while realigning is 10, the value of $\eta$ (`a_r_max`).
# - The order of saturation: $\omega$ follows from the unsaturated velocities and is then clipped;
#   $(v_x, v_y)$ is scaled as a vector (`saturate_first`, `clip_each`).
# - sgn(0) is 0 (`sgn_0`).
# - A heading error of exactly $\pi$ is wrapped to $-\pi$, so the robot turns right
#   (`planar.wrap`).
# - Algorithm 1 prints $v_x$ twice; $(v_x, v_y, \omega)$ is meant (`rps_jax.step`).
# - When contact is lost during a push, the base drives straight on at 0.01 m/s, as before the
#   first contact, and $l_{th}$ stays (`v_lost`, `keep_contact`).
#
# The rules of a trial:
#
# - The approach does not count as lost contact; only what follows the first touch does (`Rules`).
# - 150 s without contact are meant in all, not at a stretch (`Rules.max_lost`).
# - $D$ is the mean over the control steps in contact (`Outcome.mean_abs_l`).
# - An object that falls over ends the trial, as failed, once it leans by 45 degrees
#   (`Rules.max_tilt`).
# - The control period is 20 ms (`--physics default,control_period=0.02`).
#
# Base and skin:
#
# - The base is 0.725 m long, with 12 taxels in front, 15 on the left and 15 on the right, of 48.3
#   mm each (`Robot.half_length`, `Robot.boards`).
# - The simulated contact sensor has a tolerance of 6 mm (`--skin ideal,tolerance=0.006`), and what
#   it feels is a point up to the length of one taxel (`point_length`).
# - The capacitive skin has 10 mm of foam, a filter of 50 ms and a threshold of +25 % capacitance
#   (`CapacitiveSkin`).
#
# The worlds:
#
# - The initial gap to the object is 2 cm (`--gap`).
# - The corner "rear left" of the nonuniform box: left is +y, and rear faces the robot (`--rear`).
# - The "8 target points at 2.1 m intervals" of the hardware lie on a circle of radius 2.1 m
#   (`--layout`).
# - The friction of the hardware was not measured: every pair of ground 0.2, 0.35, 0.5, 0.65 and
#   robot 0.3, 0.5, 0.7 is run.
# - The hardware box is pushed on its side of 26 cm (`mjcf/hardware_box.xml`).
#
# APS:
#
# - It brings the contact point to the target: it aims one object radius beyond, since it is built
#   for the centre (`aim_beyond`, as in `--law aps,aim_beyond=0`).
# - The radius of a rectangular robot is half its length (`r_robot`).
# - Its least speed is 0.01 m/s, and an object that moved by less than 1 mm has not moved (`v_min`,
#   `min_motion`).
#
# Physics (`Physics`; `mjcf/README.md` gives the reasons):
#
# - The solver is Newton's with 8 iterations of 10 line-search steps and a tolerance of 1e-13, the
#   cone is elliptic, impratio is 10, and steps last 10 ms.
# - Contacts at the base are as soft as MuJoCo's own; the ground is softer and less damped, since
#   on MuJoCo's own ground pushed objects hop (`base_solref`, `ground_solref`, `ground_impedance`).
