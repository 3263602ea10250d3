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
# The paper simulates 432 trials: three objects, two sets of friction, 24 targets and three laws.
# This notebook only reads the results of `rps table` in `runs/table` (MJX, two processors). Set
# `run` to read another folder.

# %%
import drawing
from IPython.display import Markdown

import rps_jax
from rps_jax.analysis import tables
from rps_jax.analysis.figures import paper as figures
from sweeps import render_tables

run = "runs/table"
results = rps_jax.load(run)

# %% [markdown]
# ## Table II
#
# Successes of 24 trials, with Wilson 95 % intervals in percent; the paper's counts are below
# ours.

# %%
Markdown(tables.markdown(tables.table_ii(results)))

# %% [markdown]
# Here RPS reaches every target. The paper's 127 of 144 is outside our interval, and so are three
# of its six cells: the cylinder with both sets of friction, and the nonuniform box with S1. The
# totals of the baselines agree (23 and 8 in the paper), and NPS agrees in every cell. Without
# reaction the task is therefore as hard here as in the paper, and only the failures of RPS
# differ. `sweeps/ambiguities` tests whether the paper's simulator caused them.

# %%
print(tables.summary(results))

# %% [markdown]
# ## Maps over the targets: Fig. 5
#
# The robot starts at the centre, faces right, and has the object in front of it. The colour shows
# the smallest distance between contact and target, and the number counts successes.

# %%
figures.min_distance(results)

# %% [markdown]
# - NPS reaches targets ahead: all but two of its successes are within 27 degrees of the initial
#   heading. It misses targets at the side (x = 0) by nearly their distance, since it loses the
#   object before the object has turned.
# - APS fails near its targets: it comes within half a metre almost everywhere, but rarely within
#   the 5 cm of a success.
# - The maps of RPS have one colour. On this grid only the time can improve.
#
# ## Time to success

# %%
drawing.time_to_success(results, "rps")

# %% [markdown]
# Straight ahead (dark), a metre takes 20 s: the base moves at 0.05 m/s all the way. A target
# straight behind (yellow) takes 75 to 80 s more than one ahead, at 1 m and at 2 m: the time to
# turn the object without losing it. In between, the angle matters more than the distance, and
# object and friction matter little.
#
# One trial is an outlier: the nonuniform box with S1 and its target 2 m to the right takes 256 s,
# while the mirrored target, 2 m to the left, takes 91 s. The load of the box is on the left, and
# the trial ends 44 s before the horizon. The 144 of 144 therefore have at least one near miss.
#
# ## Contact offset
#
# The paper's measure is D, the mean of $|l|$ while pushing [m], averaged here over the successes.

# %%
distance = results.mean_abs_l.where(results.success == 1).mean("target")
distance.to_series().unstack("law").round(3)

# %% [markdown]
# With RPS the contact moves to about 10 cm for a box and 8 cm for a cylinder. There Eq. 5 rises,
# as `01_the_law` shows: the law keeps the contact where the base starts to follow it, and not at
# the centre. The few successes of the baselines have easy targets, so their D is not informative.
#
# ## What the paper leaves open, and what we chose
#
# Each choice is a parameter, so one option selects another interpretation. `rps
# sweeps/ambiguities` runs the interpretations one by one; its page has the table.

# %%
rows = render_tables.load("readings")["rows"]
count = sum(total == "144 of 144" for *_, total, _, _, _ in rows)
Markdown(f"{count} of {len(rows)} interpretations give 144 of 144.")

# %% [markdown]
# The law:
#
# - $\tan\gamma$ beyond $\pm\pi/2$ changes sign and turns the robot away: $\gamma$ is clipped to
#   $\pm 1.56$ rad, and `inf` gives the tangent as printed (`gamma_max`).
# - The end of the middle region is 0.15 m (`l_mr`).
# - The adaptive rate while realigning is 10, the value of $\eta$ (`a_r_max`).
# - The order of saturation: $(v_x, v_y)$ is scaled as a vector, and $\omega$ follows from the
#   scaled velocities and is then clipped (`saturate_first`, `clip_each`).
# - sgn(0) is 0 (`sgn_0`).
# - A heading error of exactly $\pi$ is wrapped to $-\pi$, so the robot turns right
#   (`planar.wrap`).
# - Algorithm 1 prints $v_x$ twice; we read $(v_x, v_y, \omega)$ (`rps_jax.step`).
# - After a loss of contact the base moves straight ahead at 0.01 m/s, as before the first
#   contact, and $l_{th}$ is unchanged (`v_lost`, `keep_contact`).
#
# The rules of a trial:
#
# - The approach does not count as lost contact; only the time after the first contact does
#   (`Rules`).
# - The 150 s without contact are a total, and need not be consecutive (`Rules.max_lost`).
# - $D$ is the mean over the control steps in contact (`Outcome.mean_abs_l`).
# - A trial fails when its object tilts by 45 degrees (`Rules.max_tilt`).
# - The control period is 20 ms (`--physics default,control_period=0.02`).
#
# Base and skin:
#
# - The base is 0.725 m long, with 12 taxels in front, 15 on the left and 15 on the right, of 48.3
#   mm each (`Robot.half_length`, `Robot.boards`).
# - The simulated contact sensor has a tolerance of 6 mm (`--skin ideal,tolerance=0.006`), and a
#   contact up to the length of one taxel is a point (`point_length`).
# - The capacitive skin has 10 mm of foam, a filter of 50 ms and a threshold of +25 % capacitance
#   (`CapacitiveSkin`).
#
# The worlds:
#
# - The initial gap to the object is 2 cm (`--gap`).
# - The corner "rear left" of the nonuniform box: left is +y, and rear faces the robot (`--rear`).
# - The "8 target points at 2.1 m intervals" of the hardware lie on a circle of radius 2.1 m
#   (`--layout`).
# - The friction of the hardware was not measured: all pairs of ground 0.2, 0.35, 0.5, 0.65 and
#   robot 0.3, 0.5, 0.7 are run.
# - The hardware box is pushed on its side of 26 cm (`mjcf/hardware_box.xml`).
#
# APS:
#
# - It is designed for the object's centre. To bring the contact point to the target, it aims one
#   object radius beyond (`aim_beyond`, as in `--law aps,aim_beyond=0`).
# - The radius of a rectangular robot is half its length (`r_robot`).
# - Its smallest speed is 0.01 m/s, and motion of the object below 1 mm is ignored (`v_min`,
#   `min_motion`).
#
# Physics (`Physics`; `mjcf/README.md` gives the reasons):
#
# - The solver is Newton's, with 8 iterations of 10 line-search steps and a tolerance of 1e-13.
#   The cone is elliptic, impratio is 10, and the time step is 10 ms.
# - Contacts at the base are as soft as MuJoCo's default. The ground is softer and less damped,
#   since pushed objects hop on MuJoCo's default ground (`base_solref`, `ground_solref`,
#   `ground_impedance`).
