"""Tune two parameters of RPS with a custom optimiser: SciPy's differential evolution.

    python notebooks/examples/custom_optimiser.py

`rps_jax.evaluate` runs all candidates of a generation at once and returns labelled outcomes.
"""

import tyro
from scipy.optimize import differential_evolution

import rps_jax

BOUNDS = {"K_h": (0.2, 2.0), "K_v": (0.05, 0.5)}  # [1], [1/s]
PARAMS = rps_jax.RPSParams.paper()


def setting_of(horizon):
    """Return the default setting, with trials that end after `horizon` [s]."""
    return rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon))


def scores(vectors, worlds, horizon):
    """Return the cost (P,) of vectors (2, P): 1 for a failure, plus a term for the time."""
    candidates = rps_jax.stack([PARAMS] * vectors.shape[1])
    candidates = candidates._replace(**dict(zip(BOUNDS, vectors, strict=True)))
    results = rps_jax.evaluate(candidates, "wide", worlds, setting=setting_of(horizon))
    return (1 - results.success + 0.1 * results.time / horizon).mean("world").values


def main(worlds: int = 64, generations: int = 10, horizon: float = 300.0):
    """Search, and compare with the paper's parameters in test worlds."""
    optimum = differential_evolution(
        scores,
        list(BOUNDS.values()),
        args=(worlds, horizon),
        maxiter=generations,
        popsize=8,
        seed=0,
        vectorized=True,
        updating="deferred",
        polish=False,
    )
    best = PARAMS._replace(**dict(zip(BOUNDS, optimum.x, strict=True)))
    setting = setting_of(horizon)
    tested = rps_jax.evaluate([PARAMS, best], "wide", 8 * worlds, split="test", setting=setting)
    print(dict(zip(BOUNDS, optimum.x, strict=True)), tested.success.mean("world").values)
    return optimum.x, tested


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
