"""`python -m rps_jax` is `rps`."""

from rps_jax.app.cli import run

run()
