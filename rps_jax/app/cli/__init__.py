"""The command line: `rps NAME` and `rps PATH` ask a question, and write its report.

A question's fields are the options (`flags`), found by its file's text (`names`), so that
`rps --help` imports neither JAX nor MuJoCo. Input is checked before anything compiles (`running`).
"""

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from rps_jax.app.cli import names, running


def run() -> NoReturn:
    """Run `rps` as a process, which ends at once if it was stopped.

    Threads of XLA may still be compiling then, and can crash while Python is taken down.
    """
    code = main()
    if code == 130:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Ask what the words ask; exit code 0, 2 for bad input, 130 if stopped."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        return running.guarded(lambda: print(names.overview()))
    if words[0] == "--version":
        from rps_jax import __version__

        return running.guarded(lambda: print(f"rps_jax {__version__}"))
    return running.guarded(lambda: _ask(words))


def _ask(words: list[str]) -> None:
    """Find the question, read its options, and answer it."""
    from rps_jax.app.cli import flags
    from rps_jax.engines import device

    name, rest = names.split(words)
    device.configure_xla()
    question = names.question_of(name)
    running.carry_out(*flags.parse(question, name, rest))
