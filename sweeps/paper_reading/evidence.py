"""Posterior of draws by importance weights: readings, unknowns and predictions of numbers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import xarray as xr
from scipy.special import logsumexp

from rps_jax.analysis import statistics
from sweeps.paper_reading import experiments, printed
from sweeps.paper_reading.printed import PARTS, PRINTED
from sweeps.paper_reading.unknowns import NAMES, UNKNOWNS, Part, Proposal, texts, values

_READINGS = ("saturate_first", "clip_each")  # of which the evidence is compared
_SHARE = 0.1  # of the draws: effective number at least, when a proposal is fitted
_ROUNDING = 1e-9  # [1] of shares at the end of an interval
_QUANTILES = (0.05, 0.5, 0.95)


def log_weights(
    results: xr.Dataset, without: str = "", parts: tuple[str, ...] = PARTS
) -> np.ndarray:
    """Return the log weights (draw,) of draws, by the numbers of some parts without one number."""
    used = [name for name in _names(results) if name != without and printed.part_of(name) in parts]
    fit = results.log_likelihood.sel(number=used).sum("number").values
    return fit - results.log_proposal.values


def normalised(log: np.ndarray) -> np.ndarray:
    """Return weights that sum to 1."""
    return np.exp(log - logsumexp(log))


def effective(weights: np.ndarray) -> float:
    """Return the effective number of draws (Kish)."""
    return float(weights.sum() ** 2 / np.sum(weights**2))


def closest(results: xr.Dataset) -> int:
    """Return the draw that agrees with most of the paper's numbers, of these the likeliest."""
    fit = results.log_likelihood.sum("number").values
    return int(np.lexsort((fit, _matches(results, _names(results))))[-1])


def _names(results: xr.Dataset) -> list[str]:
    return results.number.values.tolist()


def _cells(results: xr.Dataset) -> list[str]:
    return [name for name in _names(results) if printed.part_of(name) == "Table II"]


# Parts of the numbers that tell of a part of the unknowns.
_INFORMED: Mapping[Part, tuple[str, ...]] = {
    "text": PARTS,
    "hardware": ("hardware",),
    "simulation": ("Table II", "targets", "Fig. 6"),
}


def proposal(results: xr.Dataset) -> Proposal:
    """Return a proposal for the next round: the posterior of each part of the unknowns, tempered.

    The power of the likelihood is the highest one at which enough draws count.
    """
    weights = {}
    for part, informed in _INFORMED.items():
        fit = log_weights(results, parts=informed) + results.log_proposal.values
        least = _SHARE * (results.simulation.values.max() + 1)
        low, high = 0.0, 1.0
        for _ in range(30):
            middle = 0.5 * (low + high)
            tempered = normalised(middle * fit - results.log_proposal.values)
            enough = effective(_of_simulations(results, tempered)) >= least
            low, high = (middle, high) if enough else (low, middle)
        weights[part] = normalised(low * fit - results.log_proposal.values)
    return Proposal.fitted(results.u.values, weights)


def summary(results: xr.Dataset) -> str:
    """Return a sentence on draws, numbers and the effective number of draws."""
    weights = _of_simulations(results, normalised(log_weights(results)))
    cells = _cells(results)
    return (
        f"{weights.size:,} draws of the text and the simulation, each with "
        f"{results.sizes['draw'] // weights.size} draws of the hardware: {len(NAMES)} unknowns "
        f"against {len(PRINTED)} numbers and observations of the paper; effective number of draws "
        f"{effective(weights):.0f}. A mean has a normal likelihood, with a standard deviation of "
        f"{1000 * printed.D:g} mm for D and {printed.TIME:g} s for times; a count a beta-binomial "
        "one; an observation in the text is wrong with a probability of "
        f"{100 * printed.WRONG:g} %. The closest draw has "
        f"{int(_matches(results, cells)[closest(results)])} of {len(cells)} cells of Table II "
        "inside the paper's Wilson intervals."
    )


# --- tables ----------------------------------------------------------------------------------


def readings_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each reading: its posterior probability by parts of the numbers, and all."""
    columns = {
        "hardware": ("hardware",),
        "Table II and targets": ("Table II", "targets"),
        "Fig. 6": ("Fig. 6",),
        "all": PARTS,
    }
    rows = [[*(UNKNOWNS[name].label for name in _READINGS), *columns]]
    chosen = [np.array(texts(results.u.values, name)) for name in _READINGS]
    weights = [normalised(log_weights(results, parts=parts)) for parts in columns.values()]
    for words in itertools.product(*(UNKNOWNS[name].choices for name in _READINGS)):
        mask = np.all([x == word for x, word in zip(chosen, words, strict=True)], 0)
        cells = [_probability(results, x, mask) for x in weights]
        rows.append([*words, *cells])
    return rows


def _probability(results: xr.Dataset, weights: np.ndarray, mask: np.ndarray) -> str:
    """Return a share of weights and its standard error, in percent."""
    share = weights[mask].sum()
    error = np.sqrt(np.sum(_of_simulations(results, weights * (mask - share)) ** 2))
    return f"{100 * share:.0f} ± {100 * error:.0f} %"


def _of_simulations(results: xr.Dataset, x: np.ndarray) -> np.ndarray:
    """Return sums of x (draw,) over the draws that share a simulation."""
    return np.bincount(results.simulation.values, x)


def unknowns_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each unknown: prior, posterior, and its value in the closest draw."""
    weights, at = normalised(log_weights(results)), closest(results)
    rows = [["part", "unknown", "prior", "posterior: median, 5 to 95 %", "the closest draw"]]
    for name, unknown in UNKNOWNS.items():
        u = results.u.values
        if unknown.choices:
            drawn = np.array(texts(u, name))
            share = _probability(results, weights, drawn == unknown.choices[1])
            cells = [" or ".join(unknown.choices), f"{unknown.choices[1]}: {share}", drawn[at]]
        else:
            drawn, unit = values(u, name), "" if unknown.unit == "1" else f" {unknown.unit}"
            prior = f"{unknown.range.low:g} to {unknown.range.high:g}{unit}"
            low, middle, high = quantiles(drawn, weights)
            cells = [prior, f"{middle:.2g}{unit} [{low:.2g}, {high:.2g}]", f"{drawn[at]:.2g}{unit}"]
        rows.append([unknown.part, unknown.label, *cells])
    return rows


def quantiles(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted 5, 50 and 95 % quantiles of finite values."""
    finite = np.isfinite(x) & (weights > 0)
    if not finite.any():
        return np.full(3, np.nan)
    return np.quantile(x[finite], _QUANTILES, weights=weights[finite], method="inverted_cdf")


def predictions(results: xr.Dataset) -> dict[str, dict[str, np.ndarray]]:
    """Return quantiles (3,) of each number under prior, posterior, and posterior without it.

    Counts are scaled to the number of trials in the paper.
    """
    prior = normalised(-results.log_proposal.values)
    posterior = normalised(log_weights(results))
    predicted = {}
    for name in _names(results):
        simulated = scaled(results, name)
        left_out = normalised(log_weights(results, without=name))
        by_kind = {"prior": prior, "posterior": posterior, "left out": left_out}
        predicted[name] = {key: quantiles(simulated, weights) for key, weights in by_kind.items()}
    return predicted


def scaled(results: xr.Dataset, name: str) -> np.ndarray:
    """Return a simulated number (draw,), a count as if out of the paper's number of trials."""
    simulated, trials = results.simulated.sel(number=name).values, PRINTED[name].trials
    return simulated * trials / float(results.trials.sel(number=name)) if trials else simulated


def numbers_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each number: the paper's, predictions, and the closest draw's.

    The last rows count the numbers that agree.
    """
    at, predicted = closest(results), predictions(results)
    header = ["number", "paper", "prior", "posterior", "predicted from the others"]
    rows = [[*header, "the closest draw", "inside the paper's interval"]]
    for name, quantities in predicted.items():
        printed_number, ours = PRINTED[name], scaled(results, name)[at]
        cells = [_words(name, x) for x in quantities.values()]
        inside = "yes" if agrees(name, ours) else "no"
        rows.append([name, _word(name, printed_number.value), *cells, _word(name, ours), inside])
    weights = normalised(-results.log_proposal.values), normalised(log_weights(results))
    for words, names in (("cells of Table II", _cells(results)), ("all of these", _names(results))):
        matches = _matches(results, names)
        ranges = [_range(quantiles(matches, x), ".0f") for x in weights]
        largest = f"{len(names)} of {len(names)}"
        ours = f"{matches[at]:.0f} of {len(names)}"
        rows.append([f"inside the interval: {words}", largest, *ranges, "", ours, ""])
    return rows


def _matches(results: xr.Dataset, names: list[str]) -> np.ndarray:
    """Return the number (draw,) of the paper's numbers that agree."""
    return np.sum([agrees(name, scaled(results, name)) for name in names], 0)


def agrees(name: str, values: np.ndarray) -> np.ndarray:
    """Return whether numbers agree with the paper's: within its Wilson interval or tolerance."""
    number = PRINTED[name]
    if number.trials > 1:
        low, high = statistics.wilson(int(number.value), number.trials)
        share = values / number.trials
        return (low - _ROUNDING <= share) & (share <= high + _ROUNDING)
    return np.abs(values - number.value) <= 2 * number.deviation


def _word(name: str, value: float) -> str:
    number = PRINTED[name]
    if number.trials == 1:
        return "yes" if value else "no"
    if number.trials:
        return f"{value:.0f} of {number.trials}"
    return f"{value:.3f} m" if number.unit == "m" else f"{value:.0f} s"


def _words(name: str, limits: np.ndarray) -> str:
    """Return a median and its interval."""
    return _range(limits, ".3f" if PRINTED[name].unit == "m" else ".0f")


def _range(limits: np.ndarray, form: str) -> str:
    low, middle, high = (f"{x:{form}}" for x in limits)
    return f"{middle} [{low}, {high}]"


def checks_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each number of the hardware: the closest draw repeated in two engines."""
    rows = [["number", "paper", *(f"{engine}: mean, range" for engine in results.engine.values)]]
    for name in map(str, results.checked_number.values):
        repeated = results.checked.sel(checked_number=name).values
        form = {"m": ".3f", "s": ".0f"}.get(PRINTED[name].unit, ".1f")
        cells = [f"{x.mean():{form}} [{x.min():{form}}, {x.max():{form}}]" for x in repeated]
        rows.append([name, _word(name, PRINTED[name].value), *cells])
    return rows


_STATEMENTS = {
    "Fig. 6: the right corner touches first": (
        "the sensor initially detected only the right corner, 0.2 m from the center"
    ),
    "Fig. 6: a_r starts near its highest": "a_r started from nearly at its highest value",
    "Fig. 6: line contact before Realignment": (
        "a line contact occurred with the side edge of the box"
    ),
    "Fig. 6: one Realignment State": (
        "the Realignment State ... remained active until ... the center of the robot"
    ),
    "Fig. 6: success": "the robot successfully pushed the object to the target",
}


def figure_6_table(results: xr.Dataset) -> list[list[str]]:
    """Return a row for each statement of the text on Fig. 6: what the closest draw does."""
    holds, weights = experiments.observations(results), normalised(log_weights(results))
    rows = [["the paper's text", "in the closest draw", "posterior probability"]]
    for name, text in _STATEMENTS.items():
        share = _probability(results, weights, results.simulated.sel(number=name).values > 0)
        rows.append([text, "yes" if holds[name] else "no", share])
    return rows
