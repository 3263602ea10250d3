"""The environment of a command: streams, variables that would abort it, and the terminal."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import warnings

from rps_jax.errors import InputError, not_allowed

_MIN_COLUMNS = 40  # of a terminal: tyro never ends the help of a narrower one
# XLA parses its flags, and no backend starts.
_PARSE_FLAGS = (
    "import jaxlib.xla_client as xla; xla.CompileOptions().executable_build_options.debug_options"
)
_FATAL = re.compile(r"^F\d{4} .*?\] (.*)$", re.MULTILINE)  # line of XLA before it aborts


def start_process() -> None:
    """Open the null device for closed standard streams, and set what output depends on.

    The first file that is opened would otherwise get the number of a closed stream. Where the
    locale is ASCII, Python starts again in UTF-8, in which file names are.
    """
    if sys.getfilesystemencoding() == "ascii":
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    warnings.formatwarning = lambda message, *_, **__: f"rps: warning: {message}\n"
    os.environ["MPLBACKEND"] = "agg"  # figures are only written to files
    if shutil.get_terminal_size().columns < _MIN_COLUMNS:
        os.environ["COLUMNS"] = str(_MIN_COLUMNS)
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null > descriptor:
                os.dup2(null, descriptor)
            setattr(sys, name, os.fdopen(descriptor, "w" if descriptor else "r", closefd=False))


def unset_bad_variables() -> list[str]:
    """Unset variables that would abort the process; return a sentence for each fault.

    Raises:
      InputError: JAX or tqdm refuses its variables.
    """
    parser = _parse_flags()  # meanwhile modules are imported
    faults = list[str]()
    try:
        os.getcwd()
    except FileNotFoundError:
        faults.append("the current folder was deleted: change to another, as by `cd ~`.")
    for module in ("jax", "tqdm"):
        try:
            importlib.import_module(module)
        except ValueError as error:
            raise InputError(
                f"{module} cannot be imported ({error}): correct or unset the environment variable "
                f"{module.upper()}_... that this names."
            ) from error
    return [fault, *faults] if (fault := _unset_bad_flags(parser)) else faults


def _parse_flags() -> subprocess.Popen[str] | None:
    """Start a process that aborts if XLA would because of XLA_FLAGS."""
    from rps_jax.engines import device

    if not os.environ.get("XLA_FLAGS") or device.has_started():
        return None
    command = [sys.executable, "-c", _PARSE_FLAGS]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, errors="replace")


def _unset_bad_flags(parser: subprocess.Popen[str] | None) -> str:
    """Unset XLA_FLAGS if the parser aborted because of it, and return why."""
    errors = parser.communicate()[1] if parser else ""
    if not parser or not parser.returncode:
        return ""
    flags = os.environ.pop("XLA_FLAGS")
    match = _FATAL.search(errors)
    reason = match[1].partition(". (")[0] if match else "Check failed"
    rule = "XLA cannot read the value of a flag" if "Check failed" in reason else reason
    return str(not_allowed("XLA_FLAGS", flags, f"{rule}; correct or unset it"))
