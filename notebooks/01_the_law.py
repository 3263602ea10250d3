# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The law, without a world
#
# The Reactive Pushing Strategy is a pure function. Its inputs are the contact point on the skin,
# the odometry of the base and the target. Its output is a twist of the base. This notebook plots
# the function with the paper's parameters, without any simulation.
#
# In all figures $l$ is the contact offset: the position of the contact along the front of the
# base, positive to the left.

# %%
import drawing

from rps_jax import RPSParams
from rps_jax.analysis.figures import paper as figures

paper = RPSParams.paper()

# %% [markdown]
# ## Sideways motion: Eq. 5
#
# A base that pushes only straight ahead loses the object if the contact is off the centre, since
# the contact moves outwards. The adaptive rate $a_r = v_y / v_x$ lets the base follow the
# contact.

# %%
figures.profile(paper)

# %% [markdown]
# The curve has three regimes. Within about 5 cm of the centre $a_r$ is nearly zero, and the base
# moves straight ahead. Around $\beta$ = 12 cm it rises. From about 20 cm it stays at $\eta$ = 10:
# the base moves ten times as fast sideways as forward. The two directions share the speed $v^*$
# (Eqs. 1-2), so $a_r$ = 10 leaves a tenth of it for pushing. In the shaded region Realignment
# replaces Eq. 5.
#
# ## The whole twist
#
# A twist depends on two quantities: the contact offset and the heading error, which is the angle
# between the heading of the base and the direction to the target. Arrows show the linear
# velocity, with forward upwards. Colour shows the angular velocity, blue to the left and red to
# the right. The target is 2 m away. In the upper row the base is outside the Realignment State,
# in the lower row inside.

# %%
sets = {"paper": paper, "tangent as printed": paper._replace(gamma_max=float("inf"))}
drawing.twist_field(sets, 2.0)

# %% [markdown]
# The left column, from top to bottom:
#
# - The arrows depend on $l$ alone, the colour on both. The law has two tasks, to keep the contact
#   and to turn to the target. They share the base without a switch.
# - With the contact at the centre the base turns at its maximum rate from 31 degrees of error on,
#   where $\tan\gamma = \omega_{max} L / v_{max}$ = 0.6. With a large offset it needs about 80
#   degrees, since Eq. 6 turns in proportion to $v_x$, of which a tenth is left.
# - Beyond $l_{cr}$, the dashed lines in the upper row, the base does not turn: it first brings
#   the contact back.
# - Inside the Realignment State, beyond the dashed lines in the lower row, turning returns
#   gradually for errors within about 80 degrees, as the contact approaches the centre: this is
#   $\sigma$ of Eq. 10. Just outside $l_{mr}$ the base turns faster than just inside, since Eq. 9
#   turns in proportion to $v^*$ and not to $v_x$.
#
# The right column uses the paper's tangent as printed: its sign changes beyond 90 degrees. If the
# target is behind the base, the base turns away from it until it faces the opposite direction,
# and stays there. We therefore clip $\gamma$ to $\pm$1.56 rad. Within 90 degrees the two columns
# are equal.
#
# ## Why there are two thresholds
#
# Realignment starts at $|l| > l_{cr}$ and ends at $|l| \le l_{mr}$. The paper does not give
# $l_{mr}$. Here we prescribe a contact that moves out to 28 cm and back, with a ripple of 1.2 cm,
# for three choices of $l_{mr}$.

# %%
sets = {f"$l_{{mr}}$ = {l_mr} m": paper._replace(l_mr=l_mr) for l_mr in (0.05, 0.15, 0.24)}
drawing.hysteresis(sets, 0.012)

# %% [markdown]
# With one threshold (right) the state flickers while the ripple crosses it: it enters Realignment
# five times instead of once. Any gap wider than the ripple prevents this, and the paper's
# parameters leave room for one.
#
# The lower row shows the cost of a wide gap. On the way out all three follow Eq. 5. On the way
# back the base keeps $a_r$ = 10 until $l_{mr}$. There $a_r$ drops: with 5 cm to almost zero, with
# 15 cm, our choice, only from 10 to 8.6. So 15 cm prevents the flicker, and the transition stays
# nearly smooth.
