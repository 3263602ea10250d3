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
# The log of one push has information about the floor, the object and the drive of the robot. Here
# the log is simulated, in a world of `wide` whose quantities are known. For your robot, use a
# table `FILE.csv` or a bag (`rps fit --help` lists the columns).

# %%
import tempfile

import rps_jax
from rps_jax.analysis import statistics

setting = rps_jax.Setting("fused", rules=rps_jax.Rules(horizon=60.0))
domain = "wide,objects=random_box,distance=1.5:2.5"
run = tempfile.mkdtemp()
truth = rps_jax.sweep("rps", domain, worlds=4, setting=setting, out=run, progress=False)
log = rps_jax.replay(run, 3, progress=False)
log.plot()

# %% [markdown]
# ## Quantities that the log determines
#
# `fit` simulates 1536 worlds of the domain and learns to estimate a world's quantities from the
# statistics of its log. Blue is the posterior, grey the central 90 % of the prior; a grey
# histogram is a quantity that the log does not determine. More worlds determine more (default
# 6144).

# %%
fitted = rps_jax.fit(log, domain, worlds=1536, window=15.0, setting=setting, progress=False)
fitted.plot()

# %%
determined = fitted.data.where(fitted.data.undetermined == 0, drop=True)
for name in determined["quantity"].values:
    row, true = determined.sel(quantity=name), truth.coords.get(name)
    value = "" if true is None else f", in truth {float(true[3]):.3g}"
    print(f"{name}: {float(row.low):.3g} to {float(row.high):.3g} {row.unit.item()}{value}")

# %% [markdown]
# ## A sweep in the fitted domain
#
# The fitted domain has these intervals as its ranges, and those of `wide` for other quantities.
# The command `rps fit` writes it to a file: `rps sweep --domain runs/fit/fitted.json`.

# %%
whole = rps_jax.Setting("fused")  # trials of 300 s
for name, ranges in (("wide", domain), ("fitted", fitted.domain)):
    success = rps_jax.sweep("rps", ranges, worlds=256, setting=whole, progress=False).success
    low, high = statistics.wilson(int(success.sum()), success.size)
    print(f"{name}: RPS succeeds in {float(success.mean()):.1%} [{low:.1%}, {high:.1%}]")

# %% [markdown]
# Brackets are Wilson 95 % intervals. The first rate is of all these boxes, the second of those that
# agree with the log: it is the forecast for this robot, object and floor. If the intervals overlap,
# one log does not tell whether the law suits them. Fit several logs, or log the force, which
# determines the friction force of the ground. Then tune the law in the fitted domain:
# `rps tune es --domain runs/fit/fitted.json`.
