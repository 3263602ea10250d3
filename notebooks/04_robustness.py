# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Random worlds, from a run folder
#
# This notebook computes nothing: it reads what
#
#     rps tune compare --params paper tuned --domain wide --worlds 1000 --out notebooks/runs/compare
#
# left.

# %%
import tempfile
from pathlib import Path

from IPython.display import Image, Markdown

from rps_jax import analysis, figures, record, robustness, score

out = Path(tempfile.mkdtemp())
run = Path("runs/compare/wide")
plan, results = robustness.load_plan(run), record.read_results(run)
max_lost = float(plan.setting.rules.max_lost)

# %% [markdown]
# ## How often, how near, how long

# %%
Markdown(score.markdown(analysis.rates(results, max_lost)))

# %% [markdown]
# ## How it fails

# %%
Image(figures.failures(results, max_lost, out / "failures.png"))

# %% [markdown]
# ## What success depends on

# %%
Image(figures.success_curves(results, out / "success.png"))

# %%
Markdown(score.markdown(analysis.influences(results, "paper")))

# %%
Markdown(score.markdown(analysis.influences(results, "tuned")))

# %% [markdown]
# ## The hardest worlds

# %%
Markdown(score.markdown(analysis.hardest_table(results, str(run))))
