"""Install the third-party engines of the arena.

    python sweeps/speed/peers.py FOLDER
    rps sweeps/speed/arena.py --peers FOLDER

The folder has these packages only; JAX, NumPy and MuJoCo are those of this environment.
"""

from __future__ import annotations

import subprocess
import sys

# MuJoCo Warp and Newton, the Warp version that MJX requires, and their imports.
PACKAGES = ("mujoco-warp==3.17.0", "newton==1.8.0", "warp-lang==1.18.0", "absl-py", "etils")


def install(folder: str) -> int:
    """Install the packages into a folder and return the exit status of pip."""
    words = [sys.executable, "-m", "pip", "install", "--no-deps", "--upgrade", "--target", folder]
    return subprocess.run([*words, *PACKAGES], check=False).returncode


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(f"usage: python {sys.argv[0]} FOLDER")
    sys.exit(install(sys.argv[1]))
