# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From a map to a success curve
#
# A robot has to push drums through the door between two rooms. How wide must the door be? This
# tutorial needs the package with its extra `bags`, which reads ROS maps. A robot that maps its
# surroundings writes an image and `map.yaml`; here NumPy draws the image. Its cells have 5 cm, and
# white ones are free.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import binomtest
from xarray.groupers import BinGrouper

import rps_jax

rps_jax.use_cache()  # store compiled programs for the next process
cells = np.zeros((100, 190), np.uint8)  # rows from above
cells[10:90, 10:90] = cells[10:90, 94:180] = 254  # two rooms
cells[40:76, 90:94] = 254  # a door of 1.8 m
cells[30:36, 120:126] = 0  # a pillar
Path("room.pgm").write_bytes(b"P5 190 100 255\n" + cells.tobytes())
_ = Path("map.yaml").write_text("image: room.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")

# %% [markdown]
# ## One push
#
# The task `rooms` plans a path that keeps `base_radius` and `object_radius` from all walls, and a
# trial fails at the first touch. Start (x, y, yaw) and goal (x, y) are in the map. The picture
# shows the world, which is the frame of the base at its start.

# %%
task = "rooms,map.yaml,start=1.5:3.5:0,goal=7.5:2,base_radius=0.3,object_radius=0.1"
drum = rps_jax.push("cylinder", task=task, law="rps_tuned", progress=False)
print(drum.summary)
drum.plot()

# %% [markdown]
# ## The curve
#
# A drawn `scale` of the map gives each world a door of another width. Three laws push equal random
# drums. Intervals contain the true rate with 95 % confidence.

# %%
laws, domain = ["rps", "rps_tuned", "rps_plus"], "wide,objects=random_cylinder"
results = rps_jax.sweep(laws, domain, task=f"{task},scale=0.55:1.15", worlds=300, progress=False)
edges = 1.8 * np.linspace(0.55, 1.15, 7)
fig, ax = plt.subplots(figsize=(6, 4))
for i, law in enumerate(laws):
    success = results.success.sel(law=law).groupby({"scale": BinGrouper(edges / 1.8)})
    counts = np.array([success.sum(), success.count()], int).T
    rate = counts[:, 0] / counts[:, 1]
    spans = [binomtest(*map(int, pair)).proportion_ci(method="wilson") for pair in counts]
    low, high = np.transpose(spans)
    middle = (edges[1:] + edges[:-1]) / 2 + 0.01 * (i - 1)
    ax.errorbar(middle, rate, (rate - low, high - rate), marker="o", capsize=3, label=law)
ax.set(xlabel="width of the door [m]", ylabel="success", ylim=(0, 1.02))
_ = ax.legend()

# %% [markdown]
# What touched the walls in the trials that failed:

# %%
for law in laws:
    touch = results.wall_touch.sel(law=law)
    base, drums = int((touch == 1).sum()), int((touch == 2).sum())
    rest = int((results.success.sel(law=law) == 0).sum()) - base - drums
    print(f"{law}: the base in {base}, the drum in {drums}; {rest} failed without a touch")
