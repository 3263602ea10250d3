"""An optimiser of one's own: SciPy's differential evolution over two of the law's parameters.

    python notebooks/examples/custom_optimiser.py

`rps_jax.evaluate` takes all candidates of a generation at once and gives labelled outcomes.
"""

from scipy.optimize import differential_evolution

import rps_jax

BOUNDS = {"K_h": (0.2, 2.0), "K_v": (0.05, 0.5)}  # [1], [1/s]
LAW = rps_jax.RPSParams.paper()


def setting_of(horizon):
    """The usual setting, with trials that end after `horizon` [s]."""
    return rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon))


def scores(vectors, worlds, horizon):
    """Score (P,) of vectors (2, P): failures, and the time of the others, less is better."""
    candidates = rps_jax.stack([LAW] * vectors.shape[1])
    candidates = candidates._replace(**dict(zip(BOUNDS, vectors, strict=True)))
    found = rps_jax.evaluate(candidates, "wide", worlds, setting=setting_of(horizon))
    return (1 - found.success + 0.1 * found.time / horizon).mean("world").values


def main(worlds: int = 64, generations: int = 10, horizon: float = 300.0):
    """Search, then compare with the paper's parameters in worlds kept for testing."""
    found = differential_evolution(
        scores, list(BOUNDS.values()), args=(worlds, horizon), maxiter=generations, popsize=8,
        seed=0, vectorized=True, updating="deferred", polish=False,
    )  # fmt: skip
    best = LAW._replace(**dict(zip(BOUNDS, found.x, strict=True)))
    setting = setting_of(horizon)
    tested = rps_jax.evaluate([LAW, best], "wide", 8 * worlds, split="test", setting=setting)
    print(dict(zip(BOUNDS, found.x, strict=True)), tested.success.mean("world").values)
    return found.x, tested


if __name__ == "__main__":
    main()
