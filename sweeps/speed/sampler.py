"""Runs `rps` with the arguments after a file's name, and writes samples of its stack to the file.

    python sweeps/speed/sampler.py samples.json push --object box --target -2 0

The file has the times at which sampling began and ended [s], and each stack with its seconds. A
stack names its functions, outermost first, and ends with the first import of another package.
"""

import atexit
import json
import runpy
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from types import FrameType

PERIOD = 0.005  # [s] between samples


def names_of(frame: FrameType | None) -> tuple[str, ...]:
    """Return the names of the functions on a stack, outermost first, up to a foreign import."""
    names = list[str]()
    while frame is not None:
        module, code = frame.f_globals.get("__name__", ""), frame.f_code
        if module.startswith("importlib"):
            if code.co_name == "_find_and_load":
                imported = f"import {frame.f_locals['name']}"
                names = [*(names if "rps_jax" in imported else ()), imported]
        else:
            names.append(f"{module}.{getattr(code, 'co_qualname', code.co_name)}")
        frame = frame.f_back
    return tuple(reversed(names))


def sample(thread: int, seconds: dict[tuple[str, ...], float], write: Callable[[], None]) -> None:
    """Add the time since the last sample to the present stack of a thread, until Python ends.

    The command ends Python in the first function that it registers for the end, which runs last:
    so that which writes the samples is registered after it.
    """
    last, running = time.perf_counter(), False
    while True:
        time.sleep(PERIOD)
        now = time.perf_counter()
        names = names_of(sys._current_frames().get(thread))
        seconds[names] += now - last
        last = now
        if not running and "rps_jax.app.cli.main" in names:
            running = True
            atexit.register(write)


def main() -> None:
    """Run the command, and sample the thread that runs it."""
    file, *arguments = sys.argv[1:]
    del sys.path[0]  # the folder of this file
    start_time, seconds = time.time(), defaultdict[tuple[str, ...], float](float)

    def write() -> None:
        """Write the samples."""
        with open(file, "w") as stream:
            json.dump([start_time, time.time(), list(dict(seconds).items())], stream)

    inputs = threading.get_ident(), seconds, write
    threading.Thread(target=sample, args=inputs, daemon=True).start()
    sys.argv[1:] = arguments
    runpy.run_module("rps_jax", run_name="__main__")


if __name__ == "__main__":
    main()
