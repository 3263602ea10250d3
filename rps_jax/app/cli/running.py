"""How a command runs: the question, its report, its exit code, and what it prints."""

from __future__ import annotations

import _thread
import contextlib
import dataclasses
import errno
import importlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rps_jax.errors import InputError
from rps_jax.record import cache

if TYPE_CHECKING:
    from rps_jax.app.cli.flags import Beside
    from rps_jax.runs.push import Trace
    from rps_jax.trials.progress import Bar

_MEND = "make room, then run the same command again; what is done is kept"
# Of results and report.
_AFTER = ("rps_jax.analysis.figures.sweeps", "h5netcdf", "markdown.extensions.tables")
_stopped: list[bool] = []  # interrupts of this command


def guarded(action: Callable[[], object]) -> int:
    """Run a command: exit code 0, or one sentence on the error stream and 2 (130: interrupted)."""
    for stream in (sys.stdout, sys.stderr):  # a terminal without UTF-8 shows `?`
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with _interruptible():
            action()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more to say
        return 0
    except InputError as error:
        return _told(error)
    except OSError as error:
        hint = f": {_MEND}" if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else ""
        return _told(InputError(f"{error.filename or 'output'}: {error.strerror or error}{hint}."))
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return _told(
            "the device is out of memory: ask for fewer worlds at once with --slots; what is done "
            "is kept."
        )
    except MemoryError:
        return _told("this machine is out of memory: ask for fewer worlds; what is done is kept.")
    except KeyboardInterrupt:
        print("rps: interrupted.", file=sys.stderr)
        return 130
    except SystemExit as end:  # of --help
        return int(end.code or 0)
    return 0


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Remember an interrupt that comes while a module is imported, where it may be swallowed.

    Where Python can raise nothing, as in a callback of its garbage collector, it comes again.
    """

    def stop(*_: object) -> None:
        _stopped.append(True)
        raise KeyboardInterrupt

    def again(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            threading.Timer(0.05, repeated).start()
        else:
            told(unraisable)

    def repeated() -> None:
        if sys.unraisablehook is again:  # and not when the command has ended
            _thread.interrupt_main()

    _stopped.clear()
    usual = threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    told = sys.unraisablehook
    if usual:
        signal.signal(signal.SIGINT, stop)
        sys.unraisablehook = again
    try:
        yield
    finally:
        if usual:
            sys.unraisablehook = told
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _go_on() -> None:
    if _stopped:
        raise KeyboardInterrupt


def _told(sentence: str | InputError) -> int:
    print(f"rps: error: {sentence}", file=sys.stderr)
    return 2


def carry_out(question: Any, beside: Beside) -> None:
    """Check a question, answer it, and write and print its report."""
    from tqdm import tqdm

    from rps_jax.engines import device
    from rps_jax.record import folder
    from rps_jax.runs.push import check_length
    from rps_jax.runs.question import timing_line

    if question.out is None and not hasattr(question, "in_shell"):
        question = dataclasses.replace(question, out=question.default_folder)
    asked = question.with_quick_values()
    few = beside.device == "auto" and asked.suits_processors()
    device.choose("cpu" if few or getattr(asked, "ray", None) else beside.device)
    asked.validate()
    check_length(beside.film_length)
    _go_on()
    if note := asked.note():
        print(note)
    cache.use_cache()
    if hasattr(asked, "in_shell"):
        asked.in_shell()
        return
    if beside.overwrite:
        folder.remove_run(Path(asked.out))
    tqdm.set_lock(threading.RLock())  # of this process alone: no semaphore is left if it is stopped
    film = None
    with asked.progress_bar() as bar:
        _go_on()
        importlib.import_module("scipy.special")  # JAX does, too: in two threads they could meet
        bar.on_compiled = _import_ahead
        found = asked.execute(bar)
        timed = bar.timing.simulated > 0 and bar.over != "clock"
        spent = timing_line(bar.timing, device.device_name()) if timed else ""
        if isinstance(found, Path):
            print(f"{asked.name}: {found}")
            return
        if beside.video and hasattr(found, "film"):
            film = _Film(found, Path(asked.out), beside.film_length)
        path = _report(asked, found, bar)
    print(path.read_text(encoding="utf-8"))
    if spent:
        print(spent)
    if film is not None:
        film.end()
    if getattr(asked, "film", False) and (Path(asked.out) / "worlds").is_dir():
        from rps_jax.app.film import Film

        print(f"film: {Film(Path(asked.out) / 'worlds', grid='3x4', which='hardest')()}")
    print(f"run folder: {asked.out}")


def _import_ahead() -> None:
    """Import what the report needs while trials run, which leaves Python to others."""
    later = map(importlib.import_module, _AFTER)
    threading.Thread(target=list, args=(later,), daemon=True).start()


def _report(asked: Any, found: Any, bar: Bar) -> Path:
    """Write the report of an answer; returns its path."""
    from rps_jax.analysis.report import write_report
    from rps_jax.record import provenance

    out = Path(asked.out)
    bar.phase("report")
    sections = asked.report(found, asked.create_run(out, bar))
    parts = [asked.intro(found)]
    with contextlib.suppress(InputError):
        parts.append(provenance.describe(out))
    return write_report(out, asked.title, "\n\n".join(filter(None, parts)), sections)


class _Film:
    """Stills and film of one trial; the film is drawn while the report is written."""

    def __init__(self, trace: Trace, out: Path, seconds: float):
        self._trace, self._out = trace, out
        self._total, self._drawn = 0, 0
        pool = ThreadPoolExecutor(1)
        self._film = pool.submit(trace.film, out / "push.mp4", seconds, watch=self._watched)
        pool.shutdown(wait=False)

    def _watched(self, frames: Any) -> Iterator[Any]:
        self._total = len(frames)
        for self._drawn, frame in enumerate(frames):
            if _stopped:
                raise KeyboardInterrupt
            yield frame

    def end(self) -> None:
        """Wait for the film, with a bar, and draw the stills."""
        from tqdm import tqdm

        from rps_jax.analysis.report import save
        from rps_jax.world import video

        try:
            save(self._trace.stills(), self._out / "stills.png")
            with tqdm(unit="frame", desc="film") as bar:
                while not self._film.done():
                    bar.total, bar.n = self._total, self._drawn
                    bar.refresh()
                    time.sleep(0.1)
            print(f"film: {self._film.result()}")
        except video.VideoError as error:
            print(f"no film: {error}")
