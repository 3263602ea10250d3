"""Public names of worlds: domains, named trials, and the skins and paths in them."""

from rps_jax.geometry.polyline import Polyline as Polyline
from rps_jax.robot.skin import CapacitiveSkin as CapacitiveSkin
from rps_jax.trials.case import Case as Case
from rps_jax.world.domain import DomainLike as DomainLike
from rps_jax.world.domain import parse_domain as parse_domain
from rps_jax.world.tasks.path import PathCourse as PathCourse
