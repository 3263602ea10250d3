# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # One push
#
# This is the trial of the paper's Fig. 6: the box under the friction set S1, with its target 2 m
# behind the robot. The fused engine steps it, as it does for `rps push`.

# %%
import tempfile
from pathlib import Path

from IPython.display import Video

import rps_jax

out = Path(tempfile.mkdtemp())

# %% [markdown]
# ## What the base did, and why

# %%
setting = rps_jax.Setting("fused")
seen = rps_jax.push("box", target=(-2.0, 0.0), friction="S1", setting=setting, progress=False)
seen.plot()

# %%
outcome, realigning = seen.outcome, seen.data.realigning
entries = int((realigning.diff("time") > 0).sum())
print(
    f"reached at {outcome.time:.1f} s; mean |l| = {outcome.mean_abs_l:.3f} m; "
    f"without contact for {outcome.contact_lost_time:.1f} s after the first touch\n"
    f"Realignment State: {entries} time(s), {100 * float(realigning.mean()):.0f} % of the trial"
)

# %% [markdown]
# The trial has four acts.
#
# 1. *Approach* (yellow). Nothing is felt; the base creeps forward at 1 cm/s until the skin
#    touches.
# 2. *Turning on the edge* (blue, until 43 s). The target lies straight behind, so the base turns
#    right at once, and the contact runs to the left edge of the front within seconds. There the
#    law enters the Realignment State: $a_r$ = 10, and all speed goes sideways, after the contact.
#    One point holds the box, near $l_{cr}$ (dashed), and base and box turn about each other. Since
#    $\sigma$ is nearly zero so far out, the turn is slow: this act takes a third of the trial.
# 3. *Pushing home* (43 to 98 s). The box has come round until its side lies flat on the front (the
#    point becomes a line at 38 s). The contact slides back to 7 cm, below $\beta$; $a_r$ falls to
#    0.4, and the base drives forward at nearly full speed with a little motion to the left.
# 4. *Arriving* (from 98 s). Nearer than $d_{th}$ = 0.5 m Eq. 5 gives no more lateral motion: $a_r$
#    is 0 at once, and the path bends visibly. Speed falls with the distance (Eq. 3), so the last
#    half metre takes 23 s, nearly a fifth of the trial.
#
# Contact is never lost. The angular velocity changes fast around 4 s because $|l|$ is then at the
# edge of the critical region, where $\sigma$ of Eq. 10 is zero on one side and turns the base on
# the other.
#
# ## The push in pictures

# %%
seen.stills()

# %% [markdown]
# In the second picture the base has gone round the corner of the box. In the third it stands
# behind the box, as seen from the target, and from then on it pushes. The film shows the whole
# trial twelve times as fast; the purple trail is that of the contact point.

# %%
film = seen.film(out / "push.mp4", seconds=10.0, fps=6, size=(480, 270))
Video(film, embed=True, width=480)
