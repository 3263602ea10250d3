"""Push a custom object: an MJCF file, and the outline of its contact surface.

    python notebooks/examples/custom_object.py

A registered name is valid wherever `box` and `cylinder` are, in every engine: in pushes, in
domains, in `PushEnv` and in films.
"""

import tempfile
from pathlib import Path

import numpy as np
import tyro

import rps_jax

# A hexagonal bin of 12 kg, 0.2 m from its middle to a corner, 0.5 m high: three boxes, turned.
MJCF = """
<mujoco model="hexagon">
  <include file="base.xml"/>  <!-- of the package -->
  <worldbody>
    <body name="object">
      <freejoint name="object"/>
      <geom name="object" class="object" type="box" size="0.1732 0.1 0.25" mass="4"/>
      <geom class="object" type="box" size="0.1732 0.1 0.25" euler="0 0 1.0472" mass="4"/>
      <geom class="object" type="box" size="0.1732 0.1 0.25" euler="0 0 -1.0472" mass="4"/>
    </body>
  </worldbody>
</mujoco>"""
CORNERS = np.pi / 180 * np.arange(30, 390, 60)  # [rad] counter-clockwise
OUTLINE = 0.2 * np.stack([np.cos(CORNERS), np.sin(CORNERS)], axis=-1)  # (6, 2) [m]


def main(horizon: float = 300.0, engine: str = "fused"):
    """Push the object to targets ahead and to the left, and return the outcomes."""
    path = Path(tempfile.mkdtemp()) / "hexagon.xml"
    path.write_text(MJCF)
    rps_jax.register_object("hexagon", path, OUTLINE)
    targets = [(1.5, 0.5), (1.0, 1.0)]
    setting = rps_jax.Setting(engine, rules=rps_jax.Rules(horizon=horizon))
    results = rps_jax.table("rps", ["hexagon"], ["S1"], targets, setting=setting)
    print(results.success.values.ravel(), results.time.values.ravel())
    return results


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
