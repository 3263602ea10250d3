"""Run two laws in a custom domain: heavy, slippery, tall boxes.

    python notebooks/examples/custom_domain.py

All other ranges are those of the domain `wide`.
"""

import tyro

import rps_jax
from rps_jax import Range

TALL = rps_jax.Domain(
    objects=("random_box",),
    mass=Range(30, 80, log=True),  # [kg]
    height=Range(0.6, 1.0),  # [m]
    friction_robot=Range(0.1, 0.3),  # [1]
)


def main(worlds: int = 300, horizon: float = 300.0):
    """Print success of the paper's and the tuned parameters, and over the object's width."""
    laws = {"paper": rps_jax.RPSParams.paper(), "tuned": rps_jax.RPSParams.tuned()}
    setting = rps_jax.Setting(rules=rps_jax.Rules(horizon=horizon))
    results = rps_jax.sweep(laws, TALL, worlds=worlds, setting=setting)
    print(results.success.mean("world").to_series())
    print(results.success.groupby_bins("size", 4).mean().to_pandas())
    return results


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
