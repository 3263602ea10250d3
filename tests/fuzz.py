"""Faults of many classes, injected into the command line.

    python tests/fuzz.py                  # all classes
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
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from helpers import setting_of

PATIENCE = 10.0  # [s] after which a command hangs


class Attempt(NamedTuple):
    """Outcome of a command that was given a fault."""

    how: str  # refused, wordy, accepted, told, traceback, hang
    text: str


class Accepted(BaseException):
    """Signal that the input was accepted and stepping would start."""


class Hang(BaseException):
    """Signal that a command exceeded its time limit."""


def never_stepping() -> contextlib.ExitStack:
    """Stop commands before the first world is stepped or the first program is compiled."""
    from rps_jax.app import film
    from rps_jax.trials import trial
    from rps_jax.tuning.learn import Learn

    stack = contextlib.ExitStack()
    for owner, name in ((trial, "start_all"), (Learn, "answer"), (film, "_shots")):
        stack.enter_context(mock.patch.object(owner, name, side_effect=Accepted))
    return stack


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


# A fault: its title, the command, and how else than refused the command may end.
Fault = tuple[str, Sequence[str], Sequence[str]]


def inject(
    faults: Callable[[int, int], Iterator[Fault]], limit: int, seed: int, tell: Callable[[str], Any]
) -> Counter[str]:
    """Run commands with faults up to the first step of a world, and count how they end."""
    counts: Counter[str] = Counter()
    for title, command, allowed in faults(limit, seed):
        with never_stepping():
            result = attempt(command)
        counts[result.how] += 1
        if result.how not in ("refused", *allowed):
            words = f"{result.how}: {title}: rps {' '.join(command)}"
            tell(f"{words[:400]}\n{result.text[-1800:]}")
        for leftover in ("merged", "runs"):
            shutil.rmtree(leftover, ignore_errors=True)
    return counts


# --- bad values of options -----------------------------------------------------------------


def _words(text: str) -> list[str]:
    return text.split()


VALUES = (
    "",
    " ",
    *_words("nan -nan inf -inf 1e400 -1e400 1e-320 -1 0 -0 0.5 1e9 1e308"),
    "9" * 60,
    "-" + "9" * 60,
    "9" * 5000,
    "0x10",
    "1_000",
    "\u0661",
    "\u00b2",
    *_words("""
    None null true [] {} () [[[[ {] a=b = L= =1 L=nan L=1e400 mass=3 mass=3,nan mass=9,3
    mass=, 1/0 0/1 2/1 -1/3 a/b
    """),
    "1/" + "9" * 60,
    *_words("S1,S2 0.3,0.3,0.3 0,0 nan,nan rps rps,rps RPS"),
    "aps ",
    *_words("""
    nowhere.json nowhere.py:P nowhere.npz .json .py: .npz : .. / . /dev/null /dev/zero
    /dev/zero.json /proc/self/mem /etc/passwd ~ $HOME list.json null.json deep.json
    text.json binary.json empty.json number.json big.json pipe.json pipe.npz pipe.py:P
    folder.json pipe folder.npz broken.py:P syntax.py:P text.npz encrypted.npz zip.npz
    exit.py:P
    """),
    "\N{SNOWMAN}",
    "\N{PILE OF POO}" * 40,
    "\u202eabc",
    "\x1b[31m",
    "a\nb",
    "x" * 4000,
    "-",
    "--",
    "a b",
    "'",
    '"',
    "\\",
    *_words("%s {0} `id` ;ls && * ?"),
    "\t",
    "--help",
    "-1.5",
    "+5",
)


def furnish(folder: Path) -> None:
    """Write the files that `VALUES` names."""
    contents = {
        "list.json": b"[1, 2]",
        "null.json": b"null",
        "number.json": b"7",
        "deep.json": b"[" * 100_000,
        "text.json": b"a note",
        "binary.json": bytes(range(256)),
        "empty.json": b"",
        "big.json": b'{"a": ' + b"9" * 10_000 + b"}",
        "broken.py": b"raise RuntimeError('broken')\n",
        "syntax.py": b"def :\n",
        "exit.py": b"import sys\nsys.exit(3)\n",
        "text.npz": b"a note",
        "zip.npz": b"PK\x05\x06" + bytes(18),
        "encrypted.npz": encrypted(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
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
    setting = setting_of(2.0)
    options = {"worlds": 8, "setting": setting, "out": folder, "part": 4, "progress": False}
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


def values(limit: int, seed: int) -> Iterator[Fault]:
    """Yield some options of all commands with some values, in random order."""
    from command_line import RECORD

    cases = [
        (*name.split(), *NEEDS.get(name, ()), option, value)
        for name, options in json.loads(RECORD.read_text()).items()
        for option in options
        for value in VALUES
        if option.startswith("--")
        if not (option == "--out" and value in ("/", "..", "~"))  # these may be writable
    ]
    random.Random(seed).shuffle(cases)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        furnish(Path(folder))
        for command in cases[:limit]:
            yield "a value", command, ("accepted", "told")


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
    "head": "",
    "field": "",
    "before": "",
    "takes_init": "params",
    "starts": "pass",
    "memory": "jnp.zeros(2)",
    "takes": "params, memory, seen",
    "body": "pass",
    "returns": "memory, Twist(params.v, 0.0, 0.0), Details.from_obs(seen)",
    "register": "rps_jax.register_law('{name}', rps_jax.Law(init, step), {P}())",
}
MEMORY = "{}, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)"
TWIST = "memory, {}, Details.from_obs(seen)"
DETAILS = "memory, Twist(0.0, 0.0, 0.0), {}"
REGISTER = "rps_jax.register_law({}, rps_jax.Law({}), {})"


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.strip().splitlines()]


_WRONG: dict[str, Sequence[str]] = {
    "returns": (
        *_lines("""
            None
            'text'
            memory
            (memory, Twist(0.0, 0.0, 0.0))
            {}
            ()
            iter(())
            Twist(0.0, 0.0, 0.0)
            step
            seen
            {'memory': memory}
            [memory, Twist(0.0, 0.0, 0.0), Details.from_obs(seen)]
        """),
        *map(DETAILS.format, ("None", "Details(0, 0, 0, 0, here)", "Details.from_obs(seen), 1")),
        *map(DETAILS.format, ("Details(*5 * [None])",)),
        *map(TWIST.format, ("None", "'left'", "(0.0, 0.0)", "here", "[0, 0, 0]", "jnp.zeros(3)")),
        *map(TWIST.format, ("Twist(here, 0.0, 0.0)", "Twist('a', 0.0, 0.0)", "Twist(None, 0, 0)")),
        *map(TWIST.format, ("Twist(1j, 0.0, 0.0)", "Twist(seen.in_contact, 0, 0)", "Twist")),
        *map(MEMORY.format, ("jnp.concatenate([memory, here])", "memory[0]", "None", "memory > 0")),
        *map(MEMORY.format, ("(memory, memory)", "{'x': memory}", "memory.astype(int)")),
    ),
    "body": (
        *_lines("""
            if seen.in_contact: pass
            float(seen.yaw)
            1 / 0
            int(seen.yaw)
            nothing
            np.sin(seen.yaw)
            math.sin(seen.yaw)
            np.asarray(here)
            seen.yaw.item()
            range(seen.yaw)
            here.tolist()
            here[9.0]
            jnp.arange(seen.yaw)
            [1, 2][seen.yaw]
            seen.nothing
            memory['a']
            raise ValueError
            step()
            raise RuntimeError('a\\nb')
            assert seen.in_contact
            step(params, memory, seen)
            import nothing
            open('/nowhere')
            sys.exit(3)
            here[0] = 1.0
            min(here)
            here + jnp.zeros(3)
            jnp.reshape(here, 5)
            here[seen.in_contact]
            (lambda: 1)(2)
            jax.lax.cond(here, None, None)
            sum(here, 'a')
            here.astype('nothing')
            jnp.linalg.inv(here)
            jax.lax.scan(lambda c, x: (c, c, x), 0, here)
            seen.yaw = 3
            jax.grad(lambda x: here)(1.0)
            np.random.default_rng(seen.yaw)
            jnp.where(1, 2)
            jax.random.key(seen.yaw)
            here.at[9].nothing(1)
            f'{seen.yaw:.2f}'
            jnp.concatenate([here, seen.yaw])
        """),
    ),
    "starts": (
        *_lines("""
            raise ValueError('no')
            1 / 0
            params.nothing
            if params.v > 0: pass
            nothing
            float(params.v)
            np.sin(params.v)
            sys.exit(3)
            assert False
            jnp.zeros(params.v)
        """),
    ),
    "memory": (
        *_lines("""
            'text'
            object()
            [1, 'a']
            step
            jnp.zeros
            {'a': 'b'}
            0
            None
            1j
            np.array([1, 'a'])
            np.zeros(2, int)
            [jnp.zeros(2)]
            np.array([None])
            b'bytes'
        """),
    ),
    "field": tuple(
        f"gain: {kind} = {value}"
        for kind, defaults in {
            "float": ("None", "1j", "float('nan')", "float('inf')"),
            "str": ("'high'",),
            "list": ("[1, 'a']", "[[1, 2], [None]]"),
            "bytes": ("b''",),
            "object": (
                "object()",
                "np.array([1, None])",
                "slice(3)",
                "np.array(['a'])",
                "jnp.array([jnp.nan])",
            ),
        }.items()
        for value in defaults
    ),
    "takes": ("", "params", "params, memory", "params, memory, seen, more", "*, params", "**seen"),
    "takes_init": ("", "params, more", "*, params"),
    "head": _lines("""
            def :
            raise RuntimeError('head')
            import nothing
            sys.exit(3)
            1 / 0
            P
        """),
    "register": (
        "",
        "rps_jax.register_law('{name}')",
        "rps_jax.register_law('{name}', None, {P}())",
        *(
            REGISTER.format("'{name}'", "init, step", params)
            for params in ("None", "3.0", "[1.0]", "{P}", "rps_jax.RPSParams()")
        ),
        *(
            REGISTER.format("'{name}'", law, "{P}()")
            for law in (
                "None, None",
                "init, 'step'",
                "init, step, 'smell'",
                "init, step, check=1",
                "init, step, check=init",
            )
        ),
        *(REGISTER.format(name, "init, step", "{P}()") for name in ("'rps'", "3")),
        "{P}.d_success = None\n" + REGISTER.format("'{name}'", "init, step", "{P}()"),
    ),
}
# Fragments above that give a valid law.
_VALID_LAWS = {
    *(f"memory: {value}" for value in ("0", "1j", "None", "[jnp.zeros(2)]", "np.zeros(2, int)")),
    "body: jax.random.key(seen.yaw)",
    "register: " + REGISTER.format("'{name}'", "init, step, check=init", "{P}()"),
}


def wrong_laws(limit: int, seed: int) -> Iterator[Fault]:
    """Yield sweeps of invalid laws, in files of a temporary folder."""
    fragments = [(slot, fragment) for slot, texts in _WRONG.items() for fragment in texts]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for index, (slot, fragment) in enumerate(fragments[:limit]):
            text = LAW
            for key, part in (DEFAULTS | {slot: fragment}).items():
                text = text.replace(f"{{{key}}}", part)
            text = text.replace("{name}", f"wrong_{index}").replace("{P}", f"P{index}")
            Path(f"law_{index}.py").write_text(text)
            command = ("sweep", "--laws", f"law_{index}.py:P{index}", "--worlds", "8")
            title = f"{slot}: {fragment}"
            yield title, command, ("accepted",) * (title in _VALID_LAWS)


# --- run folders that somebody edited --------------------------------------------------------

ODD: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**30,
    float("inf"),
    float("nan"),
    "",
    "text",
    "1",
    [],
    {},
    [[]],
    [None],
    ["a", "b"],
    [1, 2, 3],
    {"a": 1},
    "x" * 1000,
    [[[[[[[[0]]]]]]]],
)


# The title of a change of a file in a run folder, and a function that makes it.
Edit = tuple[str, Callable[[Path], Any]]


def json_paths(tree: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of keys and indices of each value in a JSON tree."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in inner:
        yield (*at, key)
        if isinstance(value, dict | list) and len(at) < 5:
            yield from json_paths(value, (*at, key))


def _changed(tree: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a copy of a JSON tree with another value at a path; `...` deletes the value."""
    if not at:
        return value
    parent = tree = json.loads(json.dumps(tree))
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


def json_edits(path: Path, rng: random.Random) -> list[Edit]:
    """Return edits that replace or delete values of a JSON file."""
    tree = json.loads(path.read_text())

    write = lambda file, at, value: file.write_text(json.dumps(_changed(tree, at, value)))  # noqa: E731
    candidates = [((), value) for value in (None, [], 7, "text", [{}])]
    candidates += [(at, value) for at in json_paths(tree) for value in (*ODD, ...)]
    return [
        (f"{'.'.join(map(str, at))} = {value!r:.40}", partial(write, at=at, value=value))
        for at, value in candidates
    ]


def _changes(dataset: Any, name: str) -> dict[str, Callable[[], Any]]:
    """Return functions that build the dataset with one variable changed, by title."""
    import numpy as np

    x, dims = dataset[name].values, dataset[name].dims

    def column(values: Any, dims: Any = dims, **attrs: Any) -> Any:
        return dataset.drop_vars(name).assign({name: (dims, values, dataset[name].attrs | attrs)})

    changes: dict[str, Callable[[], Any]] = {
        "is missing": lambda: dataset.drop_vars(name),
        "another name": lambda: dataset.rename({name: f"{name}_"}),
        "other units": lambda: column(x, units="furlong"),
        "units are a number": lambda: column(x, units=7),
        "texts": lambda: column(x.astype(str)),
        "bytes": lambda: column(x.astype("S8")),
    }
    if x.dtype.kind in "fiu":
        changes |= {
            "NaN": lambda: column(np.full(x.shape, np.nan)),
            "huge": lambda: column(np.full(x.shape, 1e300)),
            "a number": lambda: column(1.0, ()),
            "64 bits": lambda: column(x.astype(complex).real),
            "complex": lambda: column(x.astype(complex)),
        }
    if dims:
        changes |= {
            "one row less": lambda: dataset.isel({dims[-1]: slice(1, None)}),
            "another axis": lambda: column(x[None], ("more", *dims)),
            "twice": lambda: column(np.concatenate([x, x]), ("more", *dims[1:])),
        }
    return {f"{name}: {title}": change for title, change in changes.items()}


def dataset_edits(path: Path, rng: random.Random) -> list[Edit]:
    """Return edits to other variables, shapes, types and units of a NetCDF file."""
    import xarray as xr

    def write(file: Path, change: Callable[[], Any]) -> None:
        try:
            edited = change()
            for variable in edited.variables.values():
                variable.encoding = {}
            content = bytes(edited.to_netcdf(engine="h5netcdf", invalid_netcdf=True))
        except Exception:  # xarray cannot write this dataset
            content = b"not written"
        file.write_bytes(content)

    with xr.open_dataset(path, engine="h5netcdf") as lazy:
        dataset = lazy.load()
    changes: dict[str, Callable[[], Any]] = {
        "nothing in it": xr.Dataset,
        "another dataset": lambda: xr.Dataset({"a": ("b", [1, 2])}),
    }
    for name in map(str, dataset.variables):
        changes |= _changes(dataset, name)
    return [(title, partial(write, change=change)) for title, change in changes.items()]


def archive_edits(path: Path, rng: random.Random) -> list[Edit]:
    """Return edits to other arrays of a NumPy archive."""
    import numpy as np

    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    edits: list[Edit] = []
    for name, array in arrays.items():
        contents: dict[str, Any] = {
            "texts": array.astype(str),
            "flat": array.ravel()[:1],
            "another axis": array[None],
            "pickles": np.array([{"a": 1}], object),
            "structured": np.zeros(2, "i4,f4"),
        }
        if array.dtype.kind in "fiu":
            contents |= {"NaN": np.full(array.shape, np.nan), "bits": array.astype(np.float16)}
        if array.dtype.kind == "U":
            with contextlib.suppress(ValueError):
                tree = json.loads(str(array))
                candidates = [(at, value) for at in json_paths(tree) for value in (*ODD, ...)]
                for at, value in rng.sample(candidates, min(40, len(candidates))):
                    changed = np.array(json.dumps(_changed(tree, at, value)))
                    contents[f"{at} = {value!r:.40}"] = changed
        rest = {key: value for key, value in arrays.items() if key != name}
        edits += [(f"{name} is missing", partial(np.savez, **rest))]
        edits += [
            (f"{name}: {title}", partial(np.savez, **arrays | {name: content}))
            for title, content in contents.items()
        ]
    return edits


SHORT = "--engine quasistatic --horizon 2"
DRUMS = "--domain wide,objects=random_cylinder"
# Commands that make a run folder quickly.
COMMANDS = {
    "sweep": f"sweep {SHORT} {DRUMS} --laws rps nps --worlds 24 --part 4",
    "tune": f"tune es --quick {SHORT} {DRUMS} --generations 4 --population 4 --worlds 2 "
    "--validation 2 --tuned K_h L",
    "learn": f"learn --quick --engine quasistatic {DRUMS} --updates 3 --minutes 0 --num-envs 4 "
    "--drawn 4 --validation 2 --width 4 --num-steps 2 --num-minibatches 1",
}


@functools.cache
def _furnished(complete: bool) -> tuple[Path, dict[str, list[str]]]:
    """Return a temporary folder with small runs, and the commands that read them."""
    home = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    with contextlib.chdir(home):
        return home, furnish_runs(home, complete)


def furnish_runs(folder: Path, complete: bool) -> dict[str, list[str]]:
    """Write small runs of several kinds, and return the commands that read each of them.

    A complete set has a tuned and a learned law, which take a minute.
    """
    import rps_jax
    from rps_jax.control.learned import policy
    from rps_jax.world import points

    drums = rps_jax.Domain(("random_cylinder",))
    at = points.worlds_at(drums, points.points_of(drums, range(12)))
    small_run(folder / "points", worlds=None, points=at)
    (folder / "policy").mkdir()
    shutil.copy(
        Path(policy.__file__).parent / "learned_small.npz", folder / "policy" / "policy.npz"
    )
    runs = {name: f"{words} --out {name}" for name, words in COMMANDS.items()}
    for command in [runs[name] for name in runs if complete or name == "sweep"]:
        if (result := attempt(command.split(), 300)).how != "told":
            raise RuntimeError(f"rps {command} made no run ({result.how}): {result.text}")
    reads = {
        "sweep": [
            "merge sweep --out merged",
            "replay sweep 0",
            "film sweep",
            "gallery sweep --each 1",
            "view sweep 0",
            "ceiling sweep --lost-by rps --sample 1",
            runs["sweep"],
        ],
        "points": ["merge points --out merged", "replay points 0"],
        "tune": [runs["tune"], "push --law rps,tune/tuned.json"],
        "policy": ["push --skin capacitive --law policy/policy.npz"],
        "learn": [runs["learn"], "export c --law learn/policy.npz"],
    }
    return {
        name: words for name, words in reads.items() if complete or name not in ("tune", "learn")
    }


def edited_folders(limit: int, seed: int) -> Iterator[Fault]:
    """Yield commands that read a run folder with one file edited consistently."""
    rng = random.Random(seed)
    readers = {".json": json_edits, ".nc": dataset_edits, ".npz": archive_edits}
    home, reads = _furnished(complete=limit >= 100)
    with contextlib.chdir(home):
        candidates = []
        for path in (path for name in reads for path in sorted(Path(name).rglob("*"))):
            editor = readers.get(path.suffix)
            if editor and path.is_file() and not path.name.startswith("."):
                edits = editor(path, rng)
                sample = rng.sample(edits, min(len(edits), max(4, limit // 8)))
                candidates += [(path.parts[0], path, *edit) for edit in sample]
        for name, path, title, make in rng.sample(candidates, min(limit, len(candidates))):
            shutil.move(name, f"{name}.sound")
            shutil.copytree(f"{name}.sound", name)
            make(path)
            _sign(path)
            yield f"{path}: {title}", rng.choice(reads[name]).split(), ("accepted", "told")
            shutil.rmtree(name)
            shutil.move(f"{name}.sound", name)


# --- the table -------------------------------------------------------------------------------

CLASSES = {
    "values": (partial(inject, values), 6000),
    "laws": (partial(inject, wrong_laws), 1000),
    "edits": (partial(inject, edited_folders), 800),
}


def main() -> int:
    """Inject the faults of some classes, and print failures and the table of outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("classes", nargs="*", default=list(CLASSES), metavar="CLASS")
    parser.add_argument("--most", type=int, help="cases of each class")
    parser.add_argument("--seed", type=int, default=0)
    choice, failures = parser.parse_args(), []

    def tell(text: str) -> None:
        failures.append(text)
        print(text, flush=True)

    for name in choice.classes:
        run, default = CLASSES[name]
        counts = run(choice.most or default, choice.seed, tell)
        print(json.dumps({name: counts}), flush=True)
    return int(bool(failures))


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    sys.exit(main())
