"""The fused engine: MuJoCo's equations, specialised to these scenes and written out in scalars.

`contacts` finds the contacts, `newton` solves for the accelerations, `step` integrates.
"""

from rps_jax.engines.fused.step import ENGINE as ENGINE
from rps_jax.engines.fused.step import Fused as Fused
