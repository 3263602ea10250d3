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
# This notebook computes nothing: it reads what `rps table --out notebooks/runs/table` left. Name
# another folder as `run` to read your own.

# %%
import tempfile
from pathlib import Path

from IPython.display import Image, Markdown

from rps_jax import figures, record, score

out = Path(tempfile.mkdtemp())
run = Path("runs/table")
results = record.read_results(run)

# %% [markdown]
# ## Table II

# %%
Markdown(score.markdown(score.table(results)))

# %%
print(score.summary(results))

# %% [markdown]
# ## Maps over the targets: Fig. 5

# %%
Image(figures.min_distance(results, out / "maps.png"))

# %% [markdown]
# ## How long a success takes

# %%
Image(figures.time_to_success(results, "rps", out / "time.png"))

# %% [markdown]
# ## Where the contact sits

# %%
won = results.mean_abs_l.where(results.success == 1).mean("target")
won.to_series().unstack("strategy").round(3)
