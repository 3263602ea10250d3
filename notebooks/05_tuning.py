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
# `runs/coarse` and `runs/fine` are the logs of the two runs of CMA-ES that made
# `RPSParams.tuned()` (their commands stand in the README), `runs/compare/wide` compares the
# result with the paper's parameters in 1000 worlds that no tuner has seen.

# %%
import json
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import Image, Markdown

from rps_jax import (
    RPSParams,
    Setting,
    analysis,
    figures,
    gradients,
    paper,
    record,
    score,
    strategies,
    sweep,
    trial,
    tune,
)
from rps_jax.scene import FRICTION
from rps_jax.skin import SmoothSkin

out = Path(tempfile.mkdtemp())

# %% [markdown]
# ## Evolution

# %%
names = tune.SUBSETS["full"]
Image(figures.tuning(tune.read_log(Path("runs/coarse")), names, out / "coarse.png"))

# %%
Image(figures.tuning(tune.read_log(Path("runs/fine")), names, out / "fine.png"))

# %% [markdown]
# ## What it changed

# %%
sets = {"paper": RPSParams.paper(), "tuned": RPSParams.tuned()}
made = json.loads(Path("runs/fine/tuned.json").read_text())
assert made == {name: getattr(sets["tuned"], name) for name in names}
space = tune.Space(names)
places = {label: jax.nn.sigmoid(space.vector(params)) for label, params in sets.items()}
Image(figures.between_bounds(places, names, out / "bounds.png"))

# %%
Image(figures.twist_field(sets, 1.0, out / "twist.png"))

# %% [markdown]
# ## The same worlds, twice

# %%
results = record.read_results(Path("runs/compare/wide"))
Markdown(score.markdown(analysis.differences(results)))

# %%
Image(figures.paired(results, out / "paired.png"))

# %% [markdown]
# ## How good is a gradient?

# %%
names = ("L", "K_h", "K_v", "beta")
space = tune.Space(names)
cases = [
    sweep.Case("box", FRICTION["S1"], target, gap=0.004, skin=SmoothSkin())
    for target in paper.TARGETS
]
setting = Setting(engine="quasistatic")
stage, worlds = sweep.build(cases, setting)
strategy = strategies.smooth_rps()
starts = worlds, trial.start_all(worlds, np.ones(len(cases), bool), strategy=strategy)
horizons = np.array([1.0, 3.0, 10.0])  # [s]
steps = np.round(horizons / setting.physics.control_period).astype(int)


@jax.jit
def estimates(theta, step):
    scores = gradients.window(
        stage,
        space.params,
        lambda seen: seen.details.distance[step],
        physics=setting.physics,
        strategy=strategy,
        steps=int(steps[-1]) + 1,
    )
    key = jax.random.key(0)
    return {
        "reverse": gradients.reverse(scores, theta, starts),
        "differences": gradients.differences(scores, theta, starts, step=0.01),
        "evolution": gradients.evolution(scores, theta, starts, key, sigma=0.15, pairs=4),
    }


theta = space.vector(RPSParams.paper())
found = jax.device_get(jax.lax.map(lambda step: estimates(theta, step), jnp.asarray(steps)))
bars = {name: (one.gradient, one.variance) for name, one in found.items()}
Image(figures.estimates(horizons, bars, names, out / "gradients.png"))
