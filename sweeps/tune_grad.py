"""Tune by gradients; the same as `rps tune grad`.

python sweeps/tune_grad.py --quick
"""

import sys

from rps_jax.app import cli

if __name__ == "__main__":
    sys.exit(cli.main(["tune", "grad", *sys.argv[1:]]))
