# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Failures in random worlds
#
# RPS solves the paper's grid (`03_paper`). This notebook shows where it fails. Worlds of the
# domain `wide` differ in mass, size, shape, friction, centre of mass, start and target, and in
# the errors of skin, odometry and drive. The paper's parameters and `RPSParams.tuned()` run in
# the same worlds.
#
# The sweep of 1000 worlds takes less than a minute on two cores. With a folder as `out`, as
# `runs/wide`, it is stored, and `rps_jax.load("runs/wide")` reads it.

# %%
import drawing
import numpy as np
import pandas as pd
from IPython.display import Markdown

import rps_jax
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures import sweeps as figures

laws = {"paper": "rps", "tuned": "rps_tuned"}
results = rps_jax.sweep(laws, "wide", worlds=1000, progress=False)
max_lost = rps_jax.Rules().max_lost  # [s] without contact; more ends a trial

# %% [markdown]
# ## Success, distance and time
#
# Intervals are Wilson 95 % intervals. The sentences below tables and figures are computed from the
# same data.

# %%
Markdown(tables.markdown(tables.success_table(results, max_lost)))

# %%
laws = {str(law): results.sel(law=law) for law in results.law.values}
groups = {drawing.words(name): mask for name, mask in statistics.worlds_by_object(results).items()}
groups["all worlds"] = np.ones(results.sizes["world"], bool)
failed = {law: part.success.values == 0 for law, part in laws.items()}
lines = [f"{law} fails in {mask.sum()} of {mask.size} worlds" for law, mask in failed.items()]
intervals = {
    name: [statistics.wilson(int((~mask[rows]).sum()), rows.sum()) for mask in failed.values()]
    for name, rows in groups.items()
}
disjoint = [
    name for name, x in intervals.items() if max(low for low, _ in x) > min(high for _, high in x)
]
Markdown(
    f"{'; '.join(lines)}. The intervals of the laws are disjoint for {drawing.listed(disjoint)}, "
    f"and overlap for {drawing.listed(groups.keys() - disjoint)}. No tuner has used prisms."
)

# %% [markdown]
# ## Failure modes

# %%
drawing.failures(results, max_lost)

# %%
lines = []
for law, part in laws.items():
    modes, distance = statistics.failure_modes(part, max_lost), statistics.distance_left(part)
    for i, mode in enumerate(statistics.FAILURES):
        distance_cm = 100 * distance[modes == i]
        if distance_cm.size:
            lines.append(
                f"- {law}, {mode}: {distance_cm.size} worlds, at a median of "
                f"{np.median(distance_cm):.0f} cm from the target; {(distance_cm < 30).sum()} "
                f"within 30 cm, {(distance_cm > 100).sum()} beyond 1 m"
            )
Markdown("\n".join(lines))

# %% [markdown]
# The distance separates the failure modes. In a *timeout* near the target the base circles around
# the target and does not arrive; in a *lost contact* far from it the object was left behind. After
# a loss, the tuned parameters move to the last contact.
#
# ## Influence of drawn quantities
#
# Success over the most influential drawn quantities, in eight bins with equal numbers of worlds. A
# quantity has a panel if its curve differs from a constant; the lines below the panels name the
# others.

# %%
figures.success_curves(results)

# %%
influences = statistics.influences(results)
clear = [drawing.quantity(x.name) for x in influences if x.q < 0.05]
Markdown(
    f"Of {len(influences)} drawn quantities, {len(clear)} have an influence (q < 0.05) in these "
    f"{results.sizes['world']} worlds: {drawing.listed(clear)}."
)

# %% [markdown]
# One dip in many curves may be chance. Each curve is therefore tested, with a correction for the
# number of tests: the worlds show an influence if q is below 0.05.

# %%
pd.DataFrame(statistics.influences(results.sel(law=["paper"]))).head(8)

# %%
pd.DataFrame(statistics.influences(results.sel(law=["tuned"]))).head(3)

# %%
lines = []
for law, part in laws.items():
    clear = [x.name for x in statistics.influences(results.sel(law=[law])) if x.q < 0.05]
    for name in clear:
        binned = statistics.bins(results[name].values, part.success.values > 0)
        rates, unit = 100 * binned.successes / binned.trials, results[name].attrs["units"]
        worst, best = (
            f"{rates[i]:.0f} % at about {binned.middle[i]:.3g} {unit}".removesuffix(" 1")
            for i in (rates.argmin(), rates.argmax())
        )
        lines.append(f"- {law}, {drawing.quantity(name)}: success from {worst} to {best}")
    lines += [] if clear else [f"- {law}: no quantity"]
Markdown("\n".join(["Influences (q < 0.05), with the worst and the best bin:", "", *lines]))

# %% [markdown]
# Zero corners mean a cylinder. The half width of the base is 29 cm. A run of 240,000 worlds
# (`sweeps/random_worlds`) finds more influences, such as the centre of mass, dead taxels and
# friction at the robot.
#
# ## The hardest worlds
#
# The hardest worlds are those in which most laws fail, sorted by the remaining distance.

# %%
Markdown(tables.markdown(tables.worlds_table(results, "runs/wide", statistics.hardest(results))))

# %% [markdown]
# The command in the last column replays a world of a stored sweep, plots it as in `02_one_push` and
# films it.

# %%
hardest = results.isel(world=statistics.hardest(results))
all_fail = (hardest.success == 0).all("law").values
single = hardest.isel(world=~all_fail)
behind = np.abs(np.degrees(single.bearing.values)) > 90
arrivals = single.time.where(single.success == 1)
Markdown(
    f"All laws fail in {all_fail.sum()} of these {all_fail.size} worlds. In the others one law "
    f"arrives, in {float(arrivals.min()):.0f} to {float(arrivals.max()):.0f} s; the target is "
    f"behind the robot (beyond 90 degrees) in {behind.sum()} of {behind.size}."
)
