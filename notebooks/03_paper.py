# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # The paper's trials, from a run folder
#
# This notebook computes nothing: it reads what `rps table --out runs/table` left. Set `RPS_RUN` to
# read another folder.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rps_jax import record, score

run = Path(os.environ.get("RPS_RUN", "runs/table"))
results = record.read_results(run)
print(score.markdown(score.table(results)))
print(score.summary(results))

# %% [markdown]
# How long does a success take? The base drives at 0.05 m/s at most, so distance alone costs 20 s a
# metre; a target behind the robot costs a turn on top.

# %%
figure, ax = plt.subplots(layout="constrained")
won = results.where(results.success == 1)
distance = np.hypot(results.target_x, results.target_y)
for name in results.object.values:
    part = won.sel(object=name, strategy="rps").time.mean("friction")
    ax.plot(distance, part, "o", label=str(name))
ax.set(xlabel="distance of the target from the start [m]", ylabel="time to success [s]")
ax.legend()

# %% [markdown]
# Where does the contact sit on the base while it pushes? Fig. 7 of the paper sums it up as D, the
# mean of |l|.

# %%
print(results.mean_abs_l.mean("target").to_series().unstack("strategy").round(3))
