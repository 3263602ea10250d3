# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Analysis of a sweep with xarray
#
# A sweep runs laws in random worlds. Its result is a labelled dataset: outcomes over `law` and
# `world`, and the drawn quantities as coordinates of `world`. This tutorial asks which quantities
# cause failures: by a heat map, and by a logistic regression. It needs only the package.

# %%
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize
from xarray.groupers import BinGrouper

import rps_jax

rps_jax.use_cache()  # store compiled programs for the next process
laws, boxes = ["rps", "rps_tuned"], "wide,objects=random_box"
rps_jax.sweep(laws, boxes, worlds=400, out="runs/boxes", progress=False)
results = rps_jax.load("runs/boxes")
print(dict(results.sizes))
print("outcomes:", *results.data_vars)
print("coordinates:", *results.coords)

# %% [markdown]
# ## Selection and means
#
# `sel` selects by label, `where` by a condition, and `mean` and `sum` reduce a named dimension.

# %%
success = results.success.astype(float)
print(success.mean("world").to_series())
heavy = results.where(results.mass > 40, drop=True)
print(f"{heavy.sizes['world']} worlds have more than 40 kg:")
print(heavy.success.mean("world").to_series())

# %% [markdown]
# Both laws ran in the same worlds, so they are compared world by world:

# %%
paper, tuned = (results.success.sel(law=law) == 1 for law in laws)
print(f"only rps: {int((paper & ~tuned).sum())}, only rps_tuned: {int((tuned & ~paper).sum())}")

# %% [markdown]
# ## A heat map
#
# Success of the paper's parameters over the half width of the box and the distance of the centre of
# mass from its middle. Each cell has the number of its worlds.

# %%
edges = {
    name: np.linspace(float(results[name].min()), float(results[name].max()) + 1e-6, 6)
    for name in ("size", "com_offset")
}
cells = success.sel(law="rps").groupby(**{name: BinGrouper(e) for name, e in edges.items()})
rate, count = cells.mean(), cells.count()
fig, ax = plt.subplots(figsize=(6, 4))
image = ax.pcolormesh(*edges.values(), rate.values.T, vmin=0, vmax=1, cmap="RdYlGn")
for (i, j), worlds in np.ndenumerate(count.values):
    x, y = (e[k : k + 2].mean() for e, k in zip(edges.values(), (i, j), strict=True))
    ax.text(x, y, int(np.nan_to_num(worlds)), ha="center", va="center", fontsize=8)
labels = [f"{results[n].attrs['long_name']} [{results[n].attrs['units']}]" for n in edges]
ax.set(xlabel=labels[0], ylabel=labels[1])
_ = fig.colorbar(image, label="share of successes")

# %% [markdown]
# ## A logistic regression
#
# Which quantities change the odds of a success? The regression has all quantities that differ
# between worlds, each divided by its standard deviation. A small penalty keeps it finite.

# %%
quantities = {
    name: x
    for name, x in results.coords.items()
    if x.dims == ("world",) and np.issubdtype(x.dtype, np.floating) and float(x.std()) > 0
}
X = np.stack([(x - x.mean()) / x.std() for x in quantities.values()], axis=1)
X = np.column_stack([np.ones(len(X)), X])
y = success.sel(law="rps").values


def loss(b):
    """Return the negative log-likelihood with a penalty, and its gradient."""
    z = X @ b
    penalty, slope = 0.5 * (b[1:] ** 2).sum(), np.concatenate([[0.0], b[1:]])
    p = 1 / (1 + np.exp(-z))
    return np.logaddexp(0, z).sum() - y @ z + penalty, X.T @ (p - y) + slope


b = scipy.optimize.minimize(loss, np.zeros(X.shape[1]), jac=True).x
p = 1 / (1 + np.exp(-X @ b))
curvature = (X.T * (p * (1 - p))) @ X + np.diag([0.0, *np.ones(len(b) - 1)])
error = np.sqrt(np.diag(np.linalg.inv(curvature)))
order = np.argsort(-np.abs(b[1:] / error[1:]))[:8]
names = [list(quantities)[i] for i in order]
fig, ax = plt.subplots(figsize=(6, 4))
ax.errorbar(b[1 + order], names, xerr=1.96 * error[1 + order], fmt="o", capsize=3)
ax.axvline(0, color="grey", linewidth=0.8)
ax.invert_yaxis()
ax.set(xlabel="change of the log odds of a success, per standard deviation")
fig.tight_layout()

# %%
clear = [name for i, name in zip(order, names, strict=True) if abs(b[1 + i]) > 3.2 * error[1 + i]]
print(f"{len(quantities)} quantities were tested. Clear influence:", ", ".join(clear) or "none")

# %% [markdown]
# The bars are 95 % intervals of one coefficient. With this many quantities one of them may exclude
# zero by chance, so the last line asks for 3.2 standard errors (Bonferroni's correction for about
# 40 tests). More worlds show smaller influences; `rps sensitivity` attributes the variance, and
# `rps sweep` reports a test of each quantity.
#
# ## A table for other tools
#
# Poses have a third dimension, so the table leaves them out.

# %%
table = results.drop_dims("pose").to_dataframe().reset_index()
table[["law", "world", "success", "time", "mass", "size", "com_offset"]].head()

# %% [markdown]
# `table.to_csv("results.csv")` writes it. `results.nc` is a NetCDF file that MATLAB, R and Julia
# read, with the units.
