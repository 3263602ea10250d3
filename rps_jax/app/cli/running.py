"""Running a command: exit codes, errors, interrupts, output and report."""

from __future__ import annotations

import _thread
import contextlib
import dataclasses
import errno
import gc
import importlib
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.analysis.report import Section
    from rps_jax.app.cli.flags import Session
    from rps_jax.runs.push import Trace
    from rps_jax.runs.question import Command, Question
    from rps_jax.trials.progress import Bar

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Modules that the results and the report need.
_IMPORTED_EARLY = ("rps_jax.analysis.figures.sweeps", "h5netcdf", "markdown.extensions.tables")
_interrupts: list[bool] = []  # of this command
_importers: list[threading.Thread] = []  # that `_import_early` started


def exit_code(command: Callable[[], object]) -> int:
    """Run a command, and return its exit code: 0, 2 after one sentence, or 130 if interrupted."""
    for stream in (sys.stdout, sys.stderr):  # a terminal without UTF-8 shows `?`
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        with _interruptible():
            command()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads the output
        _discard(sys.stdout)
    except InputError as error:
        return _print_error(error)
    except OSError as error:
        full = ": make room, then run the same command again; finished parts are stored"
        hint = full if error.errno in _DISK_FULL else ""
        return _print_error(f"{error.filename or 'output'}: {error.strerror or error}{hint}.")
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return _print_error(
            "out of memory: run fewer worlds, or step fewer at once with --slots; finished parts "
            "are stored."
        )
    except KeyboardInterrupt:
        print("rps: interrupted.", file=sys.stderr)
        return 130
    except SystemExit as end:  # of --help
        return int(end.code or 0)
    return 0


def _print_error(sentence: object) -> int:
    """Print one sentence on the error stream; return the exit code for bad input."""
    try:
        print(f"rps: error: {InputError(sentence)}", file=sys.stderr, flush=True)
    except OSError:  # nobody reads it
        _discard(sys.stderr)
    return 2


def _discard(stream: TextIO) -> None:
    """Send the rest of a stream and all further output to the null device."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Note interrupts, since a module that is being imported may swallow them.

    Python cannot raise in some callbacks, such as those of its garbage collector. An interrupt in
    one of these is sent again.
    """
    default_hook = sys.unraisablehook

    def interrupt(*_: object) -> None:
        _interrupts.append(True)
        raise KeyboardInterrupt

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            threading.Timer(0.05, interrupt_again).start()
        else:
            default_hook(unraisable)

    def interrupt_again() -> None:
        if sys.unraisablehook is hook:  # and not when the command has ended
            _thread.interrupt_main()

    _interrupts.clear()
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = default_hook
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _raise_interrupts() -> None:
    if _interrupts:
        raise KeyboardInterrupt


def execute(command: Command[object], session: Session, faults: list[str]) -> None:
    """Check a command and execute it; write and print the report of a question.

    The command refuses `faults` of the environment, or reports them.
    """
    import jax
    from tqdm import tqdm

    from rps_jax.engines import device
    from rps_jax.record import cache
    from rps_jax.runs.push import Trace
    from rps_jax.runs.question import OutputCommand, Question
    from rps_jax.world import opengl

    is_default = command.out == type(command)().out
    if command.out is None:
        command = dataclasses.replace(command, out=command.default_folder)
    if opengl.FAULT:
        faults.append(opengl.FAULT)
    is_small = session.device == "auto" and command.suits_processors()
    try:
        device.choose("cpu" if is_small or getattr(command, "ray", None) else session.device)
    except InputError as error:
        faults.append(str(error))
        jax.config.update("jax_platforms", "cpu")
    command = command.with_faults(faults)
    command.validate()
    if is_default and isinstance(command, OutputCommand):
        default, command = command.out, command.in_free_place()
        if command.out != default:
            is_run = isinstance(command, Question)
            holds = "holds another run: the folder of this one" if is_run else "exists: this one"
            print(f"{default} {holds} is {command.out}.")
    _raise_interrupts()
    if note := command.note():
        print(note)
    cache.use_cache()
    out = Path(str(command.out))
    tqdm.set_lock(threading.RLock())  # of this process alone: no semaphore is left if it is stopped
    with command.progress_bar() as bar:
        _raise_interrupts()
        importlib.import_module("scipy.special")  # JAX does, too: in two threads they could meet
        bar.on_compiled = _import_early
        if not gc.isenabled():  # imported modules are never garbage
            gc.freeze()
            gc.enable()
        results = command.execute(bar)
        timed = bar.timing.simulated > 0 and bar.over != "clock"
        timed = timed and not getattr(command, "REPORTS_TIMES", False)
        timing = f"{bar.timing} on {jax.devices()[0].device_kind}" if timed else ""
        if not isinstance(command, Question):
            if results is not None:
                print(f"{command.name}: {results}")
            return
        film: list[Section] = []
        if session.video and isinstance(results, Trace):
            bar.phase("film")
            film.append(_film(results, out, session.film_length, shown=command.shows_progress))
        report = _report(command, results, bar, film)
    print(report.read_text(encoding="utf-8"))
    if timing:
        print(timing)
    if getattr(command, "film", False) and (out / "worlds").is_dir():
        from rps_jax.app.film import Film

        print(f"film: {Film(out / 'worlds', grid='3x4', which='hardest', overwrite=True)()}")
    print(f"run folder: {out}")


def _import_early() -> None:
    """Import what the report needs while trials run, which leaves Python to other threads."""
    imports = map(importlib.import_module, _IMPORTED_EARLY)
    _importers.append(threading.Thread(target=list, args=(imports,), daemon=True))
    _importers[-1].start()


def _report(question: Question[object], results: object, bar: Bar, film: list[Section]) -> Path:
    """Write the report of the results, with the section of a film, and return its path."""
    while _importers:  # a module that two threads import at once may be incomplete in one
        _importers.pop().join()
    import xarray as xr

    from rps_jax.analysis import tables
    from rps_jax.analysis.report import Section, write_report
    from rps_jax.record import provenance

    out = Path(str(question.out))
    bar.phase("report")
    sections = [*question.report(results, question.create_run(out, bar)), *film]
    if isinstance(results, xr.Dataset | xr.DataTree) and len(rows := tables.nan_table(results)) > 1:
        text = "These laws returned NaN or infinity, and the trials ended there as diverged."
        sections.insert(0, Section("Laws that returned NaN", text, rows))
    intro = [question.quick_note(), question.intro(results)]
    with contextlib.suppress(InputError):
        intro.append(provenance.describe(out))
    return write_report(out, question.title, "\n\n".join(filter(None, intro)), sections)


def _film(trace: Trace, out: Path, seconds: float, *, shown: bool) -> Section:
    """Write the film of a trial to its run folder; return its section of the report."""
    from tqdm import tqdm

    from rps_jax.analysis.report import Picture, Section
    from rps_jax.world import video

    try:
        stills = trace.stills()
        watch = partial(tqdm, unit="frame", desc="film", disable=not shown, leave=False)
        film = trace.film(out / "push.mp4", seconds, watch=watch)
    except video.VideoError as error:
        return Section("Film", f"There is no film: {error}")
    return Section("Film", picture=Picture("stills", lambda: stills), film=film)
