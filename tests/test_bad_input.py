"""Bad input on the command line: exit code 2 and a sentence with field, value and allowed values,
before anything compiles."""

import json
import re
import sys
import time

import pytest
from helpers import one_sentence, refusal, refusals, refusing, rps

import rps_jax
from rps_jax import engines
from rps_jax.control import registry
from rps_jax.control.laws.rps import RPSParams
from rps_jax.record import files
from rps_jax.record.folder import claim
from rps_jax.runs.plan import Plan, open_run
from rps_jax.studies.rare import Rare
from rps_jax.trials.setting import Setting
from rps_jax.world.domain import DOMAINS


def unlike(option, value, *choices):
    """Return the pattern of the error for a value that is none of an option's choices."""
    return f"unknown {option.strip('-')} '{value}': choose from {', '.join(choices)}"


# Patterns of errors by the arguments of a command.
NO_RANGE = "domain mass = .* is not allowed: write low and high"
# Contents of domain files, and patterns of their errors.
DOMAIN_FILES = {
    "list": ([1], "list.json is no JSON object .it holds no names with values"),
    "quantity": ({"masss": [1, 2]}, "unknown domain quantity 'masss': .*did you mean 'mass'"),
    "word": ({"mass": "heavy"}, r"mass = heavy is not allowed: write low and high, as \[0.1"),
    "one": ({"mass": [1]}, r"domain mass = \[1\] is not allowed: write low and high"),
    "frictions": ({"frictions": [[0.1]]}, r"frictions = \[\[0.1\]\] is not allowed: write pairs"),
    "slippery": ({"frictions": [[-1, 0.3]]}, "friction ground = -1.0 is not allowed: .* above 0"),
    "targets": ({"targets": [[1]]}, r"domain targets = \[\[1\]\] is not allowed: write pairs"),
    "nan": ({"targets": [[float("nan"), 0]]}, "target x = nan is not allowed"),
    "under": ({"targets": [[0, 0]]}, r"target = \(0, 0\) m is not allowed: .* outside the robot"),
    "fur": ({"skin": "fur"}, "unknown domain skin 'fur': choose from ideal, capacitive"),
    "figures": ({"mass": "36"}, "domain mass = 36 is not allowed: write low and high"),
    "words": ({"mass": ["three", "four"]}, NO_RANGE),
    "vast": ({"mass": [3, 10**400]}, NO_RANGE),
    "four": ({"mass": [3, 60, True, 1]}, NO_RANGE),
    "keys": ({"objects": {"random_box": 1}}, "names, as .*random_box"),
    "twice": ({"objects": ["random_box"] * 2}, "objects = .* is not allowed: name each once"),
}
PARAMS_FILES = {
    "no_path": {},
    "L": {"L": -1, "saturate_first": 1},
    "L_word": {"L": "x"},
    "good": {"L": 0.3, "saturate_first": 1},
    "old": {"L": 0.3},
}
# Changes that corrupt the manifest of a run, with patterns of the reason, and those of versions.
WORD = registry.params_to_json(RPSParams.paper()) | {"L": "x"}
CORRUPT = {
    "worlds": ({"worlds": 2.5}, "worlds = 2.5 is not allowed: .* whole number"),
    "class": ({"laws": {"rps": {"law": "Lost"}}}, "unknown class of parameters 'Lost': choose"),
    "params": ({"laws": {"rps": WORD}}, "L = x is not allowed"),
    "few": (
        {"laws": {"rps": {"law": "RPSParams", "L": 1}}},
        "parameters of .* = L is not allowed: they are eta, ",
    ),
    "laws": ({"laws": []}, ""),
    "physics": ({"physics": {"timestep": -1}}, "timestep = -1 is not allowed"),
}
VERSIONS = {"older": {"rules": {"horizon": 300.0}}, "foreign": {"engine": "mine"}}
# The same of several commands: "COMMAND, COMMAND: arguments".
SHARED = {
    "table, hardware, paper, sweep, ladder, tune es: --out file": "out = file cannot be written",
    "merge run, replay run 0: --out file": "out = file cannot be written .* choose a writable",
    "table, push, sweep: --out done": "out = done holds another run .* --overwrite",
    "table, hardware, paper, sweep: --slots 0": "slots = 0 is not allowed: .* number from 1 to",
    "table, sweep, tune es, view: --horizon 0": "horizon = 0.0 is not allowed: .* above 0 and at",
    "sweep, tune es, ladder: --worlds 0": "worlds = 0 is not allowed: .* a whole number from 1 to",
    "push, sweep: --seed -1": "seed = -1 is not allowed",
    "table, sweep, tune es: --engine ode": unlike("--engine", "ode", *engines.names()),
    "sweep, tune es, ladder: --domain narrow": "unknown domain 'narrow': choose from paper, .*",
    "table, sweep: --laws": r"laws = \[\] is not allowed: name each once, at least one",
    "table, sweep: --laws rps rps": "laws = .* is not allowed: name each once",
    "ladder --laws, tune es --law: force_push_published --engine quasistatic": "no contact force",
    "sweep, ladder: --laws hello.npz": "give a file that `rps learn` wrote",
    "sweep, ladder: --laws none.npz": r"cannot be read \(No such file or directory\)",
    "sweep, ladder: --laws rps,lost.json": "lost.json cannot be read",
    "push, view: --law RPS": "unknown law 'RPS': choose from aps, .* rps",
    "replay run 0, view run 0, film run, gallery run: --law nps": "unknown law of the run 'nps': ",
    "push, view: --object sphere": "unknown object 'sphere': choose from box",
    "push, view: --target inf 0": "target x = inf is not allowed",
    "table, view: --friction S3": "unknown friction set 'S3': choose from S1, S2",
    "push, hardware: --skin fur": "unknown skin 'fur': choose from ideal, thin, capacitive",
    "replay run, view run: 3": "world = 3 is not allowed: .* a whole number from 0 to",
    "replay, view, merge --out x: nowhere 0": "run = nowhere holds no manifest.json: give the",
    "view, film, merge --out x, sweep --out: cut": "cut/manifest.json is corrupt",
}
COMMANDS = {
    "table": {
        "--out run": "out = run holds another run .* choose another folder",
        "--objects bx": "unknown object 'bx': choose from box, closet, .*did you mean 'box'",
        "--objects": r"objects = \(\) is not allowed: name each once, at least one",
        "--objects box box": r"objects = .* is not allowed: name each once",
        "--laws mpc": "unknown law 'mpc': choose from aps, .* rps",
        "--friction": r"friction = \(\) is not allowed",
        "--friction S1 S1": "friction = .* is not allowed: name each once",
        "--friction 0.3,": "friction robot =  is not allowed: it must be a number",
        "--friction 1e99,0.3": "friction ground = 1e99 is not allowed: .* at most 10",
        "--friction 0.3,0.2,0.1": "write S1, S2 or ground,robot",
        "--targets 1": "targets",
        "--targets x y": "targets",
        "--targets 1e9 0": "target x = 1000000000.0 is not allowed",
        "--targets 0.1 0.1": r"target = \(0.1, 0.1\) m is not allowed: .* outside the robot",
        "--laws rps,beta": "law = rps,beta is not allowed: write changes as name=value",
        "--laws rps,bta=1": "unknown parameter of RPSParams .bta.: .*did you mean .beta.",
        "--laws aps,vmax=1": "unknown parameter of APSParams 'vmax': .*did you mean 'v_max'",
        "--laws aps,v_max=0": "aps.v_max = 0.0 is not allowed: it must be a number and above 0",
        "--laws rps,L=zero": "rps L = zero is not allowed: it must be a number",
        "--laws rps,L=0": "L = 0.0 is not allowed: it must be a number and above 0",
        "--laws rps,l_mr=0.3": "l_mr = 0.3 is not allowed: .* at most 0.24",
        "--laws rps,sgn_0=2": "sgn_0 = 2.0 is not allowed: .* at most 1",
        "--slots 1.5": "1.5",
        "--seed 4294967296": "seed = 4294967296 is not allowed: .* from 0 to 4294967295",
        "--fidelity best": unlike("--fidelity", "best", "reference", "standard", "fast"),
    },
    "push": {
        "--friction 0.3": "unknown friction set '0.3': choose from S1, S2, or give GROUND,ROBOT",
        "--bag push.txt": "bag = push.txt is not allowed: name a file, as push.mcap",
        "--target 0 0": "target = .* outside the robot",
        "--target 1": "target",
        "--mass heavy": "heavy",
        "--physics default,timestep=0": r"timestep = 0.0 is not allowed: .* at most 0.1 \[s\]",
        "--physics default,ground_solref=0.1": "ground_solref = 0.1 .*: give 2 numbers",
        "--physics default,timestep=0.006": "control_period = 0.02 s .* a multiple of",
        "--physics default,control_period=5": "control_period = 5.0 is not allowed: .* at most 1",
        "--physics bullet": "unknown physics 'bullet': choose from default, paper_gazebo",
        "--skin ideal,tolerance": "skin = ideal,tolerance is not allowed: write changes as",
        "--skin ideal,tolerance=-1": "skin tolerance = -1.0 is not allowed: .* at least 0",
        "--skin ideal,foam=0.01": "unknown number of the skin ideal 'foam': choose from tolerance",
        "--skin ideal,half_length=9": "unknown number of the skin ideal 'half_length'",
        "--rear left": unlike("--rear", "left", "near", "far"),
        "--film-length 0": r"film_length = 0.0 is not allowed: .* above 0 and at most 600 \[s\]",
        "--video maybe": "maybe",
        "--colour red": "--colour",
        "--out /proc/nowhere/run": "out = /proc/nowhere/run cannot be written",
    },
    "hardware": {"--layout ring": unlike("--layout", "ring", "circle", "grid")},
    "sweep": {
        "--domain none.json": "none.json cannot be read .* give a JSON file",
        "--domain folder.json": "folder.json cannot be read",
        "--domain text.json": "text.json is no JSON object",
        "--domain binary.json": "binary.json is no JSON object",
        "--domain wide,mass": "domain = wide,mass is not allowed: write changes as name=value",
        "--domain wide,mass=nan:4": r"domain mass \(low\) = nan is not allowed",
        "--domain wide,mass=4:3": "domain mass = 4 to 3 is not allowed: low must not exceed high",
        "--domain wide,masses=3:4": "unknown domain quantity 'masses': .*did you mean 'mass'",
        "--domain paper,mass=50:60": "domain mass = 50 to 60 is not .* leave no mass to draw",
        "--domain wide,com_offset=0:0.9": r"domain com_offset \(high\) = 0.9 is not allowed",
        "--domain hostile,load_size=0.4": r"load_size \(high\) = 0.4 .* up to 0.7 .* 0.3",
        "--laws npss": "unknown law 'npss': .*did you mean 'nps'",
        "--laws rps,L.json": "L = -1.0 is not allowed",
        "--laws rps,L_word.json": "rps L = x is not allowed: it must be a number",
        "--laws rps,list.json": "list.json is no JSON object .it holds no names with values",
        "--laws rps,.": "law = rps,. is not allowed: write changes as name=value or file.json",
        "--laws rps,good.json rps,good.json": "laws = .* is not allowed: name each once",
        "--device tpu": unlike("--device", "tpu", "auto", "cpu", "gpu", "xla"),
        "--device gpu": "device = gpu is not available: install .*, or choose cpu",
        "--shard ²/2": "shard = ²/2 is not allowed: write k/n, as 3/8",
        "--shard 1/2/3": "shard = 1/2/3 is not allowed: write k/n, as 3/8",
        "--shard 3/2": "shard = 3 is not allowed: it must be a whole number from 1 to 2",
        "--shard 1/0": "shard = 0 is not allowed",
        "--out /dev/null/x": "out = /dev/null/x cannot be written",
        "--out run": "out = run holds another run .domain.objects = .* choose another folder",
        "--out bytes": "bytes/manifest.json is corrupt",
        "--out empty": "empty/manifest.json is corrupt .it holds no names",
    },
    "merge": {
        "--out x": r"folders = \(\) is not allowed: give the run folders",
        "file --out x": "run = file holds no manifest.json",
        "lacking --out x": "run = lacking does not hold a sweep: give the folder of",
        "run --out x": "run = run lacks 1 of 1 parts: run the same command again",
        "run in_c --out x": "run = in_c has another plan than run .engine = 'mjx' there",
    },
    "replay": {
        "foreign 0": "run = foreign has an unknown engine 'mine': give the file that registers",
        "older 0": "older was written by another version .rules.max_lost = None there, 150",
        "run x": "world = x is not allowed: give a whole number",
        "run -1": "world = -1 is not allowed: it must be a whole number from 0 to",
    },
    "ceiling": {
        "lacking": "run = lacking does not hold a sweep: give the folder of",
        "run --robot turtlebot4": "robot = turtlebot4 is not allowed: the run has its own",
        "--lost-by rps": "only a run has laws",
        "run --horizon 4": "horizon = 4.0 is not allowed: the run has its own",
    },
    "view": {
        "run --seed 3": "seed = 3 is not allowed: the run has its own",
        "--engine mujoco": "engine = mujoco is not allowed: JAX must trace it; choose fused,",
        "--port http": "http",
    },
    "film": {
        "": "run is missing: `rps film --help` lists the options",
        "run --law rps --laws rps": "law = rps is not allowed: laws name those that are filmed",
        "run --grid 4x": "grid = 4x is not allowed: write ROWSxCOLUMNS, as 4x6, each from 1 to 12",
        "run --grid 0x3": "grid = 0x3 is not allowed: write ROWSxCOLUMNS",
        "run --grid 4x99": "grid = 4x99 is not allowed",
        "run --camera abov": unlike("--camera", "abov", "oblique", "above"),
        "run --which worst": unlike("--which", "worst", "first", "hardest"),
        "run --which hardest": "run = run holds no results.nc",
        "run --out folder.json": "out = folder.json is a folder: name a file",
        "run --out file/film.mp4": "out = file cannot be written",
        "done": "run = done does not hold a sweep: give the folder of",
    },
    "tune": {
        "es --objects sphere": "unknown domain object 'sphere'",
        "es --sigma 0.4": "sigma = 0.4 is not allowed: only the estimator antithetic has it",
        "es --law aps": "its parameters have no bounds",
        "es --tuned mass": "unknown tuned parameter 'mass': choose from eta",
        "es --tuned L L": "tuned = .* is not allowed: name each once",
        "es --objective.risk worst": "the option objective.risk has been removed",
        "grad --starts 0": "the option starts has been removed: rps tune grad follows derivatives",
    },
    "ladder": {
        "--domain wide wide": "name each once",
        "--domain wide paper --shard 1/2": "shard is not allowed with several domains",
    },
    "attack": {
        "--axes size colour mass": "unknown axes 'colour'",
        "--axes size mass": "name three quantities",
        "--axes size mass mass": "name each once",
        "--domain wide,mass=5 --axes size mass gap": "does not draw it",
        "--domain paper": "does not draw it",
    },
    "learn": {
        "--domain paper": "skin of a domain to learn in 'ideal'",
        "--hold 0.001": "hold = 0.001 is not allowed",
        "--minutes 0": "minutes = 0 is not allowed without updates",
        "--num-envs 1 --num-minibatches 4": "num_minibatches = 4 is not allowed: there are only 3",
        "--engine mujoco": "engine = mujoco is not allowed",
        "--task pose": "task = pose is not allowed: a learned law does not sense the heading",
    },
    "regress --laws rps": {"--against best": "unknown against 'best': choose from rps, "},
    "export c --law rps": {"--skin ideal": "name one with taxels", "--prefix 2": "prefix = 2 is"},
    "shadow": {"none.mcap": "give FILE.mcap"},
    "fit": {"none.csv": "none.csv cannot be read"},
    "puhs": {"": "puhs"},
    "hello.py puhs": {"": "unknown command 'puhs': .*did you mean 'push'"},
}
TASKS = {
    "push --quick": "unknown option '--quick'",
    "push --task nofile.json": "nofile.json cannot be read",
    "push --task path,nofile.json": "nofile.json cannot be read",
    "push --task no_path.json": "waypoints as [[0.4, 0], [2, 1]], or a map",
    "push --task corridor,width=0.5": "the base is 0.58 m wide",
    "push --task corridor,width=0.6,doors=1,door_width=0.6": "the base is 0.58 m wide",
    "push --task path --target 1 1": "target = (1.0, 1.0) is not allowed: the task path has",
    "push --task pathh": "did you mean 'path'?",
    "push --task path,lookahed=2": "did you mean 'lookahead'?",
    "push --task path,spline=maybe": "write true or false",
    "push --task corridor,doors=x": "write a whole number",
    "push --task path,turns=1.5": "give whole numbers",
    "sweep --task corridor,width=0.8": "the widest object is 0.99 m wide",
    "ladder --task pathh": "did you mean 'path'?",
    "learn --task pathh": "did you mean 'path'?",
    "tune es --task pathh": "did you mean 'path'?",
    "table --task path": "unknown option '--task'",
}
CASES = {f"{name} {more}": says for name, cases in COMMANDS.items() for more, says in cases.items()}
CASES |= {f"sweep --domain {name}.json": says for name, (_, says) in DOMAIN_FILES.items()}
CASES |= {command: re.escape(words) for command, words in TASKS.items()}
for name, (_, reason) in CORRUPT.items():
    CASES[f"replay {name} 0"] = f"{name}/manifest.json is corrupt .{reason}"
for key, pattern in SHARED.items():
    names, _, arguments = key.partition(": ")
    CASES |= {f"{name} {arguments}": pattern for name in names.split(", ")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Inputs of the cases: invalid files of all kinds, and one run of three worlds."""
    root = tmp_path_factory.mktemp("bad")
    (root / "file").touch()
    (root / "hello.py").touch()
    (root / "hello.npz").write_bytes(b"hello")
    (root / "text.json").write_text("mass = 3")
    (root / "binary.json").write_bytes(b"\xff\xfe\x00")
    for name in ("folder.json", "bytes", "cut", "empty", "lacking"):
        (root / name).mkdir()
    claim(root / "done", Rare().configuration())
    (root / "bytes" / "manifest.json").write_bytes(b"\xff\xfe\x00")
    for name, text in (("cut", '{"worlds": 3'), ("empty", "[]"), ("lacking", "{}")):
        (root / name / "manifest.json").write_text(text)
    contents = {name: content for name, (content, _) in DOMAIN_FILES.items()}
    for name, values in (contents | PARAMS_FILES).items():
        (root / f"{name}.json").write_text(json.dumps(values))
    laws = {"rps": RPSParams.paper()}
    for name, engine in (("run", "mjx"), ("in_c", "mujoco")):
        open_run(root / name, Plan(DOMAINS["paper"], 3, laws, Setting(engine=engine)))
    good = json.loads((root / "run" / "manifest.json").read_text())
    changed = {name: changes for name, (changes, _) in CORRUPT.items()} | VERSIONS
    for name, changes in changed.items():
        (root / name).mkdir()
        (root / name / "manifest.json").write_text(json.dumps(good | changes))
    return root


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_sentence(case, folder, compiled, capsys, monkeypatch):
    """The command ends before it compiles anything."""
    monkeypatch.chdir(folder)
    start_time = time.process_time()
    assert rps(*case.split()) == 2
    assert time.process_time() - start_time < 2.0
    assert not compiled
    error = capsys.readouterr().err
    if error.startswith("rps: error: "):
        one_sentence(error)
    else:  # an error of tyro, in a frame
        error = " ".join(re.sub("[│╭╮╰╯─]", " ", error).split())
    assert re.search(CASES[case], error)
    assert not [*folder.rglob("*.nc"), *folder.rglob("parts")]


def test_a_corrupt_results_file_is_named(tmp_path):
    (tmp_path / "results.nc").write_bytes(b"not a file of results")
    with refusing(r"results\.nc is corrupt"):
        files.read_results(tmp_path)


MISSING = {
    "attack": ("ribs", "failures"),
    "sensitivity": ("SALib.sample.sobol", "failures"),
    "export onnx --law rps": ("onnx", "export"),
    "view": ("viser", "viz"),
    "push --no-video --bag push.mcap": ("mcap_ros2.writer", "bags"),
}


@pytest.mark.parametrize("command", MISSING)
def test_a_missing_package_is_named(command, tmp_path, capsys, monkeypatch):
    package, extra = MISSING[command]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    hint = f"is not installed: run pip install 'rps_jax[{extra}]'"
    assert hint in refusal(capsys, command)


TWICE = {
    "sweep --domain twice.json": '{"mass": [3, 4], "mass": [5, 6]}',
    "push --robot twice.json": '{"mass": 100, "mass": 200}',
    "push --law rps,twice.json": '{"L": 0.3, "L": 0.4}',
    "push --task twice.json": '{"kind": "path", "turns": 1, "turns": 2}',
    "push --task twice.yaml": "kind: path\nturns: 1\nturns: 2\n",
    "push --law rps,L=0.3,L=0.4": "",
    "push --task path,turns=1,turns=2": "",
    "sweep --domain wide,mass=3:4,gap=0:0,mass=5:6": "",
}


@pytest.mark.parametrize("command", TWICE)
def test_a_name_that_is_given_twice_is_refused(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    name = f"twice.{command.rpartition('.')[2]}"
    (tmp_path / name).write_text(TWICE[command])
    sentence = refusal(capsys, command)
    assert re.search(
        r"it has (mass|L|turns) twice|duplicate key|give (mass|L|turns) once", sentence
    )
    assert (name in sentence) == bool(TWICE[command])


def test_a_file_of_changes_may_be_changed_again(tmp_path):
    path = files.write_json(tmp_path / "a.json", {"L": 0.3, "saturate_first": 1})
    assert registry.parse_law(f"rps,{path},L=0.4")[1].L == 0.4


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize(
    "command",
    [
        "sweep --domain {}.json",
        "push --law rps,{}.json",
        "push --law {}.npz",
        "push --law {}.py",
        "push --object {}.xml",
        "push --task {}.yaml",
        "fit {}.csv",
        "fit {}.mcap",
        "shadow {}.db3",
    ],
)
def test_a_pointer_of_git_lfs_is_named(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = command.format("pointer").split()
    name = words[-1].rpartition(",")[2]
    (tmp_path / name).write_text(POINTER)
    sentence = refusal(capsys, *words)
    assert name in sentence
    assert sentence.endswith("fetch the file itself by `git lfs pull`.\n")


test_an_argument_of_no_name_is_refused_with_its_place = refusals(
    rps_jax.sweep,
    ({"engine": "mjx"}, r"engine of sweep belongs to its setting: write setting=Setting\(engine="),
    ({"horizon": 3.0}, r"write setting=Setting\(rules=Rules\(horizon=\.\.\.\)\)"),
    ({"wolrds": 3}, "unknown argument of sweep 'wolrds': .*did you mean 'worlds'"),
)
