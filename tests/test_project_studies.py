"""The studies of this project: options, pages, published commands and digests."""

import json
import re
import shlex
import shutil

import pytest
from helpers import ROOT, refusal

from rps_jax.app.cli import flags, names
from rps_jax.control import registry
from rps_jax.control.learned import policy
from sweeps.publish.study import published as data_files
from sweeps.study_base import Table, digest, write_table

SWEEPS = ROOT / "sweeps"
FOLDERS = sorted(path.parent for path in SWEEPS.glob("*/README.md"))
STUDIES = sorted(path.parent for path in SWEEPS.glob("*/study.py"))

REFUSED = [
    ("gradients", "--object box", "unknown object 'box'"),
    ("gradients", "--horizons 2 1", r"horizons = \(2\.0, 1\.0\) is not allowed"),
    ("gradients", "--estimators backward", "unknown estimators 'backward'"),
    ("gradients", "--tuned v_max", "unknown tuned parameter 'v_max'"),
    ("landscape", "--candidates 1", "candidates = 1 is not allowed"),
    ("landscape", "--laws rps,tund.json", r"tund\.json cannot be read"),
    ("landscape", "--laws pursuit", "law = pursuit is not allowed"),
    ("landscape", "--domain wyde", "unknown domain 'wyde'"),
    ("speed", "--families cone", "cone"),
    ("speed", "--names fast", "unknown names 'fast'"),
    ("speed", "--refill -1", "refill = -1 is not allowed"),
    ("speed", "--at-once 0", "at_once = 0 is not allowed"),
    ("speed", "--mujocos -4", "mujocos = -4 is not allowed"),
    ("speed", "--names 'mjx fast' --worlds 65536", "leave nothing to time"),
    ("speed/costs.py", "--names mjx", "unknown names 'mjx'"),
    ("levers", "--program mjx", "unknown program 'mjx'"),
    ("levers", "--family cone", "cone"),
    ("levers", "--worlds 1", "worlds = 1 is not allowed"),
    ("levers", "--simulated nan", "simulated = nan is not allowed"),
    ("engines", "--objects cone", "unknown domain object 'cone'"),
    ("engines", "--domain wyde", "unknown domain 'wyde'"),
    ("engines", "--engines fast", "unknown engines 'fast'"),
    ("fidelity", "--conditions fine", "unknown conditions 'fine'"),
    ("ambiguities", "--gazebo --curve", "gazebo and curve are not allowed together"),
    ("ambiguities", "--readings none", "unknown reading 'none'"),
    ("limits", "--limits leg", "did you mean 'lag'"),
    ("mends", "--laws none", "unknown mend 'none'"),
    ("ground", "--grounds our", "did you mean 'ours'"),
    ("ground", "--worlds 0", "worlds = 0 is not allowed"),
    ("learned", "run run", "runs"),
    ("force_push_grid", "--duration 0", "duration"),
    ("hardware", "--setups 1", "setups = 1 is not allowed"),
    ("hardware", "--domain wyde", "unknown domain 'wyde'"),
    ("random_worlds", "--domains wyde", "unknown domain 'wyde'"),
    ("random_worlds", "--laws none", "unknown law 'none'"),
    ("publish", "--only nothing", "no data file has such a name"),
    ("real_pushes", "--pushes none.csv", r"pushes = none\.csv cannot be read"),
    ("real_pushes", "--models rigid", "unknown models 'rigid'"),
    ("real_pushes", "--mujoco -1", "mujoco = -1 is not allowed"),
    ("fit", "--logs 1", "logs = 1 is not allowed"),
    ("fit", "--law aps", "fit needs a law that senses touch"),
    ("fit/bags.py", "--logs 0", "logs = 0 is not allowed"),
    ("fit/bags.py", "--law aps", "fit needs a law that senses touch"),
    ("export", "--laws nune", "unknown law 'nune'"),
    ("export", "--tables sped", "sped"),
    ("export", "--inputs 0", "inputs = 0 is not allowed"),
]


@pytest.mark.parametrize(("study", "options", "message"), REFUSED)
def test_a_study_refuses_invalid_options_before_it_compiles(
    study, options, message, tmp_path, compiled, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert re.search(message, refusal(capsys, SWEEPS / study, *shlex.split(options)))
    assert not compiled
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("folder", STUDIES, ids=lambda folder: folder.name)
def test_a_folder_has_one_study(folder):
    question = names.question_type(str(folder))
    assert question.__doc__
    assert question.TITLE
    assert names.question_type(str(folder / "study.py")) is question


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_folder_has_a_page_that_starts_with_the_result(folder):
    lines = (folder / "README.md").read_text().splitlines()
    assert lines[0].startswith("# ")
    assert lines[2]
    assert not lines[2].startswith(("<!--", "|", "#", "`"))
    assert f"({folder.name}/README.md)" in (SWEEPS / "README.md").read_text()


def published():
    """Yield the commands of `rps` in all data files, except those with placeholders."""
    for path in sorted(SWEEPS.glob("**/results/*.json")):
        commands = json.loads(path.read_text()).get(
            "command", []
        )  # a table that cites others has none
        for line in [commands] if isinstance(commands, str) else commands:
            if line.startswith("rps ") and not re.search(r"\$C|[A-Z]{3,}|\.\.\.", line):
                yield pytest.param(line, id=f"{path.stem}: {line[:60]}")


@pytest.mark.parametrize("line", list(published()))
def test_a_published_command_exists(line, monkeypatch):
    """Only its options are checked; files that it names may not exist."""
    monkeypatch.chdir(ROOT)
    _, *words = shlex.split(line.replace("\\\n", " "), comments=True)
    name, rest = names.split(words)
    question, _ = flags.parse(names.question_type(name), name, rest)
    assert question.name


def test_commands_are_published():
    assert len(list(published())) > 50


def test_a_published_command_has_no_local_path(tmp_path):
    run = {
        "command": ["rps", "sweep", "--out", "/somewhere/of mine", "--worlds", "3"],
        "packages": dict.fromkeys(("rps_jax", "jax", "mujoco", "mujoco-mjx")),
        "commit": None,
        "time": "2026-01-01T00:00:00",
    }
    path = write_table(tmp_path / "results" / "x.json", [run], "", Table([["what"]]))
    data = json.loads(path.read_text())
    assert data["command"] == ["rps sweep --worlds 3"]
    assert data["digest"] == digest([["rps", "sweep", "--worlds", "3"]])
    script = [run | {"command": ["python", "mine.py"]}]  # has no digest
    assert "digest" not in json.loads(write_table(path, script, "", Table([["what"]])).read_text())
    for path in SWEEPS.rglob("results/*.json"):
        assert "--out /" not in path.read_text(), path


def test_a_digest_changes_with_laws_domains_and_options():
    """The default engine may be named; laws, domains, seeds and sizes matter."""
    command = ["rps", "sweep", "--domain", "wide", "--laws", "rps_tuned", "--worlds", "8"]
    assert digest([command]) == digest([[*command, "--engine", "fused"]])
    for changes in (["--laws", "rps"], ["--domain", "real"], ["--seed", "3"], ["--worlds", "9"]):
        assert digest([command]) != digest([[*command, *changes]])


def test_no_published_number_is_stale(monkeypatch):
    """A ladder runs all registered laws, so the laws of other tests are removed first."""
    monkeypatch.setattr(
        registry, "LAWS", {name: registry.LAWS[name] for name in registry.PACKAGE_LAWS}
    )
    for path in data_files():
        data = json.loads(path.read_text())
        if "digest" in data:
            commands = [shlex.split(text) for text in data["command"]]
            assert digest(commands) == data["digest"], f"{path.name} is stale: make it anew"


def test_a_copy_of_a_shipped_policy_does_not_change_its_law(tmp_path):
    shutil.copy(policy.SHIPPED["learned_mlp"], tmp_path / "copy.npz")
    params = registry.params_to_json(registry.LAWS["learned_mlp"])
    assert registry.parse_law(str(tmp_path / "copy.npz"))[0] == "learned_mlp"
    assert registry.params_to_json(registry.LAWS["learned_mlp"]) == params
