"""Laws and robots: the package's combinations are compiled to C, and misfits are refused."""

import itertools
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SLOTS, refusing, rps, setting_of, slow
from numpy.testing import assert_array_equal

import rps_jax
from rps_jax.control import registry, validation
from rps_jax.control.base import Law
from rps_jax.control.observation import Details, Twist
from rps_jax.control.registry import register_law
from rps_jax.engines import native
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
FEW = [
    tuple(x[i * step % len(x)] for x, step in zip(CHOICES, (1, 1, 1, 3), strict=True))
    for i in range(COUNT)
]
PAIRS = [
    tuple(case)
    for i, j in itertools.combinations(range(len(CHOICES)), 2)
    for a, b in itertools.product(CHOICES[i], CHOICES[j])
    if (case := [a if k == i else b if k == j else x[-1] for k, x in enumerate(CHOICES)])
]
MORE = [slow(*x) for x in dict.fromkeys(PAIRS) if x not in FEW]


@pytest.mark.parametrize(NAMES, [*FEW, *MORE])
def test_no_law_of_the_package_warns_that_it_is_slow(law, robot, task, skin, monkeypatch):
    """The code is printed, but not compiled."""
    monkeypatch.setattr(native, "load", lambda name: True)
    setting = Setting()
    kind, has_walls = registry.law_of(registry.LAWS[law]), task in ("corridor", "rooms")
    options = {"law": law, "robot": robot, "task": TASKS[task], "skin": skin}
    follows = kind.follows or not kind.heading or task == "reach"
    if ROBOTS[robot].drive not in kind.drives or (kind.room and has_walls) or not follows:
        rules = "it moves sideways|its detours need|the law does not follow"
        with refusing(rf"law (= )?{law} is not allowed: .*({rules})"):
            pushes.build([Case("cylinder", **options)], setting)
        return
    case = Case("cylinder", **options)
    if law.startswith("learned") and case.base.shell.count != 42:
        with refusing("the law was learned with 42"):
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


COMMANDS = {
    **dict.fromkeys(("push", "view", "rare", "attack", "sensitivity"), "--law learned"),
    **dict.fromkeys(("sweep", "ladder", "table"), "--laws rps learned"),
    "hardware": "--law learned --quick",
    "score": "learned",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_law_for_another_skin_is_refused_before_anything_compiles(
    command, tmp_path, compiled, capsys
):
    out = tmp_path / "run"
    options = "" if command == "view" else f"--out {out}"
    assert rps(f"{command} {COMMANDS[command]} --robot ridgeback {options}") == 2
    assert "number of taxels = 51 is not allowed: the law was learned with 42" in (
        capsys.readouterr().err
    )
    assert not compiled
    assert not out.exists()


class Fragile(NamedTuple):
    d_success: float = 0.05


def test_a_custom_law_for_another_skin_is_refused_with_its_line(registries):
    def step(params, state, obs):
        total = jnp.sum(obs.signal * np.ones(42))
        return state, Twist(total, 0 * total, 0 * total), Details.from_obs(obs.touch)

    register_law("fragile", Law(lambda params: (), step, "taxels"), Fragile())
    pushes.build([Case(law="fragile")], Setting())
    with refusing(r"step, for a robot with 51 taxels, of the law in .*42"):
        pushes.build([Case(law="fragile", robot="ridgeback")], Setting())


def test_laws_that_ran_keep_their_results_when_another_fails(registries, tmp_path):
    def fail(value):
        raise RuntimeError("no gripper")

    def step(params, state, obs):
        kind = jax.ShapeDtypeStruct((), obs.yaw.dtype)
        v = jax.pure_callback(fail, kind, obs.yaw, vmap_method="sequential")
        return state, Twist(v, v, v), Details.from_obs(obs)

    register_law("fragile", Law(lambda params: (), step), Fragile())
    setting = setting_of(1.0)
    domain = "wide,objects=random_cylinder"
    options = {"worlds": SLOTS, "setting": setting, "out": tmp_path}
    with (
        pytest.raises(Exception, match="no gripper"),
        pytest.warns(UserWarning, match="has the results of the laws that ran: rps"),
    ):
        rps_jax.sweep(["rps", "fragile"], domain, **options)
    results = rps_jax.load(tmp_path)
    assert results.law.values.tolist() == ["rps"]
    expected = rps_jax.sweep("rps", domain, worlds=SLOTS, setting=setting)
    assert_array_equal(results.base_pose, expected.base_pose)


def test_a_learned_law_is_checked_on_the_robot_of_the_paper(monkeypatch):
    monkeypatch.setattr(validation, "_TAXELS", 51)
    law = registry.law_of(params := registry.LAWS["learned_small"])
    validation.check_law(law, params)  # of no robot
    with refusing("the law was learned with 42"):
        validation.check_law(law, params, 51)
