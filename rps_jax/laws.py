"""Public names for custom and packaged laws: parameters, their bounds, and the registry."""

from rps_jax.control.base import Bound as Bound
from rps_jax.control.base import LawParams as LawParams
from rps_jax.control.registry import LawsLike as LawsLike
from rps_jax.control.registry import law_of as law_of
from rps_jax.control.registry import resolve_law as resolve_law
from rps_jax.tuning.space import Space as Space
