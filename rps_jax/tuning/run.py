"""One loop for all tuners, part by part, so that a run can be killed and continued."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

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
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.options import option
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import LawQuestion, Run, seed_of
from rps_jax.trials.progress import Bar, Progress
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.tuning.space import Space, expanded
from rps_jax.world import domain as worlds_
from rps_jax.world.domain import DOMAINS, Domain, DomainLike

Metrics = dict[str, np.ndarray]  # results of the trials of a generation, by name
LogLine = dict[str, Any]  # a line of `log.jsonl`: numbers or None by name, and `params` by name
ScoreCandidates = Callable[[list[Candidates]], list[CandidateScores]]  # in the worlds of a problem


@dataclass(frozen=True)
class Problem:
    """The worlds in which candidates are tried, and what is minimised there."""

    domains: tuple[Domain, ...] = (DOMAINS["wide"],)
    worlds: int = 512  # of a generation, in each domain
    validation: int = 512  # worlds for validation, in each domain
    setting: Setting = Setting()
    objective: Objective = Objective()

    def ask(self, params: LawParams, seed: int, generation: int) -> Candidates:
        """Candidates with leaves (P,) in the worlds of a generation."""
        worlds = generation * self.worlds + np.arange(self.worlds)
        return Candidates(params, seed_of(seed, "tune"), worlds)

    def validate(self, params: LawParams, seed: int) -> Candidates:
        """Candidates with leaves (P,) in the worlds for validation."""
        return Candidates(params, seed_of(seed, "validate"), np.arange(self.validation))


class Tuner(Protocol):
    """Search for parameters: one generation after another is proposed, judged and used.

    Its state follows from the vectors (P, p) of all generations and from their metrics.
    """

    space: Space
    problem: Problem
    generations: int  # number of generations, at most
    budget: float  # [s] simulated time after which no generation begins; 0: no bound
    best: np.ndarray  # (p,) vector with the best validation

    def begin(self) -> None:
        """Reset the search to its start; nothing is computed before."""

    def propose(self) -> np.ndarray:
        """Return the vectors (P, p) of the next generation."""
        ...

    def shapes(self, vectors: np.ndarray, generation: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of a generation's metrics."""
        ...

    def judge(
        self, vectors: np.ndarray, generation: int, score_candidates: ScoreCandidates
    ) -> tuple[Metrics, LogLine]:
        """Try the vectors of a generation; return its metrics and its line of the log."""
        ...

    def update(self, vectors: np.ndarray, metrics: Metrics) -> None:
        """Advance the search by the metrics of a generation."""


@dataclass(frozen=True)
class Tuning(LawQuestion[xr.Dataset]):
    """A question for better parameters of a law."""

    IGNORED_FIELDS: ClassVar[tuple[str, ...]] = ("budget", "generations")
    QUICK: ClassVar[dict[str, Any]] = {
        # Few parameters, those that matter most, since few trials tell no more; and cylinders on
        # the quasi-static model, which compile and run fastest.
        "tuned": ("K_h", "K_v", "l_cr", "d_th"),
        "objects": ("random_cylinder",),
        "setting.engine": "quasistatic",
        "setting.rules": Rules(horizon=150.0),
        "validation": 64,
        "slots": 64,
    }

    law: LawLike = "rps"
    """The law, with the parameters to begin with: its name, as rps, rps_tuned or rps_plus, or a
    file's with bounds, as my_law.py:MyParams; changes follow, as rps,K_h=0.3 or rps,tuned.json.
    Gradients are of laws with a smooth form, rps and rps_plus."""
    domain: Sequence[DomainLike] = ("wide",)
    """Domains to tune in: paper, hardware, wide, real, prisms, hostile, or JSON files of ranges;
    changes follow each, as wide,mass=3:10."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects of these domains; random_prism is held out by default."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to tune: names, or logistic (eta, zeta, beta, k), or full (all that are the
    law's, not the robot's speeds, the rules or the switches)."""
    worlds: int = option(512, 1, 10_000_000)
    """Number of worlds that each candidate meets, in each domain; every generation has its own."""
    validation: int = option(512, 1, 10_000_000)
    """Number of worlds for validation, in each domain."""
    objective: Objective = Objective()
    budget: float = option(0.0, 0, unit="s")
    """Simulated time after which no generation begins [s]; 0 stands for no bound."""

    @property
    def title(self) -> str:
        return f"{self.label}, tuned"

    @functools.cached_property
    def space(self) -> Space:
        """The parameters that are tuned."""
        return Space(expanded(self.tuned, self.params), self.params)

    @functools.cached_property
    def problem(self) -> Problem:
        """The worlds in which candidates are tried, and what is minimised there."""
        one = isinstance(self.domain, str | Domain)
        several: list[Any] = [self.domain] if one else list(self.domain)
        domains = tuple(replace(worlds_.parse_domain(x), objects=self.objects) for x in several)
        errors.check_each_once("domain", domains)
        return Problem(domains, self.worlds, self.validation, self.setting, self.objective)

    @functools.cached_property
    def tuner(self) -> Tuner:
        """The search."""
        raise NotImplementedError

    def quick_values(self) -> Mapping[str, Any]:
        """Values of `quick`; which parameters matter is known of RPS alone."""
        own = registry.LAWS["rps"]
        alike = isinstance(self.params, type(own))
        return {k: v for k, v in self.QUICK.items() if k != "tuned" or alike}

    def check(self) -> None:
        errors.check_count("seed", self.setting.seed, at_least=0, at_most=2**30)
        known = [n for n, own in registry.LAWS.items() if registry.law_of(own).bounds]
        if not registry.law_of(self.params).bounds:
            raise errors.InputError(
                f"law = {self.label} is not allowed: it has no bounds to tune within; "
                f"{', '.join(known)} have."
            )
        for one in self.problem.domains:
            self.setting.check_here(one.weakest, [self.space.base])
        _ = self.tuner

    def fields_as_json(self) -> dict[str, Any]:
        """Own fields as JSON, with all that is tuned, and domains by their ranges."""
        ranges = [asdict(one) for one in self.problem.domains]
        return super().fields_as_json() | {"tuned": self.space.names, "domain": ranges}

    def progress_bar(self) -> Bar:
        name, count = self.name.replace("_", " "), self.tuner.generations
        return Bar(name, count, "generations", shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        log = tune(
            run.folder, self.tuner, callback=run.callback, slots=run.slots, workers=run.workers
        )
        return labelled(log, self.tuner)

    def intro(self, results: xr.Dataset) -> str:
        names = ", ".join(self.space.names)
        return (
            f"{self.label}: {names}; {self.worlds} worlds of each generation and "
            f"{self.validation} for validation, engine {self.setting.engine}."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        best = int(results.validation.argmin("generation"))
        rate = [tables.percent(float(won)) for won in results.validation_success.values]
        total = {name: float(results[name].sum()) for name in ("compile", "run", "simulated")}
        grad = ""
        if "differentiate" in results:
            took = float(results["differentiate"].sum())  # `found.differentiate` is a method
            grad = f", gradients {took:.1f} s with their compilation"
        text = (
            f"Validation: objective {float(results.validation[0]):.4f} and success {rate[0]} % "
            f"at the start, {float(results.validation[best]):.4f} and {rate[best]} % after "
            f"{best} of {results.sizes['generation']}. Compile {total['compile']:.1f} s, run "
            f"{total['run']:.1f} s{grad}, {total['simulated']:.3g} s simulated."
        )
        if run.folder is not None:
            text += f" The law with these parameters is `{self.label},{run.folder / TUNED}`."
        rows = [["parameter", "start", "tuned"]]
        start = registry.named_leaves(self.space.base)
        for name, value in zip(results.parameter.values, results.tuned.values, strict=True):
            rows.append([str(name), f"{float(start[str(name)]):.4g}", f"{float(value):.4g}"])
        picture = Picture("tuning", partial(figures.search, results))
        return [Section("What was found", text, rows, picture)]


TUNED = "tuned.json"  # in a run folder: the parameters that validated best


def labelled(log: Sequence[Mapping[str, Any]], tuner: Tuner) -> xr.Dataset:
    """The log of a run (generation), and the parameters of each and at last (parameter)."""
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


UNITS = {"compile": "s", "run": "s", "simulated": "s", "differentiate": "s"}


def tune(
    folder: Path | None,
    tuner: Tuner,
    *,
    callback: Callable[[Progress], Any] = lambda progress: None,
    **shape: Any,
) -> list[dict[str, Any]]:
    """Run a tuner to its end, in a folder in which it can be continued, or in memory.

    A tuner is a search whose state follows from the vectors (P, p) that it has proposed, once in
    each generation, and from their metrics. Nothing is computed before it begins.

    Every generation is a part of the run: the vectors proposed, their metrics, and its line of
    `log.jsonl`. What is there is not tried again: a tuner that is continued proposes what it did
    and is given what it was, as if it had never been stopped. A part that is damaged is tried
    again. `compile` and `run` [s] of a line are the times of the trials, `simulated` [s] is all
    simulated time. Returns the log; `tuner.best` is what validated best.

    Raises:
      InputError: the folder holds generations that this tuner does not propose.
    """
    tuner.begin()
    parts, log = None if folder is None else Checkpoints(folder), []
    kept = {} if parts is None else parts.paths()
    simulated = 0.0

    def heard(progress: Progress) -> None:
        callback(replace(progress, simulated=simulated + progress.simulated, rounds=len(log)))

    while (name := f"{len(log):06d}") in kept or (
        len(log) < tuner.generations and not 0 < tuner.budget <= simulated
    ):
        vectors = tuner.propose()
        if name in kept:
            vectors, metrics, line = _restored(tuner, kept[name], vectors, len(log))
        else:
            metrics, line = _tried(tuner, vectors, len(log), heard, shape)
            if parts is not None:
                own = {f"metric_{key}": value for key, value in metrics.items()}
                told = np.array(json.dumps(line))
                parts.put(name, files.encode_arrays(vectors=vectors, line=told, **own), ".npz")
        tuner.update(vectors, metrics)
        log.append(line)
        simulated += line["simulated"]
        callback(Progress(0, simulated, rounds=len(log)))
        if folder is not None and name not in kept:
            _write(folder, tuner, log)
    if folder is not None:
        _write(folder, tuner, log)
    return log


def _tried(
    tuner: Tuner,
    vectors: np.ndarray,
    generation: int,
    callback: Callable[[Progress], Any],
    shape: dict[str, Any],
) -> tuple[Metrics, dict[str, Any]]:
    """The metrics of a generation, and its line of the log."""
    took = dict.fromkeys(("simulated", "compile", "run"), 0.0)
    problem = tuner.problem
    where = problem.domains, problem.setting, problem.objective

    def score_candidates(asks: list[Candidates]) -> list[CandidateScores]:
        answers, timing = evaluate.score_candidates(asks, *where, callback=callback, **shape)
        for name in took:
            took[name] += getattr(timing, name)
        return answers

    metrics, line = tuner.judge(vectors, generation, score_candidates)
    took["simulated"] += line.pop("simulated", 0.0)
    return metrics, {"generation": generation} | line | took


def finite(value: Any) -> float | None:
    """A number as JSON has it: None for what is not finite."""
    return float(value) if np.isfinite(value) else None


def _write(folder: Path, tuner: Tuner, log: Sequence[dict[str, Any]]) -> None:
    files.write_json(folder / TUNED, tuner.space.named(tuner.best))
    files.write_text(folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in log))
    rows = [line | {f"params.{k}": v for k, v in line["params"].items()} for line in log]
    files.write_csv(
        folder / "curve.csv", [{k: row[k] for k in row if k != "params"} for row in rows]
    )


def _check_line(line: Any, names: Sequence[str]) -> None:
    """Raises ValueError or KeyError unless this is a line of a log, with these parameters."""
    if not (isinstance(line, dict) and isinstance(line["params"], dict)):
        raise ValueError("its line holds no names with values")
    numbers = {name: value for name, value in line.items() if name != "params"} | line["params"]
    for name, value in numbers.items():
        if value is not None:
            errors.check_number(f"{name} of its line", value)
    for name in ("simulated", "compile", "run", "validation", "validation_success", *names):
        if numbers[name] is None and name != "validation":
            raise ValueError(f"its line holds no {name}")


def _restored(
    tuner: Tuner, path: Path, proposed: np.ndarray, generation: int
) -> tuple[np.ndarray, Metrics, dict[str, Any]]:
    """The vectors of a generation that was tried before, their metrics, and the log's line."""
    content = files.read_regular(path, "part")
    try:
        arrays = files.decode_arrays(content)
        line = files.parse_json(str(arrays.pop("line")))
        _check_line(line, tuner.space.names)
    except (ValueError, KeyError) as error:
        raise files.CorruptFileError(path, error) from error
    vectors = arrays.pop("vectors", np.empty(0))
    metrics = {name.removeprefix("metric_"): values for name, values in arrays.items()}
    shapes = {name: values.shape for name, values in metrics.items() if values.dtype.kind == "f"}
    if shapes != tuner.shapes(proposed, generation):
        raise files.CorruptFileError(
            path, "its numbers are not those of a generation of this search"
        )
    # Another machine may round otherwise, so the search goes on from what was tried.
    if (
        vectors.dtype.kind != "f"
        or vectors.shape != proposed.shape
        or not np.allclose(vectors, proposed, rtol=1e-4, atol=1e-4)
    ):
        raise errors.InputError(
            f"run = {path.parent.parent} cannot be continued: its generation {generation} is not "
            "what this search proposes, so another version made it; choose another folder."
        )
    return vectors, metrics, line
