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
# The Reactive Pushing Strategy is a pure function. It observes where the skin is touched, where the
# base believes itself to be and where the target is, and it returns a twist of the base. Nothing
# is pushed here; the function itself is drawn, with the paper's parameters.
#
# In all figures $l$ is the place of the contact along the front of the base, positive to the left.

# %%
import drawing

from rps_jax import RPSParams
from rps_jax.analysis import figures

paper = RPSParams.paper()

# %% [markdown]
# ## How far to go sideways: Eq. 5
#
# A base that only pushes straight loses an object that it does not push through the middle, since
# the contact wanders outwards. The adaptive rate $a_r = v_y / v_x$ lets the base follow the
# contact.

# %%
figures.profile(paper)

# %% [markdown]
# The curve has three regimes. Within some 5 cm of the middle $a_r$ is nearly zero, so the base
# drives straight ahead. Around $\beta$ = 12 cm it rises, and from about 20 cm on it stands at
# $\eta$ = 10: the base moves ten times as fast sideways as forward. The speed $v^*$ is shared out
# between the two (Eqs. 1-2), so $a_r$ = 10 leaves a tenth of it for pushing. In the shaded region
# Realignment acts instead of Eq. 5.
#
# ## The whole twist
#
# A twist depends on two things: the place of the contact, and the heading error, which says how
# far the target lies off the direction in which the base looks. Arrows show the linear velocity,
# with forward upwards; colour shows the angular velocity, blue to the left and red to the right.
# The target is 2 m away. In the upper row the base is outside the Realignment State, in the lower
# row within it.

# %%
sets = {"paper": paper, "tangent as printed": paper._replace(gamma_max=float("inf"))}
drawing.twist_field(sets, 2.0)

# %% [markdown]
# The left column, from top to bottom:
#
# - The arrows depend on $l$ alone, the colour on both. The two tasks of the law, to keep the
#   contact and to turn to the target, share the base without a switch between them.
# - With the contact in the middle the base turns as fast as it may from a few degrees of error
#   on: the pale band is narrow. With the contact far out it needs some 50 degrees, since Eq. 6
#   turns in proportion to $v_x$, of which a tenth is left.
# - Beyond $l_{cr}$, the dashed lines above, the base does not turn at all: it first fetches the
#   contact back.
# - Within the Realignment State, beyond the dashed lines below, turning comes back gradually, for
#   errors within some 80 degrees, as the contact approaches the middle: this is $\sigma$ of Eq.
#   10. Just outside $l_{mr}$ the base turns faster than just inside, since Eq. 9 turns in
#   proportion to $v^*$ and not to $v_x$.
#
# The right column takes the paper's tangent literally: beyond 90 degrees its sign changes. A base
# whose target lies behind it turns away from the target until it looks exactly the wrong way, and
# stays there. This is why $\gamma$ is held within $\pm$1.56 rad here; within 90 degrees the two
# columns are the same.
#
# ## Why there are two thresholds
#
# Realignment begins at $|l| > l_{cr}$ and ends at $|l| \le l_{mr}$. The paper does not give
# $l_{mr}$. Here a contact is led out to 28 cm and back by hand, with a ripple of 1.2 cm on its
# way, for three choices of $l_{mr}$.

# %%
sets = {f"$l_{{mr}}$ = {l_mr} m": paper._replace(l_mr=l_mr) for l_mr in (0.05, 0.15, 0.24)}
drawing.hysteresis(sets, 0.012)

# %% [markdown]
# With one threshold (right) the state flickers while the ripple crosses it: five entries where
# one was meant. Any gap wider than the ripple removes that, and the paper's parameters leave room
# for one.
#
# The lower row shows what a wide gap costs. On the way out all three follow Eq. 5. On the way back
# the base keeps $a_r$ = 10 until $l_{mr}$. There $a_r$ falls at once: with 5 cm to almost nothing,
# with 15 cm, our choice, only from 10 to 8.6. So 15 cm removes the flicker and leaves the
# transition nearly smooth.
