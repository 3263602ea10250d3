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
# The box, with a target behind the robot.

# %%
import tempfile
from pathlib import Path

from rps_jax import video

video.choose_gl()  # before MuJoCo is imported

import numpy as np
from IPython.display import Image, Video

from rps_jax import FRICTION, Case, Setting, figures, follow, sweep
from rps_jax.trial import p_world_contact

out = Path(tempfile.mkdtemp())

# %%
case = Case("box", FRICTION["S1"], p_world_target=(-2.0, 0.0))
setting = Setting(engine="fused")
(trace,) = follow([case], setting)
seen, outcome = trace.snapshots, trace.outcome
Image(figures.one_trial(trace, figures.title_of(case), out / "trial.png"))

# %%
realigning = np.asarray(seen.details.realigning)
print(
    f"reached at {outcome.time:.1f} s; contact lost for {outcome.contact_lost_time:.1f} s; "
    f"mean |l| {outcome.mean_abs_l:.3f} m"
)
print(
    f"{np.sum(np.diff(realigning.astype(int)) > 0)} times in the Realignment State, "
    f"{100 * realigning.mean():.0f} % of the time"
)

# %% [markdown]
# ## The same in pictures

# %%
scene = sweep.scene_of(case, setting.physics)
film = {"p_world_target": trace.p_world_target, "size": (480, 270)}
rows = np.linspace(0, len(seen.time) - 1, 6).astype(int)
images = video.images(scene, seen.qpos[rows], **film)
Image(figures.stills(images, [f"{t:.0f} s" for t in seen.time[rows]], out / "stills.png"))

# %%
rows = np.linspace(0, len(seen.time) - 1, 100).astype(int)
contacts = np.asarray(p_world_contact(seen))[rows]
video.render(scene, seen.qpos[rows], out / "push.mp4", fps=10, p_world_contacts=contacts, **film)
Video(out / "push.mp4", embed=True, width=480)
