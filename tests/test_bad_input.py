"""Bad input on the command line: exit code 2 and a sentence that names field, value and what is
allowed, before anything compiles."""

import json
import math
import re
import runpy
import time

import pytest
from helpers import ROOT, one_sentence, rps

from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.engines import ENGINES
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.runs import sweep
from rps_jax.runs.plan import Plan
from rps_jax.trials.setting import Setting
from rps_jax.world.domain import DOMAINS


def unlike(option, value, *choices):
    """What tyro says of a value that is none of the choices of an option, in any order."""
    listed = "".join(f"(?=.*'{choice}')" for choice in choices)
    return f"invalid choice '{value}' for argument '{option}'. Expected one of{listed}"


SKINS = ("ideal", "thin", "capacitive", "hardware")
ESTIMATORS = ("reverse", "forward", "evolution", "combined")
# What is asked for, and what the answer says of it.
TABLE = {
    "--out run": "out = run holds a run that can be continued: choose another folder",
    "--objects bx": "unknown object 'bx': choose from box, cylinder, .*did you mean 'box'",
    "--objects": r"objects = \(\) is not allowed: name each once, at least one",
    "--objects box box": r"objects = .* is not allowed: name each once",
    "--strategies": r"strategies = \(\) is not allowed",
    "--strategies rps rps": "strategies = .* is not allowed: name each once",
    "--strategies mpc": "unknown strategy 'mpc': choose from rps, nps, aps",
    "--friction": r"friction = \(\) is not allowed",
    "--friction S1 S1": "friction = .* is not allowed: name each once",
    "--friction S3": "unknown friction set 'S3': choose from S1, S2",
    "--friction 0.3,": "friction robot =  is not allowed: it must be a number",
    "--friction a,b": "friction ground = a is not allowed: it must be a number",
    "--friction -0.3,0.35": "friction ground = -0.3 is not allowed: .* above 0",
    "--friction 0.3,nan": "friction robot = nan is not allowed",
    "--friction 1e99,0.3": "friction ground = 1e99 is not allowed: .* at most 10",
    "--friction 0.3,0.2,0.1": "write S1, S2 or ground,robot",
    "--targets 1": "targets",
    "--targets x y": "targets",
    "--targets nan 0": "target x = nan is not allowed: .* at least -50 and at most 50",
    "--targets 1e9 0": "target x = 1000000000.0 is not allowed",
    "--targets 0.1 0.1": r"target = \(0.1, 0.1\) m is not allowed: .* outside the robot",
    "--params beta": "params 'beta' is not allowed: write name=value",
    "--params bta=1": "unknown params 'bta': choose from eta, .*did you mean 'beta'",
    "--params aps.vmax=1": "did you mean 'aps.v_max'",
    "--params aps.v_max=0": "aps.v_max = 0.0 is not allowed: it must be a number and above 0",
    "--strategies rps --params aps.v_max=1": "unknown params 'aps.v_max'",
    "--params reactive=0": "unknown params 'reactive'",
    "--params L=": "params L =  is not allowed: it must be a number",
    "--params L=zero": "params L = zero is not allowed: it must be a number",
    "--params L=0": "L = 0.0 is not allowed: it must be a number and above 0",
    "--params L=1e400": "L = inf is not allowed: it must be finite",
    "--params K_h=-1": "K_h = -1.0 is not allowed",
    "--params eta=inf": "eta = inf is not allowed: it must be finite",
    "--params l_mr=0.3": "l_mr = 0.3 is not allowed: .* at most 0.24",
    "--params sgn_0=2": "sgn_0 = 2.0 is not allowed: .* at most 1",
    "--params gamma_max=nan": "gamma_max = nan is not allowed",
    "--horizon 0": r"horizon = 0.0 is not allowed: .* above 0 and at most 100000 \[s\]",
    "--horizon nan": "horizon = nan is not allowed",
    "--horizon 1e9": "horizon = 1000000000.0 is not allowed",
    "--slots 0": "slots = 0 is not allowed: it must be a whole number from 1 to",
    "--slots 1.5": "1.5",
    "--slots 99999999999999": "slots = 99999999999999 is not allowed",
    "--workers -1": "workers = -1 is not allowed: it must be a whole number from 1 to",
    "--workers 99999999": "workers = 99999999 is not allowed",
    "--seed 4294967296": "seed = 4294967296 is not allowed: .* from 0 to 4294967295",
    "--fidelity best": unlike("--fidelity", "best", "reference", "standard", "fast"),
    "--engine ode": unlike("--engine", "ode", *ENGINES),
    "--out file": "out = file cannot be written .* choose a writable folder",
    "--out done": "out = done already holds a run: .* --overwrite",
}
PUSH = {
    "--object sphere": "unknown object 'sphere': choose from box",
    "--target inf 0": "target x = inf is not allowed",
    "--target 0 0": "target = .* outside the robot",
    "--target 1": "target",
    "--strategy RPS": "unknown strategy 'RPS': choose from rps",
    "--engine mujoco": "engine = mujoco is not allowed: follow a trial with mjx, fused or",
    "--mass -20": r"mass = -20.0 is not allowed: .* above 0 and at most 10000 \[kg\]",
    "--mass 0": "mass = 0.0 is not allowed",
    "--mass nan": "mass = nan is not allowed",
    "--mass heavy": "heavy",
    "--timestep 0": r"timestep = 0.0 is not allowed: .* at least 1e-05 and at most 0.1 \[s\]",
    "--timestep -0.01": "timestep = -0.01 is not allowed",
    "--timestep 1e-9": "timestep = 1e-09 is not allowed",
    "--timestep 0.006": "control_period = 0.02 s is not allowed: .* a multiple of timestep",
    "--control-period 0.025": "control_period = 0.025 s .* a multiple of timestep",
    "--control-period 5": "control_period = 5.0 is not allowed: .* at most 1",
    "--physics bullet": unlike("--physics", "bullet", "default", "paper_gazebo"),
    "--skin leather": unlike("--skin", "leather", *SKINS),
    "--skin-params tolerance": "skin-params 'tolerance' is not allowed: write name=value",
    "--skin-params tolerance=-1": "skin tolerance = -1.0 is not allowed: .* at least 0",
    "--skin-params foam=0.01": "unknown skin-params 'foam': choose from tolerance",
    "--skin-params half_length=9": "unknown skin-params 'half_length'",
    "--skin capacitive --skin-params foam=0": "skin foam = 0.0 is not allowed: .* above 0",
    "--skin capacitive --skin-params dead_share=2": "skin dead_share = 2.0 .* at most 1",
    "--skin capacitive --skin-params time_constant=0": "skin time_constant = 0.0 is not allowed",
    "--gap -0.1": "gap = -0.1 is not allowed: .* at least 0 and at most 1",
    "--rear left": unlike("--rear", "left", "near", "far"),
    "--seed -1": "seed = -1 is not allowed",
    "--film-length 0": r"film_length = 0.0 is not allowed: .* above 0 and at most 600 \[s\]",
    "--video maybe": "maybe",
    "--colour red": "--colour",
    "--out /proc/nowhere/run": "out = /proc/nowhere/run cannot be written",
    "--out done": "out = done already holds a run",
}
HARDWARE = {
    "--layout ring": unlike("--layout", "ring", "circle", "grid"),
    "--mass 3": "Unrecognized .*--mass",  # each object of the hardware has the paper's
    "--rear far": "Unrecognized .*--rear",
    "--skin fur": unlike("--skin", "fur", *SKINS),
    "--engine mujoco": "engine = mujoco is not allowed",
    "--params aps.v_max=1": "unknown params 'aps.v_max'",
    "--slots -1": "slots = -1 is not allowed",
    "--out file": "out = file cannot be written",
}
PAPER = {
    "--slots 0": "slots = 0 is not allowed",
    "--workers 0": "workers = 0 is not allowed",
    "--quick maybe": "maybe",
    "--out file": "out = file cannot be written",
}
SWEEP = {
    "--domain narrow": "unknown domain 'narrow': choose from paper, .* hostile",
    "--domain none.json": "none.json cannot be read .* give a JSON file",
    "--domain folder.json": "folder.json cannot be read",
    "--domain text.json": "text.json is not JSON",
    "--domain binary.json": "binary.json is not JSON",
    "--domain list.json": "list.json holds no names with values",
    "--domain quantity.json": "unknown domain quantity 'masss': .*did you mean 'mass'",
    "--domain word.json": r"domain mass = heavy is not allowed: write low and high, as \[0.1",
    "--domain one.json": r"domain mass = \[1\] is not allowed: write low and high",
    "--domain object.json": "domain objects = random_box is not allowed: write names",
    "--domain frictions.json": r"domain frictions = \[\[0.1\]\] is not allowed: write pairs",
    "--domain slippery.json": "friction ground = -1.0 is not allowed: .* above 0",
    "--domain targets.json": r"domain targets = \[\[1\]\] is not allowed: write pairs",
    "--domain nan.json": "target x = nan is not allowed",
    "--domain under.json": r"target = \(0, 0\) m is not allowed: .* outside the robot",
    "--domain fur.json": "unknown domain skin 'fur': choose from ideal, capacitive",
    "--domain figures.json": "domain mass = 36 is not allowed: write low and high",
    "--domain words.json": "domain mass = .* is not allowed: write low and high",
    "--domain vast.json": "domain mass = .* is not allowed: write low and high",
    "--domain four.json": "domain mass = .* is not allowed: write low and high",
    "--domain twice.json": "domain objects = .* is not allowed: name each once",
    "--change mass": "change 'mass' is not allowed: write quantity=low,high",
    "--change mass=3": "change 'mass=3' is not allowed: write quantity=low,high",
    "--change mass=3,4,5": "change 'mass=3,4,5' is not allowed: write quantity=low,high",
    "--change mass=a,b": "domain mass = a is not allowed: it must be a number",
    "--change mass=nan,4": "domain mass = nan is not allowed",
    "--change mass=4,3": "domain mass = 4 to 3 is not allowed: low must not exceed high",
    "--change masses=3,4": "unknown domain quantity 'masses': .*did you mean 'mass'",
    "--domain paper --change mass=50,60": "change 'mass=50,60' is not allowed: .* no mass to draw",
    "--change com_offset=0,0.9": r"domain com_offset \(high\) = 0.9 is not allowed: .* at most",
    "--strategies": r"strategies = \(\) is not allowed",
    "--strategies npss": "unknown strategy 'npss': .*did you mean 'nps'",
    "--strategies rps rps": "strategies = .* is not allowed: name each once",
    "--params": r"params = \(\) is not allowed",
    "--params none.json": "none.json cannot be read",
    "--params L.json": "L = -1.0 is not allowed",
    "--params L_word.json": "L_word.json L = x is not allowed: it must be a number",
    "--params reactive.json": "unknown parameter of reactive.json 'reactive'",
    "--params list.json": "list.json holds no names with values",
    "--params .": r"\. cannot be read .* give a JSON file",
    "--params good.json good.json": "params = .* is not allowed: name each once",
    "--worlds 0": "worlds = 0 is not allowed: it must be a whole number from 1 to",
    "--worlds -1": "worlds = -1 is not allowed",
    "--worlds 99999999999": "worlds = 99999999999 is not allowed",
    "--part 0": "part = 0 is not allowed: it must be a whole number from 1 to",
    "--horizon 0": "horizon = 0.0 is not allowed",
    "--seed -1": "seed = -1 is not allowed",
    "--engine bullet": unlike("--engine", "bullet", *ENGINES),
    "--device tpu": unlike("--device", "tpu", "auto", "cpu", "gpu"),
    "--device gpu": "device = gpu is not there: install .*, or choose cpu",
    "--shard ²/2": "shard '²/2' is not allowed: write k/n",
    "--shard 3": "shard '3' is not allowed: write k/n, as 3/8",
    "--shard 1/2/3": "shard '1/2/3' is not allowed: write k/n",
    "--shard 3/2": "shard = 3 is not allowed: it must be a whole number from 1 to 2",
    "--shard 1/0": "shard = 0 is not allowed",
    "--slots 0": "slots = 0 is not allowed",
    "--out file": "out = file cannot be written",
    "--out /dev/null/x": "out = /dev/null/x cannot be written",
    "--out run": "out = run holds another run .domain.objects = .* choose another folder",
    "--out done": "out = done holds another run: choose another folder",
    "--out cut": "cut/manifest.json is corrupt .*: restore it, or delete it",
    "--out bytes": "bytes/manifest.json is corrupt",
    "--out empty": "empty/manifest.json is corrupt .it holds no names",
}
MERGE = {
    "--out x": r"folders = \(\) is not allowed: give the run folders",
    "run": "--out",
    "nowhere --out x": "run = nowhere holds no manifest.json: give the folder of a run",
    "file --out x": "run = file holds no manifest.json",
    "cut --out x": "cut/manifest.json is corrupt",
    "lacking --out x": "run = lacking is not of a sweep: give the folder of",
    "run --out x": "run = run lacks 1 of 1 parts: run the same command again",
    "run in_c --out x": "run = in_c is of another plan than run .engine = 'mjx' there",
    "run --out file": "out = file cannot be written",
}
REPLAY = {
    "run": "Index of the world",
    "run x": "Index of the world",
    "run 3": "index = 3 is not allowed: it must be a whole number from 0 to 2",
    "run -1": "index = -1 is not allowed",
    "run 0 --arm nps": "unknown arm 'nps': choose from rps",
    "run 0 --film-length nan": "film_length = nan is not allowed",
    "run 0 --out file": "out = file cannot be written",
    "nowhere 0": "run = nowhere holds no manifest.json",
    "bytes 0": "bytes/manifest.json is corrupt",
    "worlds 0": "worlds/manifest.json is corrupt .worlds = 2.5 is not allowed: .* whole number",
    "class 0": "class/manifest.json is corrupt .unknown class of parameters 'Lost': choose from",
    "params 0": "params/manifest.json is corrupt .L = x is not allowed",
    "few 0": "few/manifest.json is corrupt .parameters of RPSParams are eta, .* and not L.:",
    "arms 0": "arms/manifest.json is corrupt",
    "physics 0": "physics/manifest.json is corrupt .timestep = -1 is not allowed",
    "older 0": "run = older was made by another version .rules.max_lost = 'nothing' there, 150",
}
VIEW = {
    "--object sphere": "unknown object 'sphere': choose from box",
    "--target inf 0": "target x = inf is not allowed",
    "--friction S3": "unknown friction set 'S3': choose from S1, S2",
    "--strategy RPS": "unknown strategy 'RPS': choose from rps",
    "--engine mujoco": "engine = mujoco is not allowed: follow a trial with mjx, fused or",
    "--params L=0": "L = 0.0 is not allowed",
    "--horizon 0": "horizon = 0.0 is not allowed",
    "--port -1": "port = -1 is not allowed: it must be a whole number from 0 to 65535",
    "--port 65536": "port = 65536 is not allowed",
    "--port http": "http",
    "--host 203.0.113.1": "host = 203.0.113.1, port = 8080 cannot be served on .*: choose another",
    "--out x": "--out",
    "run 3": "index = 3 is not allowed: it must be a whole number from 0 to 2",
    "run 0 --arm nps": "unknown arm 'nps': choose from rps",
    "nowhere 0": "run = nowhere holds no manifest.json",
    "cut": "cut/manifest.json is corrupt",
}
FILM = {
    "": "run",
    "run --grid 4x": "grid = 4x is not allowed: write ROWSxCOLUMNS, as 4x6, each from 1 to 12",
    "run --grid 0x3": "grid = 0x3 is not allowed: write ROWSxCOLUMNS",
    "run --grid 4x99": "grid = 4x99 is not allowed",
    "run --grid 4*6": r"grid = 4\*6 is not allowed",
    "run --grid 4x6x2": "grid = 4x6x2 is not allowed",
    "run --seconds 0": "seconds = 0.0 is not allowed: .* above 0",
    "run --speed nan": "speed = nan is not allowed",
    "run --camera abov": unlike("--camera", "abov", "oblique", "above"),
    "run --arm nps": "unknown arm 'nps': choose from rps",
    "run --which worst": unlike("--which", "worst", "first", "hardest"),
    "run --which hardest": "run = run holds no results.nc",
    "run --out folder.json": "out = folder.json is a folder: name a file",
    "run --out file/film.mp4": "out = file cannot be written",
    "cut": "cut/manifest.json is corrupt",
    "done": "run = done holds neither a table nor a sweep: give the folder of",
    "file": "run = file holds neither a table nor a sweep",
    "table --object cylinder": "unknown objects of the run 'cylinder': choose from box",
    "table --strategy aps": "unknown strategies of the run 'aps': choose from rps, nps",
    "table --friction S2": "unknown friction of the run 'S2': choose from S1",
}
TUNE = {
    "es --domain narrow": "unknown domain 'narrow': choose from paper",
    "es --objects sphere": "unknown domain object 'sphere'",
    "es --tuned mass": "unknown tuned parameter 'mass': choose from eta",
    "es --tuned L L": "tuned = .* is not allowed: name each parameter once",
    "es --start lost.json": "lost.json cannot be read",
    "es --start L.json": "L = -1.0 is not allowed: it must be a number and above 0",
    "es --algorithm CMA_ES": "invalid choice 'CMA_ES'",
    "es --algorithm xnes --tuned L": "algorithm = xnes is not allowed for one parameter",
    "es --population 2": "population = 2 is not allowed: .* at least 4",
    "es --generations 0": "generations = 0 is not allowed",
    "es --spread nan": "spread = nan is not allowed",
    "es --prior -1": "prior = -1.0 is not allowed",
    "es --risk worst": unlike("--risk", "worst", "mean", "cvar"),
    "es --time-weight -1": "time = -1.0 is not allowed",
    "es --worlds 0": "worlds = 0 is not allowed",
    "es --horizon 0": "horizon = 0.0 is not allowed",
    "es --engine ode": unlike("--engine", "ode", *ENGINES),
    "es --out file": "out = file cannot be written",
    "grad --estimator backprop": unlike("--estimator", "backprop", *ESTIMATORS),
    "grad --optimiser sgdd": "optimiser = sgdd is not allowed: name one of optax",
    "grad --optimiser huber_loss": "optimiser = huber_loss is not allowed: name one of optax",
    "grad --optimiser lbfgs": "optimiser = lbfgs is not allowed: name one of optax",
    "grad --learning-rate 0": "learning_rate = 0.0 is not allowed",
    "grad --window -1": "window = -1.0 is not allowed",
    "grad --starts 0": "starts = 0 is not allowed",
    "compare --params lost.json": "lost.json cannot be read",
    "compare --domain narrow": "unknown domain 'narrow'",
    "compare --worlds 0": "worlds = 0 is not allowed",
    "compare --out file": "out = file cannot be written",
}
COMMANDS = {
    "table": TABLE,
    "push": PUSH,
    "hardware": HARDWARE,
    "paper": PAPER,
    "sweep": SWEEP,
    "merge": MERGE,
    "replay": REPLAY,
    "view": VIEW,
    "film": FILM,
    "tune": TUNE,
    "doctor": {"--loudly": "--loudly"},
    "puhs": {"": "puhs"},
}
CASES = {f"{name} {more}": says for name, cases in COMMANDS.items() for more, says in cases.items()}

DOMAIN_FILES = {
    "list": [1],
    "quantity": {"masss": [1, 2]},
    "word": {"mass": "heavy"},
    "one": {"mass": [1]},
    "object": {"objects": "random_box"},
    "frictions": {"frictions": [[0.1]]},
    "slippery": {"frictions": [[-1, 0.3]]},
    "targets": {"targets": [[1]]},
    "nan": {"targets": [[float("nan"), 0]]},
    "under": {"targets": [[0, 0]]},
    "fur": {"skin": "fur"},
    "figures": {"mass": "36"},
    "words": {"mass": ["three", "four"]},
    "vast": {"mass": [3, 10**400]},
    "four": {"mass": [3, 60, True, 1]},
    "twice": {"objects": ["random_box", "random_box"]},
}
PARAMS_FILES = {
    "L": {"L": -1},
    "L_word": {"L": "x"},
    "reactive": {"reactive": 0.5},
    "good": {"L": 0.3},
    "other/good": {"L": 0.25},
}
CHANGED_MANIFESTS = {
    "worlds": {"worlds": 2.5},
    "class": {"arms": {"rps": {"strategy": "Lost"}}},
    "params": {"arms": {"rps": strategies.recorded(RPSParams.paper()) | {"L": "x"}}},
    "few": {"arms": {"rps": {"strategy": "RPSParams", "L": 0.2}}},
    "arms": {"arms": []},
    "physics": {"physics": {"timestep": -1}},
    "older": {"rules": {"horizon": 300.0}},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the cases speak of: files of every kind of badness, and one run of three worlds."""
    root = tmp_path_factory.mktemp("bad")
    (root / "file").touch()
    (root / "text.json").write_text("mass = 3")
    (root / "binary.json").write_bytes(b"\xff\xfe\x00")
    for name in ("other", "folder.json", "done", "bytes", "cut", "empty", "lacking", "table"):
        (root / name).mkdir()
    (root / "done" / "config.json").write_text("{}")
    options = {"objects": ["box"], "strategies": ["rps", "nps"], "friction": ["S1"]}
    (root / "table" / "config.json").write_text(json.dumps({"options": options}))
    (root / "bytes" / "manifest.json").write_bytes(b"\xff\xfe\x00")
    for name, text in (("cut", '{"worlds": 3'), ("empty", "[]"), ("lacking", "{}")):
        (root / name / "manifest.json").write_text(text)
    for name, values in (DOMAIN_FILES | PARAMS_FILES).items():
        (root / f"{name}.json").write_text(json.dumps(values))
    arms = {"rps": RPSParams.paper()}
    for name, engine in (("run", "mjx"), ("in_c", "mujoco")):
        sweep.open_run(root / name, Plan(DOMAINS["paper"], 3, arms, Setting(engine=engine)))
    good = json.loads((root / "run" / "manifest.json").read_text())
    for name, changes in CHANGED_MANIFESTS.items():
        (root / name).mkdir()
        (root / name / "manifest.json").write_text(json.dumps(good | changes))
    return root


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_sentence_before_anything_compiles(
    case, folder, compiled, capsys, monkeypatch
):
    monkeypatch.chdir(folder)
    began = time.process_time()
    assert rps(*case.split()) == 2
    assert time.process_time() - began < 2.0
    assert not compiled
    error = capsys.readouterr().err
    if error.startswith("rps: error: "):
        one_sentence(error)
    else:  # it is tyro's own, in a frame
        error = " ".join(re.sub("[│╭╮╰╯─]", " ", error).split())
    assert re.search(CASES[case], error)
    assert not list(folder.rglob("*.nc"))


def test_a_corrupt_results_file_is_named(tmp_path):
    (tmp_path / "results.nc").write_bytes(b"not a file of results")
    with pytest.raises(InputError, match=r"results\.nc is corrupt"):
        files.read_results(tmp_path)


SCRIPTS = [
    ("gradient_quality", {"object": "box"}, "unknown object 'box'"),
    ("gradient_quality", {"horizons": ()}, r"horizons = \(\) is not allowed"),
    ("gradient_quality", {"estimators": ("backward",)}, "unknown estimator 'backward'"),
    ("gradient_quality", {"tuned": ("v_max",)}, "unknown tuned parameter 'v_max'"),
    ("landscape", {"candidates": 1}, "candidates = 1 is not allowed"),
    ("landscape", {"params": ("tund",)}, "tund cannot be read"),
    ("landscape", {"domain": ("wyde",)}, "unknown domain 'wyde'"),
    ("benchmark", {"families": ("cone",)}, "unknown family 'cone'"),
    ("benchmark", {"refill": -1}, "refill = -1 is not allowed"),
    ("benchmark", {"at_once": 0}, "at_once = 0 is not allowed"),
    ("benchmark", {"mujocos": -4}, "mujocos = -4 is not allowed"),
    ("benchmark", {"names": ("mjx fast",), "worlds": (65536,)}, "leave nothing to time"),
    ("levers", {"name": "mjx"}, "unknown name 'mjx'"),
    ("levers", {"family": "cone"}, "unknown family 'cone'"),
    ("levers", {"worlds": 1}, "worlds = 1 is not allowed"),
    ("levers", {"simulated": math.nan}, "simulated = nan is not allowed"),
    ("engines", {"objects": ("cone",)}, "unknown domain object 'cone'"),
    ("engines", {"domain": "wyde"}, "unknown domain 'wyde'"),
]


@pytest.mark.parametrize(("script", "options", "message"), SCRIPTS)
def test_a_script_refuses_before_it_compiles(script, options, message, tmp_path, compiled):
    names = runpy.run_path(str(ROOT / "sweeps" / f"{script}.py"))
    with pytest.raises(InputError, match=message):
        names["main"](names["Options"](**options, out=tmp_path / "run"))
    assert not compiled
