"""The options of a question as flags of the command line: by their types, with their own help.

tyro reads a flat dataclass that is made here. A law, a domain, a robot and the like are texts
there, `Setting` and its rules become flags of their own, and what is asked for is made of them.
"""

import ast
import contextlib
import dataclasses
import io
import os
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

import tyro

from rps_jax.engines.device import Device
from rps_jax.errors import InputError
from rps_jax.record import options
from rps_jax.runs.push import FILM_LENGTH, TraceQuestion
from rps_jax.runs.question import SimulationQuestion
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules

_PLAIN = (int, float, bool, str, Path, type(None))


class Beside(NamedTuple):
    """Options of the command line alone."""

    device: Device = "auto"
    """Where the worlds are stepped: auto takes the GPU if JAX finds one, and processors for a few
    trials, which they have ended before a GPU has begun. On a processor the fused engine is
    compiled by the machine's C compiler if it has one, with xla by XLA alone."""
    overwrite: bool = False
    """Whether a run that the folder already holds is removed first."""
    video: bool = True
    """Whether the push is filmed."""
    film_length: float = FILM_LENGTH
    """Length of the film [s], whatever the trial's."""


def parse(kind: type[Any], name: str, words: Sequence[str]) -> tuple[Any, Beside]:
    """Read the options of a question, or raise InputError; SystemExit if help was asked for."""
    flat, beside = _flat(kind)
    summary = (kind.__doc__ or "").split("\n\n", 1)[0].replace("\n", " ")
    made = dataclasses.make_dataclass(kind.__name__, flat, frozen=True)
    asked = _read(made, f"rps {name}", words, summary)
    given = {one.name: getattr(asked, one.name) for one in dataclasses.fields(asked)}
    extra = Beside(**{key: given.pop(key) for key in beside})
    said = [re.sub(r"\W", "_", word[2:].split("=")[0]) for word in words if word[:2] == "--"]
    said += ["rules"] if {*said} & {*Rules._fields} else []
    return kind(**_gathered(kind, given), explicit_options=tuple(said)), extra


def _read(made: type[Any], program: str, words: Sequence[str], summary: str) -> Any:
    """What tyro reads, or its complaint as one sentence."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), _wide(words):
            return tyro.cli(made, prog=program, args=list(words), description=summary)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(_sentence(said.getvalue(), program)) from end


@contextlib.contextmanager
def _wide(words: Sequence[str]) -> Iterator[None]:
    """Have tyro believe in a terminal that is wide enough for every word, unless help is asked."""
    before = os.environ.get("COLUMNS")
    if not {"-h", "--help"}.intersection(words):
        os.environ["COLUMNS"] = str(200 + 2 * len(" ".join(words)))
    try:
        yield
    finally:
        os.environ.pop("COLUMNS", None)
        if before is not None:
            os.environ["COLUMNS"] = before


def _sentence(said: str, program: str) -> str:
    """Take the complaint of tyro out of its box, or of what stands for one in ASCII."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", said)
    lines = [_unboxed(line) for line in plain.splitlines()]
    rules = [
        i for i, line in enumerate(lines)
        if line and (set(line) <= set("─-") or line[0] in "╭╰┌└")
    ]  # fmt: skip
    # Below its title, and above the next rule.
    first, last = (*rules, len(lines))[:2] if rules else (-1, len(lines))
    kept = lines[first + 1 : last]
    text = re.sub(r"\s+", " ", " ".join(kept)).strip().rstrip(".")
    if wrong := re.match(r"Error parsing (\S+): (.*)", text):
        name, why = wrong[1].strip("-").lower(), wrong[2]
        if " is not allowed: " in why:  # a record's own sentence
            return f"{why}."
        usage = next((line for line in lines[last:] if line.startswith(wrong[1])), why).upper()
        many = usage.count("INT") + usage.count("FLOAT") > 1
        whole = re.search(r"\bint\b", usage + why, re.IGNORECASE)
        kind = ("whole " if whole else "") + ("numbers" if many else "number")
        return f"{name} = {_value(why)} is not allowed: give {kind if many else f'a {kind}'}."
    return f"{text or 'the options cannot be read'}; `{program} --help` lists them."


def _value(why: str) -> str:
    """What tyro could not read, of its reason."""
    found = re.search(r"(\[.*?\])(?: into |\. Got |$)", why) or re.search(r": ([\'\"].*)$", why)
    try:
        value = ast.literal_eval(found[1] if found else "''")
    except (ValueError, SyntaxError):
        value = why
    return " ".join(value) if isinstance(value, list) else value


def _unboxed(line: str) -> str:
    """A line of a box without its sides."""
    for side in "│|":
        line = line.strip().removeprefix(side).removesuffix(side)
    return line.strip()


# --- the flat dataclass --------------------------------------------------------------------


def _flat(kind: type[Any]) -> tuple[list[Any], list[str]]:
    """Fields of the flat dataclass, and which of them are the command line's alone."""
    types_, helps = options.field_types(kind), options.field_docs(kind)
    shared = [
        one.name for one in dataclasses.fields(SimulationQuestion)
    ]  # told last, but for the setting
    own, last = [], []
    for one in dataclasses.fields(kind):
        if not one.init or options.is_hidden(one):
            continue
        if types_[one.name] is Setting:
            last = [*_of_setting(_default(one)), *last]
        else:
            kind_, help_ = cli_type(types_[one.name]), helps.get(one.name, "")
            made = _made(one.name, kind_, _default(one), help_, options.is_positional(one))
            (last if one.name in shared else own).append(made)
    beside = ["device"] if issubclass(kind, SimulationQuestion | TraceQuestion) else []
    if beside and not hasattr(kind, "in_shell"):
        filmed = issubclass(kind, TraceQuestion)  # one trial over time
        beside += ["overwrite", "video", "film_length"] if filmed else ["overwrite"]
    texts, hints = options.field_docs(Beside), typing.get_type_hints(Beside)
    extra = [_made(n, hints[n], Beside._field_defaults[n], texts[n]) for n in beside]
    every = [*own, *last, *extra]
    # Required ones must come first in a dataclass, and so must positional ones here.
    every.sort(key=lambda one: (one[2].default is not MISSING, _POSITIONAL not in get_args(one[1])))
    return every, beside


def _default(one: Field[Any]) -> Any:
    return one.default if one.default_factory is MISSING else one.default_factory()


def _made(
    name: str, kind: Any, default: Any, text: str, positional: bool = False
) -> tuple[str, Any, Field[Any]]:
    """Name, annotated type and default of a field of the flat dataclass."""
    metavar = name.upper() if positional else _METAVARS.get(_bare(kind))
    marks = [
        tyro.conf.arg(help=" ".join(text.split()), metavar=metavar),
        *[_POSITIONAL] * positional,
    ]
    full = typing.Annotated[(kind, *marks)]
    if isinstance(default, Sequence) and not isinstance(default, str):
        default = tuple(default)
    required = positional and default in ("", ())
    field: Any = dataclasses.field() if required else dataclasses.field(default=default)
    return name, full, field


def _bare(kind: Any) -> Any:
    """A type without its None."""
    inner = [one for one in get_args(kind) if one is not type(None)]
    return inner[0] if type(None) in get_args(kind) and len(inner) == 1 else kind


_POSITIONAL = tyro.conf.Positional
_METAVARS = {str: "TEXT", int: "INT", float: "FLOAT", Path: "PATH"}


def _of_setting(default: Setting) -> list[Any]:
    """Flags of a setting and its rules."""
    found = []
    for kind, own in ((Setting, default), (Rules, default.rules)):
        types_, helps = typing.get_type_hints(kind), options.field_docs(kind)
        for name, text in helps.items():
            if name in types_:
                value = own.__dict__.get(name) if kind is Setting else getattr(own, name)
                found.append(_made(name, cli_type(types_[name]), value, text))
    return found


def cli_type(kind: Any) -> Any:
    """The type by which tyro reads an option of a type: what may be a text is one."""
    if kind in _PLAIN or get_origin(kind) is Literal or dataclasses.is_dataclass(kind):
        return kind
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (typing.Union, types.UnionType):
        some = [one for one in inner if one is not type(None)]
        if str in some:
            several = any(get_origin(one) is Sequence for one in some)
            found: Any = tuple[str, ...] if several else str
        else:
            plain = [one for one in some if one in _PLAIN] or some
            found = cli_type(plain[0])
        return found | None if type(None) in inner else found
    if origin in _MANY:
        return tuple[cli_type(inner[0]), ...]
    if origin is tuple:
        return tuple[tuple(one if one is Ellipsis else cli_type(one) for one in inner)]
    return str  # a setting's physics, and the like


_MANY = (Sequence, Mapping)


def _gathered(kind: type[Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a question, of the values of its flags."""
    found = dict(given)
    for one in dataclasses.fields(kind):
        if options.field_types(kind)[one.name] is Setting:
            rules = {name: found.pop(name) for name in options.field_docs(Rules) if name in found}
            own = {name: found.pop(name) for name in options.field_docs(Setting) if name in found}
            usual: Setting = _default(one)
            rules_ = usual.rules._replace(**rules)
            found[one.name] = dataclasses.replace(usual, **own, rules=rules_)
    return found
