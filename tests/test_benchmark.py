"""A speed is of what was timed, and is compared with C MuJoCo in the closed loop."""

from dataclasses import replace

import numpy as np

from rps_jax import benchmark


def test_a_program_is_timed_and_compared_with_c_in_the_closed_loop():
    setting = benchmark.BATCHED["quasistatic"]
    program = benchmark.traced("quasistatic", setting, "cylinder", 2, simulated=0.1)()
    assert program.compile > 0
    speed = benchmark.batched(program)
    assert (speed.name, speed.family, speed.worlds) == ("quasistatic", "cylinder", 2)
    assert 0 < speed.rate < np.inf
    assert speed.memory > 2 * 40  # bytes: two worlds, of more than ten numbers each

    in_c = replace(speed, name="C in closed loop", rate=2.0, memory=np.nan)
    header, first, second = benchmark.table([in_c, replace(speed, rate=5.0)])
    ratio = header.index("against C in closed loop")
    assert (first[ratio], second[ratio]) == ("1", "2.5")
    assert first[-1] == ""


def test_every_measurement_is_of_an_engine_or_of_c():
    assert not set(benchmark.BATCHED) & set(benchmark.IN_C)
    assert benchmark.can("C in closed loop", "prism")
    assert not benchmark.can("warp standard", "prism")  # whose worlds share a mesh's corners
