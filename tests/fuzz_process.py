"""Faults that need separate processes: kills, full disks, signals, pipes, locales, neighbours.

    python tests/fuzz_process.py            # all classes, about twenty minutes on two cores
    python tests/fuzz_process.py kills --most 14

A killed command is repeated with the same arguments until it ends. Its results must then equal
those of an undisturbed command bit for bit, except for clocks.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

RPS = (sys.executable, "-m", "rps_jax")
HOME = Path(__file__).parents[1]
SHORT = ("--engine", "quasistatic", "--horizon", "2")
DRUMS = ("--domain", "wide,objects=random_cylinder")
SMALL = ("--laws", "rps", "nps", "--worlds", "24", "--part", "4")
SWEEP = ("sweep", *SHORT, *DRUMS, *SMALL)
KILLED: dict[str, tuple[str, ...]] = {
    "sweep": SWEEP,
    "ladder": (
        "ladder",
        *SHORT,
        *DRUMS,
        *SMALL,
    ),
    "table": (
        "table",
        *SHORT,
        "--objects",
        "cylinder",
        "--friction",
        "S1",
    ),
    "sensitivity": ("sensitivity", *SHORT, *DRUMS, "--worlds", "100"),
    "attack": (
        *("attack", *SHORT, *DRUMS, "--axes", "size", "mass", "friction_robot", "--cells", "3"),
        *[
            "--batch",
            "8",
            "--generations",
            "4",
            "--minutes",
            "30",
            "--drawn",
            "8",
            "--check-again",
            "0",
            "--repeats",
            "1",
        ],
    ),
    "tune": (
        *("tune", "es", "--quick", *SHORT, *DRUMS, "--generations", "4", "--population", "4"),
        *("--worlds", "2", "--validation", "2", "--tuned", "K_h", "L"),
    ),
    "learn": (
        *("learn", "--quick", "--engine", "quasistatic", *DRUMS, "--updates", "3"),
        *[
            "--minutes",
            "0",
            "--num-envs",
            "4",
            "--drawn",
            "4",
            "--validation",
            "2",
            "--width",
            "4",
            "--num-steps",
            "2",
        ],
        *("--num-minibatches", "1"),
    ),
}
_CLOCKS = (
    "compile",
    "run",
)  # of a tuner's generation; other clocks have "wall clock" in their long name


def start(*words: str, **how: Any) -> subprocess.Popen[str]:
    """Start a command on the CPU with captured output."""
    env = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(HOME)} | how.pop("env", {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | how
    return subprocess.Popen([*RPS, *words], env=env, **pipes)


def ended(process: subprocess.Popen[str], patience: float = 300.0) -> tuple[int, str]:
    """Return exit code and output of a process; kill it when it takes too long."""
    try:
        out, err = process.communicate(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return -1, "hang"
    return process.returncode, (out or "") + (err or "")


def payload(folder: Path) -> dict[str, Any]:
    """Return all variables and arrays of a run folder except clocks, by file and name."""
    import numpy as np
    import xarray as xr

    contents: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".nc" and path.parent == folder:
            with xr.open_dataset(path, engine="h5netcdf") as data:
                for key, variable in data.variables.items():
                    if key not in _CLOCKS and "wall clock" not in variable.attrs.get(
                        "long_name", ""
                    ):
                        contents[f"{name}:{key}"] = (
                            variable.dims,
                            str(variable.dtype),
                            variable.values.tobytes(),
                        )
                        if variable.dtype == object:
                            contents[f"{name}:{key}"] = (
                                variable.dims,
                                "text",
                                tuple(variable.values.ravel()),
                            )
        elif path.name in ("policy.npz", "elites.npz"):
            with np.load(path, allow_pickle=False) as archive:
                for key in archive.files:
                    if archive[key].dtype.kind != "U":
                        contents[f"{name}:{key}"] = archive[key].tobytes()
        elif path.name == "tuned.json":
            contents[name] = json.loads(path.read_text()).get("params", path.read_text())
    return contents


def fault(text: str) -> str:
    """Return "hang" or "Traceback" if the output of a command shows it, else ""."""
    return "hang" if text == "hang" else "Traceback" * ("Traceback (most recent" in text)


def run_kills(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Kill seven commands at random times, repeat them, and compare their results."""
    counts: Counter[str] = Counter()
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as home:
        for index, (name, words) in enumerate(KILLED.items()):
            kills = limit // len(KILLED) + (index < limit % len(KILLED))
            ended(start(*words, "--out", f"{home}/warm-{name}"))  # compiles
            start_time = time.monotonic()
            code, text = ended(start(*words, "--out", f"{home}/{name}"))
            whole = time.monotonic() - start_time
            if code or fault(text):
                counts["traceback"] += 1
                tell(f"{name}: code {code}: {text[-1500:]}")
                continue
            right, done = payload(Path(home, name)), 0
            if not right:
                counts["wrong"] += 1
                tell(f"{name}: holds nothing")
            while done < kills:
                out = Path(home, f"{name}-{done}")
                for _ in range(rng.randint(2, 6)):
                    process = start(*words, "--out", str(out))
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(rng.uniform(0.3, 1.0) * whole)
                    process.kill()
                    counts["killed" if process.wait() < 0 else "ended before"] += 1
                    process.communicate()
                    done += 1
                code, text = ended(start(*words, "--out", str(out)))
                again = payload(out)
                if code or fault(text) or again.keys() != right.keys():
                    counts["traceback" if fault(text) else "wrong"] += 1
                    tell(f"{name}: code {code}: {text[-1500:]}")
                elif bad := [key for key in right if right[key] != again[key]]:
                    counts["wrong"] += 1
                    tell(f"{name}: other values in {bad}")
                else:
                    counts["equal"] += 1
    return counts


# --- the machine ---------------------------------------------------------------------------------


@contextlib.contextmanager
def small_disk(megabytes: float) -> Iterator[Path]:
    """Mount a small file system and yield its folder; this needs the right to mount."""
    with tempfile.TemporaryDirectory() as mount_point:
        size = f"size={int(megabytes * 1024)}k"
        words = ["mount", "-t", "tmpfs", "-o", size, "tmpfs", mount_point]
        if subprocess.run(words, capture_output=True).returncode:
            raise PermissionError("this user may not mount a small disk")
        try:
            yield Path(mount_point)
        finally:
            subprocess.run(["umount", "-l", mount_point], check=True)


def limited(kilobytes: int) -> Callable[[], None]:
    """Return a `preexec_fn` that limits the size of a child's files, as on a full disk."""

    def limit() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (kilobytes * 1024, kilobytes * 1024))

    return limit


def machine(home: Path) -> Iterator[tuple[str, str, int, str]]:
    """Yield faults of the machine: title, expected exit code, exit code and output."""
    sound = home / "sound"
    ended(start(*SWEEP, "--out", str(sound)))
    right = payload(sound)

    def same(folder: Path) -> str:
        return "" if payload(folder) == right else "Traceback (most recent): a wrong result"

    for size in (1, 4, 16):
        out = home / f"full-{size}"
        code, text = ended(start(*SWEEP, "--out", str(out), preexec_fn=limited(size)))
        yield f"files of {size} kB at most", "2", code, text
        code, text = ended(start(*SWEEP, "--out", str(out)))
        yield f"after files of {size} kB at most", "0", code, text + same(out)
    try:
        for size in (0.05, 0.2):
            with small_disk(size) as disk:
                code, text = ended(start(*SWEEP, "--out", str(disk / "run")))
                yield f"a disk of {size} MB", "2", code, text
    except PermissionError as error:
        print(f"left out: {error}")
    for title, temporary in (
        ("no temporary folder", "/nowhere"),
        ("temporary is a file", __file__),
    ):
        out = home / title
        code, text = ended(start(*SWEEP, "--out", str(out), env={"TMPDIR": temporary}))
        yield title, "0", code, text + same(out)
    for title, cache in (("no cache", "/dev/null/x"), ("the cache is a file", __file__)):
        out = home / title
        code, text = ended(start(*SWEEP, "--out", str(out), env={"RPS_CACHE": cache}))
        yield title, "0 or 2", code, text
    code, text = ended(start(*SWEEP, "--out", str(out), env={"HOME": "/nowhere"}))
    yield "no home", "0 or 2", code, text
    out = home / "two"
    both = [start(*SWEEP, "--out", str(out)) for _ in range(2)]
    codes = [ended(process) for process in both]
    yield "two processes: one does it", "0", min(codes)[0], min(codes)[1] + same(out)
    yield "two processes: the second is refused", "0 or 2", max(codes)[0], max(codes)[1]
    for when in (0.5, 1.5, 3.0, 4.5, 6.0):
        out = home / f"interrupt-{when}"
        process = start(*SWEEP, "--worlds", "20000", "--part", "64", "--out", str(out))
        time.sleep(when)
        process.send_signal(signal.SIGINT)
        code, text = ended(process, 10)
        yield f"Ctrl-C after {when} s", "130" if when > 0.5 else "130 or -2", code, text
    for words in (("--help",), ("sweep", "--help"), ("doctor",), (*SWEEP, "--out", f"{home}/pipe")):
        process = start(*words, stdout=subprocess.PIPE)
        process.stdout.close()  # type: ignore[union-attr]
        process.stdout = None
        code, text = ended(process)
        yield f"closed pipe: {words[0]} {words[1:2]}", "0 or 1 or 141", code, text
    for locale in ({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
                   {"LC_ALL": "POSIX", "PYTHONIOENCODING": "ascii"}):  # fmt: skip
        out = home / f"locale-{len(locale)}-\N{SNOWMAN}"
        code, text = ended(start(*SWEEP, "--out", str(out), env=locale, errors="replace"))
        yield f"locale {locale}", "0", code, text
        code, text = ended(start("sweep", "--help", env=locale, errors="replace"))
        yield f"help, locale {locale}", "0", code, text
    odd = (
        "a b",
        "\N{SNOWMAN}",
        "-",
        "--out",
        "%s{0}",
        "a'b\"c",
        "new\nline",
        "x" * 200,
        "..a",
        "~",
    )
    for name in odd:
        out = home / "odd" / name
        code, text = ended(start(*SWEEP, f"--out={out}", env={"RPS_CACHE": str(home / name)}))
        yield f"path {name[:20]!r}", "0", code, text + same(out)
    (home / "seen").mkdir(mode=0o500)
    code, text = ended(start(*SWEEP, "--out", "/proc/run"))
    yield "a folder where nothing can be made", "2", code, text
    code, text = ended(start("doctor", stdin=subprocess.DEVNULL, cwd="/proc"))
    yield "doctor where nothing can be written", "0", code, text


def run_machine(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Check faults of the machine: disks, folders, signals, pipes, locales and paths."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as home:
        for index, (title, expected, code, text) in enumerate(machine(Path(home))):
            if index >= limit:
                break
            good = str(code) in expected.split(" or ") and not fault(text)
            counts["held" if good else "traceback" if fault(text) else "wrong code"] += 1
            if not good:
                tell(f"{title}: code {code}, not {expected}: {text[-1200:]}")
    return counts


def run_memory(num_calls: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Check that memory does not grow after the fifth call of `evaluate` in a process."""
    program = f"""
import dataclasses, gc, rps_jax
drums = rps_jax.Domain(("random_cylinder",))
setting = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
def now():
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20
for call in range({num_calls}):
    seeded = dataclasses.replace(setting, seed=call)
    rps_jax.evaluate(rps_jax.RPSParams.paper(), drums, worlds=16, setting=seeded)
    if call in (4, {num_calls - 1}):
        print(f"{{now():.1f}}")
"""
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | {
        "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(HOME)})  # fmt: skip
    if done.returncode:
        tell(done.stderr[-2000:])
        return Counter(traceback=1)
    fifth, last = map(float, done.stdout.split())
    print(f"memory after call 5: {fifth} MB, after call {num_calls}: {last} MB")
    grown = last > fifth + 8.0
    if grown:
        tell(f"memory grew from {fifth} to {last} MB")
    return Counter({"grown" if grown else "held": 1})


CLASSES = {"kills": (run_kills, 100), "machine": (run_machine, 1000), "memory": (run_memory, 50)}


def main() -> int:
    """Inject the faults, print failures and the table of outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("classes", nargs="*", default=list(CLASSES), metavar="CLASS")
    parser.add_argument("--most", type=int, help="cases of each class")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    bad = 0
    for name in options.classes:
        run, default = CLASSES[name]
        start_time = time.monotonic()
        counts = run(options.most or default, options.seed, lambda text: print(text, flush=True))
        seconds = {"seconds": round(time.monotonic() - start_time)}
        print(json.dumps({name: dict(counts) | seconds}), flush=True)
        bad += sum(counts[how] for how in ("traceback", "wrong", "wrong code", "grown"))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
