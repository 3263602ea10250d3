"""Push a custom object: an MJCF file, and the outline of its contact surface.

    python notebooks/examples/custom_object.py

A registered name is valid wherever `box` and `cylinder` are, in every engine: in pushes, in
domains, in `PushEnv` and in films.
"""

from pathlib import Path

import numpy as np
import tyro

import rps_jax
from rps_jax.geometry.footprint import polygon

CORNERS = np.pi / 180 * np.arange(30, 390, 60)  # [rad] counter-clockwise
OUTLINE = 0.2 * np.stack([np.cos(CORNERS), np.sin(CORNERS)], axis=-1)  # (6, 2) [m]


def main(horizon: float = 300.0, engine: str = "fused"):
    """Push the object to targets ahead and to the left, and return the outcomes."""
    path = Path(__file__).with_name("hexagon.xml")
    rps_jax.register_object("hexagon", path, polygon(OUTLINE))
    targets = [(1.5, 0.5), (1.0, 1.0)]
    setting = rps_jax.Setting(engine, rules=rps_jax.Rules(horizon=horizon))
    results = rps_jax.table("rps", ["hexagon"], ["S1"], targets, setting=setting)
    print(results.success.values.ravel(), results.time.values.ravel())
    return results


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
