"""Small runs that tell whether today's code still gives the published numbers.

A probe is a short command. Its record has, for each variable of its results, a digest of the bits,
their mean and their root mean square. `PROBES_OF` names the probes of each data file. A data file
stores the record that its code gave, by an identifier of `publish/probes.json`, and it is current
if today's run of each probe gives the same: bit for bit on the same processor with the same
versions, else within `TOLERANCE`.
"""

from __future__ import annotations

import fnmatch
import functools
import hashlib
import json
import platform
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import xarray as xr

Record: TypeAlias = dict[str, Any]  # processor, versions, variables: digest, mean, size of each

FILE = Path(__file__).with_name("publish") / "probes.json"
# Of the root mean square of a variable, on another processor: pushes are chaotic, and one of 24
# worlds that ends otherwise changes a mean by a twentieth.
TOLERANCE = 0.2
_ROUNDING = 1e-6  # root mean square below which a variable is rounding, in any unit
_SWEEPS = Path(__file__).parent
_PACKAGES = ("jax", "mujoco", "numpy")
# Measured variables of results; with a slash, those of one probe.
_WALL_TIMES = ("compile", "run", "differentiate", "learn/time")
_FLOAT = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_BOX = "wide,objects=random_box"
_SHORT = "--horizon 20"
_FAST = "sweep --worlds 24 --laws rps_tuned rps_plus"
# A network whose weights stay, when those of `learned` change.
_NETWORK = _SWEEPS / "learned" / "learned_0_4.npz"

# Commands of the probes, by name. A command may read the run folder of an earlier probe.
PROBES = {
    "table": "table --quick",
    "table_mjx": "table --engine mjx --objects box --friction S1 --targets -2 0 2 0 --horizon 1",
    "push_mujoco": "push --object box --target 0.6 0 --no-video",
    "push_fused": "push --object cylinder --target 0.8 0.3 --engine fused --no-video",
    "push_quasistatic": "push --object box --target 0.6 0 --engine quasistatic --no-video",
    "hardware": "hardware --quick --engine fused --horizon 20 --shifts 0.1",
    "wide": f"{_FAST} rps nps aps --domain wide --horizon 60",
    "hostile": f"sweep --worlds 24 --laws rps aps {_NETWORK} --domain hostile --horizon 60",
    "learned": f"sweep --worlds 24 --laws learned --domain hostile {_SHORT}",
    "real": f"sweep --worlds 32 --laws rps_tuned force_push --domain real {_SHORT}",
    "prisms": f"sweep --worlds 32 --laws rps_tuned dipole --domain prisms {_SHORT}",
    "feet": f"{_FAST} --domain wide,feet=0.5:0.9 --horizon 60",
    "round": f"{_FAST} --domain wide --robot round {_SHORT}",
    "drives": f"sweep --worlds 24 --laws unicycle --robot ideal,drive=differential {_SHORT}",
    "pose": f"sweep --worlds 16 --laws pose --task pose --domain {_BOX} --horizon 60",
    "pose_drive": "sweep --worlds 16 --laws pose_drive,v_free=0.05,omega_free=0.15 --task pose "
    f"--robot ideal,drive=differential --domain {_BOX} --horizon 60",
    "pose_narrow": "sweep --worlds 16 --laws pose_medium pose_narrow --task pose "
    f"--robot turtlebot4 --domain {_BOX} --horizon 60",
    "path": f"{_FAST} {_NETWORK} --task path {_SHORT}",
    "corridor": f"{_FAST} {_NETWORK} --task corridor {_SHORT}",
    "floor": f"{_FAST} --domain wide,slope=0:0.05,boundary_factor=1:2 {_SHORT}",
    "mujoco": f"sweep --worlds 12 --laws rps rps_tuned --engine mujoco {_SHORT}",
    "mjx": f"sweep --worlds 8 --laws rps --engine mjx --domain {_BOX} --horizon 1",
    "quasistatic": f"sweep --worlds 32 --laws rps --engine quasistatic --domain {_BOX}",
    "ladder": f"ladder --quick --worlds 12 --laws rps rps_tuned rps_plus {_SHORT}",
    "score": f"score rps,K_h=0.5 --worlds 16 {_SHORT}",
    "ceiling": f"ceiling --domain {_BOX} --quick --horizon 60",
    "attack": f"attack --quick --generations 2 --minutes 60 --batch 16 {_SHORT}",
    "rare": f"rare --quick --law rps --domain {_BOX} --particles 40 --levels 2 {_SHORT}",
    "regress": f"regress --laws rps rps_plus --worlds 12 {_SHORT}",
    "sensitivity": f"sensitivity --quick --worlds 128 {_SHORT}",
    "tune_es": f"tune es --quick --generations 2 --population 8 --worlds 16 {_SHORT}",
    "tune_grad": "tune grad --quick --steps 2 --worlds 8 --horizon 20",
    "learn": "learn --quick --updates 2 --minutes 60 --num-envs 16 --num-minibatches 2",
    "gallery": "gallery RUNS/mujoco --each 2",
    "replay": "replay RUNS/mujoco 3 --law rps --no-video",
    "export_c": "export c --law rps_plus",
    "export_js": "export js --law rps",
    "real_pushes": f"{_SWEEPS / 'real_pushes'} --quick --mujoco 0",
}
_TRIALS = ("wide", "hostile", "real")
# Probes of each data file, by the first pattern that its name has. A measured time has none.
PROBES_OF: Mapping[str, tuple[str, ...]] = {
    "table_mjx": ("table_mjx",),
    "table": ("table",),
    "grid": ("table", "learned"),
    **dict.fromkeys(("gazebo*", "readings*", "fidelity", "rest"), ("table", "push_mujoco")),
    **dict.fromkeys(("hardware", "shoves", "reading_*"), ("hardware",)),
    # Lookaheads are chosen in worlds of tuners.
    "corridors_*": ("path", "corridor", "tune_es", "learned"),
    "tuned_for_corridors": ("wide", "real"),
    "tasks_parity": ("path", "corridor", "mujoco", "mjx"),
    "force_push_paths": ("path", "prisms", "learned"),
    "force_push_grid": ("real", "push_mujoco"),
    "floors_steps": ("floor",),
    "floors_*": ("floor", "learned"),
    "drives": ("drives", "wide", "hostile", "real"),
    "pose_parity": ("pose",),
    "pose_paths": ("pose", "pose_drive", "path"),
    "pose_presets": ("pose_drive", "pose_narrow"),
    "pose*": ("pose", "pose_drive"),
    "drives_omni": ("wide", "hostile", "real"),
    "drives_engines": ("drives", "push_mujoco"),
    "drives_tasks": ("drives", "path", "corridor"),
    "drives_learned": ("drives", "learn"),
    "presets": ("drives",),
    "engines_*": ("wide", "mujoco", "mjx", "quasistatic"),
    "export_worlds": ("export_c", "export_js", "wide"),
    "export_*": ("export_c", "export_js", "wide", "learned"),
    "attack": ("attack", "tune_es"),
    "rare*": ("rare", "wide"),
    "regression": ("regress", "learned"),
    "sensitivity": ("sensitivity", "hostile", "real"),
    "fit_*": ("push_fused", "wide", "tune_es"),
    "real_pushes_*": ("real_pushes",),
    **dict.fromkeys(("gradients_mjx", "gradients_stiff"), ("mjx",)),
    "gradients_tables": ("tune_grad", "wide", "hostile"),
    "gradients_*": ("tune_grad", "wide"),
    "learned_windows": ("tune_grad", "learn", "learned"),
    **dict.fromkeys(("ground", "straight"), ("push_mujoco", "push_fused")),
    "support*": ("wide", "hardware"),
    "mit*": ("real_pushes",),
    "ceiling": ("ladder", "ceiling"),
    **dict.fromkeys(("ladder", "bearings"), ("ladder", *_TRIALS, "learned")),
    **dict.fromkeys(("plus", "saturation", "tuned"), ("ladder", *_TRIALS)),
    "rivals_tuned": ("ladder", "tune_es"),
    **dict.fromkeys(
        ("learned_test", "learned_tasks", "learned_failures"), ("hostile", "learn", "learned")
    ),
    "sb3": ("hostile", "learn"),
    **dict.fromkeys(("limits", "sizes"), ("wide", "hostile")),
    **dict.fromkeys(("plans", "replans"), ("quasistatic",)),
    "feet": ("wide", "feet"),
    **dict.fromkeys(("headline", "models"), (*_TRIALS, "path", "corridor", "mujoco", "learned")),
    "million": ("wide", "real", "learned"),
    **dict.fromkeys(("random_worlds", "robots"), ("wide", "real")),
    "real": ("real",),
    "round_base*": ("round",),
    **dict.fromkeys(
        ("arena", "commands*", "compilers*", "costs", "derivatives*", "environments*", "gpus"), ()
    ),
    **dict.fromkeys(
        ("kernel", "levers", "moved", "robot", "speed*", "stages*", "tasks_cost_*"), ()
    ),
    "maps": ("corridor",),
}


def probes_of(name: str) -> set[str]:
    """Return the names of the probes of a data file."""
    return set(next((v for k, v in PROBES_OF.items() if fnmatch.fnmatch(name, k)), ()))


def stored_ids(name: str) -> dict[str, str]:
    """Run the probes of a data file; return the identifiers of their records, which are stored."""
    return {probe: store(probe, run(probe)) for probe in sorted(probes_of(name))}


def differences(ids: Mapping[str, str]) -> list[str]:
    """Return the probes whose run of today differs from the records of a data file."""
    return [probe for probe, id in ids.items() if not same(stored()[probe][id], run(probe))]


def same(record: Record, today: Record) -> bool:
    """Return whether a run gives the numbers of a record; on one processor names may differ."""
    recorded, current = record["variables"], today["variables"]
    if all(record[key] == today[key] for key in ("processor", "versions")):
        digests = {row[0] for row in current.values()}
        return all(row[0] in digests for row in recorded.values())
    return recorded.keys() <= current.keys() and all(
        abs(a - b) <= TOLERANCE * max(size, _ROUNDING)
        for name, (_, *row, size) in recorded.items()
        for a, b in zip((*row, size), current[name][1:], strict=True)
    )


# --- records --------------------------------------------------------------------------------


def stored() -> dict[str, dict[str, Record]]:
    """Return the records of all probes, by their identifiers."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def store(probe: str, record: Record) -> str:
    """Store the record of a probe, and return its identifier."""
    id = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:12]
    records = stored()
    records.setdefault(probe, {})[id] = record
    write(records)
    return id


def write(records: Mapping[str, Mapping[str, Record]]) -> None:
    """Write records, a line for each."""
    lines = [
        f" {json.dumps(probe)}: {{\n"
        + ",\n".join(f"  {json.dumps(id)}: {json.dumps(x)}" for id, x in sorted(rows.items()))
        + "\n }"
        for probe, rows in sorted(records.items())
    ]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def remove_unused() -> None:
    """Remove the records that no data file names."""
    named = set[tuple[str, str]]()
    for path in FILE.parents[1].rglob("results/*.json"):
        named |= json.loads(path.read_text(encoding="utf-8")).get("probes", {}).items()
    records = stored()
    current = {
        probe: rows
        for probe, ids in records.items()
        if (rows := {id: x for id, x in ids.items() if (probe, id) in named})
    }
    if current != records:
        write(current)


@functools.cache
def run(probe: str) -> Record:
    """Return the record of a probe, run by the code of today."""
    out = Path(_folder().name) / probe
    words = PROBES[probe].split()
    for word in words:
        if word.startswith("RUNS/"):
            run(word.removeprefix("RUNS/"))
    words = [word.replace("RUNS", _folder().name) for word in words]
    command = [sys.executable, "-m", "rps_jax", *words, "--out", str(out)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode:
        raise RuntimeError(f"the probe `{shlex.join(command)}` fails: {process.stderr[-400:]}")
    return {
        "processor": _processor(),
        "versions": {name: metadata.version(name) for name in _PACKAGES},
        "variables": dict(sorted(_variables(out))),
    }


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


def _processor() -> str:
    """Return the model of the processor with the numbers of its family and model, or of the GPU."""
    import jax

    if (used_device := jax.devices()[0]).platform != "cpu":
        return used_device.device_kind
    info = Path("/proc/cpuinfo")
    text = info.read_text() if info.exists() else ""
    fields = dict(re.findall(r"^(cpu family|model|model name)\s*: (.*)", text, re.MULTILINE))
    if len(fields) < 3:  # as on ARM
        return platform.machine()
    # A name alone may stand for several processors, whose last bits differ.
    return "{model name} (family {cpu family}, model {model})".format_map(fields)


def _variables(out: Path) -> Iterable[tuple[str, list[Any]]]:
    """Yield name, and digest, mean and root mean square of the finite numbers, of each array."""
    for path in sorted(out.rglob("*")):
        if path.suffix == ".nc" and "parts" not in path.parts:
            with xr.open_datatree(path) as tree:
                for group in tree.subtree:
                    for name, values in group.variables.items():
                        array = np.ascontiguousarray(values)
                        is_measured = name in _WALL_TIMES or f"{out.name}/{name}" in _WALL_TIMES
                        if array.dtype.kind in "biuf" and not is_measured:
                            key = f"{path.stem}{group.path.rstrip('/')}/{name}"
                            yield key, _row(array)
        elif path.suffix in (".h", ".mjs"):  # the numbers, without comments
            text = re.sub(r"//[^\n]*|/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
            yield path.name, _row(np.array(_FLOAT.findall(text), float))


def _row(array: np.ndarray) -> list[Any]:
    """Return digest, mean and root mean square of an array."""
    numbers = array.astype(float).ravel()
    numbers = numbers[np.isfinite(numbers)]
    mean, size = (numbers.mean(), np.sqrt((numbers**2).mean())) if numbers.size else (0.0, 0.0)
    return [hashlib.sha256(array.tobytes()).hexdigest()[:12], float(mean), float(size)]
