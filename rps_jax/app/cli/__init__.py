"""The command line: `rps NAME` and `rps PATH` run a question and write its report.

`names` finds the class of a command in the text of its file, so that `rps --help` imports neither
JAX nor MuJoCo. `flags` parses the options, and `running` checks them before anything compiles.
"""

import atexit
import contextlib
import gc
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from rps_jax.app.cli import environment, names, running


def run() -> NoReturn:
    """Run `rps` as a process, which ends without taking Python down, and at once if interrupted.

    To take it down takes half a second, and threads of XLA that still compile can crash meanwhile.
    """
    gc.disable()  # until the command runs: imports leave no garbage that is worth a search
    codes = list[int]()
    atexit.register(_end, codes)  # the first that is registered runs last
    environment.start_process()
    codes.append(main())
    if codes == [130]:
        _end(codes)
    sys.exit(*codes)


def _end(codes: Sequence[int]) -> None:
    """End the process with an exit code, if there is one."""
    for code in codes:
        with contextlib.suppress(OSError):  # nobody reads the output
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit code: 0, 2 for bad input, or 130 if interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        return running.exit_code(lambda: print(names.overview()))
    if words[0] == "--version":
        from rps_jax import __version__

        return running.exit_code(lambda: print(f"rps_jax {__version__}"))
    return running.exit_code(lambda: _run(words))


def _run(words: list[str]) -> None:
    """Find the question of a command, parse its options, and execute it."""
    extensions, words = names.extensions(words)
    name, rest = names.split(words)
    faults = environment.unset_bad_variables()
    from rps_jax.app.cli import flags
    from rps_jax.engines import device

    device.configure_xla()
    for path in extensions:
        names.import_file(path)
    with device.standard_jax():
        running.execute(*flags.parse(names.question_type(name), name, rest), faults)
