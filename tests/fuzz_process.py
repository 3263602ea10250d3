"""Faults that need separate processes: kills, full disks, signals, pipes, locales, neighbours.

    python tests/fuzz_process.py            # all classes, about twenty minutes on two cores
    python tests/fuzz_process.py kills --most 14

A killed command is repeated with the same arguments until it ends. Its results must then equal
those of an undisturbed command bit for bit, except for clocks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import itertools
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

from fuzz import COMMANDS, DRUMS, SHORT, main
from helpers import setting_of

RPS = (sys.executable, "-m", "rps_jax")
HOME = Path(__file__).parents[1]
KILLED = {
    name: tuple(words.split())
    for name, words in {
        **COMMANDS,
        "ladder": COMMANDS["sweep"].replace("sweep", "ladder"),
        "table": f"table {SHORT} --objects cylinder --friction S1",
        "sensitivity": f"sensitivity {SHORT} {DRUMS} --worlds 100",
        "attack": f"attack {SHORT} {DRUMS} --axes size mass friction_robot --cells 3 --batch 8 "
        "--generations 4 --minutes 30 --drawn 8 --check-again 0 --repeats 1",
    }.items()
}
SWEEP = KILLED["sweep"]
# Durations of a tuner's generation; other clocks have "wall clock" in their long name.
_CLOCKS = ("compile", "run")


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


def run(*words: str, **how: Any) -> tuple[int, str]:
    """Return exit code and output of a command."""
    return ended(start(*words, **how))


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
                    x, clock = variable.values, variable.attrs.get("long_name", "")
                    if key not in _CLOCKS and "wall clock" not in clock:
                        content = tuple(x.ravel()) if x.dtype == object else x.tobytes()
                        contents[f"{name}:{key}"] = variable.dims, str(x.dtype), content
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
            run(*words, "--out", f"{home}/warm-{name}")  # compiles
            start_time = time.monotonic()
            code, text = run(*words, "--out", f"{home}/{name}")
            whole = time.monotonic() - start_time
            right, done = payload(Path(home, name)), 0
            if code or fault(text) or not right:
                counts["traceback" if fault(text) else "wrong"] += 1
                tell(f"{name}: code {code}, {len(right)} contents: {text[-1500:]}")
                continue
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
                code, text = run(*words, "--out", str(out))
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
    run(*SWEEP, "--out", f"{home}/sound")
    right = payload(home / "sound")

    def swept(name: str, **how: Any) -> tuple[int, str]:
        return run(*SWEEP, f"--out={home / name}", **how)

    def checked(name: str, **how: Any) -> tuple[int, str]:
        """Run the sweep, and add to its output whether its results are wrong."""
        code, text = swept(name, **how)
        is_right = payload(home / name) == right
        return code, text + "Traceback (most recent): a wrong result" * (not is_right)

    for size in (1, 4, 16):
        folder = f"full-{size}"
        yield f"files of {size} kB at most", "2", *swept(folder, preexec_fn=limited(size))
        yield f"after files of {size} kB at most", "0", *checked(folder)
    try:
        for size in (0.05, 0.2):
            with small_disk(size) as disk:
                yield f"a disk of {size} MB", "2", *run(*SWEEP, "--out", f"{disk}/run")
    except PermissionError as error:
        print(f"left out: {error}")
    for title, folder in (("no temporary folder", "/nowhere"), ("temporary is a file", __file__)):
        yield title, "0", *checked(title, env={"TMPDIR": folder})
    for title, folder in (("no cache", "/dev/null/x"), ("the cache is a file", __file__)):
        yield title, "0 or 2", *swept(title, env={"RPS_CACHE": folder})
    yield "no home", "0 or 2", *swept("the cache is a file", env={"HOME": "/nowhere"})
    both = [start(*SWEEP, "--out", f"{home}/two") for _ in range(2)]
    first, second = sorted(ended(process) for process in both)
    yield "two processes: one does it", "0", *first
    yield "two processes: the second is refused", "0 or 2", *second
    yield "two processes: their result", "0", *checked("two")
    for when in (0.5, 1.5, 3.0, 4.5, 6.0):
        large = ("--worlds", "20000", "--part", "64", "--out", f"{home}/interrupt-{when}")
        process = start(*SWEEP, *large)
        time.sleep(when)
        process.send_signal(signal.SIGINT)
        expected = "130" if when > 0.5 else "130 or -2"
        yield f"Ctrl-C after {when} s", expected, *ended(process, 10)
    for words in (("--help",), ("sweep", "--help"), ("doctor",), (*SWEEP, "--out", f"{home}/pipe")):
        process = start(*words, stdout=subprocess.PIPE)
        process.stdout.close()  # type: ignore[union-attr]
        process.stdout = None
        yield f"closed pipe: {words[0]} {words[1:2]}", "0 or 1 or 141", *ended(process)
    for locale in (
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"LC_ALL": "POSIX", "PYTHONIOENCODING": "ascii"},
    ):
        how = {"env": locale, "errors": "replace"}
        yield f"locale {locale}", "0", *swept(f"locale-{len(locale)}-\N{SNOWMAN}", **how)
        yield f"help, locale {locale}", "0", *run("sweep", "--help", **how)
    odd = ("a b", "\N{SNOWMAN}", "-", "--out", "%s{0}", "a'b\"c", "new\nline")
    for name in (*odd, "x" * 200, "..a", "~"):
        cache = {"RPS_CACHE": str(home / name)}
        yield f"path {name[:20]!r}", "0", *checked(f"odd/{name}", env=cache)
    yield "a folder where nothing can be made", "2", *run(*SWEEP, "--out", "/proc/run")
    where = {"stdin": subprocess.DEVNULL, "cwd": "/proc"}
    yield "doctor where nothing can be written", "0", *run("doctor", **where)


def run_machine(limit: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Check faults of the machine: disks, folders, signals, pipes, locales and paths."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as home:
        for title, expected, code, text in itertools.islice(machine(Path(home)), limit):
            good = str(code) in expected.split(" or ") and not fault(text)
            counts["held" if good else "traceback" if fault(text) else "wrong code"] += 1
            if not good:
                tell(f"{title}: code {code}, not {expected}: {text[-1200:]}")
    return counts


def run_memory(num_calls: int, seed: int, tell: Callable[[str], None]) -> Counter[str]:
    """Check that memory does not grow after the fifth call of `evaluate` in a process."""
    import rps_jax

    drums = rps_jax.Domain(("random_cylinder",))
    setting = setting_of(2.0)
    used = []  # [MB]
    for call in range(num_calls):
        seeded = dataclasses.replace(setting, seed=call)
        rps_jax.evaluate(rps_jax.RPSParams.paper(), drums, worlds=16, setting=seeded)
        gc.collect()
        used.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20)
    fifth, last = used[4], used[-1]
    print(f"memory after call 5: {fifth:.1f} MB, after call {num_calls}: {last:.1f} MB")
    grown = last > fifth + 8.0
    if grown:
        tell(f"memory grew from {fifth:.1f} to {last:.1f} MB")
    return Counter({"grown" if grown else "held": 1})


CLASSES = {"kills": (run_kills, 100), "machine": (run_machine, 1000), "memory": (run_memory, 50)}


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    sys.exit(main(CLASSES, str(__doc__)))
