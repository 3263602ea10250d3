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
    faults = [fault] if (fault := _unset_bad_flags()) else []
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
    return faults


def _unset_bad_flags() -> str:
    """Unset XLA_FLAGS if XLA would abort this process because of it, and return why."""
    from rps_jax.engines import device

    flags = os.environ.get("XLA_FLAGS", "")
    if not flags or device.has_started():
        return ""
    command = [sys.executable, "-c", _PARSE_FLAGS]
    parsed = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if not parsed.returncode:
        return ""
    del os.environ["XLA_FLAGS"]
    match = _FATAL.search(parsed.stderr)
    reason = match[1].partition(". (")[0] if match else "Check failed"
    rule = "XLA cannot read the value of a flag" if "Check failed" in reason else reason
    return str(not_allowed("XLA_FLAGS", flags, f"{rule}; correct or unset it"))
