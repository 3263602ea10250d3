"""An object of one's own: an MJCF file, and the outline of what touches.

    python notebooks/examples/custom_object.py

Once registered, its name works wherever `box` and `cylinder` do, in every engine: in pushes, in
domains, in `PushEnv` and in films.
"""

from pathlib import Path

import numpy as np

import rps_jax
from rps_jax.geometry.footprint import polygon

CORNERS = np.pi / 180 * np.arange(30, 390, 60)  # [rad] counter-clockwise
OUTLINE = 0.2 * np.stack([np.cos(CORNERS), np.sin(CORNERS)], axis=-1)  # (6, 2) [m]


def main(horizon: float = 300.0, engine="fused"):
    """Push it to targets ahead and to the left; returns the outcomes."""
    path = Path(__file__).with_name("hexagon.xml")
    rps_jax.register_object("hexagon", path, polygon(OUTLINE))
    targets = [(1.5, 0.5), (1.0, 1.0)]
    setting = rps_jax.Setting(engine, rules=rps_jax.Rules(horizon=horizon))
    found = rps_jax.table("rps", ["hexagon"], ["S1"], targets, setting=setting)
    print(found.success.values.ravel(), found.time.values.ravel())
    return found


if __name__ == "__main__":
    main()
