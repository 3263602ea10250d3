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
from sweeps.publish.recipes import RECIPES
from sweeps.study_base import _PACKAGES, Table, split_folder, write_table

SWEEPS = ROOT / "sweeps"
FOLDERS = sorted(path.parent for path in SWEEPS.glob("*/README.md"))
STUDIES = sorted(path.parent for path in SWEEPS.glob("*/study.py"))

# Options of studies whose value is none of their choices.
UNKNOWN = [
    "gradients/race.py --methods newton",
    "gradients/race.py --counts 7",
    "engines --domain wyde",
    "random_worlds --domains wyde",
    "random_worlds --laws none",
    "export --laws nune",
    "speed --names fast",
    "speed/costs.py --names mjx",
    "levers --program mjx",
    "engines --objects cone",
    "engines --engines fast",
    "fidelity --conditions fine",
    "ambiguities --readings none",
    "real_pushes --models rigid",
    "planning --methods newton",
]
REFUSED = [
    ("speed --families cone", "cone"),
    ("levers --family cone", "cone"),
    ("limits --limits leg", "did you mean 'lag'"),
    ("ground --grounds our", "did you mean 'ours'"),
    ("force_push_grid --duration 0", "duration"),
    ("publish --only nothing", "no data file has such a name"),
    ("real_pushes --pushes none.csv", r"pushes = none\.csv cannot be read"),
    ("fit --law aps", "fit needs a law that senses touch"),
    ("fit/bags.py --law aps", "fit needs a law that senses touch"),
    ("export --tables sped", "sped"),
    ("planning --engine mujoco", "no reverse-mode derivatives"),
]
for line in UNKNOWN:
    _, option, value = line.split()
    name = option.strip("-").replace("-", "_").rstrip("s")
    REFUSED.append((line, rf"unknown [\w ]*{name}[\w ]* '{value}'"))


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_a_study_refuses_invalid_options_before_it_compiles(
    line, message, tmp_path, compiled, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    study, *options = shlex.split(line)
    assert re.search(message, refusal(capsys, SWEEPS / study, *options))
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


def words_of(line):
    """Return the words of a command without its run folder."""
    return tuple(split_folder(shlex.split(line.replace("\\\n", " "), comments=True))[0])


def published():
    """Yield the commands of `rps` in all data files."""
    for path in sorted(SWEEPS.glob("**/results/*.json")):
        commands = json.loads(path.read_text()).get("command", [])  # of a table that cites: none
        for line in [commands] if isinstance(commands, str) else commands:
            if line.startswith("rps ") and not re.search(r"\$C|[A-Z]{3,}|\.\.\.", line):
                yield words_of(line)


RECIPE_COMMANDS = [words_of(x) for recipe in RECIPES.values() for x in recipe.commands]
PUBLISHED = {x for x in RECIPE_COMMANDS if x[0] == "rps"} | set(published())


@pytest.mark.parametrize("words", sorted(PUBLISHED), ids=" ".join)
def test_a_published_command_exists(words, monkeypatch):
    """Only its options are checked; files that it names may not exist."""
    monkeypatch.chdir(ROOT)
    assert flags.read(words[1:])[0].name


def test_commands_are_published():
    assert len(PUBLISHED) > 50


def stored(folder, *commands):
    """Return the data file of runs of some commands."""
    signed = {"packages": dict.fromkeys(_PACKAGES, "1"), "commit": None, "time": "2026-01-01"}
    runs = [signed | {"command": shlex.split(line)} for line in commands]
    path = write_table(folder / "results" / "x.json", runs, "a core", Table([["x"]]))
    return json.loads(path.read_text())


def test_a_data_file_has_its_commands_without_local_paths(tmp_path):
    """Run folders that other commands read stay."""
    tuned = "rps tune es --worlds 16 --law pursuit --out runs/tuned"
    ladder = "rps ladder --worlds 9 --laws pursuit pursuit,runs/tuned/tuned.json"
    data = stored(tmp_path, tuned, f"{ladder} --out '/somewhere/of mine'")
    assert data["command"] == [tuned, ladder]
    for path in SWEEPS.rglob("results/*.json"):
        assert "--out /" not in path.read_text(), path


def test_a_data_file_has_the_commits_of_all_parts(tmp_path):
    """Also of a part that another commit began."""
    packages = dict.fromkeys(_PACKAGES, "1")
    run = {"packages": packages, "time": "2026-01-01", "command": ["rps", "x"], "commit": "a"}
    begun, new = run | {"before": [run | {"commit": "b"}]}, packages | {"jax": "2"}
    path = tmp_path / "results" / "x.json"
    for runs, commit, jax in (
        ([run, run], "a", "1"),
        ([begun, run | {"packages": new}], ["b", "a"], ["1", "2"]),
    ):
        data = json.loads(write_table(path, runs, "a core", Table([["x"]])).read_text())
        assert (data["commit"], data["versions"]["jax"]) == (commit, jax)


def test_a_copy_of_a_shipped_policy_does_not_change_its_law(tmp_path):
    shutil.copy(policy.SHIPPED["learned_small"], tmp_path / "copy.npz")
    params = registry.params_to_json(registry.LAWS["learned_small"])
    assert registry.parse_law(str(tmp_path / "copy.npz"))[0] == "learned_small"
    assert registry.params_to_json(registry.LAWS["learned_small"]) == params
