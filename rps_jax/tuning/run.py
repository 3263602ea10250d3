"""Base of the tuning commands: their common options, the interface of a search, and its loop.

`Problem` holds the worlds and the objective. `Tuner` is the interface of a search, such as an
evolution or a gradient descent. `Tuning` holds the options and the report of `TuneES` and
`TuneGrad`. `tune` runs a tuner and checkpoints every generation, so a killed run resumes.
"""

from __future__ import annotations

import functools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, SupportsFloat

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import LawParams
from rps_jax.control.registry import LawLike
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import LawQuestion, Run, seed_of
from rps_jax.runs.run import StepFormat
from rps_jax.trials.progress import Bar, Progress
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning.space import Space, expand_subsets
from rps_jax.world.domain import DOMAINS, Domain, DomainLike, parse_domain

TUNED = "tuned.json"  # file of a run folder: the parameters with the best validation
UNITS = {"compile": "s", "run": "s", "simulated": "s", "differentiate": "s"}

Metrics = dict[str, np.ndarray]  # results of a generation's trials, by name
LogLine = dict[str, Any]  # line of `log.jsonl`: numbers or None by name, and `params` by name
ScoreCandidates = Callable[
    [list[Candidates]], list[CandidateScores]
]  # runs candidates in the worlds of a problem


@dataclass(frozen=True)
class Problem:
    """Worlds in which candidates are tried, and the objective that is minimised there."""

    domains: tuple[Domain, ...] = (DOMAINS["wide"],)
    worlds: int = 512  # of a generation, in each domain
    validation: int = 512  # worlds for validation, in each domain
    setting: Setting = Setting()
    objective: Objective = Objective()

    def ask(self, params: LawParams, seed: int, generation: int) -> Candidates:
        """Return candidates with leaves (P,) and the worlds of a generation."""
        worlds = generation * self.worlds + np.arange(self.worlds)
        return Candidates(params, self.domains, seed_of(seed, "tune"), worlds)

    def validate(self, params: LawParams, seed: int) -> Candidates:
        """Return candidates with leaves (P,) and the worlds for validation."""
        worlds = np.arange(self.validation)
        return Candidates(params, self.domains, seed_of(seed, "validate"), worlds)


class Tuner(ABC):
    """Search for the vector (p,) of parameters with the least objective, in generations.

    Its state depends on nothing but the vectors (P, p) of all generations and their metrics, so a
    resumed run restores the state from these.
    """

    def __init__(self, tuning: Tuning, generations: int):
        self.space, self.problem = tuning.space, tuning.problem
        self.generations, self.budget = generations, tuning.budget  # maximum; [s] simulated
        self.seed = tuning.setting.seed

    def start(self) -> None:
        """Start, or restart, the search at the base parameters of the space."""
        self.base = self.best = np.asarray(self.space.vector(self.space.base), float)  # (p,)
        self.best_value = np.inf  # [1] validation of `best`

    @abstractmethod
    def propose(self) -> np.ndarray:
        """Return the vectors (P, p) of the next generation."""

    @abstractmethod
    def shapes(self, vectors: np.ndarray, generation: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the metrics of a generation."""

    @abstractmethod
    def judge(
        self, vectors: np.ndarray, generation: int, score_candidates: ScoreCandidates
    ) -> tuple[Metrics, LogLine]:
        """Try the vectors of a generation in worlds; return their metrics and the log's line."""

    @abstractmethod
    def update(self, vectors: np.ndarray, metrics: Metrics) -> None:
        """Advance the search by the metrics of a generation."""

    def record_best(self, vector: np.ndarray, value: float) -> bool:
        """Store a vector if its validation is the best so far; return whether it is."""
        if better := value < self.best_value:
            self.best, self.best_value = vector, value
        return better


@dataclass(frozen=True)
class Tuning(LawQuestion[xr.Dataset]):
    """Base of the questions for better parameters of a law."""

    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("budget", "generations")
    QUICK: ClassVar[dict[str, Any]] = {
        # The few parameters that matter most, since few trials cannot determine more; cylinders on
        # the quasi-static model, which compile and run fastest.
        "tuned": ("K_h", "K_v", "l_cr", "d_th"),
        "objects": ("random_cylinder",),
        "setting.engine": "quasistatic",
        "setting.rules": Rules(horizon=150.0),
        "validation": 64,
        "slots": 64,
    }

    law: LawLike = "rps"
    """Law with the initial parameters: a name, as rps, rps_tuned or rps_plus, or a file's class
    with bounds, as my_law.py:MyParams; changes follow, as rps,K_h=0.3 or rps,tuned.json. Gradients
    need a law with a smooth form: rps or rps_plus."""
    domain: Sequence[DomainLike] = ("wide",)
    """Domains to tune in: paper, hardware, wide, real, prisms, hostile, or JSON files of ranges;
    changes follow each, as wide,mass=3:10."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects of these domains; random_prism is held out by default."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to tune: names, or logistic (eta, zeta, beta, k), or full (all parameters of the
    law, but not the robot's speeds, the rules or the switches)."""
    worlds: int = option(512, 1, 10_000_000)
    """Number of worlds of each candidate, in each domain; every generation has other worlds."""
    validation: int = option(512, 1, 10_000_000)
    """Number of worlds for validation, in each domain."""
    objective: Objective = Objective()
    budget: float = option(0.0, 0, unit="s")
    """Simulated time after which no generation starts [s]; 0 means no limit."""

    @property
    def title(self) -> str:
        return f"{self.label}, tuned"

    @functools.cached_property
    def space(self) -> Space:
        """Space of the tuned parameters."""
        return Space(expand_subsets(self.tuned, self.params), self.params)

    @functools.cached_property
    def problem(self) -> Problem:
        """Worlds in which candidates are tried, and the objective."""
        ranges = tuple(replace(d, objects=self.objects) for d in parse_domains(self.domain))
        errors.check_each_once("domain", ranges)
        return Problem(ranges, self.worlds, self.validation, self.setting, self.objective)

    @functools.cached_property
    def tuner(self) -> Tuner:
        """Search of this command."""
        raise NotImplementedError

    def quick_values(self) -> Mapping[str, Any]:
        """Values of `quick`; its choice of parameters is for RPS alone."""
        is_rps = isinstance(self.params, type(registry.LAWS["rps"]))
        return {k: v for k, v in self.QUICK.items() if k != "tuned" or is_rps}

    def check(self) -> None:
        errors.check_count("seed", self.setting.seed, at_least=0, at_most=2**30)
        if not registry.law_of(self.params).bounds:
            names = [n for n, params in registry.LAWS.items() if registry.law_of(params).bounds]
            raise errors.InputError(
                f"law = {self.label} is not allowed: its parameters have no bounds; choose from "
                f"{', '.join(names)}."
            )
        for domain in self.problem.domains:
            self.setting.check_here(domain.weakest, [self.space.base])
        _ = self.tuner

    def fields_as_json(self) -> dict[str, Any]:
        """Fields as JSON, with the names of all tuned parameters and the ranges of all domains."""
        ranges = [asdict(domain) for domain in self.problem.domains]
        return super().fields_as_json() | {"tuned": self.space.names, "domain": ranges}

    def progress_bar(self) -> Bar:
        name, count = self.name.replace("_", " "), self.tuner.generations
        return Bar(name, count, "generations", shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        return label_log(tune(run, self.tuner), self.tuner)

    def intro(self, results: xr.Dataset) -> str:
        names = ", ".join(self.space.names)
        return (
            f"{self.label}: {names}; {self.worlds} worlds of each generation and "
            f"{self.validation} for validation, engine {self.setting.engine}."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        best = int(results.validation.argmin("generation"))
        rates = [tables.percent(float(rate)) for rate in results.validation_success.values]
        total = {name: float(results[name].sum()) for name in ("compile", "run", "simulated")}
        gradients = ""
        if "differentiate" in results:
            seconds = float(results["differentiate"].sum())  # `results.differentiate` is a method
            gradients = f", gradients {seconds:.1f} s with their compilation"
        text = (
            f"Validation: objective {float(results.validation[0]):.4f} and success {rates[0]} % "
            f"at the start, {float(results.validation[best]):.4f} and {rates[best]} % after "
            f"{best} of {results.sizes['generation']}. Compile {total['compile']:.1f} s, run "
            f"{total['run']:.1f} s{gradients}, {total['simulated']:.3g} s simulated."
        )
        if run.folder is not None:
            text += f" The law with these parameters is `{self.label},{run.folder / TUNED}`."
        rows = [["parameter", "start", "tuned"]]
        start = registry.named_leaves(self.space.base)
        for name, value in zip(results.parameter.values, results.tuned.values, strict=True):
            rows.append([str(name), f"{float(start[str(name)]):.4g}", f"{float(value):.4g}"])
        picture = Picture("tuning", partial(figures.search, results))
        return [Section("Results", text, rows, picture)]


def parse_domains(domain: DomainLike | Sequence[DomainLike]) -> tuple[Domain, ...]:
    """Return one or several domains by their names, files or ranges."""
    several = [domain] if isinstance(domain, str | Domain) else domain
    return tuple(map(parse_domain, several))


def label_log(log: Sequence[LogLine], tuner: Tuner) -> xr.Dataset:
    """Return the log (generation), with the parameters of all generations and the tuned ones."""
    names = list(tuner.space.names)
    frame = pd.DataFrame(log).drop(columns=["generation", "params"]).astype(float)
    columns: dict[str, Any] = {
        str(key): ("generation", values.to_numpy(), {"units": UNITS.get(str(key), "1")})
        for key, values in frame.items()
    }
    params = [[line["params"][name] for name in names] for line in log]
    columns["params"] = (("generation", "parameter"), np.array(params, float))
    best = registry.named_leaves(tuner.space.params(tuner.best))
    columns["tuned"] = ("parameter", np.array([float(best[name]) for name in names]))
    return xr.Dataset(columns, {"generation": np.arange(len(log)), "parameter": names})


class Generation(NamedTuple):
    """Vectors of a generation with their metrics and its line of the log; one checkpoint."""

    vectors: np.ndarray  # (P, p)
    metrics: Metrics
    line: LogLine
    is_new: bool = True  # computed in this process, not restored

    def encode(self) -> bytes:
        """Return the content of the checkpoint."""
        arrays = {f"metric_{key}": value for key, value in self.metrics.items()}
        line = np.array(json.dumps(self.line))
        return files.encode_arrays(vectors=self.vectors, line=line, **arrays)


def tune(run: Run, tuner: Tuner) -> list[LogLine]:
    """Run a tuner to its end, in a run folder or in memory, and return its log.

    Every generation is a checkpoint. A resumed tuner proposes the same vectors again and reads
    their metrics from the checkpoints; a damaged checkpoint is computed again. In a line of the
    log, `compile` and `run` [s] are the wall clock of the trials, and `simulated` [s] is the total
    simulated time of the generation.

    Raises:
      InputError: the folder has generations that this tuner does not propose.
    """
    tuner.start()
    log: list[LogLine] = []
    simulated = 0.0

    def report(progress: Progress) -> None:
        total = simulated + progress.simulated
        run.callback(replace(progress, simulated=total, rounds=len(log)))

    def proceed(generation: int) -> bool:
        return generation < tuner.generations and not 0 < tuner.budget <= simulated

    def compute(generation: int) -> Generation:
        return _try_generation(tuner, generation, run._replace(callback=report))

    def restore(path: Path, content: bytes) -> Generation:
        return _restore(tuner, len(log), path, content)

    form = StepFormat(lambda _, generation: generation.encode(), restore, ".npz")
    for generation in run.steps(compute, proceed, form=form):
        tuner.update(generation.vectors, generation.metrics)
        log.append(generation.line)
        simulated += generation.line["simulated"]
        run.callback(Progress(0, simulated, rounds=len(log)))
        if generation.is_new and run.folder is not None:
            _write(run.folder, tuner, log)
    if run.folder is not None:
        _write(run.folder, tuner, log)
    return log


def _try_generation(tuner: Tuner, generation: int, run: Run) -> Generation:
    """Propose and try the vectors of a generation."""
    times = dict.fromkeys(("simulated", "compile", "run"), 0.0)  # [s]
    problem = tuner.problem

    def score_candidates(candidates: list[Candidates]) -> list[CandidateScores]:
        scores, timing = evaluate.score_candidates(
            candidates, problem.setting, problem.objective, **run.batch_options
        )
        for name in times:
            times[name] += getattr(timing, name)
        return scores

    vectors = tuner.propose()
    metrics, line = tuner.judge(vectors, generation, score_candidates)
    times["simulated"] += line.pop("simulated", 0.0)
    return Generation(vectors, metrics, {"generation": generation} | line | times)


def finite(value: SupportsFloat) -> float | None:
    """Return a number for JSON: None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def _write(folder: Path, tuner: Tuner, log: Sequence[LogLine]) -> None:
    """Write the tuned parameters, and the log as JSON lines and as a table."""
    files.write_json(folder / TUNED, tuner.space.changed_values(tuner.best))
    files.write_text(folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in log))
    rows = [line | {f"params.{k}": v for k, v in line["params"].items()} for line in log]
    columns = [{key: row[key] for key in row if key != "params"} for row in rows]
    files.write_csv(folder / "curve.csv", columns)


def _check_line(line: object, names: Sequence[str]) -> None:
    """Raise ValueError or KeyError unless this is a line of a log with these parameters."""
    if not (isinstance(line, dict) and isinstance(line["params"], dict)):
        raise ValueError("its line has no names with values")
    values = {name: value for name, value in line.items() if name != "params"} | line["params"]
    for name, value in values.items():
        if value is not None:
            errors.check_number(f"{name} of its line", value)
    for name in ("simulated", "compile", "run", "validation", "validation_success", *names):
        if values[name] is None and name != "validation":
            raise ValueError(f"its line has no {name}")


def _restore(tuner: Tuner, generation: int, path: Path, content: bytes) -> Generation:
    """Return a generation from its checkpoint; the tuner proposes it again for comparison."""
    proposal = tuner.propose()
    try:
        arrays = files.decode_arrays(content)
        line = files.parse_json(str(arrays.pop("line")))
        _check_line(line, tuner.space.names)
    except (ValueError, KeyError) as error:
        raise files.CorruptFileError(path, error) from error
    vectors = arrays.pop("vectors", np.empty(0))
    metrics = {name.removeprefix("metric_"): values for name, values in arrays.items()}
    shapes = {name: values.shape for name, values in metrics.items() if values.dtype.kind == "f"}
    if shapes != tuner.shapes(proposal, generation):
        raise files.CorruptFileError(path, "its arrays are not of this search")
    # The tolerance allows for other rounding on another machine; the search uses the vectors that
    # were tried.
    if (
        vectors.dtype.kind != "f"
        or vectors.shape != proposal.shape
        or not np.allclose(vectors, proposal, rtol=1e-4, atol=1e-4)
    ):
        raise errors.InputError(
            f"run = {path.parent.parent} cannot be resumed: its generation {generation} differs "
            "from the one that this search proposes; another version wrote it. Choose another "
            "folder."
        )
    return Generation(vectors, metrics, line, is_new=False)
