"""`python -m rps_jax` is `rps`."""

import sys

from rps_jax.cli import main

sys.exit(main())
