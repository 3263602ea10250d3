"""The exported JavaScript module of a law and a skin."""

from __future__ import annotations

import json

import numpy as np

from rps_jax.app.export.program import Program
from rps_jax.lowering.js import HELPERS, object_of, statements
from rps_jax.lowering.routine import Group


def module(program: Program, prefix: str) -> str:
    """Return the whole module, in whose template capitals are lines that are printed for a law."""
    groups, tables = program.groups, dict[str, str]()
    law = {"params": "params.", "memory": "memory.", "observation": "observation."}
    skin = {"skin_params": "params.", "skin": "skin.", "scan": ""}
    lines = {
        "HELPERS": HELPERS,
        "PARAMS": _values(groups["params"]),
        "SKIN_PARAMS": _values(groups["skin_params"]),
        "INIT": statements(program.init, law, tables),
        "STEP": statements(program.step, law, tables),
        "SKIN": statements(program.skin_step, skin, tables),
        **{name.upper(): object_of(name, groups) for name in ("memory", "twist", "contact")},
    }
    return program.fill(
        "law.mjs.in",
        prefix,
        **lines,
        TABLES="\n".join(tables.values()),
        axle=program.about_axle("export const AXLE = {};"),
    )


def _values(group: Group) -> str:
    lines = [f"  {field.name}: {json.dumps(np.asarray(field.value).tolist())}," for field in group]
    return "\n".join(["{", *lines, "}"])
