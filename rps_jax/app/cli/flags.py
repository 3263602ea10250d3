"""Flags of the commands: tyro parses them, by the fields of a question and their docstrings.

Two rules are added to those of tyro. Whatever has a text form, such as a law or a domain, is read
as text. Hidden fields are not offered, and the fields of the setting and its rules are flags
without a prefix.
"""

import dataclasses
import types
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

import tyro
from tyro import _errors
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from rps_jax.app.cli import names
from rps_jax.engines.device import Device
from rps_jax.errors import InputError, check_name, suggest
from rps_jax.record import options
from rps_jax.record.options import option
from rps_jax.runs.push import FILM_LENGTH, TraceQuestion
from rps_jax.runs.question import (
    Command,
    Question,
    SimulationQuestion,
    current_names,
    quick_command,
)
from rps_jax.trials.setting import PhysicsField, Setting
from rps_jax.trials.trial import Rules

Q = TypeVar("Q", bound=Command[object])
_REGISTRY = ConstructorRegistry()
_NO_PREFIX = tyro.conf.arg(name="")
_NUMBER_NOUNS = {int: "a whole number", float: "a number"}
_LAST = [field.name for field in dataclasses.fields(SimulationQuestion)]  # in the help


@dataclass(frozen=True)
class Session:
    """Options of the command line alone, at their defaults. Subclasses offer some as flags."""

    device: Device = option("auto", hidden=True)
    video: bool = option(True, hidden=True)
    film_length: float = option(FILM_LENGTH, hidden=True)


@dataclass(frozen=True)
class FolderSession(Session):
    """Options of commands that write a run folder."""

    device: Device = "auto"
    """Where the worlds are stepped: auto takes the GPU if JAX finds one, and processors for a few
    trials, which they have ended before a GPU has begun. On a processor the fused engine is
    compiled by the machine's C compiler if it has one, with xla by XLA alone."""


@dataclass(frozen=True)
class FilmSession(FolderSession):
    """Options of commands that follow one trial."""

    video: bool = True
    """Whether the push is filmed."""
    film_length: float = option(FILM_LENGTH, above=0, at_most=600, unit="s")
    """Length of the film [s], whatever the trial's."""


def session_type(question_type: type) -> type[Session]:
    """Return the type of the options that a command has beside those of its question."""
    if issubclass(question_type, TraceQuestion):
        return FilmSession
    return FolderSession if issubclass(question_type, SimulationQuestion) else Session


def read(words: list[str]) -> tuple[Question[Any], Session]:
    """Return the question and session of the words after `rps`."""
    name, options = names.split(words)
    return parse(names.question_type(name), name, options)


def parse(question_type: type[Q], command: str, words: Sequence[str]) -> tuple[Q, Session]:
    """Return the question and session of a command. With `--quick` the defaults are quick ones.

    Raises:
      InputError: an option is unknown, lacks its value, or has one that is not allowed.
      SystemExit: the help was printed.
    """
    words = [_current_flag(question_type, word) for word in words]
    question, session = _parse(question_type(), command, words)
    if getattr(question, "quick", False):
        question, session = _parse(quick_command(question, question_type()), command, words)
    options.check_fields(session)
    return question, session


def _current_flag(question_type: type[Q], word: str) -> str:
    """Return a word of the command line, with the present name of a flag that was renamed.

    Raises:
      InputError: the flag was removed.
    """
    flag, equals, value = word.partition("=")
    name = flag.removeprefix("--").replace("-", "_") if flag.startswith("--") else ""
    if name not in {**question_type.RENAMED, **question_type.REMOVED}:
        return word
    (current,) = current_names(question_type, {name: value})
    return f"--{current.replace('_', '-')}{equals}{value}"


def _parse(defaults: Q, command: str, words: Sequence[str]) -> tuple[Q, Session]:
    kinds = type(defaults), session_type(type(defaults))

    def raise_sentence(event: _errors.ParseErrorEvent) -> None:
        known = [name for kind in kinds for name in _flag_names(kind)]
        raise InputError(_sentence(event, command, known))

    with _errors.on_parse_error(raise_sentence):
        return tyro.cli(
            tuple[Annotated[kinds[0], _NO_PREFIX], Annotated[kinds[1], _NO_PREFIX]],
            prog=f"rps {command}",
            description=(kinds[0].__doc__ or "").split("\n\n")[0].replace("\n", " "),
            args=words,
            default=(defaults, kinds[1]()),
            registry=_REGISTRY,
        )


def _sentence(event: _errors.ParseErrorEvent, command: str, known: Sequence[str]) -> str:
    """Return the sentence of an error in the options of a command, whose flags are `known`."""
    hint = f"`rps {command} --help` lists the options"
    match event:
        case _errors.UnrecognizedArgs(tokens=[token, *_]):
            return f"unknown option '{token}'{suggest(token.partition('=')[0], known)}: {hint}."
        case _errors.MissingArgs(missing_arguments=[missing, *_]):
            return f"{missing.arg.field.intern_name} is missing: {hint}."
        case _errors.BadValue(argument=argument):
            count = argument.lowered.nargs
            return f"{argument.field.intern_name} needs {count} value(s): {hint}."
        case _errors.InvalidChoice(argument=argument, value=value, choices=choices):
            check_name(argument.lowered.name_or_flags[-1].lstrip("-"), value, choices)
        case _errors.InstantiationFailure(message=message, argument=argument):
            if argument is None:  # a record that checks itself
                return message
            return f"{argument.field.intern_name} = {message}: {hint}."
    return f"the options cannot be read: {hint}."


# --- rules for tyro --------------------------------------------------------------------------


@_REGISTRY.primitive_rule
def _number_or_text(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[object] | None:
    """Read numbers, optional or not, and as text whatever has a text form."""
    kinds = {info.type}
    if get_origin(info.type) in (typing.Union, types.UnionType):
        kinds = {*get_args(info.type)}
    if kinds & {str, Path}:
        if any(get_origin(kind) is Sequence for kind in kinds):
            return PrimitiveConstructorSpec("*", "[TEXT [TEXT ...]]", tuple, _is_any, _texts)
        return PrimitiveConstructorSpec(1, "TEXT", lambda words: words[0], _is_any, _texts)
    for kind in kinds & {*_NUMBER_NOUNS}:
        read = partial(_parse_number, kind)
        return PrimitiveConstructorSpec(1, kind.__name__.upper(), read, _is_any, _texts)
    return None


def _parse_number(kind: type[int] | type[float], words: list[str]) -> float:
    try:
        return kind(words[0])
    except ValueError as error:
        raise ValueError(f"{words[0]} is not allowed: give {_NUMBER_NOUNS[kind]}") from error


def _is_any(value: object) -> bool:
    return True


def _texts(value: object) -> list[str]:
    """Return a default as words of the command line."""
    return [*map(str, value)] if isinstance(value, tuple | list) else [str(value)]


@_REGISTRY.struct_rule
def _fields(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Offer the fields of a dataclass, without the hidden ones."""
    is_tuple = hasattr(info.type, "_fields")
    if not (is_tuple or dataclasses.is_dataclass(info.type)):
        return None
    types_ = options.field_types(info.type)
    if is_tuple:
        rows = ((x, types_[x], getattr(info.default, x)) for x in info.type._fields)
        fields = (StructFieldSpec(*row, options.help_of(info.type, row[0])) for row in rows)
        return StructConstructorSpec(info.type, tuple(fields))
    specs = []
    for field in _offered(info.type):
        default = vars(info.default)[field.name]  # as it was given: a property may convert it
        is_group = types_[field.name] in (Setting, Rules)
        marks: list[object] = [_NO_PREFIX] if is_group else []
        if field.metadata.get(options.POSITIONAL):
            marks = [tyro.conf.Positional, tyro.conf.arg(metavar=field.name.upper())]
            default = tyro.MISSING if default == "" else default
        kind = str if types_[field.name] is PhysicsField else types_[field.name]
        if flag := field.metadata.get(options.FLAG):
            marks, kind = [tyro.conf.arg(name=flag), tyro.conf.UseAppendAction], tuple[str, ...]
        if get_origin(kind) is Sequence:
            kind = tuple[get_args(kind)[0], ...]
        marked = typing.cast(type, Annotated[(kind, *marks)] if marks else kind)
        # The help has no text of a group, which tyro would read from the source at once.
        text = "" if is_group else partial(options.help_of, info.type, field.name)
        specs.append(StructFieldSpec(field.name, marked, default, text))
    return StructConstructorSpec(info.type, tuple(specs))


def _offered(kind: type) -> list[dataclasses.Field[object]]:
    """Return the fields that are flags: those of the command first, then the shared ones."""
    shown = [f for f in dataclasses.fields(kind) if not f.metadata.get(options.HIDDEN)]
    return sorted(shown, key=lambda field: field.name in _LAST)


def _flag_names(kind: type) -> Iterator[str]:
    """Yield the flags of a dataclass, with those of its setting."""
    for field in _offered(kind):
        if options.field_types(kind)[field.name] is Setting:
            yield from _flag_names(Setting)
        else:
            yield f"--{(field.metadata.get(options.FLAG) or field.name).replace('_', '-')}"
