"""`python -m rps_jax` is `rps`."""

import sys

from rps_jax.app.cli import main

sys.exit(main())
