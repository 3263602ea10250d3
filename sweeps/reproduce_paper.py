"""All of the paper in one run folder; the same as `rps paper`.

python sweeps/reproduce_paper.py --quick
"""

import sys

from rps_jax.app import cli

if __name__ == "__main__":
    sys.exit(cli.main(["paper", *sys.argv[1:]]))
