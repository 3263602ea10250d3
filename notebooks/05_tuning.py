# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Tuning the law
#
# The paper's parameters were chosen by hand. `RPSParams.tuned()` is the result of three runs of
# CMA-ES: a coarse one, a fine one, and one with robots that have limits. `sweeps/random_worlds`
# has their commands, and `runs/coarse`, `runs/fine` and `runs/robots` their logs.
# `runs/compare/wide` has both sets of parameters in 1000 worlds that no tuner has used. After the
# fine run we set one switch by hand: after a loss, the tuned law uses the last contact
# (`keep_contact`).

# %%
import json
from pathlib import Path

import drawing
import jax
import xarray as xr
from IPython.display import Markdown

import rps_jax
from rps_jax import RPSParams
from rps_jax.analysis import tables
from rps_jax.analysis.figures import sweeps as figures
from rps_jax.laws import Space
from sweeps import render_tables


def read_log(run):
    """Return a tuner's record of each generation."""
    return [json.loads(line) for line in Path("runs", run, "log.jsonl").read_text().splitlines()]


def labelled(log):
    """Return the record as labelled data: variables (generation), and the parameters."""
    names = [name for name in log[0] if name not in ("generation", "params")]
    columns = {name: ("generation", [line[name] for line in log]) for name in names}
    params = [list(line["params"].values()) for line in log]
    columns["params"] = (("generation", "parameter"), params)
    labels = {"generation": range(len(log)), "parameter": list(log[0]["params"])}
    return xr.Dataset(columns, labels)


# %% [markdown]
# ## The coarse search
#
# Each generation evaluates 64 candidates in 512 new worlds. The mean of the candidates'
# distribution is then evaluated in separate worlds for validation. The objective is minimised: a
# success scores its time, and a failure scores 1 plus its remaining distance.

# %%
log = read_log("coarse")
names = tuple(log[0]["params"])
figures.search(labelled(log))

# %% [markdown]
# In seven generations the objective in the validation worlds halves, from 0.31 to 0.15, and
# success rises from 86 to 95.5 %. Then validation gets worse, while the mean score of the
# candidates keeps improving: the candidates converge (the blue band narrows) to a region where
# the bounded map is flat. $K_v$, $a_r^{max}$ and $d_{th}$ reach their upper bounds, 2, 100 and 2.
# Only the validation worlds reveal this. The fine search starts at generation 6.
#
# ## The fine search
#
# The fine search has half the initial spread and a larger penalty for leaving the start. Time has
# a smaller weight in its objective, and its worlds are different, so its values cannot be
# compared with those above.

# %%
figures.search(labelled(read_log("fine")))

# %% [markdown]
# Validation falls from 0.164 to 0.117 at generation 7, whose mean we chose. The values jump from
# one generation to the next, and so do those of the start (dashed), since the worlds change.
# Candidates are therefore compared only within a generation. The seventh generation differs from
# its neighbours by less than these jumps, so another run would end at slightly different
# parameters.
#
# ## With robots
#
# Up to here every base followed its twist immediately. The third search started at the result of
# the second. A third of its worlds had robots with a lag, a bounded acceleration and a bounded
# force (the domain `real`).

# %%
figures.search(labelled(read_log("robots")))

# %% [markdown]
# Validation falls from 0.100 to 0.085 in one generation, and success there rises from 94.3 to
# 95.8 %. The next twenty generations gain nothing: every mean is better than the start, and none
# is clearly better than another. We chose the last one, which validated best by a small margin.
# It steers slightly more and realigns slightly later; both changes are much smaller than those
# from the paper's parameters. The page of `sweeps/random_worlds` has both sets of parameters in
# test worlds of today's version:

# %%
rates = [
    render_tables.cell(f"tuned | `real`, 10,000 | {x} | success") for x in ("rps_tuned", "rps")
]
Markdown("In `real`, the tuned law succeeds in {}, the paper's in {}.".format(*rates))

# %% [markdown]
# ## Changed parameters

# %%
sets = {"paper": RPSParams.paper(), "tuned": RPSParams.tuned()}
tuned = json.loads(Path("runs/robots/tuned.json").read_text())
assert tuned == {name: getattr(sets["tuned"], name) for name in tuned}
space = Space(names)
fractions = {label: jax.nn.sigmoid(space.vector(params)) for label, params in sets.items()}
drawing.between_bounds(fractions, names)

# %% [markdown]
# $K_v$, $a_r^{max}$, $K_h$ and $l_{cr}$ changed most; $\beta$ and $\gamma_{max}$ changed little.
# The effect is clearer in the twist (compare `01_the_law`), here 1 m from the target:

# %%
drawing.twist_field(sets, 1.0)

# %% [markdown]
# The tuned law rarely uses Eq. 5, which acts only beyond $d_{th}$ = 1.53 m. Nearer to the target
# it has two modes. It pushes straight ahead and turns at its maximum rate, or, beyond $l_{cr}$ =
# 18 cm, it moves sideways without pushing until the contact is back at 14 cm. The paper's law
# mixes the two, and keeps the contact where they balance.
#
# ## Both laws in the same worlds

# %%
results = rps_jax.load("runs/compare/wide")
Markdown(tables.markdown(tables.difference_table(results)))

# %%
drawing.paired(results)

# %% [markdown]
# The tuned law succeeds in 71 worlds where the paper's parameters fail, and fails in 6 where they
# succeed; this difference is significant. It is not slower, either. Most worlds are just below
# the diagonal: half of them end at least 15 % sooner. In a second group of worlds the paper's
# parameters need 150 s and more; in most of these the tuned law needs less than half of that. In
# the worlds that it alone solves it is nearly as fast as in the others. A few worlds became slower
# (above the diagonal).
# `04_robustness` shows which objects gained.
#
# ## Gradients
#
# Evolution needs no derivatives. `10_gradients` and
# [the race of the tuners](../sweeps/gradients/README.md) show when derivatives help.
