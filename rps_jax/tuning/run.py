"""Base of the tuning commands: their common options and report, and the loop of a search.

`Tuning` holds the options and the report of `TuneES` and `TuneGrad`, and the worlds in which
candidates are tried. Its `search` proposes vectors of parameters, and `judge` tries them. `answer`
runs the search and checkpoints every generation, so a killed run resumes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.analysis import statistics, tables
from rps_jax.analysis.figures import sweeps as figures
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import unit_of_leaf
from rps_jax.control.registry import LawLike
from rps_jax.geometry.arrays import Array
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.runs import evaluate
from rps_jax.runs.evaluate import Candidates, CandidateScores
from rps_jax.runs.question import DefaultLaw, LawQuestion, Run, SimulationQuestion, TaskOption
from rps_jax.spec import Spec
from rps_jax.trials.progress import Bar, Progress, Timing
from rps_jax.trials.results import labelled
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Split, seed_of
from rps_jax.trials.trial import Rules
from rps_jax.tuning.space import Space, expand_subsets
from rps_jax.world.domain import Domain, DomainLike, parse_domain, task_attribute, to_json
from rps_jax.world.objects import STORED

TUNED = "tuned.json"  # file of a run folder: the parameters with the best validation
TIMES = {  # of a generation
    "compile": Spec("s", "time of compilation"),
    "run": Spec("s", "wall clock without compilation"),
    "simulated": Spec("s", "simulated time, summed over worlds"),
}
# Dimensions of those results of a generation that are arrays.
DIMS = {
    **dict.fromkeys(("vectors", "gradients", "anchors"), ("candidate", "parameter")),
    "moments": ("feature", "other_feature"),
    "values": ("candidate",),
    **dict.fromkeys(("center", "params"), ("parameter",)),
}

_SHOWN = 100  # rows of the table of parameters in a report
Results = Mapping[str, np.ndarray | Array | float]  # of a generation, by name
Proposal = Mapping[str, np.ndarray]  # arrays by name, `vectors` (P, p) among them
# Runs candidates in the worlds of a tuning.
ScoreCandidates = Callable[[list[Candidates]], list[CandidateScores]]
# Yields a proposal for each generation, and receives the results of its trials.
Search = Generator[Proposal, Mapping[str, np.ndarray], None]


@dataclass(frozen=True)
class DomainsQuestion(TaskOption, SimulationQuestion[xr.Dataset]):
    """Base of the questions for better laws in random worlds of some domains."""

    domain: DomainLike | Sequence[DomainLike] = ("wide",)
    """Domains of the worlds: their names, or JSON files of ranges; changes follow each, as
    wide,mass=3:10."""

    @functools.cached_property
    def domains(self) -> tuple[Domain, ...]:
        """The domains, with robot and task."""
        several = [self.domain] if isinstance(self.domain, str | Domain) else self.domain
        return tuple(parse_domain(item, self.robot, self.task) for item in several)

    def attributes(self) -> dict[str, str | int]:
        return super().attributes() | task_attribute(self.domains[0])

    def fields_as_json(self) -> JsonObject:
        """Fields as JSON, with domains by their ranges, and the seed of the worlds."""
        ranges, seed = list(map(to_json, self.domains)), seed_of(self.setting.seed, "tune")
        return super().fields_as_json() | {"domain": ranges, "tune_seed": seed}


@dataclass(frozen=True)
class Tuning(DomainsQuestion, LawQuestion[xr.Dataset]):
    """Base of the questions for better parameters of a law."""

    IGNORED_FIELDS = ("budget", "minutes", "generations")
    REPORTS_TIMES = True
    QUICK: ClassVar = {
        # The few parameters that matter most, since few trials cannot determine more; cylinders on
        # the quasi-static model, which compile and run fastest.
        "tuned": ("K_h", "K_v", "l_cr", "d_th"),
        "objects": ("random_cylinder",),
        "setting.engine": "quasistatic",
        "setting.rules": Rules(horizon=150.0),
        "validation": 64,
        "slots": 64,
    }

    REMOVED: ClassVar = dict.fromkeys(
        ("objective.risk", "objective.tail"), "tuners minimise the mean over all worlds"
    )

    law: LawLike = DefaultLaw("rps")
    """Law with the initial parameters: a name, as rps, rps_tuned or rps_plus, or a file's class
    with bounds, as my_law.py:MyParams; changes follow, as rps,K_h=0.3 or rps,tuned.json."""
    objects: Annotated[tuple[str, ...], STORED] = ("random_box", "random_cylinder")
    """Objects of these domains; random_prism is held out by default."""
    tuned: tuple[str, ...] = ("full",)
    """Parameters to tune: names, or logistic (eta, zeta, beta, k), or full (all parameters of the
    law, but not the robot's speeds, the rules or the switches)."""
    worlds: int = option(512, 1, 10_000_000)
    """Number of worlds of each candidate, in each domain; every generation has other worlds."""
    validation: int = option(512, 1, 10_000_000)
    """Number of worlds for validation, in each domain."""
    objective: Objective = Objective()
    """Score of a trial: a success scores its time, and a failure one more and the distance by which
    it missed the target. Both score the time without contact."""
    budget: float = option(0.0, 0, unit="s")
    """Simulated time after which no generation starts [s]; 0 means no limit."""
    minutes: float = option(0.0, 0, unit="min")
    """Wall clock without compilation after which no generation starts [min]; 0 means no limit."""

    @property
    def title(self) -> str:
        return f"{self.label}, tuned"

    @functools.cached_property
    def space(self) -> Space:
        """Space of the tuned parameters."""
        return Space(expand_subsets(self.tuned, self.params), self.params)

    @functools.cached_property
    def domains(self) -> tuple[Domain, ...]:
        """Domains of the worlds in which candidates are tried."""
        ranges = tuple(replace(d, objects=self.objects) for d in super().domains)
        errors.check_each_once("domain", ranges)
        return ranges

    def candidates(
        self, vectors: ArrayLike, generation: int, count: int | None = None
    ) -> Candidates:
        """Return vectors (P, p) in the worlds of a generation, or in the first `count` of them."""
        worlds = generation * self.worlds + np.arange(count or self.worlds)
        return self._candidates(vectors, "tune", worlds)

    def validation_candidates(self, vector: ArrayLike) -> Candidates:
        """Return a vector (p,) as the only candidate in the worlds for validation."""
        return self._candidates(np.asarray(vector)[None], "validate", np.arange(self.validation))

    def _candidates(self, vectors: ArrayLike, split: Split, worlds: np.ndarray) -> Candidates:
        """Return vectors (P, p) in the worlds of a split with some indices, of each domain."""
        params, seed = self.space.params(vectors), seed_of(self.setting.seed, split)
        return Candidates(params, self.domains, seed, worlds)

    @functools.cached_property
    def base(self) -> np.ndarray:
        """Vector (p,) of the initial parameters."""
        return np.asarray(self.space.vector(self.space.base), float)

    # --- for subclasses to override --------------------------------------------------------

    @property
    def num_generations(self) -> int:
        """Maximum number of generations."""
        raise NotImplementedError

    def search(self) -> Search:
        """Search for the vector (p,) of parameters with the least objective, in generations.

        A proposal has the `vectors` (P, p) of the next generation. The search depends on nothing
        but the results of all generations, so a resumed run repeats it from these.
        """
        raise NotImplementedError

    def judge(self, proposal: Proposal, generation: int, score: ScoreCandidates) -> Results:
        """Try a proposal in worlds; return numbers and the arrays of `DIMS` except `params`.

        The vector `center` (p,) has the `validation` of the generation.
        """
        raise NotImplementedError

    # ---------------------------------------------------------------------------------------

    def quick_values(self) -> Mapping[str, object]:
        """Values of `quick`; parameters for RPS alone, an engine for laws that sense no force."""
        values = dict(self.QUICK)
        if not isinstance(self.params, type(registry.LAWS["rps"])):
            del values["tuned"]
        if registry.law_of(self.params).senses == "force":
            del values["setting.engine"]
        return values

    def check(self) -> None:
        if not registry.law_of(self.params).bounds:
            names = [n for n, params in registry.LAWS.items() if registry.law_of(params).bounds]
            rule = (
                f"its parameters have no bounds; choose from {', '.join(names)}, or give a custom "
                'law Law(..., bounds={"NAME": rps_jax.laws.Bound(low, high)})'
            )
            raise errors.not_allowed("law", self.label, rule)
        for domain in self.domains:
            self.setting.check_domain(domain, [self.space.base])

    def fields_as_json(self) -> JsonObject:
        """Fields as JSON, with the names of all tuned parameters."""
        return super().fields_as_json() | {"tuned": self.space.names}

    def progress_bar(self) -> Bar:
        name = self.name.replace("_", " ")
        return Bar(name, self.num_generations, "generations", shown=self.shows_progress)

    def answer(self, run: Run) -> xr.Dataset:
        """Run a search to its end, and return its results.

        Every generation is a checkpoint. A resumed search proposes the same vectors again and reads
        their results from the checkpoints; a damaged checkpoint is computed again. `compile` and
        `run` [s] are the wall clock of a generation's trials, and `simulated` [s] is its total
        simulated time.

        Raises:
          InputError: the folder has generations that this search does not propose.
        """
        search = self.search()
        proposal, best, least = next(search), self.base, np.inf  # `best` has the least validation
        log, count, simulated, wall = xr.Dataset(), 0, 0.0, 0.0

        def report(progress: Progress) -> None:
            run.callback(replace(progress, simulated=simulated + progress.simulated, rounds=count))

        def proceed(generation: int) -> bool:
            spent = 0 < self.budget <= simulated or 0 < 60 * self.minutes <= wall
            return generation < self.num_generations and not spent

        def compute(generation: int) -> xr.Dataset:
            if generation:
                self._write(run.folder, best, log)
            return self._try_proposal(proposal, generation, run._replace(callback=report))

        for results in run.steps(compute, proceed):
            names = {*map(str, results), "vectors", "center", "validation", "simulated"}
            dims = {name: DIMS.get(name, ()) for name in names}
            files.check_columns(results, run.folder, dims, {})
            tried, vectors = results.vectors, proposal["vectors"]
            # Another machine may round otherwise; the search uses the vectors that were tried.
            tolerance = {"rtol": 1e-4, "atol": 1e-4, "equal_nan": True}
            if tried.shape != vectors.shape or not np.allclose(tried, vectors, **tolerance):
                reason = f"generation {count} is of another search or version"
                raise files.CorruptFileError(run.folder, reason)
            if results.validation < least:
                best, least = results.center.values, float(results.validation)
            row = results.drop_dims({*results.dims} - {"parameter"}).drop_vars("center")
            row = row.expand_dims(generation=[count])
            log = xr.concat([log, row], "generation") if count else row
            count, simulated = count + 1, simulated + float(results.simulated)
            wall += float(results.run)
            report(Progress(0, 0.0))
            proposal = search.send({str(name): x.values for name, x in results.items()})
        results = self._write(run.folder, best, log)
        return results.merge(self._test(best, run._replace(callback=report)))

    def _test(self, best: np.ndarray, run: Run) -> xr.Dataset:
        """Return the success of start and tuned law in worlds that the search has not met."""

        dims = "tested", "test_world"

        def compute() -> xr.Dataset:
            both, worlds = np.stack([self.base, best]), np.arange(self.validation)
            (scores,), _ = self._score([self._candidates(both, "test", worlds)], run)
            meaning = "success in worlds that the search has not met"
            variables = labelled(test_success=(dims, scores.outcome.success, "1", meaning))
            return xr.Dataset(variables, {"tested": ["start", "tuned"]})

        results = run.checkpoint(f"test-{files.sha256(best.tobytes())[:8]}", compute)
        return files.check_columns(results, run.folder, {"test_success": dims}, {})

    def _score(self, tried: list[Candidates], run: Run) -> tuple[list[CandidateScores], Timing]:
        """Run candidates; return their outcomes and scores, and where the time went."""
        return evaluate.score_candidates(tried, self.setting, self.objective, **run.batch_options)

    def _try_proposal(self, proposal: Proposal, generation: int, run: Run) -> xr.Dataset:
        """Try the proposal of a generation, and return its results."""
        times = dict.fromkeys(("simulated", "compile", "run"), 0.0)  # [s]

        def score(candidates: list[Candidates]) -> list[CandidateScores]:
            scores, timing = self._score(candidates, run)
            for name in times:
                times[name] += getattr(timing, name)
            return scores

        results = {**proposal, **self.judge(proposal, generation, score)}
        for name in times:
            times[name] += float(results.pop(name, 0.0))
        results |= times | {"params": self.space.values(results["center"])}
        variables = {
            name: (DIMS.get(name, ()), np.asarray(x, float), TIMES.get(name, Spec()).attributes)
            for name, x in results.items()
        }
        return xr.Dataset(variables, {"parameter": list(self.space.parameters)})

    def _write(self, folder: Path | None, best: np.ndarray, log: xr.Dataset) -> xr.Dataset:
        """Return the log (generation) with the best parameters, and write both."""
        if folder is not None:
            files.write_json(folder / TUNED, self.space.changed_values(best))
            columns = log.params.to_pandas().add_prefix("params.")
            table = log.drop_dims("parameter").to_dataframe().join(columns)
            files.write_csv(folder / "curve.csv", table)
        units = [unit_of_leaf(self.params, x) for x in self.space.parameters.values()]
        log = log.assign_coords(unit=("parameter", units))
        return log.assign(tuned=("parameter", self.space.values(best)))

    def intro(self, results: xr.Dataset) -> str:
        names = ", ".join(self.space.names)
        return (
            f"{self.label}: {names}; {self.worlds} worlds of each generation and "
            f"{self.validation} for validation, engine {self.setting.engine}."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        best, worlds = int(results.validation.argmin("generation")), results.sizes["test_world"]
        success = np.nan_to_num(results.validation_success.values)  # NaN without a validation
        rates = [tables.share(round(worlds * rate), worlds) for rate in success]
        totals = (f"{x} {float(results[x].sum()):,.1f} s" for x in TIMES if x in results)
        text = (
            f"{test_sentences(results.test_success)} The worlds have the objects "
            f"{', '.join(self.objects)}, the engine {self.setting.engine} and the horizon "
            f"{float(self.setting.rules.horizon):g} s; others may decide otherwise.\n\n"
            f"Validation: objective {float(results.validation[0]):.4f} and success {rates[0]} "
            f"at the start, {float(results.validation[best]):.4f} and {rates[best]} after "
            f"{best} of {results.sizes['generation']}. These worlds chose the generation, so the "
            f"tuned law looks better there than it is. Times of the generations: "
            f"{', '.join(totals)}."
        )
        if run.folder is not None:
            start = self.law if isinstance(self.law, str) else self.label
            law = f"{start},{run.folder / TUNED}"
            text += (
                f" The law with these parameters is `{law}`; "
                f"`{self.next_command('ladder', laws=[start, law], domain=self.domain)}` tests it "
                "on all objects."
            )
        rows = [["parameter", "start", "tuned"]]
        columns = results.parameter.values, self.space.values(self.base), results.tuned.values
        for name, start, tuned in zip(*columns, strict=True):
            rows.append([str(name), f"{start:.4g}", f"{tuned:.4g}"])
        if len(rows) > _SHOWN:
            rows = [*rows[:_SHOWN], [f"and {len(rows) - _SHOWN} more", "", ""]]
        picture = Picture("tuning", partial(figures.search, results))
        return [Section("Results", text, rows, picture)]


def test_sentences(success: xr.DataArray) -> str:
    """Return sentences on the success (tested, test_world) of start and tuned law."""
    start, tuned = success
    c = statistics.compare(start, tuned)
    rates = [tables.rate(x.values > 0) for x in success]
    better = "better" if c.gained > c.lost else "worse"
    verdict = f"The tuned law is {better}." if c.p < 0.05 else "Too few to tell which is better."
    return (
        f"Test: in {start.size} worlds that the search has not met, the start succeeds in "
        f"{rates[0]} and the tuned law in {rates[1]}; {c.gained} gained and {c.lost} lost "
        f"(McNemar p = {c.p:.2g}). {verdict}"
    )
