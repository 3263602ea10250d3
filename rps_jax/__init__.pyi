# ruff: noqa: I001
# The public names of the package, each at its home. `rps_jax/README.md` has a table of them.

__version__: str

# --- ask ---------------------------------------------------------------------------------------
from rps_jax.runs.push import push as push
from rps_jax.runs.push import replay as replay
from rps_jax.studies.table import table as table
from rps_jax.studies.hardware import hardware as hardware
from rps_jax.studies.paper import paper as paper
from rps_jax.runs.sweep import sweep as sweep
from rps_jax.runs.results import load as load
from rps_jax.runs.evaluate import evaluate as evaluate
from rps_jax.runs.evaluate import stack as stack
from rps_jax.studies.ladder import ladder as ladder
from rps_jax.studies.ladder import score as score
from rps_jax.studies.ceiling import ceiling as ceiling
from rps_jax.studies.gallery import gallery as gallery
from rps_jax.studies.attack import attack as attack
from rps_jax.studies.rare import rare as rare
from rps_jax.studies.regress import regress as regress
from rps_jax.studies.sensitivity import sensitivity as sensitivity

# --- tune and learn ----------------------------------------------------------------------------
from rps_jax.tuning.evolution import tune_es as tune_es
from rps_jax.tuning.descent import tune_grad as tune_grad
from rps_jax.tuning.derivatives import value_and_grad as value_and_grad
from rps_jax.tuning.learn import learn as learn
from rps_jax.tuning.fit import fit as fit
from rps_jax.tuning.objects import fit_object as fit_object
from rps_jax.trials.env import PushEnv as PushEnv
from rps_jax.trials.trajectory import draw_worlds as draw_worlds
from rps_jax.trials.trajectory import rollout as rollout

# --- laws --------------------------------------------------------------------------------------
from rps_jax.control.base import Law as Law
from rps_jax.control.registry import register_law as register_law
from rps_jax.control.observation import Observation as Observation
from rps_jax.control.observation import Twist as Twist
from rps_jax.control.observation import Details as Details
from rps_jax.control.laws.rps import RPSParams as RPSParams
from rps_jax.control.laws.rps import RPSState as RPSState
from rps_jax.control.laws.rps import step as step

# --- what is pushed ----------------------------------------------------------------------------
from rps_jax.world.domain import Domain as Domain
from rps_jax.world.domain import Range as Range
from rps_jax.world.objects import register_object as register_object
from rps_jax.world.quantity import Quantity as Quantity
from rps_jax.world.registry import register_quantity as register_quantity
from rps_jax.world.registry import register_task as register_task

# --- how it is sensed and stepped --------------------------------------------------------------
from rps_jax.robot.robot import Robot as Robot
from rps_jax.trials.setting import Setting as Setting
from rps_jax.trials.trial import Rules as Rules
from rps_jax.engines import register_engine as register_engine
from rps_jax.record.cache import use_cache as use_cache
from rps_jax.spec import Spec as Spec
from rps_jax.errors import InputError as InputError
