"""An object of one's own: an MJCF file, and the outline of what touches.

    python notebooks/examples/new_object.py

Once registered, its name works wherever `box` and `cylinder` do, in every engine: in cases, in
domains, in `PushEnv`, in films, and in `rps_jax.app.cli.main(["push", "--object", "hexagon"])`.
"""

from pathlib import Path

import numpy as np

import rps_jax
from rps_jax.geometry.footprint import polygon

CORNERS = np.pi / 180 * np.arange(30, 390, 60)  # [rad] counter-clockwise
OUTLINE = 0.2 * np.stack([np.cos(CORNERS), np.sin(CORNERS)], axis=-1)  # (6, 2) [m]


def main(horizon: float = 300.0, engine="fused"):
    """Push it to a target ahead and to the left; returns the outcome."""
    path = Path(__file__).with_name("hexagon.xml")
    rps_jax.register_object("hexagon", path, polygon(OUTLINE))
    case = rps_jax.Case("hexagon", rps_jax.FRICTION["S1"], p_world_target=(1.5, 0.5))
    setting = rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon), engine=engine)
    outcome, _ = rps_jax.run([case], setting)
    print(f"reached: {outcome.success[0]}, at {outcome.time[0]:.1f} s")
    return outcome


if __name__ == "__main__":
    main()
