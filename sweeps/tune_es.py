"""Tune by evolution; the same as `rps tune es`.

python sweeps/tune_es.py --quick
"""

import sys

from rps_jax.app import cli

if __name__ == "__main__":
    sys.exit(cli.main(["tune", "es", *sys.argv[1:]]))
