"""What a question is: one declaration, of which call, command, manifest and run folder are made.

A question is a frozen dataclass. Its fields are the options: their annotations are the types, the
strings below them the help, and `option` holds their bounds. It has

    answer(run)           the run, part by part, so that it resumes; returns labelled data
    report(results, run)   the prose, tables and figures about them
    check()               what the fields' types and bounds do not say

    found = rps_jax.Rare("rps_tuned", "wide")()     # or rps_jax.rare("rps_tuned", "wide")
    rps rare --law rps_tuned --domain wide          # from the shell
    rps my_study.py --worlds 8                      # a question of one's own, from its file
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np
import xarray as xr

from rps_jax import engines, errors
from rps_jax.analysis.report import Section
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.registry import LawLike, LawsLike
from rps_jax.engines import device
from rps_jax.record import cache, files, folder, options, provenance
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.options import option
from rps_jax.robot.robot import RobotLike
from rps_jax.trials.batch import BatchOptions
from rps_jax.trials.progress import Bar, ProgressCallback, Timing, is_interactive
from rps_jax.trials.setting import Setting
from rps_jax.world import domain as domains
from rps_jax.world.domain import Domain, DomainLike

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T", covariant=True)
Split = Literal["tune", "validate", "test"]


def seed_of(seed: int, split: Split) -> int:
    """Seed of the worlds of one split: no two splits of any seeds share a world.

    The worlds of a domain that draws little, such as `paper`, hardly depend on the seed.
    """
    splits = ("tune", "validate", "test")
    return len(splits) * seed + splits.index(errors.check_name("split", split, splits))


class StepFormat(NamedTuple, Generic[S]):
    """File format of the results of a loop's steps."""

    encode: Callable[[str, S], bytes]  # name of the step, result -> content
    decode: Callable[[Path, bytes], S]  # path and content -> result; raises InputError
    suffix: str


def _encode_step(name: str, results: xr.Dataset) -> bytes:
    return files.encode_results(results.assign_attrs(part=name))


def _decode_step(path: Path, content: bytes) -> xr.Dataset:
    results = files.decode_results(content, path, signed=True)
    if not path.name.startswith(f"{results.attrs.pop('part', None)}-"):
        raise files.CorruptFileError(path, "it holds another part")
    return results


DATASETS = StepFormat(_encode_step, _decode_step, ".nc")


class Run(NamedTuple):
    """Run folder and resources of one execution of a question, and what the folder already holds.

    A long run is a sequence of steps that are stored as checkpoints, so that it can be killed and
    resumed. `checkpoint` runs one step; `steps` is the loop over numbered steps:

        state = initial
        for state in run.steps(lambda i: next_state(state, i), lambda i: i < 100):
            ...

    Steps in the folder are loaded and not computed again. The loop body must depend on nothing but
    the results of earlier steps, so that a resumed loop continues as if it had never stopped.
    """

    folder: Path | None  # None keeps all results in memory
    callback: ProgressCallback  # called with the progress of the run
    slots: int | None = None  # worlds that one worker steps at once
    workers: int | None = None  # host threads

    @property
    def checkpoints(self) -> Checkpoints | None:
        """Finished steps of the run, if it has a folder."""
        return None if self.folder is None else Checkpoints(self.folder)

    def checkpoint(self, name: str, compute: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return the dataset that is stored under a name; compute and store it if there is none."""
        stored = self.checkpoints
        return compute() if stored is None else stored.load_or_compute(name, compute)

    def steps(
        self,
        compute: Callable[[int], S],
        proceed: Callable[[int], bool],
        *,
        name: str = "{:06d}",
        form: StepFormat[S] = DATASETS,
    ) -> Iterator[S]:
        """Yield the results of the steps 0, 1, ... of a loop, in this order.

        Args:
          compute: returns the result of a step by its index.
          proceed: whether a step is computed if the folder lacks it; if not, the loop ends.
          name: name of a step's checkpoint, with its index.
          form: how a result is stored; by default as a labelled dataset.
        """
        stored = self.checkpoints
        finished = {} if stored is None else stored.paths()
        for index in itertools.count():
            key = name.format(index)
            content = None if stored is None or key not in finished else stored.get(key)
            if content is not None:
                yield form.decode(finished[key], content)
            elif proceed(index):
                result = compute(index)
                if stored is not None:
                    stored.put(key, form.encode(key, result), form.suffix)
                yield result
            else:
                return

    @property
    def batch_options(self) -> BatchOptions:
        """Slots, workers and callback, as keyword arguments of functions that run trials."""
        return BatchOptions(slots=self.slots, workers=self.workers, callback=self.callback)


def call_of(question: Callable[P, Question[T]]) -> Callable[P, T]:
    """Make a function of a question, with its fields as arguments, that returns its answer."""

    @functools.wraps(question, assigned=("__module__", "__doc__"), updated=())
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return question(*args, **kwargs)()

    name = snake_case(question.__name__)
    call.__name__ = call.__qualname__ = name
    call.__doc__ = f"{question.__doc__}\n\nFields of `{question.__name__}` are its arguments.\n"
    return call


def snake_case(name: str) -> str:
    """`TuneGradients` as `tune_gradients`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


@dataclass(frozen=True, kw_only=True)
class Question(Generic[T]):
    """What is asked; each subclass is one question."""

    out: Path | str | None = None
    """Run folder, in the shell by default runs/NAME; a run that was killed is continued there."""
    progress: bool | None = option(None, kw_only=True, hidden=True)
    """Whether a bar shows the progress; by default in a terminal and in a notebook."""
    report_to: ProgressCallback | None = option(None, kw_only=True, hidden=True)
    """What hears of the progress instead of a bar."""

    QUICK: ClassVar[Mapping[str, Any]] = {}  # values of `quick`, by the field's name
    TITLE: ClassVar[str] = ""  # of the report
    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ()  # fields on which the answer does not depend

    @property
    def name(self) -> str:
        """What it is called in the shell."""
        return snake_case(type(self).__name__)

    @property
    def title(self) -> str:
        """Title of the report."""
        return self.TITLE or self.name.replace("_", " ").capitalize()

    @property
    def default_folder(self) -> Path:
        """Run folder of the shell, if no other is named."""
        return Path("runs") / self.name

    # --- what a subclass says ---

    def check(self) -> None:
        """Check what the fields' types and bounds do not say; raises InputError."""

    def answer(self, run: Run) -> T:
        """Run what is missing, and return labelled data."""
        raise NotImplementedError

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """Prose, tables and figures about the answer."""
        return ()

    def intro(self, results: Any) -> str:
        """First paragraph of the report."""
        return ""

    def quick_values(self) -> Mapping[str, Any]:
        """Values of `quick`, by the field's name, or OWNER.FIELD."""
        return self.QUICK

    def note(self) -> str:
        """What the shell says before the run, if anything."""
        return ""

    def num_trials(self) -> int | None:
        """How many trials there are, if that is known."""
        return None

    def configuration(self) -> dict[str, Any]:
        """All that the answer depends on, as JSON."""
        return {"question": self.name} | self.fields_as_json()

    # --- what is made of it ---

    def __call__(self) -> T:
        """Check, run what is missing, and return the answer; InputError for what is not allowed."""
        asked = self.with_quick_values()
        asked.validate()
        cache.use_cache_if_requested()
        if asked.report_to is not None:
            return asked.execute(asked.report_to)
        with asked.progress_bar() as bar:
            return asked.execute(bar)

    def progress_bar(self) -> Bar:
        """A bar over the trials."""
        return Bar(self.name, self.num_trials(), shown=self.shows_progress)

    @property
    def shows_progress(self) -> bool:
        """Whether a bar shows the progress."""
        return is_interactive() if self.progress is None else self.progress

    def suits_processors(self) -> bool:
        """Whether processors answer sooner than a GPU, by the engine and the number of trials."""
        import jax

        setting = getattr(self, "setting", None)
        if setting is None or jax.config.jax_platforms:
            return False
        return engines.get(setting.engine).suits_processors(self.num_trials())

    def with_quick_values(self) -> Self:
        """Return the question with the values of `quick`, if asked, for fields at their default."""
        question, default = self, type(self)()
        if getattr(self, "quick", False):
            for name, value in self.quick_values().items():
                if attrgetter(name)(self) == attrgetter(name)(default):
                    question = _replace_field(question, name, value)
        return question

    def quick_defaults(self) -> Self:
        """Return the question with all options at their defaults, but for the values of `quick`."""
        return functools.reduce(
            lambda question, change: _replace_field(question, *change),
            self.quick_values().items(),
            type(self)(),
        )

    def validate(self) -> None:
        """Raises InputError for what is not allowed, before anything is compiled or written."""
        options.check_fields(self)
        self.check()

    def execute(self, callback: ProgressCallback) -> T:
        """The answer, kept in the run folder if there is one."""
        with self.open_folder() as out:
            found = self.answer(self.create_run(out, callback))
            data = found if isinstance(found, xr.Dataset) else getattr(found, "data", None)
            if out is not None and isinstance(data, xr.Dataset):
                files.write_results(out / "results.nc", data)
            return found

    def create_run(self, out: Path | None, callback: ProgressCallback) -> Run:
        """Where and how the answer is made."""
        return Run(out, callback)

    @contextlib.contextmanager
    def open_folder(self) -> Iterator[Path | None]:
        """The run folder, new or to be continued, in use."""
        if self.out is None:
            yield None
            return
        out = folder.claim(Path(self.out), self.configuration())
        with folder.lock(out):
            provenance.write_environment(out, device.collect_environment())
            yield out

    def fields_as_json(self) -> dict[str, Any]:
        """Own fields as JSON, with laws by their parameters and a domain by its ranges."""
        found: dict[str, Any] = {}
        for one in fields(self):
            if one.name in (*_NOT_ASKED, *self.IGNORED_FIELDS):
                continue
            value = getattr(self, one.name)
            if one.name == "law" and (params := getattr(self, "params", None)) is not None:
                value = registry.params_to_json(params)
            elif one.name == "laws" and isinstance(self, MultiLawQuestion):
                value = {k: registry.params_to_json(v) for k, v in self.chosen.items()}
            elif one.name == "domain" and isinstance(value, str | Domain):
                value = dataclasses.asdict(domains.parse_domain(value))
            elif one.name == "setting":
                value = setting_as_json(value)
            else:
                value = options.to_json(value)
            found[one.name] = value
        return found


_NOT_ASKED = (
    "out",
    "bag",
    "slots",
    "workers",
    "quick",
    "progress",
    "report_to",
)


def _replace_field(record: Any, name: str, value: object) -> Any:
    """Return a dataclass with another value of a field, or of a field of a field, OWNER.FIELD."""
    owner, _, inner = name.partition(".")
    new = _replace_field(getattr(record, owner), inner, value) if inner else value
    values = {one.name: vars(record)[one.name] for one in fields(record)}  # as they were given
    return type(record)(**values | {owner: new})


def setting_as_json(setting: Setting) -> dict[str, Any]:
    """A setting as manifests have it."""
    return {
        "engine": setting.engine,
        "physics": dataclasses.asdict(setting.physics),
        "rules": registry.leaves_to_json(setting.rules),
        "seed": setting.seed,
    }


# --- what many questions ask about ---------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TrialQuestion(Question[T]):
    """Base class of questions that run trials."""

    slots: int | None = option(None, 1, 10_000_000, kw_only=True)
    """Number of worlds that one worker steps at once; by default as suits engine and device."""
    workers: int | None = option(None, 1, 1024, kw_only=True)
    """Number of host threads that drive worlds; by default as suits engine and device."""
    quick: bool = False
    """Whether to make a small run of minutes on two cores: what is not asked for becomes small."""

    def create_run(self, out: Path | None, callback: ProgressCallback) -> Run:
        return Run(out, callback, self.slots, self.workers)


@dataclass(frozen=True, kw_only=True)
class SimulationQuestion(TrialQuestion[T]):
    """Base class of questions that run trials with one setting."""

    setting: Setting = Setting()


@dataclass(frozen=True)
class LawQuestion(SimulationQuestion[T]):
    """A question about one law."""

    law: LawLike = "rps_tuned"
    """The law: its name, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow, as rps,K_h=0.3 or rps,tuned.json."""

    @functools.cached_property
    def params(self) -> LawParams:
        """Parameters of the law."""
        return registry.check_params(registry.resolve_law(self.law)[1])

    @property
    def label(self) -> str:
        """What the law is called."""
        return registry.resolve_law(self.law)[0]


@dataclass(frozen=True)
class MultiLawQuestion(SimulationQuestion[T]):
    """A question about several laws, which all meet the same worlds."""

    laws: LawsLike = ("rps", "rps_tuned")
    """The laws: names, as rps, rps_tuned or rps_plus, or a file's, as my_law.py:MyParams or
    policy.npz; changes follow each, as rps,K_h=0.3 or rps,tuned.json."""

    @functools.cached_property
    def chosen(self) -> dict[str, LawParams]:
        """Parameters of the laws, by label."""
        return registry.resolve_laws(self.laws)


@dataclass(frozen=True)
class DomainQuestion(SimulationQuestion[T]):
    """A question about random worlds."""

    domain: DomainLike = "wide"
    """Ranges from which worlds are drawn: paper, hardware, wide, real (wide, but with limited
    robots), prisms or hostile, or a JSON file of ranges. Changes follow, as wide,mass=3:10."""
    robot: RobotLike | None = field(default=None, kw_only=True)
    """The robot: ideal, kairos (the paper's), ridgeback or mpo_500, or a JSON file of its size,
    boards and limits. By default the domain's, which is ideal but in the domain real."""

    @functools.cached_property
    def ranges(self) -> Domain:
        """The domain, with the robot."""
        return domains.parse_domain(self.domain, self.robot)

    def fields_as_json(self) -> dict[str, Any]:
        """Own fields as JSON; the robot stands in the domain."""
        found = super().fields_as_json() | {"domain": dataclasses.asdict(self.ranges)}
        del found["robot"]
        return found

    def check_engine(self, laws: Sequence[LawParams] = ()) -> None:
        """Raises InputError unless the engine can step these worlds with these laws here."""
        self.setting.check_here(self.ranges.weakest, laws)


def timing_line(timing: Timing, device: str) -> str:
    """Where the time of a run went, in a line."""
    rate = timing.simulated / max(timing.run, 1e-9)
    return (
        f"compile {timing.compile:.1f} s, run {timing.run:.1f} s ({rate:.0f} simulated s per s) on "
        f"{device}"
    )


def with_coordinates(results: xr.Dataset) -> xr.Dataset:
    """Results with names for the numbers of a pose, and what was drawn as coordinates of worlds."""
    if "pose" in results.dims:
        results = results.assign_coords(pose=["x", "y", "yaw"])
    return results.set_coords([name for name in results if results[name].dims == ("world",)])


def name_or_custom(given: object) -> str:
    """What a domain or a skin is called."""
    return given if isinstance(given, str) else "of one's own"


def count_true(mask: np.ndarray) -> int:
    """How many are true."""
    return int(np.count_nonzero(mask))
