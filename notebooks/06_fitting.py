# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From a log to a domain to a sweep
#
# A robot's log of one push says something of its floor, its box and its drive. Here a simulated
# push stands for the log: a world of `wide`, whose truth is known. A table `FILE.csv` or a bag
# takes its place for a robot of your own (`rps fit --help` lists the columns).

# %%
import tempfile

import rps_jax

setting = rps_jax.Setting("fused", rules=rps_jax.Rules(horizon=60.0))
domain = "wide,objects=random_box,distance=1.5:2.5"
run = tempfile.mkdtemp()
truth = rps_jax.sweep("rps", domain, worlds=4, setting=setting, out=run, progress=False)
log = rps_jax.replay(run, 3, progress=False)
log.plot()

# %% [markdown]
# ## What the log tells
#
# `fit` pushes in 384 worlds of the domain and learns to tell a world's quantities from the
# statistics of its log. Blue is the posterior, grey the 90 % of the prior; a grey histogram is a
# quantity that the log does not tell. More worlds tell more (6144 by default).

# %%
fitted = rps_jax.fit(log, domain, worlds=384, window=15.0, setting=setting, progress=False)
fitted.plot()

# %%
told = fitted.data.where(fitted.data.undetermined == 0, drop=True)
for name in told["quantity"].values:
    one, true = told.sel(quantity=name), truth.coords.get(name)
    known = "" if true is None else f", in truth {float(true[3]):.3g}"
    print(f"{name}: {float(one.low):.3g} to {float(one.high):.3g} {one.unit.item()}{known}")

# %% [markdown]
# ## A sweep in the fitted domain
#
# The fitted domain has these intervals as its ranges, and those of `wide` for all else. In the
# shell it is a file: `rps sweep --domain runs/fit/fitted.json`.

# %%
before, after = (
    rps_jax.sweep("rps", d, worlds=16, setting=setting, progress=False)
    for d in (domain, fitted.domain)
)
print({name: float(found.success.mean()) for name, found in (("wide", before), ("fitted", after))})
