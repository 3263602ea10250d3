"""Record digests of 27 small runs, or compare a checkout with a record: the guard of a refactoring.

    python tests/digests.py record before.json          # before the change
    python tests/digests.py compare before.json         # after it; exit code 1 if a number differs
    python tests/digests.py compare before.json sweep   # only the runs whose names contain `sweep`

Each run is one command of `rps`. A digest covers one variable of `results.nc`, the numbers in
`report.md`, or one written file. Words, times and rates are not covered.
"""

import argparse
import contextlib
import hashlib
import io
import json
import re
import shlex
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr

BOX = "wide,objects=random_box"
SHORT = "--horizon 20"
RUNS = {
    "table": "table --quick",
    "table_mjx": "table --engine mjx --objects box --friction S1 --targets -2 0 2 0 --horizon 1",
    "push_mujoco": "push --object box --target 0.6 0 --no-video",
    "push_fused": "push --object cylinder --target 0.8 0.3 --engine fused --no-video",
    "push_quasistatic": "push --object box --target 0.6 0 --engine quasistatic --no-video",
    "hardware": "hardware --quick --engine fused --horizon 20 --shifts 0.1",
    "sweep_fused": "sweep --worlds 24 --laws rps aps learned --domain hostile --horizon 60",
    "sweep_mujoco": f"sweep --worlds 12 --laws rps rps_tuned --engine mujoco {SHORT}",
    "sweep_quasistatic": f"sweep --worlds 32 --laws rps --engine quasistatic --domain {BOX}",
    "sweep_mjx": f"sweep --worlds 8 --laws rps --engine mjx --domain {BOX} --horizon 1",
    "sweep_real": f"sweep --worlds 32 --laws rps_tuned force_push --domain real {SHORT}",
    "sweep_prisms": f"sweep --worlds 32 --laws rps_tuned dipole --domain prisms {SHORT}",
    "ladder": f"ladder --quick --worlds 12 {SHORT}",
    "score": f"score rps,K_h=0.5 --worlds 16 {SHORT}",
    "ceiling": "ceiling --domain wide,objects=random_box --quick --horizon 60",
    "attack": f"attack --quick --generations 2 --minutes 60 --batch 16 {SHORT}",
    "rare": f"rare --quick --law rps --domain {BOX} --particles 40 --levels 2 {SHORT}",
    "regress": f"regress --laws rps rps_plus --worlds 12 {SHORT}",
    "sensitivity": f"sensitivity --quick --worlds 128 {SHORT}",
    "tune_es": f"tune es --quick --generations 2 --population 8 --worlds 16 {SHORT}",
    "tune_grad": "tune grad --quick --steps 2 --worlds 8 --horizon 20",
    "learn": "learn --quick --updates 2 --minutes 60 --num-envs 16 --num-minibatches 2",
    "gallery": "gallery {sweep_mujoco} --each 2",
    "replay": "replay {sweep_mujoco} 3 --law rps --no-video",
    "export_c": "export c --law rps_plus",
    "export_js": "export js --law rps",
    "export_onnx": "export onnx --law rps_tuned",
}
WALL_TIMES = ("compile", "run", "differentiate")  # variables of results
_FLOAT = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
# Lines of a report with times, versions or the command.
_VOLATILE = re.compile(r"compile|commit|jax |python|version|\bs of\b| run |seconds|minute", re.I)


def digest(content: bytes) -> str:
    """Return the first 16 digits of the SHA-256 of some bytes."""
    return hashlib.sha256(content).hexdigest()[:16]


def dataset_digests(path: Path) -> dict[str, str]:
    """Return the digest of each numeric variable of a NetCDF file."""
    with xr.open_datatree(path) as tree:
        return {
            f"{group.path.strip('/')}/{name}": digest(np.ascontiguousarray(values).tobytes())
            for group in tree.subtree
            for name, values in ((str(k), v.values) for k, v in group.variables.items())
            if values.dtype.kind in "biuf" and name not in WALL_TIMES
        }


def folder_digests(out: Path) -> dict[str, str]:
    """Return the digests of the results, report and exported files of a run folder."""
    digests = {}
    for path in sorted(out.rglob("*")):
        name = str(path.relative_to(out))
        if "parts" in path.parts:  # checkpoints, whose names hash their wall times
            continue
        if path.suffix == ".nc":
            digests |= {f"{name}:{key}": value for key, value in dataset_digests(path).items()}
        elif path.name == "report.md":
            lines = [line for line in path.read_text().splitlines() if not _VOLATILE.search(line)]
            digests[name] = digest(" ".join(_FLOAT.findall("\n".join(lines))).encode())
        elif path.suffix in (".h", ".mjs", ".onnx"):
            content = path.read_bytes()
            if path.suffix != ".onnx":  # numbers and operators, without names and comments
                text = re.sub(r"//[^\n]*|/\*.*?\*/", "", content.decode(), flags=re.DOTALL)
                content = " ".join(_FLOAT.findall(text)).encode()
            digests[name] = digest(content)
    return digests


def record(pattern: str, folder: Path) -> dict[str, dict[str, str]]:
    """Run the commands whose names contain a pattern, and return their digests by run."""
    from rps_jax.app import cli

    digests = {}
    for name, command in RUNS.items():
        if pattern not in name and f"{{{pattern}" not in command:
            continue
        outs = {run: str(folder / run) for run in RUNS}
        words = [word.format(**outs) for word in shlex.split(command)]
        start, text = time.perf_counter(), io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            code = cli.main([*words, "--out", outs[name]])
        digests[name] = folder_digests(folder / name) | {"exit code": str(code)}
        print(f"{name}: {len(digests[name])} digests, {time.perf_counter() - start:.0f} s")
        if code:
            print(text.getvalue()[-400:])
    return digests


def main() -> int:
    """Record or compare, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("pattern", nargs="?", default="", help="part of the names of the runs")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        current = record(arguments.pattern, Path(folder))
    expected = json.loads(arguments.file.read_text()) if arguments.file.exists() else {}
    if arguments.action == "record":
        arguments.file.write_text(json.dumps(expected | current, indent=1))
        return 0
    changed, count = [], 0
    for run, digests in current.items():
        previous = expected.get(run, {})
        keys = digests | previous
        changed += [f"{run}: {key}" for key in keys if digests.get(key) != previous.get(key)]
        count += len(keys)
    print("\n".join([*changed, f"{count - len(changed)} of {count} digests are equal"]))
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
