"""Laws, robots, tasks and skins of the package: all combinations can be compiled to C."""

import itertools
import warnings

import jax
import numpy as np
import pytest

from rps_jax.control import registry
from rps_jax.engines import native
from rps_jax.errors import InputError
from rps_jax.robot.robot import ROBOTS
from rps_jax.robot.skin import SKINS
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop

ROOM = {"kind": "rooms", "outline": [[-1, -1], [4, -1], [4, 2], [-1, 2]], "goal": [2, 1]}
TASKS = {"reach": "reach", "path": "path", "corridor": "corridor", "rooms": ROOM}
NAMES = "law", "robot", "task", "skin"
CHOICES = [[*registry.PACKAGE_LAWS], [*ROBOTS], [*TASKS], [*SKINS]]
COUNT = max(map(len, CHOICES))
# Each name at least once, and each robot with several laws, tasks and skins.
FEW = [tuple(x[i * step % len(x)] for x, step in zip(CHOICES, (1, 1, 1, 3), strict=True))
       for i in range(COUNT)]  # fmt: skip
PAIRS = [
    tuple(case)
    for i, j in itertools.combinations(range(len(CHOICES)), 2)
    for a, b in itertools.product(CHOICES[i], CHOICES[j])
    if (case := [a if k == i else b if k == j else x[-1] for k, x in enumerate(CHOICES)])
]
MORE = [pytest.param(*x, marks=pytest.mark.slow) for x in dict.fromkeys(PAIRS) if x not in FEW]


@pytest.mark.parametrize(NAMES, [*FEW, *MORE])
def test_no_law_of_the_package_warns_that_it_is_slow(law, robot, task, skin, monkeypatch):
    """The code is printed, but not compiled."""
    monkeypatch.setattr(native, "load", lambda name: True)
    setting = Setting()
    case = Case("cylinder", law=law, robot=robot, task=TASKS[task], skin=skin)
    if law.startswith("learned") and case.base.shell.count != 42:
        with pytest.raises(InputError, match="the law was learned with 42"):
            pushes.build([case], setting)
        return
    worlds = pushes.build([case], setting)
    loop = ControlLoop(setting.physics, setting.rules, worlds.law)
    live = np.ones(1, bool)
    start = jax.eval_shape(lambda *x: trial.start_all(*x, live, loop.law), *worlds.inputs)

    def advance(*state):
        return trial.advance([(worlds.stage, *state)], loop, 1)

    with warnings.catch_warnings(action="error"):
        jax.eval_shape(advance, *worlds.inputs, start)
