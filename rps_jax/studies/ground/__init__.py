"""Which ground is nearest to dry friction: single pushes, beside those of a rigid object.

`rigid` solves for the motion of the rigid object, `pushes` runs one push in C MuJoCo or in the
rigid limit, and `grounds` runs them on many grounds and compares.
"""

from rps_jax.studies.ground.grounds import DRAWN, GROUNDS, QUICK, count, run, table

__all__ = ["DRAWN", "GROUNDS", "QUICK", "count", "run", "table"]
