"""Tests of custom laws: their files, copies in run folders, purity, and twists that are NaN."""

import json
import shutil
import textwrap
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import ROOT, refusing, rps, setting_of, slow
from numpy.testing import assert_allclose

from rps_jax import evaluate, push, sweep
from rps_jax.analysis import tables
from rps_jax.app.shadow import shadowed
from rps_jax.control import registry
from rps_jax.record import files
from rps_jax.runs.plan import Plan, load_plan, open_run
from rps_jax.world.domain import Domain

pytestmark = pytest.mark.usefixtures("registries")
HEAD = """
from typing import NamedTuple
import jax
import jax.numpy as jnp
import numpy as np
import rps_jax
from rps_jax import Details, Law, Twist

class MineParams(NamedTuple):
    v: float = 0.05
    d_success: float = 0.05

def init(params):
    return ()
"""
TAIL = '\nrps_jax.register_law("mine", Law(init, step), MineParams())\n'
STEP = """
def step(params, state, obs):
    details = Details.from_obs(obs)
    {line}
    return state, Twist(params.v, v_y, 0.0), details
"""
BRIEF = setting_of(0.2, "mujoco")


def write_law(folder, line="v_y = 0.0", before=""):
    """Write the file of a law, which computes its lateral speed by a line."""
    folder.mkdir(exist_ok=True)
    body = STEP.format(line=textwrap.indent(line, "    ").strip())
    path = folder / "mine.py"
    path.write_text(HEAD + before + body + TAIL)
    return path


def test_threads_read_the_file_of_a_law_once(tmp_path):
    path = write_law(tmp_path, before="\nimport time\ntime.sleep(0.05)\n")
    with ThreadPoolExecutor(4) as pool:
        laws = list(pool.map(registry.resolve_law, [f"{path}:MineParams"] * 4))
    assert len({type(params) for _, params in laws}) == 1


# --- twists that are not finite ------------------------------------------------------------


@pytest.mark.parametrize("engine", [slow("mujoco"), "fused"])
def test_a_law_that_returns_nan_is_named_with_the_first_time(engine, tmp_path):
    """The law returns NaN in the fourth control step, as its state counts."""
    path = tmp_path / "mine.py"
    step = """
def init(params):
    return jnp.zeros(())

def step(params, state, obs):
    v_y = jnp.where(state < 3, 0.0, jnp.nan)
    return state + 1, Twist(params.v, v_y, 0.0), Details.from_obs(obs)
"""
    path.write_text(HEAD + step + TAIL)
    setting = setting_of(0.2, engine)
    with pytest.warns(UserWarning, match=r"a law returned NaN or infinity in 2 of 4 trials"):
        results = sweep(["rps", str(path)], Domain(("box",)), worlds=2, setting=setting)
    ended = results.sel(law="mine")
    assert ended.nan_twist.values.tolist() == ended.diverged.values.tolist() == [1, 1]
    assert_allclose(ended.time, 3 * setting.physics.control_period, rtol=1e-6)
    assert not results.sel(law="rps").nan_twist.any()


def test_the_commands_warn_that_the_law_returned_nan(tmp_path, capsys):
    path = write_law(tmp_path, "v_y = jnp.inf * details.distance")
    brief = "--domain wide,objects=box --engine mujoco --horizon 0.2"
    with pytest.warns(UserWarning, match="a law returned NaN"):
        assert rps(f"sweep --worlds 2 --laws {path} {brief} --out", tmp_path / "s") == 0
    assert "| mine | 2 of 2" in capsys.readouterr().out
    with pytest.warns(UserWarning, match="a law returned NaN"):
        evaluate(registry.LAWS["mine"], "wide,objects=box", worlds=2, setting=BRIEF)


NAN = {
    "laws": (("law", "world"), {"law": ["a", "b"]}, ["b"]),
    "one law": (("world",), {}, ["the law"]),
    "rows of a shard": (("row",), {"law": ("row", ["a", "b", "b"])}, ["b"]),
}


@pytest.mark.parametrize("kind", NAN)
def test_the_table_of_a_report_names_laws_that_returned_nan(kind):
    dims, coords, names = NAN[kind]
    is_nan = np.array([[0, 0, 0], [0, 1, 0]]) if len(dims) == 2 else np.array([0, 1, 0])
    outcomes = {"nan_twist": (dims, is_nan), "time": (dims, 2.0 + 0 * is_nan)}
    results = xr.Dataset(outcomes, coords)
    for data in (results, xr.DataTree(children={"wide": xr.DataTree(results)})):
        _, *rows = tables.nan_table(data)
        assert [row[0] for row in rows] == names
        count = 2 if kind == "rows of a shard" else 3
        assert rows[0][1:] == [f"1 of {count}", "2.00 s"]
    assert len(tables.nan_table(results.assign(nan_twist=0 * results.nan_twist))) == 1


def test_a_push_says_that_the_law_returned_nan(tmp_path):
    path = write_law(tmp_path, "v_y = jnp.sqrt(-details.distance)")
    trace = push("box", law=str(path), setting=BRIEF)
    assert trace.summary == "diverged at 0.00 s, since the law returned NaN"


def test_a_push_accepts_a_twist_as_a_plain_tuple(tmp_path):
    path = write_law(tmp_path)
    path.write_text(path.read_text().replace("Twist(params.v", "(params.v"))
    assert_allclose(push("box", law=str(path), setting=BRIEF).data.v_x, 0.05)


def test_shadow_counts_twists_that_are_not_finite(tmp_path):
    from rps_jax.app.shadow import Shadow

    path = write_law(tmp_path, "v_y = jnp.where(obs.yaw > 0.25, jnp.nan, 0.0)")
    _, params = registry.parse_law(str(path))
    n = 5
    recorded = {
        "pose": np.column_stack([np.zeros((n, 2)), 0.1 * np.arange(n)]),
        "contact_type": np.ones(n),
        "p_robot_contact": np.tile([0.36, 0.0], (n, 1)),
        "target": np.tile([2.0, 0.0], (n, 1)),
        "twist": np.zeros((n, 3)),
        "period": np.full(n, 0.02),
        "time": 0.02 * np.arange(n),
    }
    twists = shadowed(registry.law_of(params), params, recorded)
    assert np.isnan(twists[:, 1]).tolist() == [False, False, False, True, True]
    import xarray as xr

    both = np.stack([recorded["twist"], twists])
    results = xr.Dataset(
        {k: (("source", "time"), both[..., i]) for i, k in enumerate(("v_x", "v_y", "omega"))},
        {"source": ["commanded", "law"], "time": recorded["time"]},
        {"law": "mine"},
    )
    question = Shadow("a.mcap", str(path))
    (section,) = question.report(results, question.create_run(None, lambda progress: None))
    assert "mine returned NaN or infinity at 2 of 5 commands, first at 0.06 s" in section.text


# --- laws that are not pure ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "line", "message"),
    [
        (
            "PAST = []",
            "PAST.append(details.l)\nv_y = PAST[0]",
            "reads a value of an earlier call: keep it in the state",
        ),
        ("COUNT = [0]", "COUNT[0] += 1\nv_y = 0.1 * COUNT[0]", "is not pure"),
        ("", "v_y = 1e-3 * np.random.rand()", "is not pure"),
        ("", "v_y = 1e-3 * jnp.asarray(np.random.rand())", "is not pure"),
        ("class Memory: last = 0.0", "v_y = Memory.last\nMemory.last = details.l", "earlier call"),
    ],
)
def test_a_law_that_is_not_pure_is_refused(before, line, message, tmp_path):
    path = write_law(tmp_path, line, before)
    with refusing(message):
        sweep(str(path), Domain(("box",)), worlds=1, setting=BRIEF)


def test_a_pure_law_with_inner_functions_and_random_keys_is_accepted(tmp_path):
    line = """
key = jax.random.PRNGKey(0)
noise = jax.jit(lambda k: jax.random.normal(k, ()))(key)
smooth = jax.custom_jvp(lambda x: x)
smooth.defjvp(lambda p, t: (p[0], t[0]))
table = jnp.arange(3.0)
v_y = smooth(0.0 * noise * table[0])"""
    _, params = registry.parse_law(str(write_law(tmp_path, line)))
    assert registry.check_params(params) is params


# --- files of laws ---------------------------------------------------------------------------


def test_a_law_imports_the_modules_beside_it(tmp_path):
    """Two folders have modules of the same name with other values."""
    speeds = {}
    for name, value in (("one", 0.01), ("two", 0.02)):
        path = write_law(tmp_path / name, "v_y = gains.V_Y", "import gains")
        (tmp_path / name / "gains.py").write_text(f"V_Y = {value}")
        _, params = registry.parse_law(str(path))
        observation = registry.validation.observation_shapes("touch")
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), observation)
        speeds[name] = float(registry.law_of(params).step(params, (), zeros)[1].v_y)
    assert speeds == {"one": 0.01, "two": 0.02}


def test_a_changed_import_runs_the_law_again(tmp_path):
    path = write_law(tmp_path, "v_y = gains.V_Y", "import gains")
    digests = []
    for value in (0.01, 0.02):
        (tmp_path / "gains.py").write_text(f"V_Y = {value}")
        _, params = registry.parse_law(str(path))
        digests.append(registry.params_to_json(params)["imports"]["gains.py"])
    assert digests[0] != digests[1]


def test_a_run_is_loaded_with_the_copy_of_a_law_that_has_changed(tmp_path):
    path = write_law(tmp_path / "law", "v_y = gains.V_Y", "import gains")
    gains = tmp_path / "law" / "gains.py"
    gains.write_text("V_Y = 0.01")
    plan = Plan(Domain(), 2, {"mine": registry.parse_law(str(path))[1]})
    run = open_run(tmp_path / "run", plan)
    stored = files.read_checked_json(run / "manifest.json")
    gains.write_text("V_Y = 0.02")
    with pytest.warns(UserWarning, match=r"mine.py has changed since the run: its copy"):
        loaded = load_plan(run)
    assert json.loads(json.dumps(loaded.configuration())) == stored
    shutil.rmtree(tmp_path / "law")
    with pytest.warns(UserWarning, match="has changed since the run"):
        load_plan(run)
    shutil.rmtree(run / "sources")
    with refusing("which has no copy: restore the file"):
        load_plan(run)


def test_a_run_of_a_policy_file_is_loaded_once_the_package_has_the_policy(tmp_path, monkeypatch):
    path = tmp_path / "mine.npz"
    shutil.copyfile(ROOT / "rps_jax/control/learned/learned_small.npz", path)
    plan = Plan(Domain(), 2, {"mine": registry.LAWS["learned_small"]})
    kind = type(plan.laws["mine"])
    monkeypatch.setitem(registry._SOURCES, kind, registry.sources.describe(path))
    run = open_run(tmp_path / "run", plan)
    assert "digest" in files.read_checked_json(run / "manifest.json")["laws"]["mine"]
    monkeypatch.delitem(registry._SOURCES, kind)
    assert load_plan(run).laws.keys() == {"mine"}
    open_run(run, plan)
    with refusing("another run"):
        open_run(run, Plan(Domain(), 2, {"mine": registry.LAWS["learned"]}))


def test_an_unknown_law_is_named_with_the_other_forms():
    with refusing(r"unknown law 'pi': .* FILE.py or policy.npz"):
        registry.parse_law("pi")
