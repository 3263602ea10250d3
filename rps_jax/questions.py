"""Public names for custom questions: options, base classes, plans, runs and reports."""

from rps_jax.analysis.report import Picture as Picture
from rps_jax.analysis.report import Section as Section
from rps_jax.record.options import option as option
from rps_jax.runs.plan import Plan as Plan
from rps_jax.runs.question import LawQuestion as LawQuestion
from rps_jax.runs.question import MultiLawQuestion as MultiLawQuestion
from rps_jax.runs.question import Run as Run
from rps_jax.runs.question import call_of as call_of
