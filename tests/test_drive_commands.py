"""Commands with bases that cannot move sideways: each runs, or refuses in one sentence."""

from typing import Any

import jax
import numpy as np
import pytest
from helpers import SLOTS, slow

import rps_jax
from rps_jax import Rules, Setting
from rps_jax.app.cli import flags, names
from rps_jax.app.shadow import Shadow
from rps_jax.control import registry
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network
from rps_jax.errors import InputError
from rps_jax.runs.push import Push
from rps_jax.studies.ladder import Ladder, Score
from rps_jax.tuning.fit import Fit

ROBOTS = {
    "differential": "ideal,drive=differential,axle=0.2",
    "car": "ideal,drive=car,axle=0.2,turning_radius=0.5",
}
FIELDS = {
    name: set(names.question_type(name).__dataclass_fields__)
    for name in names.known()
    if "robot" in names.question_type(name).__dataclass_fields__
}
POSITIONAL = {"score": ["unicycle"], "shadow": ["push.mcap"]}
BRIEF = Setting("quasistatic", rules=Rules(horizon=3.0))
DRUMS = "wide,objects=random_cylinder"


def command(name, drive, tmp_path, *, law=True) -> Any:
    """Return a command with such a base, and with a law for it or its default law."""
    words = ["--robot", ROBOTS[drive], *POSITIONAL.get(name, ())]
    words += [] if name == "view" else ["--out", str(tmp_path / "run")]
    for option in {"law", "laws"} & FIELDS[name] if law and name != "score" else ():
        words += [f"--{option}", "unicycle"]
    return flags.parse(names.question_type(name), name, words)[0]


@pytest.mark.parametrize("drive", ROBOTS)
@pytest.mark.parametrize("name", [name for name in FIELDS if name not in ("fit", "shadow")])
def test_a_command_accepts_a_base_with_a_law_for_it(name, drive, tmp_path):
    command(name, drive, tmp_path).validate()


def law_of(command) -> str:
    """Return the law of a command, or its laws."""
    if hasattr(command, "case"):
        return command.case.named_law
    if hasattr(command, "chosen"):
        return " ".join(command.chosen)
    return command.law or command.program.label


@pytest.mark.parametrize("drive", ROBOTS)
@pytest.mark.parametrize("name", [name for name in FIELDS if {"law", "laws"} & FIELDS[name]])
def test_without_a_law_a_command_has_one_for_the_base(name, drive, tmp_path):
    without = command(name, drive, tmp_path, law=False)
    if name not in ("fit", "shadow"):  # which lack their logs
        without.validate()
    if name not in ("ladder", "score"):
        assert law_of(without) == {"differential": "unicycle", "car": "unicycle_car"}[drive]
    named = ["--laws" if "laws" in FIELDS[name] else "--law", "rps"]
    if name not in ("score", "fit", "shadow"):
        words = ["--robot", ROBOTS[drive], *named, "--out", str(tmp_path)]
        words = words[: -2 if name == "view" else None]
        with pytest.raises(InputError, match="choose unicycle"):
            flags.parse(names.question_type(name), name, words)[0].validate()


@pytest.mark.parametrize(
    ("task", "robot", "law"),
    [
        ("pose", "ideal", "pose"),
        ("pose", "husky", "pose_drive"),
        ("path,heading=1", "husky", "path_pose_drive"),
        ("path", "husky", "unicycle"),
    ],
)
@pytest.mark.parametrize(
    "name", [name for name in FIELDS if {"law", "laws"} & FIELDS[name] and "task" in FIELDS[name]]
)
def test_without_a_law_a_command_has_one_for_a_goal_with_a_heading(name, task, robot, law):
    words = ["--robot", robot, "--task", task, *POSITIONAL.get(name, ())]
    chosen = law_of(flags.parse(names.question_type(name), name, words)[0])
    assert chosen == law or (name in ("ladder", "score") and law in chosen.split())


@pytest.mark.parametrize(("drive", "law"), [("differential", "unicycle"), ("car", "unicycle_car")])
def test_pushes_and_exports_without_a_law_have_one_for_the_base(drive, law, tmp_path):
    push = command("push", drive, tmp_path, law=False)
    push.validate()
    assert push.case.named_law == law
    assert push.configuration()["law"]["law"] == "UnicycleParams"
    assert command("export c", drive, tmp_path, law=False).program.label == law


def test_the_ladder_and_the_score_use_the_laws_that_the_base_can_follow():
    robot = ROBOTS["differential"]
    options = {"domain": DRUMS, "worlds": 8, "setting": BRIEF, "slots": SLOTS}
    scored = rps_jax.score("unicycle,r=0.2", robot=robot, **options)
    assert scored.law.values.tolist() == ["unicycle,r=0.2", "unicycle"]
    known = registry.laws_for("differential")
    for law, base, drives in (("unicycle", robot, "omni differential car"), ("rps", None, "omni")):
        assert rps_jax.ladder(law, robot=base, **options).drives.item() == drives
    assert set(Ladder(robot=robot).chosen) == set(known)
    # No law of the package brings objects to a heading with a car.
    assert list(Score("unicycle_car", robot="f1tenth", task="pose").chosen) == ["unicycle_car"]
    assert list(Score("rps", task="corridor,heading=0").chosen) == ["rps"]
    assert "rps_reposition" not in Ladder(task="corridor").chosen


@pytest.mark.parametrize("drive", ["differential", slow("car")])
def test_the_ceiling_plans_without_a_sideways_velocity(drive):
    small = {"sample": 2, "samples": 4, "rounds": 1}
    setting = Setting(rules=Rules(horizon=2.0))
    results = rps_jax.ceiling(DRUMS, robot=ROBOTS[drive], **small, setting=setting)
    assert results.trials.values.tolist() == [4, 4]
    assert not results["mean"].sel(axis="v_y").values.any()
    assert results["mean"].sel(axis="omega").values.any()


@pytest.mark.slow
def test_a_law_is_learned_with_actions_of_two_numbers(tmp_path):
    small = {"network": "mlp", "width": 4, "num_envs": 4, "num_steps": 2, "num_minibatches": 1}
    small |= {"drawn": 4, "validation": 2, "minutes": 0, "updates": 1}
    robot, fast = ROBOTS["differential"], Setting("fused", rules=Rules(horizon=3.0))
    curve = rps_jax.learn(DRUMS, **small, robot=robot, setting=fast, out=tmp_path)
    assert curve.spread.notnull().all()
    law = str(tmp_path / "policy.npz")
    assert registry.law_of(registry.resolve_law(law)[1]).drives == ("omni", "differential", "car")
    options = {"robot": robot, "skin": "capacitive", "target": (1.0, 1.0)}
    trace = rps_jax.push(law=law, **options, setting=fast)
    assert not trace.data.v_y.any()
    assert trace.data.omega.any()
    again = {**small, "updates": 2, "setting": fast, "out": tmp_path / "again"}
    with pytest.raises(InputError, match="which do not move sideways"):
        rps_jax.learn(DRUMS, **again, initial=law)


def test_a_network_with_two_actions_is_equivariant():
    network = Network("mlp", 4, 6, actions=2)
    weights = network.init(jax.random.key(0))
    inputs = jax.random.normal(jax.random.key(1), (network.shapes["first.w"][0] // 2,))
    hidden = np.zeros((2, 0))
    _, action = network.apply(weights, hidden, inputs)
    _, mirrored = network.apply(weights, hidden, networks.features.mirror(inputs))
    np.testing.assert_allclose(mirrored, action * np.array([1, -1]), rtol=1e-6)
    assert np.abs(action).min() > 1e-6


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Bag of a push with a differential base."""
    path = tmp_path_factory.mktemp("bag") / "push.mcap"
    setting = Setting("mujoco", rules=Rules(horizon=7.0))
    Push(
        law="unicycle", robot=ROBOTS["differential"], target=(0.8, 0.8), setting=setting, bag=path
    )()
    return path


def test_shadow_compares_v_and_omega(bag):
    results = Shadow(bag, "unicycle", ROBOTS["differential"])()
    assert set(results) == {"v_x", "omega"}
    law, commanded = results.sel(source="law"), results.sel(source="commanded")
    for name in results:
        np.testing.assert_allclose(law[name], commanded[name], atol=2e-4)
        assert np.ptp(law[name].values) > 0.01


def test_fit_takes_a_log_of_the_axle_for_that_of_the_middle(bag):
    robot = ROBOTS["differential"]
    fit = Fit([bag], law="unicycle", domain="wide,distance=0.7:3", robot=robot)
    columns = dict(fit.raw_logs[0].columns)
    omega = columns["twist"][:, 2]
    assert np.ptp(omega) > 0.01
    np.testing.assert_allclose(columns["twist"][:, 1], 0.2 * omega)
