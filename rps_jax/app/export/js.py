"""The exported JavaScript module of a law and a skin."""

from __future__ import annotations

import numpy as np

from rps_jax import __version__
from rps_jax.app.export.program import Program
from rps_jax.lowering.js import HELPERS, object_of, statements, text_of
from rps_jax.lowering.routine import Group

# Placeholders in capitals are lines that are printed for a law.
_MODULE = """\
// The law {label} with the skin of the robot {robot}, written by rps_jax {version}: do not edit.
//
// import {{ params, init, step }} from "./{p}.mjs";
// let memory = init(params);
// const {{ code, twist, memory: next }} = step(params, memory, observation);
//
// A code that is not 0 (1: an input was not finite; 2: the law has no finite twist) comes with a
// zero twist and the memory as it was.

{HELPERS}
{TABLES}
const still = {{ v_x: 0, v_y: 0, omega: 0 }};
export const TAXELS = {taxels};
export const params = {PARAMS};
export const skinParams = {SKIN_PARAMS};
export const skinInit = () => (
  {{ signal: Array(TAXELS).fill(0), alive: Array(TAXELS).fill(true) }}
);

export function init(params) {{
{INIT}
  return {MEMORY};
}}

export function step(params, memory, observation) {{
  if (!Object.values(observation).every(finite)) {{
    return {{ code: 1, memory, twist: {{ ...still }} }};
  }}
{STEP}
  const next = {MEMORY};
  const twist = {TWIST};
  if (!Object.values(twist).every(finite) || Object.values(next).some(nan)) {{
    return {{ code: 2, memory, twist: {{ ...still }} }};
  }}
  return {{ code: 0, memory: next, twist }};
}}

export function skinStep(params, skin, taxels, period) {{
  if (!finite(taxels) || !finite(period)) return {{ code: 1, skin, contact: null }};
{SKIN}
  const next = {{ ...skin, signal: result_filtered_signal }};
  return {{ code: 0, skin: next, contact: {CONTACT} }};
}}
"""


def module(program: Program, prefix: str) -> str:
    """Return the whole module."""
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
    return _MODULE.format(
        **lines,
        TABLES="\n".join(tables.values()),
        **{"label": program.label, "robot": program.robot, "version": __version__},
        **{"p": prefix, "taxels": program.taxels},
    )


def _values(group: Group) -> str:
    lines = [f"  {field.name}: {text_of(np.asarray(field.value).tolist())}," for field in group]
    return "\n".join(["{", *lines, "}"])
