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
# This is the trial of the paper's Fig. 6: the box with the friction set S1, and a target 2 m
# behind the robot. The fused engine simulates it, as in `rps push`.

# %%
import tempfile
from pathlib import Path

from IPython.display import Video

import rps_jax

out = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The motion of the base, and its reasons

# %%
setting = rps_jax.Setting("fused")
trace = rps_jax.push("box", target=(-2.0, 0.0), friction="S1", setting=setting, progress=False)
trace.plot()

# %%
outcome, realigning = trace.outcome, trace.data.realigning
entries = int((realigning.diff("time") > 0).sum())
print(
    f"reached at {outcome.time:.1f} s; mean |l| = {outcome.mean_abs_l:.3f} m; "
    f"without contact for {outcome.contact_lost_time:.1f} s after the first touch\n"
    f"Realignment State: {entries} time(s), {100 * float(realigning.mean()):.0f} % of the trial"
)

# %% [markdown]
# The trial has four phases.
#
# 1. *Approach* (yellow). Without contact, the base moves forward at 1 cm/s until the skin
#    touches.
# 2. *Turning at the edge* (blue, until 35 s). The target is straight behind, so the base turns
#    right, and within seconds the contact moves to the left edge of the front. There the law
#    enters the Realignment State: $a_r$ = 10, and the speed is almost all sideways, after the
#    contact. The box touches at one point near $l_{cr}$ (dashed), and base and box rotate about
#    each other. Since $\sigma$ is nearly zero at this offset, the rotation is slow: this phase
#    takes a quarter of the trial.
# 3. *Pushing* (35 to 102 s). The box rotates until its side is flat on the front: the point becomes
#    a line at 50 s, and the contact offset jumps and recovers. It decreases to 7 cm, below $\beta$;
#    $a_r$ decreases to 0.5, and the base moves forward at nearly full speed with some motion to the
#    left.
# 4. *Arrival* (from 102 s). Within $d_{th}$ = 0.5 m Eq. 5 gives no lateral motion: $a_r$ drops to
#    0, and the path bends visibly. The speed decreases with the distance (Eq. 3), so the last
#    half metre takes 23 s, nearly a fifth of the trial.
#
# The contact is never lost. The angular velocity changes fast around 4 s, since $|l|$ is then at
# the edge of the critical region, where $\sigma$ of Eq. 10 is zero on one side and turns the base
# on the other.
#
# ## The push in pictures

# %%
trace.stills()

# %% [markdown]
# In the second picture the base has moved around the corner of the box. In the third it is behind
# the box, as seen from the target, and starts to push. The film shows the whole trial twelve
# times as fast. The purple line is the path of the contact point.

# %%
film = trace.film(out / "push.mp4", seconds=10.0, fps=6, size=(480, 270))
Video(film, embed=True, width=480)
