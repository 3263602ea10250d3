"""Study of which reading of the paper, and which physics, give all of its printed numbers.

    rps sweeps/paper_reading --quick

draws readings of the text, the hardware's unmeasured physics and the simulator's ingredients, runs
the experiments of the paper under each draw, and weights the draws by the likelihood of the printed
numbers (adaptive importance sampling). `unknowns` has the draws, `experiments` runs them, `printed`
has the numbers and their likelihood, `evidence` the posterior, and `drawing` the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting
from rps_jax.physics import PHYSICS
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.trials.progress import SequentialProgress
from rps_jax.world import paper
from sweeps.paper_reading import drawing, evidence, experiments, printed
from sweeps.paper_reading.experiments import Target
from sweeps.paper_reading.unknowns import Proposal, redraw_hardware
from sweeps.study_base import Table, TrialStudy

_REPEATS = 8  # runs of the closest draw with other starts and noise


@dataclass(frozen=True)
class PaperReading(TrialStudy[xr.Dataset]):
    """Infer readings of the paper and its physics from all of its printed numbers together.

    The result has the points `u` (draw, unknown) in the unit cube, the log density of the proposals
    `log_proposal` (draw), and the simulated numbers (draw, number), of which counts are out of
    `trials` (number). For the closest draw it has the hardware's numbers in both engines, `checked`
    (engine, repeat, number), and its Fig. 6 over time.
    """

    TITLE = "Which reading of the paper gives its numbers"
    QUICK: ClassVar = {
        "draws": 2,
        "rounds": 1,
        "samples": 2,
        "first": 4,
        "repeats": 1,
        "targets": paper.FEW_TARGETS,
    }
    PRESETS: ClassVar = {"physics": PHYSICS, "laws": paper.LAWS}

    draws: int = option(450, 2, 100_000)
    """Number of draws in each round."""
    samples: int = option(32, 1, 1000)
    """Number of draws of the hardware for each of these."""
    rounds: int = option(4, 1, 100)
    """Number of rounds; draws are concentrated where those of earlier rounds fit."""
    first: int = option(4000, 2, 1_000_000)
    """Number of draws before the rounds, of which only the hardware's experiments run."""
    repeats: int = option(_REPEATS, 1, 100)
    """Number of repetitions of the hardware's experiments under the closest draw."""
    targets: tuple[Target, ...] = paper.TARGETS
    """Targets of the simulated trials [m]."""
    setting: Setting = field(default=Setting("fused"), kw_only=True)

    def num_trials(self) -> int:
        """Number of trials of all draws."""
        table = len(paper.LAWS) * 6 * len(self.targets)
        of_draw = 16 * self.samples + table + 1
        return 16 * (self.first + 2 * self.repeats) + self.rounds * self.draws * of_draw

    def answer(self, run: Run) -> xr.Dataset:
        """Run the rounds that the folder lacks, and check the closest draw."""
        progress = SequentialProgress(run.callback)
        run = run._replace(callback=progress)
        pilot = run.checkpoint("first", partial(self._draw_hardware, run))
        progress.finish(16 * self.first)
        proposals = [evidence.proposal(_joined([pilot], [Proposal.prior()], 1))]
        rounds: list[xr.Dataset] = []
        for index in range(self.rounds):
            if rounds:
                proposals.append(evidence.proposal(_joined(rounds, proposals, self.samples)))
            compute = partial(self._draw, proposals[-1], index + 1, self.targets, run)
            rounds.append(run.checkpoint(f"round_{index}", compute))
            progress.finish((self.num_trials() - 16 * self.first) // self.rounds)
        results = _joined(rounds, proposals, self.samples)
        closest = results.isel(draw=[evidence.closest(results)])
        checked = run.checkpoint("closest", partial(self._check, closest, run))
        return xr.merge([results, checked], combine_attrs="drop")

    def _draw_hardware(self, run: Run) -> xr.Dataset:
        """Return draws of the prior and the hardware's numbers."""
        u = Proposal.prior().sample(self.first, np.random.default_rng([self.setting.seed, 0]))
        return experiments.numbers(u, 1, self.setting, (), run, 0)

    def _draw(
        self, proposal: Proposal, index: int, targets: tuple[Target, ...], run: Run
    ) -> xr.Dataset:
        """Return draws of a proposal and their numbers."""
        rng = np.random.default_rng([self.setting.seed, index])
        once = proposal.sample(self.draws, rng)
        u = redraw_hardware(proposal, once, self.samples, rng)
        return experiments.numbers(u, self.samples, self.setting, targets, run, index)

    def _check(self, closest: xr.Dataset, run: Run) -> xr.Dataset:
        """Return the hardware's numbers of one draw in two engines, and its Fig. 6 over time."""
        u = np.repeat(closest.u.values, self.repeats, 0)
        by_engine = []
        for engine in ("fused", "mujoco"):
            setting = replace(self.setting, engine=engine)
            found = experiments.hardware(u, setting, run, 1000)
            names = list(found)
            by_engine.append(np.stack([found[name] for name in names], 1))
        trace = experiments.figure_6(closest.u.values, self.setting, run.callback)[0]
        columns = {"checked": (("engine", "repeat", "checked_number"), np.stack(by_engine))}
        coords = {"engine": ["fused", "mujoco"], "checked_number": names}
        return xr.merge([xr.Dataset(columns, coords), trace], combine_attrs="drop")

    def intro(self, results: xr.Dataset) -> str:
        """Describe the draws and the likelihood."""
        return evidence.summary(results)

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return posterior, predictions, the closest draw and its Fig. 6."""
        return [
            Table(
                evidence.readings_table(results),
                name="reading_evidence",
                title="Evidence for each reading",
            ),
            Table(
                evidence.unknowns_table(results),
                name="reading_posterior",
                title="Posterior",
                picture=Picture("posterior", partial(drawing.posterior, results)),
            ),
            Table(
                evidence.numbers_table(results),
                name="reading_numbers",
                title="Printed numbers and their predictions",
                picture=Picture("predictions", partial(drawing.predictions, results)),
            ),
            Table(
                evidence.checks_table(results),
                name="reading_checks",
                title="The closest draw again, in two engines",
            ),
            Table(
                evidence.figure_6_table(results),
                name="reading_figure_6",
                title="Fig. 6, point by point",
                picture=Picture("figure_6", partial(drawing.figure_6, results)),
            ),
        ]


paper_reading = call_of(PaperReading)


def _joined(
    rounds: Sequence[xr.Dataset], proposals: Sequence[Proposal], samples: int
) -> xr.Dataset:
    """Return the draws of all rounds, with the log density of the mixture of their proposals.

    `simulation` (draw,) is the index of the simulation, which several draws share.
    """
    results = xr.concat(rounds, "draw", data_vars="minimal")
    densities = [proposal.log_density(results.u.values) for proposal in proposals]
    mixture = np.logaddexp.reduce(densities, 0) - np.log(len(densities))
    likelihoods = printed.log_likelihoods(results.simulated, results.trials)
    simulation = np.arange(results.sizes["draw"]) // samples
    return results.assign(
        log_proposal=("draw", mixture),
        log_likelihood=likelihoods,
        simulation=("draw", simulation),
    )
