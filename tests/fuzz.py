"""Faults of many classes, injected into the command line.

    python tests/fuzz.py                  # all classes, with the case counts of the published table
    python tests/fuzz.py values --most 500

Nothing may end in a traceback, hang for more than 10 s, or give a wrong result.
`tests/test_faults.py` runs a share of the cases in the suite.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import functools
import io
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

PATIENCE = 10.0  # [s] after which a command hangs


class Case(NamedTuple):
    """Arguments of a command that has one fault."""

    title: str
    arguments: tuple[str, ...]


class Attempt(NamedTuple):
    """Outcome of a command that was given a fault."""

    how: str  # refused, accepted, told, traceback, hang
    text: str


class Accepted(BaseException):
    """Signal that the input was accepted and stepping would start."""


class Hang(BaseException):
    """Signal that a command exceeded its time limit."""


@contextlib.contextmanager
def never_stepping() -> Iterator[None]:
    """Stop commands before the first world is stepped or the first program is compiled."""
    from rps_jax.app import film
    from rps_jax.trials import trial
    from rps_jax.tuning import rollout

    def stop(*_: Any, **__: Any) -> None:
        raise Accepted

    starts = ((trial, "start_all"), (rollout, "start"), (film, "_shots"))
    originals = [(module, name, getattr(module, name)) for module, name in starts]
    for module, name, _ in originals:
        setattr(module, name, stop)
    try:
        yield
    finally:
        for module, name, function in originals:
            setattr(module, name, function)


def attempt(arguments: Sequence[str], patience: float = PATIENCE) -> Attempt:
    """Run a command in this process."""
    from rps_jax.app import cli

    start_time, busy = time.monotonic(), time.process_time()

    def late(*_: Any) -> None:
        # On a busy machine, wall-clock time exceeds the process time.
        if time.process_time() - busy < patience and time.monotonic() - start_time < 4 * patience:
            signal.setitimer(signal.ITIMER_REAL, patience / 2)
            return
        raise Hang

    out, err = io.StringIO(), io.StringIO()
    previous = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, patience)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = cli.main(list(arguments))
    except SystemExit as end:
        code = end.code
    except Accepted:
        return Attempt("accepted", "")
    except Hang:
        return Attempt("hang", "".join(traceback.format_exc().splitlines(True)[-8:]))
    except BaseException:
        return Attempt("traceback", traceback.format_exc())
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
    if "Traceback (most recent call last)" in err.getvalue():
        return Attempt("traceback", err.getvalue())
    if code == 2:
        return Attempt("refused" if _one_sentence(err.getvalue()) else "wordy", err.getvalue())
    return Attempt("told", f"{code} {out.getvalue()[-300:]}{err.getvalue()[-300:]}")


def _one_sentence(text: str) -> bool:
    """Return whether the error is a single short sentence of `rps`."""
    last = [line for line in text.splitlines() if line.startswith("rps: error: ")]
    return len(last) == 1 and text.rstrip().endswith(".") and len(last[0]) < 2000


# --- bad values of options -----------------------------------------------------------------

VALUES = (
    *("", " ", "nan", "-nan", "inf", "-inf", "1e400", "-1e400", "1e-320", "-1", "0", "-0", "0.5"),
    *("1e9", "1e308", "9" * 60, "-" + "9" * 60, "9" * 5000, "0x10", "1_000", "\u0661", "\u00b2"),
    *("None", "null", "true", "[]", "{}", "()", "[[[[", "{]", "a=b", "=", "L=", "=1", "L=nan"),
    *("L=1e400", "mass=3", "mass=3,nan", "mass=9,3", "mass=,", "1/0", "0/1", "2/1", "-1/3", "a/b"),
    *("1/" + "9" * 60, "S1,S2", "0.3,0.3,0.3", "0,0", "nan,nan", "rps", "rps,rps", "RPS", "aps "),
    *("nowhere.json", "nowhere.py:P", "nowhere.npz", ".json", ".py:", ".npz", ":", "..", "/", "."),
    *("/dev/null", "/dev/zero", "/dev/zero.json", "/proc/self/mem", "/etc/passwd", "~", "$HOME"),
    *(
        "list.json",
        "null.json",
        "deep.json",
        "text.json",
        "binary.json",
        "empty.json",
        "number.json",
    ),
    *("big.json", "pipe.json", "pipe.npz", "pipe.py:P", "folder.json", "pipe", "folder.npz"),
    *("broken.py:P", "syntax.py:P", "text.npz", "encrypted.npz", "zip.npz", "exit.py:P"),
    *(
        "\N{SNOWMAN}",
        "\N{PILE OF POO}" * 40,
        "\u202eabc",
        "\x1b[31m",
        "a\nb",
        "x" * 4000,
        "-",
        "--",
    ),
    *(
        "a b",
        "'",
        '"',
        "\\",
        "%s",
        "{0}",
        "`id`",
        ";ls",
        "&&",
        "*",
        "?",
        "\t",
        "--help",
        "-1.5",
        "+5",
    ),
)


def furnish(folder: Path) -> None:
    """Write the files that `VALUES` names."""
    (folder / "list.json").write_text("[1, 2]")
    (folder / "null.json").write_text("null")
    (folder / "number.json").write_text("7")
    (folder / "deep.json").write_text("[" * 100_000)
    (folder / "text.json").write_text("a note")
    (folder / "binary.json").write_bytes(bytes(range(256)))
    (folder / "empty.json").write_text("")
    (folder / "big.json").write_text('{"a": ' + "9" * 10_000 + "}")
    (folder / "broken.py").write_text("raise RuntimeError('broken')\n")
    (folder / "syntax.py").write_text("def :\n")
    (folder / "exit.py").write_text("import sys\nsys.exit(3)\n")
    (folder / "text.npz").write_text("a note")
    (folder / "zip.npz").write_bytes(b"PK\x05\x06" + bytes(18))
    (folder / "encrypted.npz").write_bytes(encrypted())
    for name in ("pipe", "pipe.json", "pipe.npz", "pipe.py"):
        os.mkfifo(folder / name)
    for name in ("folder.json", "folder.npz"):
        (folder / name).mkdir()
    small_run(folder / "run")


def small_run(folder: Path, **changes: Any) -> None:
    """Write the run folder of a sweep of few short trials."""
    import rps_jax

    drums = rps_jax.Domain(("random_cylinder",))
    laws = {"rps": rps_jax.RPSParams.paper(), "rps tuned": rps_jax.RPSParams.tuned()}
    setting = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
    options = {"worlds": 12, "setting": setting, "out": folder, "part": 4, "progress": False}
    rps_jax.sweep(laws, drums, **options | changes)


def encrypted() -> bytes:
    """Return an archive whose only member claims to be encrypted."""
    import zipfile

    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("about.npy", b"secret")
    raw = bytearray(content.getvalue())
    for sign, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        raw[raw.index(sign) + at] |= 1
    return bytes(raw)


def commands() -> list[tuple[str, ...]]:
    """Return all commands as words."""
    from rps_jax.app.cli import names

    return [tuple(name.split()) for name in names.known()]


def options(command: Sequence[str]) -> list[str]:
    """Return the flags of a command."""
    from command_line import flags_of

    return [name for name in flags_of(" ".join(command)) if name.startswith("--")]


def values(seed: int = 0) -> Iterator[Case]:
    """Yield all options of all commands with all values, in random order."""
    cases = [
        Case(f"{' '.join(command)} {option} {value[:30]!r}", (*command, *needs, option, value))
        for command in commands()
        for option in options(command)
        for needs in (NEEDS.get(command[0], ()),)
        for value in VALUES
        if not (option == "--out" and value in ("/", "..", "~"))  # these may be writable
    ]
    random.Random(seed).shuffle(cases)
    yield from cases


# Required arguments of a command besides the tested option.
NEEDS = {
    "replay": ("run", "0"),
    "film": ("run",),
    "gallery": ("run",),
    "ceiling": ("run",),
    "merge": ("run", "--out", "merged"),
}


# --- invalid custom laws ----------------------------------------------------------------------

LAW = """
import math, sys
from functools import partial
from typing import NamedTuple
import jax, jax.numpy as jnp, numpy as np
import rps_jax
from rps_jax import Details, Twist
{head}
class {P}(NamedTuple):
    v: float = 0.05
    {field}
    d_success: float = 0.05
{before}
def init({takes_init}):
    {starts}
    return {memory}
def step({takes}):
    here = seen.p_world_robot
    {body}
    return {returns}
{register}
"""
DEFAULTS = {
    "head": "", "field": "", "before": "", "takes_init": "params", "starts": "pass",
    "memory": "jnp.zeros(2)", "takes": "params, memory, seen", "body": "pass",
    "returns": "memory, Twist(params.v, 0.0, 0.0), Details.from_obs(seen)",
    "register": "rps_jax.register_law('{name}', rps_jax.Law(init, step), {P}())",
}  # fmt: skip
TWIST = "memory, {}, Details.from_obs(seen)"
_WRONG: dict[str, Sequence[str]] = {
    "returns": (
        *("None", "'text'", "memory", "(memory, Twist(0.0, 0.0, 0.0))", "1.0", "{}", "[]", "()"),
        *(
            "memory, Twist(0.0, 0.0, 0.0), Details.from_obs(seen), 1",
            "iter(())",
            "Twist(0.0, 0.0, 0.0)",
        ),
        *("memory, Twist(0.0, 0.0, 0.0), None", "memory, Twist(0.0, 0.0, 0.0), 'details'"),
        *("memory, Twist(0.0, 0.0, 0.0), Details(0, 0, 0, 0, here)", "object()", "step", "seen"),
        "memory, Twist(0.0, 0.0, 0.0), Details(None, None, None, None, None)",
        "[memory, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)]",
        "{'memory': memory}",
        *map(TWIST.format, ("None", "'left'", "(0.0, 0.0)", "here", "0.0", "[0, 0, 0]", "{}")),
        *map(TWIST.format, ("Twist(here, 0.0, 0.0)", "Twist('a', 0.0, 0.0)", "Twist(None, 0, 0)")),
        *map(TWIST.format, ("Twist(1j, 0.0, 0.0)", "Twist(seen.in_contact, 0, 0)", "Twist")),
        *map(TWIST.format, ("Twist(0.0, 0.0, jnp.zeros(1))", "jnp.zeros(3)", "seen")),
        "jnp.concatenate([memory, here]), Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "memory[0], Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "None, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "(memory, memory), Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "'memory', Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "memory > 0, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "memory * 1j, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "{'x': memory}, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
        "memory.astype(int), Twist(0.0, 0.0, 0.0), Details.from_obs(seen)",
    ),
    "body": (
        *("if seen.in_contact: pass", "while seen.yaw > 0: pass", "float(seen.yaw)", "1 / 0"),
        *("int(seen.yaw)", "bool(seen.in_contact)", "np.sin(seen.yaw)", "math.sin(seen.yaw)"),
        *("np.asarray(here)", "seen.yaw.item()", "range(seen.yaw)", "here.tolist()", "here[9.0]"),
        *("for i in range(seen.yaw): pass", "jnp.arange(seen.yaw)", "[1, 2][seen.yaw]", "nothing"),
        *("seen.nothing", "params.nothing", "memory['a']", "memory.nothing", "raise ValueError"),
        *("raise RuntimeError('a\\nb')", "assert False", "assert seen.in_contact", "step()"),
        *("step(params, memory, seen)", "import nothing", "open('/nowhere')", "sys.exit(3)"),
        *("here[0] = 1.0", "here + jnp.zeros(3)", "jnp.reshape(here, 5)", "here @ jnp.zeros(5)"),
        *("here[seen.in_contact]", "jnp.zeros(seen.yaw)", "jax.lax.cond(here, None, None)"),
        *("min(here)", "max(seen.yaw, 0.0)", "seen.in_contact and seen.yaw", "not seen.in_contact"),
        *("sorted(here)", "sum(here, 'a')", "here.astype('nothing')", "jnp.linalg.inv(here)"),
        *("jax.lax.scan(lambda c, x: (c, c, x), 0, here)", "jax.grad(lambda x: here)(1.0)"),
        *(
            "raise KeyboardInterrupt2",
            "np.random.default_rng(seen.yaw)",
            "jax.random.key(seen.yaw)",
        ),
        *("params.v = 3", "seen.yaw = 3", "(lambda: 1)(2)", "jnp.where(1, 2)", "f'{seen.yaw:.2f}'"),
        *("print(float(seen.yaw))", "here.at[9].nothing(1)", "jnp.concatenate([here, seen.yaw])"),
    ),
    "starts": (
        *("raise ValueError('no')", "1 / 0", "params.nothing", "if params.v > 0: pass", "nothing"),
        *(
            "float(params.v)",
            "np.sin(params.v)",
            "sys.exit(3)",
            "assert False",
            "jnp.zeros(params.v)",
        ),
    ),
    "memory": (
        *(
            "'text'",
            "object()",
            "[1, 'a']",
            "step",
            "jnp.zeros",
            "{'a': 'b'}",
            "np.array([1, 'a'])",
        ),
        *("0", "np.zeros(2, int)", "[jnp.zeros(2)]", "None", "np.array([None])", "1j", "b'bytes'"),
    ),
    "field": (
        *("gain: float = None", "gain: float = 1j", "gain: str = 'high'", "gain: list = [1, 'a']"),
        *("gain: float = float('nan')", "gain: float = float('inf')", "gain: object = object()"),
        *(
            "gain: object = np.array([1, None])",
            "gain: list = [[1, 2], [None]]",
            "gain: object = len",
        ),
        *(
            "gain: object = np.array(['a'])",
            "gain: object = jnp.array([jnp.nan])",
            "gain: bytes = b''",
        ),
    ),
    "takes": ("", "params", "params, memory", "params, memory, seen, more", "*, params", "**seen"),
    "takes_init": ("", "params, more", "*, params"),
    "head": ("def :", "raise RuntimeError('head')", "import nothing", "sys.exit(3)", "1 / 0", "P"),
    "register": (
        *("", "rps_jax.register_law('{name}', rps_jax.Law(init, step), None)"),
        "rps_jax.register_law('{name}', rps_jax.Law(init, step), 3.0)",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step), [1.0])",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step), {P})",
        "rps_jax.register_law('{name}', None, {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(None, None), {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(init, 'step'), {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step, 'smell'), {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step, check=1), {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step, check=init), {P}())",
        "rps_jax.register_law('rps', rps_jax.Law(init, step), {P}())",
        "rps_jax.register_law(3, rps_jax.Law(init, step), {P}())",
        "rps_jax.register_law('{name}', rps_jax.Law(init, step), rps_jax.RPSParams())",
        "rps_jax.register_law('{name}')",
        "{P}.d_success = None\nrps_jax.register_law('{name}', rps_jax.Law(init, step), {P}())",
    ),
}
# Fragments above that give a valid law.
_VALID_LAWS = {
    *(f"memory: {value}" for value in ("0", "1j", "None", "[jnp.zeros(2)]", "np.zeros(2, int)")),
    "body: jax.random.key(seen.yaw)",
    "register: rps_jax.register_law('{name}', rps_jax.Law(init, step, check=init), {P}())",
}


def wrong_laws() -> Iterator[tuple[str, str]]:
    """Yield the fault of an invalid law and the text of its file."""
    for index, (slot, fragment) in enumerate((k, v) for k, vs in _WRONG.items() for v in vs):
        parts = {k: v.replace("{name}", f"wrong_{index}") for k, v in DEFAULTS.items()}
        parts[slot] = fragment.replace("{name}", f"wrong_{index}")
        text = LAW
        for key, part in parts.items():
            text = text.replace(f"{{{key}}}", part)
        yield f"{slot}: {fragment}", text.replace("{P}", f"P{index}")


def run_laws(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Run sweeps of invalid laws up to the first step of a world."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), never_stepping():
        for index, (title, text) in enumerate(itertools.islice(wrong_laws(), limit)):
            file = Path(f"law_{index}.py")
            file.write_text(text)
            result = attempt(("sweep", "--laws", f"{file}:P{index}", "--worlds", "8"))
            how = "right" if result.how == "accepted" and title in _VALID_LAWS else result.how
            counts[how] += 1
            if how not in ("refused", "right") or LOUD:
                tell(f"{how}: {title}\n{result.text[-1500:]}")
            shutil.rmtree("runs", ignore_errors=True)
    return counts


LOUD = False


# --- run folders that somebody edited or damaged ---------------------------------------------

ODD: tuple[Any, ...] = (
    *(None, True, -1, 0, 1.5, 10**30, float("inf"), float("nan"), "", "text", "1", [], {}, [[]]),
    *([None], ["a", "b"], [1, 2, 3], {"a": 1}, "x" * 1000, [[[[[[[[0]]]]]]]]),
)


class Edit(NamedTuple):
    """A change of one file of a run folder, consistent with its checksum unless it is damage."""

    title: str
    file: str
    make: Callable[[Path], None]


def json_paths(tree: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of keys and indices of each value in a JSON tree."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in inner:
        yield (*at, key)
        if isinstance(value, dict | list) and len(at) < 5:
            yield from json_paths(value, (*at, key))


def _changed(tree: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a copy of a JSON tree with another value at a path; `...` deletes the value."""
    tree = json.loads(json.dumps(tree))
    parent = tree
    for key in at[:-1]:
        parent = parent[key]
    if value is ...:
        del parent[at[-1]]
    else:
        parent[at[-1]] = value
    return tree


def _sign(path: Path) -> None:
    """Update the checksum of an edited file."""
    import hashlib

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    checksum_file = path.with_name(f"{path.name}.sha256")
    if checksum_file.exists():
        checksum_file.write_text(f"{digest}  {path.name}\n")
    if path.parent.name == "parts":
        name = path.stem.rpartition("-")[0]
        path.rename(path.with_name(f"{name}-{digest[:16]}{path.suffix}"))


def json_edits(path: Path, rng: random.Random, limit: int) -> Iterator[Edit]:
    """Yield replaced or deleted values of a JSON file."""
    tree = json.loads(path.read_text())
    candidates = [(at, value) for at in json_paths(tree) for value in (*ODD, ...)]
    for at, value in rng.sample(candidates, min(limit, len(candidates))):

        def make(file: Path, at: tuple[Any, ...] = at, value: Any = value) -> None:
            file.write_text(json.dumps(_changed(tree, at, value)))
            _sign(file)

        where = ".".join(map(str, at))
        yield Edit(f"{where} = {'nothing' if value is ... else repr(value)[:40]}", path.name, make)
    for value in (None, [], 7, "text", [{}]):

        def whole(file: Path, value: Any = value) -> None:
            file.write_text(json.dumps(value))
            _sign(file)

        yield Edit(f"the whole = {value!r}", path.name, whole)


def dataset_edits(path: Path, rng: random.Random, limit: int) -> Iterator[Edit]:
    """Yield other variables, shapes, types and units of a NetCDF file."""
    import numpy as np
    import xarray as xr

    with xr.open_dataset(path, engine="h5netcdf") as lazy:
        dataset = lazy.load()

    def column(name: str, values: Any, dims: Any = None, **attrs: Any) -> Any:
        old = dataset[name]
        new = (dims or old.dims, values, old.attrs | attrs)
        return dataset.drop_vars(name).assign({name: new})

    changes: list[tuple[str, Callable[[], Any]]] = []
    for name in map(str, dataset.variables):
        variable = dataset[name]

        def change(title: str, edit: Callable[[Any, str], Any], name: str = name) -> None:
            changes.append((f"{name}: {title}", lambda: edit(dataset[name], name)))

        change("is missing", lambda variable, name: dataset.drop_vars(name))
        change("other units", lambda variable, name: column(name, variable.values, units="furlong"))
        change("units are a number", lambda variable, name: column(name, variable.values, units=7))
        change("texts", lambda variable, name: column(name, variable.values.astype(str)))
        change("bytes", lambda variable, name: column(name, variable.values.astype("S8")))
        change("another name", lambda variable, name: dataset.rename({name: f"{name}_"}))
        if variable.dtype.kind in "fiu":
            change("NaN", lambda variable, name: column(name, np.full(variable.shape, np.nan)))
            change("huge", lambda variable, name: column(name, np.full(variable.shape, 1e300)))
            change("a number", lambda variable, name: column(name, 1.0, ()))
            change(
                "64 bits", lambda variable, name: column(name, variable.values.astype(complex).real)
            )
            change("complex", lambda variable, name: column(name, variable.values.astype(complex)))
        if variable.ndim:
            change(
                "one row less",
                lambda variable, name: dataset.isel({variable.dims[-1]: slice(1, None)}),
            )
            change(
                "another axis",
                lambda variable, name: column(
                    name, variable.values[None], ("more", *variable.dims)
                ),
            )
            change(
                "twice",
                lambda variable, name: column(
                    name,
                    np.concatenate([variable.values, variable.values]),
                    ("more", *variable.dims[1:]),
                ),
            )
    changes.append(("nothing in it", lambda: xr.Dataset()))
    changes.append(("another dataset", lambda: xr.Dataset({"a": ("b", [1, 2])})))
    for title, edit in rng.sample(changes, min(limit, len(changes))):

        def write(file: Path, edit: Callable[[], Any] = edit) -> None:
            try:
                edited = edit()
                for variable in edited.variables.values():
                    variable.encoding = {}
                content = bytes(edited.to_netcdf(engine="h5netcdf", invalid_netcdf=True))
            except Exception:  # xarray cannot write this dataset
                content = b"not written"
            file.write_bytes(content)
            _sign(file)

        yield Edit(title, path.name, write)


def archive_edits(path: Path, rng: random.Random, limit: int) -> Iterator[Edit]:
    """Yield other arrays of a NumPy archive."""
    import numpy as np

    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    changes: list[tuple[str, dict[str, Any]]] = []
    for name, array in arrays.items():
        less = {k: v for k, v in arrays.items() if k != name}
        changes += [
            (f"{name} is missing", less),
            (f"{name}: texts", arrays | {name: array.astype(str)}),
            (f"{name}: flat", arrays | {name: array.ravel()[:1]}),
            (f"{name}: another axis", arrays | {name: array[None]}),
            (f"{name}: pickles", arrays | {name: np.array([{"a": 1}], object)}),
            (f"{name}: structured", arrays | {name: np.zeros(2, "i4,f4")}),
        ]
        if array.dtype.kind in "fiu":
            changes += [
                (f"{name}: NaN", arrays | {name: np.full(array.shape, np.nan)}),
                (f"{name}: other bits", arrays | {name: array.astype(np.float16)}),
            ]
        if array.dtype.kind == "U":
            try:
                tree = json.loads(str(array))
            except ValueError:
                continue
            candidates = [(at, value) for at in json_paths(tree) for value in (*ODD, ...)]
            for at, value in rng.sample(candidates, min(40, len(candidates))):
                encoded = json.dumps(_changed(tree, at, value))
                changes.append(
                    (f"{name}.{at} = {value!r}"[:80], arrays | {name: np.array(encoded)})
                )
    for title, content in rng.sample(changes, min(limit, len(changes))):

        def write(file: Path, content: dict[str, Any] = content) -> None:
            np.savez(file, **content)
            _sign(file)

        yield Edit(title, path.name, write)


def discard(*_: Any) -> None:
    """Return None, so that a lambda can run several actions."""


def damages(path: Path, rng: random.Random, limit: int) -> Iterator[Edit]:
    """Yield corrupt contents, and folders, pipes and links in place of the file."""
    content = path.read_bytes()

    def bytes_(title: str, new: bytes) -> Edit:
        return Edit(title, path.name, lambda file: discard(file.write_bytes(new)))

    def instead(title: str, make: Callable[[Path], Any]) -> Edit:
        return Edit(title, path.name, lambda file: discard(file.unlink(), make(file)))

    at = rng.randrange(max(1, len(content)))
    flipped = content[:at] + bytes([content[at] ^ 1 << rng.randrange(8)]) + content[at + 1 :]
    edits = [
        bytes_("empty", b""), bytes_(f"cut at {at}", content[:at]), bytes_("twice", content * 2),
        bytes_(f"bit at {at}", flipped), bytes_("zeros", bytes(len(content))),
        bytes_("random", rng.randbytes(len(content))), bytes_("HDF5 in name", b"\x89HDF\r\n\x1a\n"),
        bytes_("zip in name", b"PK\x03\x04" + bytes(500)), bytes_("deep", b"[" * 100_000),
        bytes_("text", b"a note\n"), bytes_("backwards", content[::-1]),
        instead("is gone", lambda file: None), instead("a pipe", os.mkfifo),
        instead("a folder", Path.mkdir),
        instead("zeros for ever", lambda file: file.symlink_to("/dev/zero")),
        instead("a circle", lambda file: file.symlink_to(file)),
        instead("a link to nothing", lambda file: file.symlink_to("/nowhere")),
        instead("memory", lambda file: file.symlink_to("/proc/self/mem")),
    ]  # fmt: skip
    yield from rng.sample(edits, min(limit, len(edits)))


@functools.cache
def _furnished(learned: bool) -> tuple[Path, dict[str, list[tuple[str, ...]]]]:
    """Return a temporary folder with small runs, and the commands that read them."""
    home = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    with contextlib.chdir(home):
        return home, furnish_runs(home, learned)


def furnish_runs(folder: Path, learned: bool) -> dict[str, list[tuple[str, ...]]]:
    """Write small runs of several kinds, and return the commands that read each of them.

    A law is `learned` if it is worth the minute that this takes.
    """
    import rps_jax
    from rps_jax.control.learned import policy
    from rps_jax.world import points

    (folder / "drums.json").write_text('{"objects": ["random_cylinder"]}')
    drums = rps_jax.Domain(("random_cylinder",))
    at = points.worlds_at(drums, points.points_of(drums, range(12)))
    small_run(folder / "points", worlds=None, points=at)
    (folder / "policy").mkdir()
    shutil.copy(Path(policy.__file__).parent / "learned_mlp.npz", folder / "policy" / "policy.npz")
    for command in (SWEEP, TUNE, LEARN)[: 3 if learned else 2]:
        if (result := attempt(command, 300)).how != "told":
            raise RuntimeError(f"rps {' '.join(command)} made no run ({result.how}): {result.text}")
    return {
        "sweep": [
            ("merge", "sweep", "--out", "merged"), ("replay", "sweep", "0"), ("film", "sweep"),
            ("gallery", "sweep", "--each", "1"), ("view", "sweep", "0"),
            ("ceiling", "sweep", "--lost-by", "rps", "--sample", "1"), SWEEP,
        ],
        "points": [("merge", "points", "--out", "merged"), ("replay", "points", "0")],
        "tune": [TUNE, ("push", "--law", "rps,tune/tuned.json")],
        "policy": [("push", "--skin", "capacitive", "--law", "policy/policy.npz")],
        **({"learn": [LEARN, ("export", "c", "--law", "learn/policy.npz")]} if learned else {}),
    }  # fmt: skip


SWEEP = (
    *("sweep", "--domain", "drums.json", "--laws", "rps", "nps", "--worlds", "12"),
    *("--engine", "quasistatic", "--horizon", "2", "--part", "4", "--out", "sweep"),
)
TUNE = (
    *("tune", "es", "--quick", "--generations", "2", "--population", "4", "--worlds", "2"),
    *("--validation", "2", "--horizon", "2", "--out", "tune", "--tuned", "K_h", "L"),
)
LEARN = (
    *("learn", "--quick", "--updates", "1", "--minutes", "0", "--num-envs", "4", "--drawn", "4"),
    *("--validation", "2", "--width", "4", "--num-steps", "2", "--num-minibatches", "1"),
    *("--out", "learn", "--engine", "quasistatic", "--domain", "wide,objects=random_cylinder"),
)


def run_edits(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Run commands on edited run folders up to the first step of a world."""
    return _run_folders(limit, seed, tell, (json_edits, dataset_edits, archive_edits))


def run_damages(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Run commands on damaged run folders up to the first step of a world."""
    return _run_folders(limit, seed, tell, (damages,))


def _run_folders(
    limit: int, seed: int, tell: Callable[[str], None], kinds: Sequence[Callable[..., Any]]
) -> Counter[str]:
    counts: Counter[str] = Counter()
    rng = random.Random(seed)
    readers = {".json": json_edits, ".nc": dataset_edits, ".npz": archive_edits}
    home, reads = _furnished(learned=limit >= 100)
    with contextlib.chdir(home):
        candidates = []
        for name in reads:
            for path in sorted(Path(name).rglob("*")):
                editor = damages if damages in kinds else readers.get(path.suffix)
                if editor in kinds and editor and path.is_file() and not path.name.startswith("."):
                    for edit in editor(path, rng, max(4, limit // 8)):
                        candidates.append((name, path, edit))
        with never_stepping():
            for name, path, edit in rng.sample(candidates, min(limit, len(candidates))):
                shutil.move(name, f"{name}.sound")
                shutil.copytree(f"{name}.sound", name)
                edit.make(path)
                command = rng.choice(reads[name])
                result = attempt(command)
                counts[result.how] += 1
                if result.how in ("traceback", "hang", "wordy") or LOUD:
                    summary = f"{result.how}: {path}: {edit.title}: rps {' '.join(command)}"
                    tell(f"{summary}\n{result.text[-1800:]}")
                shutil.rmtree(name)
                shutil.move(f"{name}.sound", name)
                for leftover in ("merged", "runs"):
                    shutil.rmtree(leftover, ignore_errors=True)
    return counts


# --- the table -------------------------------------------------------------------------------


def run_values(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Run commands with bad values up to the first step of a world."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        furnish(Path(folder))
        with never_stepping():
            for case in itertools.islice(values(seed), limit):
                result = attempt(case.arguments)
                counts[result.how] += 1
                if result.how in ("traceback", "hang", "wordy"):
                    tell(f"{result.how}: rps {case.arguments}"[:400] + f"\n{result.text[-1500:]}")
                for name in ("runs", "merged"):
                    shutil.rmtree(name, ignore_errors=True)
    return counts


CLASSES = {
    "values": (run_values, 6000),
    "laws": (run_laws, 1000),
    "edits": (run_edits, 800),
    "damages": (run_damages, 500),
}


def main() -> int:
    """Inject the faults, print failures and the table of outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("classes", nargs="*", default=list(CLASSES), metavar="CLASS")
    parser.add_argument("--most", type=int, help="cases of each class")
    parser.add_argument("--seed", type=int, default=0)
    choice = parser.parse_args()
    table = {}
    for name in choice.classes:
        run, default = CLASSES[name]
        start_time = time.monotonic()
        counts = run(choice.most or default, choice.seed, lambda text: print(text, flush=True))
        table[name] = dict(counts) | {"seconds": round(time.monotonic() - start_time)}
        print(json.dumps({name: table[name]}), flush=True)
    bad = sum(
        counts_of_class.get(how, 0)
        for counts_of_class in table.values()
        for how in ("traceback", "hang", "wordy")
    )
    return int(bad > 0)


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    sys.exit(main())
