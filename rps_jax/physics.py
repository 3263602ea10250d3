"""Public names of the simulation: physics, friction, engines, and motions that drive a base."""

from rps_jax import engines
from rps_jax.engines import EngineName as EngineName
from rps_jax.engines.base import ControlPeriod as ControlPeriod
from rps_jax.engines.base import Motion as Motion
from rps_jax.world.physics import PHYSICS as PHYSICS
from rps_jax.world.physics import Physics as Physics
from rps_jax.world.physics import preset as preset
from rps_jax.world.scene import FRICTION as FRICTION

get_engine = engines.get
