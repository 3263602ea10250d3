"""Commands: one declaration makes a function of the package, a shell command and a run folder.

A command is a frozen dataclass. Its fields are the options: annotations are their types, the
strings below them their help, and `option` holds their bounds. There are two kinds:

- `Question`: has an answer, labelled data. `answer(run)` computes it, step by step so that it can
  be resumed, and `report(results, run)` describes it in prose, tables and figures.
- `Action`: does something else, such as write a film or serve a page; `execute(callback)` does it.

    results = rps_jax.Rare("rps_tuned", "wide")()   # or rps_jax.rare("rps_tuned", "wide")
    rps rare --law rps_tuned --domain wide          # from the shell
    rps my_study.py --worlds 8                      # a custom question, from its file

The other classes are base classes with the options that many questions share.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
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
from rps_jax.record import cache, files, folder, options, provenance
from rps_jax.record.bag import TopicsLike
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.robot.robot import RobotLike
from rps_jax.runs.run import Run
from rps_jax.trials.progress import Bar, ProgressCallback, is_interactive
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import domain as domains
from rps_jax.world.domain import Domain, DomainLike
from rps_jax.world.objects import custom_solids, parse_object
from rps_jax.world.tasks import TaskLike, parse_task
from rps_jax.world.tasks.reach import Reach

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

P = ParamSpec("P")
D = TypeVar("D", bound="DataclassInstance")
T = TypeVar("T", covariant=True)
Rows = list[list[str]]  # of a table in a report, with a header
# Options that say how a run is executed; results do not depend on them.
_EXECUTION_OPTIONS = (
    *("out", "overwrite", "bag", "slots", "workers", "quick", "progress", "report_to"),
)


def call_of(command: Callable[P, Command[T]]) -> Callable[P, T]:
    """Return a function with the fields of a command as arguments, which executes it."""

    @functools.wraps(command, assigned=("__module__", "__doc__"), updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return command(*args, **kwargs)()

    call.__name__ = call.__qualname__ = snake_case(command.__name__)
    call.__doc__ = f"{command.__doc__}\n\nFields of `{command.__name__}` are its arguments.\n"
    return call


def snake_case(name: str) -> str:
    """Return `TuneGradients` as `tune_gradients`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


@dataclass(frozen=True, kw_only=True)
class Command(Generic[T]):
    """Base class of questions and actions: options, their checks, and progress."""

    out: Path | str | None = None
    """Run folder, in the shell by default runs/NAME; a run that was killed is continued there."""
    progress: bool | None = option(None, kw_only=True, hidden=True)
    """Whether a bar shows the progress; by default in a terminal and in a notebook."""
    report_to: ProgressCallback | None = option(None, kw_only=True, hidden=True)
    """Callback that receives the progress instead of a bar."""

    QUICK: ClassVar[Mapping[str, Any]] = {}  # values of `quick`, by the field's name

    @property
    def name(self) -> str:
        """Name of the command in the shell."""
        return snake_case(type(self).__name__)

    @property
    def default_folder(self) -> Path:
        """Run folder of the shell, if no other is named."""
        return Path(getattr(self, "run", None) or "runs") / self.name

    # --- for subclasses to override --------------------------------------------------------

    def check(self) -> None:
        """Raise InputError for options that types and bounds allow but that make no sense."""

    def quick_values(self) -> Mapping[str, Any]:
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

    # --- for callers -----------------------------------------------------------------------

    def __call__(self) -> T:
        """Validate the options, execute the command and return its result.

        Raises:
          InputError: an option is not allowed.
        """
        options.check_fields(self)
        device.check_process()
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
        command, default = self, type(self)()
        if getattr(self, "quick", False):
            for name, value in self.quick_values().items():
                if attrgetter(name)(self) == attrgetter(name)(default):
                    command = _replace_field(command, name, value)
        return command

    def progress_bar(self) -> Bar:
        """Return a bar over the trials."""
        return Bar(self.name, self.num_trials(), shown=self.shows_progress)

    @property
    def shows_progress(self) -> bool:
        """Whether a bar shows the progress."""
        return is_interactive() if self.progress is None else self.progress

    def suits_processors(self) -> bool:
        """Return whether processors finish sooner than a GPU, by engine and number of trials."""
        setting = getattr(self, "setting", None)
        if setting is None or jax.config.jax_platforms:
            return False
        return setting.simulator.suits_processors(self.num_trials())


def _replace_field(record: D, name: str, value: object) -> D:
    """Return a dataclass with another value of a field, or of a field of a field, OWNER.FIELD."""
    owner, _, inner = name.partition(".")
    new = _replace_field(getattr(record, owner), inner, value) if inner else value
    values = {f.name: vars(record)[f.name] for f in fields(record)}  # as the user gave them
    return type(record)(**values | {owner: new})


@dataclass(frozen=True, kw_only=True)
class Action(Command[T]):
    """Command that has no report, such as one that writes a film or serves a page.

    The shell prints a path that `execute` returns.
    """


@dataclass(frozen=True, kw_only=True)
class Question(Command[T]):
    """Command with an answer, which is labelled data with a report."""

    overwrite: bool = False
    """Whether a run that the folder already holds is removed first."""

    TITLE: ClassVar[str] = ""  # of the report
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ()  # fields on which the answer does not depend
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
        if not getattr(self, "quick", False) or not self.quick_values():
            return ""
        values = (_value_in_words(name, attrgetter(name)(self)) for name in self.quick_values())
        return (
            f"**This is a quick run** ({'; '.join(values)}). It tests that the command works here; "
            "for results leave out --quick."
        )

    def configuration(self) -> JsonObject:
        """Return everything that the answer depends on, as JSON."""
        return {"question": self.name} | self.fields_as_json()

    def attributes(self) -> dict[str, str | int]:
        """Return the attributes of the results: command, version, seed, engine and domain."""
        record: dict[str, str | int] = {**provenance.attributes()}
        if isinstance(setting := getattr(self, "setting", None), Setting):
            record |= setting.attributes
        if (domain := getattr(self, "domain", None)) is not None:
            several = [domain] if isinstance(domain, str | Domain) else domain
            record["domain"] = " ".join(map(name_or_custom, several))
        ranges = getattr(self, "ranges", None) or next(iter(getattr(self, "domains", ())), None)
        return record | (task_attribute(ranges) if isinstance(ranges, Domain) else {})

    # --- execution -------------------------------------------------------------------------

    def validate(self) -> None:
        super().validate()
        if self.overwrite and self.out is not None:
            sources = [getattr(self, "run", None), *getattr(self, "folders", ())]
            out = Path(self.out).resolve()
            if any(Path(x).resolve().is_relative_to(out) for x in sources if x is not None):
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

    def in_free_folder(self) -> Self:
        """Return the question with the first of the folders OUT, OUT-2, ... without another run."""
        first, configuration = Path(str(self.out)), self.configuration()
        for count in itertools.count(1):
            out = first if count == 1 else first.with_name(f"{first.name}-{count}")
            if self.overwrite or not folder.difference(out, configuration):
                return self if count == 1 else dataclasses.replace(self, out=out)
        raise AssertionError

    def create_run(self, out: Path | None, callback: ProgressCallback) -> Run:
        """Return the run folder and the resources of the run."""
        size = getattr(self, "slots", None), getattr(self, "workers", None)
        return Run(out, callback, *size)

    def fields_as_json(self) -> JsonObject:
        """Return the fields as JSON, with laws by their parameters and a domain by its ranges."""
        names = [f.name for f in fields(self)]
        ignored = [*_EXECUTION_OPTIONS, *self.IGNORED_FIELDS]
        if parse_task(getattr(self, "task", None) or "reach") == Reach():
            ignored.append("task")  # as in the manifests of earlier versions
        record = {name: self._field_as_json(name) for name in names if name not in ignored}
        texts = getattr(self, "object", ""), *getattr(self, "objects", ())
        solids = custom_solids(map(parse_object, texts))
        return record | ({"solids": solids} if solids else {})

    def _field_as_json(self, name: str) -> object:
        value = getattr(self, name)
        if name == "law" and (params := getattr(self, "params", None)) is not None:
            return registry.params_to_json(params)
        if name == "laws" and isinstance(self, MultiLawQuestion):
            return {k: registry.params_to_json(v) for k, v in self.chosen.items()}
        if name == "task":
            return dataclasses.asdict(parse_task(value))
        if name == "domain" and isinstance(value, str | Domain):
            return domains.to_json(domains.parse_domain(value))
        return value.to_json() if isinstance(value, Setting) else options.to_json(value)


# --- base classes with shared options ------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class BagQuestion(Question[T]):
    """Base class of questions that read bags."""

    topics: TopicsLike = option((), kw_only=True, flag="topic")
    """Topic of a bag that has another name, as odom=/ridgeback/odom; the option may be repeated.
    The keys are odom, target, path, contact, taxels, force, object, cmd_vel, tf and tf_static. In
    Python a dict: topics={"odom": "/ridgeback/odom"}."""


@dataclass(frozen=True, kw_only=True)
class TrialQuestion(Question[T]):
    """Base class of questions that run trials."""

    slots: int | None = option(None, 1, 10_000_000, kw_only=True)
    """Number of worlds that one worker steps at once; by default as suits engine and device."""
    workers: int | None = option(None, 1, 1024, kw_only=True)
    """Number of host threads that step worlds; by default as suits engine and device."""
    quick: bool = False
    """Whether to make a small run of minutes on two cores; explicit options keep their values."""


@dataclass(frozen=True, kw_only=True)
class SimulationQuestion(TrialQuestion[T]):
    """Base class of questions that run trials with one setting."""

    setting: Setting = Setting()


@dataclass(frozen=True)
class LawQuestion(SimulationQuestion[T]):
    """Question about one law."""

    law: LawLike = "rps_tuned"
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json."""

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

    laws: LawsLike = ("rps", "rps_tuned")
    """The laws: names, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow each, as rps,K_h=0.3 or rps,tuned.json."""

    @functools.cached_property
    def chosen(self) -> dict[str, LawParams]:
        """Parameters of the laws, by label."""
        return registry.resolve_laws(self.laws)


@dataclass(frozen=True, kw_only=True)
class TaskOption:
    """Options of questions about random worlds."""

    robot: RobotLike | None = None
    """The robot: ideal, slipping, kairos (the paper's), ridgeback, mpo_500 or round; turtlebot4,
    jackal, husky, mir100, pioneer_3dx or f1tenth, which cannot move sideways; or a JSON file of its
    size, boards, drive and limits. By default the domain's, which is ideal but in the domain
    real."""
    task: TaskLike | None = None
    """The task: reach (one target, as in the paper), path (follow a path by a lookahead),
    corridor (a path between walls that end a trial when touched) or rooms (a planned path among the
    obstacles of a map), or a file, as JSON of waypoints or of polygons, or a ROS map.yaml.
    Changes follow, as corridor,width=1.2:1.6. By default the domain's, reach."""


@dataclass(frozen=True)
class DomainQuestion(TaskOption, SimulationQuestion[T]):
    """Question about random worlds of a domain."""

    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, real (wide, but with limited
    robots), prisms or hostile, or a JSON file of ranges. Changes follow, as wide,mass=3:10."""

    @functools.cached_property
    def ranges(self) -> Domain:
        """The domain, with robot and task."""
        return domains.parse_domain(self.domain, self.robot, self.task)

    @property
    def worlds_in_words(self) -> str:
        """Domain and task, for reports."""
        return name_or_custom(self.domain) + task_in_words(self.ranges)

    def fields_as_json(self) -> JsonObject:
        """Return the fields as JSON; robot and task are part of the domain."""
        record = super().fields_as_json() | {"domain": domains.to_json(self.ranges)}
        return {name: x for name, x in record.items() if name not in ("robot", "task")}

    def check_engine(self, laws: Sequence[LawParams] = ()) -> None:
        """Raise InputError unless the engine can step these worlds with these laws here."""
        self.setting.check_domain(self.ranges, laws)


# --- small helpers of reports --------------------------------------------------------------


def _value_in_words(name: str, value: object) -> str:
    """Return the name and the value of an option in words; of rules those that are changed."""
    if isinstance(value, Rules):
        defaults, values = Rules._field_defaults, value._asdict()
        changed = {key: item for key, item in values.items() if item != defaults[key]}
        return "; ".join(itertools.starmap(_value_in_words, changed.items()))
    items = value if isinstance(value, tuple | list) else [value]
    words = (name_or_custom(x) if isinstance(x, Domain) else str(x) for x in items)
    return f"{name.rpartition('.')[2].replace('_', ' ')} {', '.join(words)}"


def name_or_custom(item: object) -> str:
    """Return the name of a domain or a skin, or `custom` if it has none."""
    if isinstance(item, str):
        return item
    return next((name for name, domain in domains.DOMAINS.items() if domain == item), "custom")


def task_attribute(domain: Domain) -> dict[str, str]:
    """Return the task of a domain as an attribute of results; nothing for `reach`."""
    return {} if domain.task == Reach() else {"task": str(domain.task)}


def task_in_words(domain: Domain) -> str:
    """Return the task of a domain for a report, after a comma, without its long fields."""
    text = re.sub("=[^,]{60,}", "=...", str(domain.task))
    return "" if domain.task == Reach() else f", task {text}"


def count_true(mask: np.ndarray) -> int:
    """Return the number of true elements."""
    return int(np.count_nonzero(mask))
