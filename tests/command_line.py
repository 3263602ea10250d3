"""The record of all commands and flags of `rps`, with metavars, defaults and help.

    python tests/command_line.py        # write tests/command_line.json anew

`test_cli.py` compares the names and defaults of this record with those of the checkout.
"""

import argparse
import contextlib
import functools
import io
import json
import os
import re
from pathlib import Path
from unittest import mock

from rps_jax.app.cli import main as rps
from rps_jax.app.cli import names

RECORD = Path(__file__).with_suffix(".json")
_DEFAULT = re.compile(r" ?\((?:default: (?P<default>.*)|required)\)$", re.DOTALL)

Flags = dict[str, dict[str, str | None]]


def help_of(command: str) -> str:
    """Return the help text of one command, without boxes, in lines that are never wrapped."""
    printed, wide = io.StringIO(), mock.patch.dict(os.environ, COLUMNS="5000")
    with wide, contextlib.redirect_stdout(printed):
        assert rps([*command.split(), "--help"]) == 0
    return printed.getvalue()


def flags_of(command: str) -> Flags:
    """Return metavar, default and help of each flag and argument of a command, by name."""
    entries: list[list[str]] = []
    for line in help_of(command).splitlines():
        if re.match(r"  (--?\w|[A-Z_]+(  |$))", line):
            entries.append(re.split(r" {2,}", line.strip(), maxsplit=1))
        elif line.startswith("   ") and line.strip():
            entries[-1].append(line.strip())
    flags: Flags = {}
    for head, *rest in entries:
        name, _, metavar = head.partition(" ")
        if name not in ("-h,", "--help"):
            text = " ".join(rest)
            match = _DEFAULT.search(text)
            flags[name.rstrip(",")] = {
                "metavar": metavar,
                "default": match["default"] if match else None,
                "help": _DEFAULT.sub("", text),
            }
    return flags


@functools.cache
def all_flags() -> dict[str, Flags]:
    """Return the flags of all commands, by command."""
    return {command: flags_of(command) for command in sorted(names.known())}


def write_record() -> None:
    """Write the record, one flag a line."""
    commands = []
    for command, flags in all_flags().items():
        lines = [
            f"  {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in flags.items()
        ]
        commands.append(f" {json.dumps(command)}: {{\n" + ",\n".join(lines) + "\n }")
    RECORD.write_text("{\n" + ",\n".join(commands) + "\n}\n")


if __name__ == "__main__":
    argparse.ArgumentParser(description="Write tests/command_line.json anew.").parse_args()
    write_record()
