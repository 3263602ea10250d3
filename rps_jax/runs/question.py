"""Commands: one declaration makes a function of the package, a shell command and a run folder.

A command is a frozen dataclass. Its fields are the options: annotations are their types, the
strings below them their help, and `option` holds their bounds. There are two kinds:

- `Question`: has an answer, labelled data. `answer(run)` computes it, step by step so that it can
  be resumed, and `report(results, run)` describes it in prose, tables and figures.
- Any other `Command` writes a film or serves a page, for example; `execute(callback)` does it. The
  shell prints a path that it returns.

    results = rps_jax.Rare("rps_tuned", "wide")()   # or rps_jax.rare("rps_tuned", "wide")
    rps rare --law rps_tuned --domain wide          # from the shell
    rps my_study.py --worlds 8                      # a custom question, from its file

The other classes are base classes with the options that many questions share.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import itertools
import re
import textwrap
import types
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    ParamSpec,
    Self,
    TypeVar,
    get_type_hints,
)

import jax
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.registry import LawLike, LawsLike
from rps_jax.engines import device
from rps_jax.record import cache, files, folder, manifest, options, provenance
from rps_jax.record.bag import TopicsLike
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.robot.robot import Robot, RobotLike, parse_robot
from rps_jax.runs.run import Run
from rps_jax.trials.case import suited_laws
from rps_jax.trials.progress import Bar, ProgressCallback, is_interactive
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import domain as domains
from rps_jax.world.domain import (
    Domain,
    DomainLike,
    name_or_custom,
    task_attribute,
    task_in_words,
)
from rps_jax.world.tasks import Task, TaskLike

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

P = ParamSpec("P")
D = TypeVar("D", bound="DataclassInstance")
T = TypeVar("T", covariant=True)
C = TypeVar("C", bound="Command[object]")
Rows = list[list[str]]  # of a table in a report, with a header


def call_of(command: Callable[P, Command[T]]) -> Callable[P, T]:
    """Return a function with the fields of a command as arguments, which executes it.

    Examples:
      >>> @dataclass(frozen=True)
      ... class CountWorlds(Question[int]):
      ...     worlds: int = option(100, 1)
      ...
      ...     def answer(self, run):
      ...         return self.worlds
      >>> call_of(CountWorlds)(worlds=8)
      8
    """

    @functools.wraps(command, assigned=("__module__", "__doc__"), updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        current: Any = current_names(command, kwargs)
        known = inspect.signature(command).parameters
        for name in current.keys() - known.keys():
            _check_argument(name, known, call.__name__)
        return command(*args, **current)()  # pyright: ignore[reportCallIssue]

    call.__name__ = call.__qualname__ = snake_case(command.__name__)
    call.__doc__ = f"{command.__doc__}\n\nFields of `{command.__name__}` are its arguments.\n"
    help_of_arguments = functools.partial(_document, command, call.__doc__)
    vars(call).update(__signature__=_plain_signature(command), getdoc=help_of_arguments)
    return call


def _plain_signature(command: Any) -> inspect.Signature:
    """Return the signature of a command's function, whose annotations have no declarations."""
    signature = inspect.signature(command)
    declared = {name: x.annotation for name, x in signature.parameters.items()}
    evaluated = {name: x for name, x in declared.items() if not isinstance(x, str)}
    plain = declared | get_type_hints(types.SimpleNamespace(__annotations__=evaluated))
    arguments = [x.replace(annotation=plain[name]) for name, x in signature.parameters.items()]
    answer = inspect.get_annotations(getattr(command, "answer", command)).get("return")
    return signature.replace(parameters=arguments, return_annotation=answer or "Any")


def _document(command: Any, text: str) -> str:
    """Return the documentation of a command's function with its arguments, which IPython shows."""
    rows = (
        f"{name}: {options.help_of(command, name)}"
        for name in inspect.signature(command).parameters
    )
    wrap = functools.partial(textwrap.fill, initial_indent="  ", subsequent_indent="    ")
    return "\n".join([inspect.cleandoc(text), "", "Args:", *map(wrap, rows)])


def _check_argument(name: str, known: Collection[str], function: str) -> None:
    """Raise InputError for an unknown argument of a command's function, with what to write."""
    settings = {x.name: f"Setting({x.name}=...)" for x in fields(Setting)}
    settings |= {x: f"Setting(rules=Rules({x}=...))" for x in Rules._fields}
    if name in settings and "setting" in known:
        text = f"{name} of {function} belongs to its setting: write setting={settings[name]}."
        raise errors.InputError(text)
    errors.check_name(f"argument of {function}", name, known)


def current_names(command: object, values: Mapping[str, T]) -> dict[str, T]:
    """Return values by the present names of fields of a command; warn of former names.

    Raises:
      InputError: a field has been removed.
    """
    current = dict(values)
    for removed, instead in getattr(command, "REMOVED", {}).items():
        if removed in current:
            raise errors.InputError(f"the option {removed} has been removed: {instead}.")
    for former, name in getattr(command, "RENAMED", {}).items():
        if former in current:
            text = f"{former} of {snake_case(command.__name__)} will be removed: write {name}"
            warnings.warn(text, FutureWarning, stacklevel=3)
            current[name] = current.pop(former)
    return current


def snake_case(name: str) -> str:
    """Return `TuneGradients` as `tune_gradients`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


@dataclass(frozen=True, kw_only=True)
class Command(Generic[T]):
    """Base class of all commands: options, their checks, and progress."""

    out: Path | str | None = None
    """Run folder, in the shell by default runs/NAME; a run that was killed is continued there."""
    progress: bool | None = option(None, hidden=True)
    """Whether a bar shows the progress; by default in a terminal and in a notebook."""
    report_to: ProgressCallback | None = option(None, hidden=True)
    """Callback that receives the progress instead of a bar."""

    QUICK: ClassVar[Mapping[str, object]] = {}  # values of `quick`, by the field's name
    REMOVED: ClassVar[Mapping[str, str]] = {}  # what to do instead of former options, by name
    RENAMED: ClassVar[Mapping[str, str]] = {}  # present names of fields by their former ones
    # Fields of a class on which the answer does not depend, beside those of its base classes.
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("out", "progress", "report_to")

    @property
    def name(self) -> str:
        """Name of the command in the shell."""
        return snake_case(type(self).__name__)

    @property
    def default_folder(self) -> Path:
        """Run folder of the shell, if no other is named."""
        return Path(next(filter(None, self.sources), "runs")) / self.name

    @property
    def sources(self) -> Sequence[str | Path]:
        """Run folders that the command reads."""
        return ()

    # --- for subclasses to override --------------------------------------------------------

    def check(self) -> None:
        """Raise InputError for options that types and bounds allow but that make no sense."""

    def quick_values(self) -> Mapping[str, object]:
        """Return the values of `quick`, by the field's name or OWNER.FIELD."""
        return self.QUICK

    def note(self) -> str:
        """Return a line that the shell prints before the run, or nothing."""
        return ""

    def with_faults(self, faults: Sequence[str]) -> Self:
        """Return the command unless the environment has faults, which are sentences."""
        if faults:
            raise errors.InputError(faults[0])
        return self

    def num_trials(self) -> int | None:
        """Return the number of trials, if it is known."""
        return None

    def execute(self, callback: ProgressCallback) -> T:
        """Execute the command with valid options."""
        raise NotImplementedError

    def refuse_options(self, names: Sequence[str]) -> None:
        """Raise InputError for options, or numbers of the setting, that a run determines."""

        def values(source: Any, setting: Setting) -> dict[str, Any]:
            entries = {name: getattr(source, name) for name in names} | vars(setting)
            return entries | entries.pop("rules")._asdict()

        defaults = values(type(self), Setting())
        for name, value in values(self, self._setting or Setting()).items():
            if value != defaults[name]:
                raise errors.not_allowed(name, value, "the run has its own; omit it")

    # --- for callers -----------------------------------------------------------------------

    def __call__(self) -> T:
        """Validate the options, execute the command and return its result.

        Raises:
          InputError: an option is not allowed.
        """
        device.check_process()
        device.check_eager(self.name, vars(self))
        options.check_fields(self)
        with device.standard_jax():
            command = self.with_quick_values()
            command.validate()
            cache.use_cache_if_requested()
            if command.report_to is not None:
                return command.execute(command.report_to)
            with command.progress_bar() as bar:
                return command.execute(bar)

    def validate(self) -> None:
        """Raise InputError for options that are not allowed, before anything is compiled."""
        options.check_fields(self)
        self.check()

    def with_quick_values(self) -> Self:
        """Return the command with the values of `quick`, if it is set, for options at defaults."""
        return self

    def progress_bar(self) -> Bar:
        """Return a bar over the trials."""
        return Bar(self.name, self.num_trials(), shown=self.shows_progress)

    @property
    def shows_progress(self) -> bool:
        """Whether a bar shows the progress."""
        return is_interactive() if self.progress is None else self.progress

    def suits_processors(self) -> bool:
        """Return whether processors finish sooner than a GPU, by engine and number of trials."""
        if self._setting is None or jax.config.jax_platforms:
            return False
        try:
            count = self.num_trials()
        except (errors.InputError, LookupError):  # of options that `validate` refuses
            return False
        return self._setting.simulator.suits_processors(count)

    @property
    def _setting(self) -> Setting | None:
        """Setting of the trials, if a field has it."""
        return next((value for value in vars(self).values() if isinstance(value, Setting)), None)


def quick_command(command: C, changed: C) -> C:
    """Return a changed command with the quick values of another for options at their defaults."""
    default = type(command)()
    for name, value in command.quick_values().items():
        if attrgetter(name)(changed) == attrgetter(name)(default):
            changed = _replace_field(changed, name, value)
    return changed


def _replace_field(record: D, name: str, value: object) -> D:
    """Return a dataclass with another value of a field, or of a field of a field, OWNER.FIELD."""
    owner, _, inner = name.partition(".")
    new = _replace_field(getattr(record, owner), inner, value) if inner else value
    values = {f.name: vars(record)[f.name] for f in fields(record)}  # as the user gave them
    return type(record)(**values | {owner: new})


@dataclass(frozen=True, kw_only=True)
class OutputCommand(Command[T]):
    """Command whose output replaces no other one, unless the user asks for it."""

    overwrite: bool = False
    """Whether an output that `out` already holds is removed first."""

    def conflict(self, out: Path) -> object:
        """Return something true if `out` holds another output, which this one would replace."""
        return out.exists()

    def in_free_place(self) -> Self:
        """Return the command with the first of OUT, OUT-2, ... without another output."""
        first = Path(str(self.out))
        for count in itertools.count(1):
            out = first if count == 1 else first.with_stem(f"{first.stem}-{count}")
            if self.overwrite or not self.conflict(out):
                return self if count == 1 else dataclasses.replace(self, out=out)
        raise AssertionError


@dataclass(frozen=True, kw_only=True)
class Question(OutputCommand[T]):
    """Command with an answer, which is labelled data with a report."""

    TITLE: ClassVar[str] = ""  # of the report
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("overwrite",)
    # Whether the report has the times of all processes of the run.
    REPORTS_TIMES: ClassVar[bool] = False
    # Whether `answer` opens the run folder and stores results.
    STORES_ITSELF: ClassVar[bool] = False

    @property
    def title(self) -> str:
        """Title of the report."""
        return self.TITLE or self.name.replace("_", " ").capitalize()

    # --- for subclasses to override --------------------------------------------------------

    def answer(self, run: Run) -> T:
        """Compute what the run folder lacks, and return labelled data."""
        raise NotImplementedError

    def report(self, results: Any, run: Run) -> Sequence[Section]:  # `Any`: subclasses narrow it
        """Return prose, tables and figures about the answer."""
        return ()

    def intro(self, results: Any) -> str:
        """Return the first paragraph of the report."""
        return ""

    def quick_note(self) -> str:
        """Return the first line of the report of a quick run, or nothing."""
        return ""

    def configuration(self) -> JsonObject:
        """Return everything that the answer depends on, as JSON."""
        return {"question": self.name} | self.fields_as_json()

    def attributes(self) -> dict[str, str | int]:
        """Return the attributes of the results: command, version, seed, engine and domain."""
        setting = {} if self._setting is None else self._setting.attributes
        return {**provenance.attributes(), **setting, **manifest.labels(self)}

    # --- execution -------------------------------------------------------------------------

    def validate(self) -> None:
        super().validate()
        if self.overwrite and self.out is not None:
            out = Path(self.out).resolve()
            if any(Path(x).resolve().is_relative_to(out) for x in self.sources):
                rule = "overwrite would remove the run that is read; choose another folder"
                raise errors.not_allowed("out", self.out, rule)

    def execute(self, callback: ProgressCallback) -> T:
        """Answer the question, and store the results in the run folder if there is one."""
        out = None if self.out is None else Path(self.out)
        if self.overwrite and out is not None:
            folder.remove_run(out)
        if self.STORES_ITSELF:
            return self.answer(self.create_run(out, callback))
        with contextlib.ExitStack() as stack:
            if out is not None:
                stack.enter_context(folder.lock(folder.claim(out, self.configuration())))
                provenance.write_environment(out, device.collect_environment())
            answer = self.answer(self.create_run(out, callback))
            if isinstance(answer, xr.Dataset | xr.DataTree):
                answer.attrs |= self.attributes()
            results = answer if isinstance(answer, xr.Dataset) else getattr(answer, "data", None)
            if out is not None and isinstance(results, xr.Dataset):
                files.write_results(out / "results.nc", results)
            return answer

    def conflict(self, out: Path) -> object:
        return folder.difference(out, self.configuration())

    def create_run(self, out: Path | None, callback: ProgressCallback) -> Run:
        """Return the run folder and the resources of the run."""
        return Run(out, callback)

    def fields_as_json(self) -> JsonObject:
        """Return the fields as JSON, with laws by their parameters and a domain by its ranges."""
        kinds = (vars(kind).get("IGNORED_FIELDS", ()) for kind in type(self).__mro__)
        record = manifest.fields_to_json(self, set(itertools.chain.from_iterable(kinds)))
        # Manifests keep former names, so that runs of earlier versions are continued.
        former = {name: previous for previous, name in self.RENAMED.items()}
        return {former.get(name, name): value for name, value in record.items()}


# --- base classes with shared options ------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class BagQuestion(Question[T]):
    """Base class of questions that read bags."""

    topics: TopicsLike = option((), flag="topic")
    """Topic of a bag that has another name, as odom=/ridgeback/odom; the option may be repeated.
    The keys are odom, target, path, contact, taxels, force, object and cmd_vel. In Python a dict:
    topics={"odom": "/ridgeback/odom"}."""


@dataclass(frozen=True, kw_only=True)
class QuickQuestion(Question[T]):
    """Base class of questions that have a small run."""

    quick: bool = False
    """Whether to make a small run of minutes on two cores; explicit options keep their values."""

    IGNORED_FIELDS = ("quick",)

    def with_quick_values(self) -> Self:
        return quick_command(self, self) if self.quick else self

    def quick_note(self) -> str:
        text = "**This is a quick run**, which tests that the command works here: omit --quick."
        return text * bool(self.quick and self.quick_values())


@dataclass(frozen=True, kw_only=True)
class TrialQuestion(QuickQuestion[T]):
    """Base class of questions that run trials."""

    slots: int | None = option(None, 1, 10_000_000)
    """Number of worlds that one worker steps at once; by default as suits engine and device."""
    workers: int | None = option(None, 1, 1024)
    """Number of host threads that step worlds; by default as suits engine and device."""

    IGNORED_FIELDS = ("slots", "workers")

    def create_run(self, out: Path | None, callback: ProgressCallback) -> Run:
        return Run(out, callback, self.slots, self.workers)


class DefaultLaw(str):
    """Law of a command that names none, unless robot and task need another one."""


class DefaultLaws(tuple[str, ...]):
    """Laws of a command that names none, unless robot and task need others."""


def suit_robot(command: Any, robot: RobotLike | None, task: Task | None = None) -> None:
    """Set what a command does not name: the robot's control period, and laws that suit it.

    `check` refuses other periods.
    """
    if robot is None:
        return
    base = parse_robot(robot)
    if isinstance(setting := getattr(command, "setting", None), Setting):
        object.__setattr__(command, "setting", setting.with_robot(base))
    law, laws = (vars(command).get(name) for name in ("law", "laws"))
    if isinstance(law, DefaultLaw) and (suited := suited_laws(base, task, [law])) != (law,):
        object.__setattr__(command, "law", suited[0])
    if isinstance(laws, DefaultLaws) and (suited := suited_laws(base, task, laws)) != laws:
        object.__setattr__(command, "laws", suited)


@dataclass(frozen=True, kw_only=True)
class SimulationQuestion(TrialQuestion[T]):
    """Base class of questions that run trials with one setting."""

    setting: Setting = Setting()
    """Engine, physics, fidelity, rules and seed of all trials."""

    def __post_init__(self) -> None:
        """Set the control period of the robot, and laws that suit it."""
        suit_robot(self, *self._robot_and_task)

    @property
    def _robot_and_task(self) -> tuple[RobotLike | None, Task | None]:
        return getattr(self, "robot", None), None

    def next_command(self, command: str, **values: object) -> str:
        """Return a command of the shell with values, and with robot, task and physics of this."""
        same = {name: getattr(self, name, None) for name in ("robot", "task")}
        options_ = same | {"physics": vars(self.setting)["physics"]} | values
        words = command.split()
        for name, value in options_.items():
            several = value if isinstance(value, tuple | list) else (value,)
            if all(isinstance(x, str) for x in several) and value != "default":
                words += [f"--{name}", *several]
        return provenance.shell(*words)


@dataclass(frozen=True)
class LawQuestion(SimulationQuestion[T]):
    """Question about one law."""

    law: LawLike = DefaultLaw("rps_tuned")
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json. Without it, another law than the
    default is chosen if robot or goal need one."""

    @functools.cached_property
    def params(self) -> LawParams:
        """Parameters of the law."""
        return registry.check_params(registry.resolve_law(self.law)[1])

    @property
    def label(self) -> str:
        """Name of the law, with its changes."""
        return registry.resolve_law(self.law)[0]


@dataclass(frozen=True)
class MultiLawQuestion(SimulationQuestion[T]):
    """Question about several laws in the same worlds."""

    laws: LawsLike = DefaultLaws(("rps", "rps_tuned"))
    """The laws: names, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow each, as rps,K_h=0.3 or rps,tuned.json. Without it, other laws than
    the default are chosen if robot or goal need them."""

    @functools.cached_property
    def chosen(self) -> dict[str, LawParams]:
        """Parameters of the laws, by label."""
        return registry.resolve_laws(self.laws)


@dataclass(frozen=True, kw_only=True)
class TaskOption:
    """Options of questions about random worlds."""

    robot: RobotLike | None = None
    """The robot: its name, or a JSON file of its size, boards, drive and limits; changes follow,
    as kairos,force_max=300. By default the domain's, which is ideal but in the domain real."""
    task: TaskLike | None = None
    """The task: its name, or a file, as JSON of waypoints or of polygons, or a ROS map.yaml.
    Changes follow, as corridor,width=1.2:1.6. By default the domain's, reach."""

    # They are part of the domain.
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("robot", "task")

    @property
    def _robot_and_task(self) -> tuple[Robot, Task]:
        domain: Any = getattr(self, "domain", "wide")
        first = next(iter(domain), "wide") if isinstance(domain, tuple | list) else domain
        ranges = domains.parse_domain(first, self.robot, self.task)
        return ranges.robot, ranges.task


@dataclass(frozen=True)
class DomainQuestion(TaskOption, SimulationQuestion[T]):
    """Question about random worlds of a domain."""

    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: their name, or a JSON file of ranges. Changes follow, as
    wide,mass=3:10."""

    @functools.cached_property
    def ranges(self) -> Domain:
        """The domain, with robot and task."""
        return domains.parse_domain(self.domain, self.robot, self.task)

    @property
    def worlds_in_words(self) -> str:
        """Domain and task, for reports."""
        return name_or_custom(self.domain) + task_in_words(self.ranges)

    def fields_as_json(self) -> JsonObject:
        return super().fields_as_json() | {"domain": domains.to_json(self.ranges)}

    def attributes(self) -> dict[str, str | int]:
        return super().attributes() | task_attribute(self.ranges)

    def check_engine(self, laws: Sequence[LawParams] = ()) -> None:
        """Raise InputError unless the engine can step these worlds with these laws here."""
        self.setting.check_domain(self.ranges, laws)


# --- small helpers of reports --------------------------------------------------------------


def count_true(mask: np.ndarray) -> int:
    """Return the number of true elements."""
    return int(np.count_nonzero(mask))
