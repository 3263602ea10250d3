"""One loop for all tuners, in a run folder that can be killed and continued."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rps_jax import errors
from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Parts
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Answer, Ask
from rps_jax.runs.objective import Objective
from rps_jax.trials.setting import Progress, Setting
from rps_jax.tuning.space import Space
from rps_jax.world.domain import DOMAINS, Domain


@dataclass(frozen=True)
class Course:
    """The worlds in which candidates are tried, and what is wanted of them there."""

    domains: tuple[Domain, ...] = (DOMAINS["wide"],)
    worlds: int = 512
    """Number of worlds of a generation, in each domain."""
    validation: int = 512
    """Number of worlds for validation, in each domain."""
    setting: Setting = Setting(engine="fused")
    objective: Objective = Objective()

    def __post_init__(self) -> None:
        """Raises InputError for no domain or no worlds."""
        if not self.domains:
            raise errors.InputError("domains = () is not allowed: name at least one.")
        errors.check_finite("worlds", self.worlds, at_least=1, at_most=1e7)
        errors.check_finite("validation", self.validation, at_least=1, at_most=1e7)

    def ask(self, params: Params, seed: int, generation: int) -> Ask:
        """Candidates with leaves (P,) in the worlds of a generation."""
        worlds = generation * self.worlds + np.arange(self.worlds)
        return Ask(params, evaluate.seed_of(seed, "tune"), worlds)

    def validate(self, params: Params, seed: int) -> Ask:
        """Candidates with leaves (P,) in the worlds for validation."""
        return Ask(params, evaluate.seed_of(seed, "validate"), np.arange(self.validation))


Told = dict[str, np.ndarray]  # what was found out about a generation, by name
TryOut = Callable[[list[Ask]], list[Answer]]  # in the worlds of a course


class Tuner(Protocol):
    """A search whose state follows from what it has proposed and what it was told about that.

    Nothing is computed before it begins.
    """

    space: Space
    course: Course
    options: dict[str, Any]  # how it searches, apart from how long, by its name
    generations: int  # after which it ends
    budget: float  # [s] simulated time after which no generation begins; 0: no bound
    best: np.ndarray  # (p,) the vector that validated best

    def begin(self) -> None:
        """Take the place of the start."""
        ...

    def propose(self) -> np.ndarray:
        """The vectors (P, p) of the next generation; asked for once in each generation."""
        ...

    def judge(
        self, vectors: np.ndarray, generation: int, try_out: TryOut
    ) -> tuple[Told, dict[str, Any]]:
        """What trials tell about these vectors, and the tuner's entries in the log."""
        ...

    def learn(self, vectors: np.ndarray, told: Told) -> None:
        """Go on to the next generation."""
        ...


def open_run(folder: Path, tuner: Tuner) -> Path:
    """The folder of a tuner's run; one that holds a run must hold this one, but for its length.

    Raises:
      InputError: it cannot be written, or holds another run.
    """
    space, course = tuner.space, tuner.course
    setting = asdict(course.setting) | {"rules": course.setting.rules._asdict()}
    configuration = {
        "tuned": space.names,
        "base": strategies.recorded(space.base),
        "course": asdict(course) | {"setting": setting},
    }
    return run_folder.claim(folder, configuration | tuner.options)


def tune(
    folder: Path,
    tuner: Tuner,
    *,
    report: Callable[[int, Progress], Any] = lambda generation, progress: None,
    **shape: Any,
) -> Params:
    """Run a tuner to its end, in a folder that `open_run` opened.

    Every generation is a part of the run: the vectors proposed, what the tuner was told, and its
    line of `log.jsonl`. What is there is not tried again: a tuner that is continued proposes the
    same and is told the same, as if it had never been stopped. A part that is damaged is tried
    again. `compile` and `run` [s] of a line are the times of the trials, `simulated` [s] is all
    simulated time. Returns what validated best, as `tuned.json` holds it.

    Raises:
      InputError: the folder holds generations that this tuner does not propose.
    """
    tuner.begin()
    parts, log = Parts(folder), []
    kept = parts.found()
    while (name := f"{len(log):06d}") in kept or (
        len(log) < tuner.generations and not spent(log, tuner.budget)
    ):
        vectors = tuner.propose()
        if name in kept:
            vectors, told, line = _restored(folder, kept[name], vectors)
        else:
            told, line = _tried(tuner, vectors, len(log), report, shape)
            parts.put(name, _encoded(vectors, told, line), ".npz")
        tuner.learn(vectors, told)
        log.append(line)
        if name not in kept:
            _write(folder, tuner, log)
    _write(folder, tuner, log)
    return tuner.space.params(tuner.best)


def _tried(
    tuner: Tuner,
    vectors: np.ndarray,
    generation: int,
    report: Callable[[int, Progress], Any],
    shape: dict[str, Any],
) -> tuple[Told, dict[str, Any]]:
    """What a generation tells, and its line of the log."""
    took = dict.fromkeys(("simulated", "compile", "run"), 0.0)
    course = tuner.course
    where = course.domains, course.setting, course.objective

    def try_out(asks: list[Ask]) -> list[Answer]:
        def tell(progress: Progress) -> None:
            report(generation, progress)

        answers, timing = evaluate.try_out(asks, *where, report=tell, **shape)
        for name in took:
            took[name] += getattr(timing, name)
        return answers

    told, line = tuner.judge(vectors, generation, try_out)
    took["simulated"] += line.pop("simulated", 0.0)
    return told, {"generation": generation} | line | took


def spent(log: Sequence[dict[str, Any]], budget: float) -> bool:
    """Whether the generations of a log have simulated a budget [s]; never one of 0."""
    return 0 < budget <= sum(line["simulated"] for line in log)


def finite(value: Any) -> float | None:
    """A number as JSON has it: None for what is not finite."""
    return float(value) if np.isfinite(value) else None


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's log, one for each generation."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def _write(folder: Path, tuner: Tuner, log: Sequence[dict[str, Any]]) -> None:
    files.write_json(folder / "tuned.json", tuner.space.named(tuner.best))
    files.write_text(folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in log))


def _encoded(vectors: np.ndarray, told: Told, line: dict[str, Any]) -> bytes:
    """The file of a generation."""
    content = io.BytesIO()
    own: dict[str, Any] = {f"told_{name}": value for name, value in told.items()}
    np.savez(content, vectors=vectors, line=np.array(json.dumps(line)), **own)
    return content.getvalue()


def _restored(
    folder: Path, path: Path, proposed: np.ndarray
) -> tuple[np.ndarray, Told, dict[str, Any]]:
    """The vectors of a generation that was tried before, what they told, and the log's line."""
    with np.load(path, allow_pickle=False) as file:
        vectors, line = file["vectors"], json.loads(str(file["line"]))
        told = {n.removeprefix("told_"): file[n] for n in file.files if n.startswith("told_")}
    # Another machine may round otherwise, so the search goes on from what was tried.
    if vectors.shape != proposed.shape or not np.allclose(vectors, proposed, rtol=1e-4, atol=1e-4):
        raise errors.InputError(
            f"run = {folder} cannot be continued: its generation {line['generation']} is not what "
            "this search proposes, so another version made it; choose another folder."
        )
    return vectors, told, line
