"""The folder of a law in C: the header, and an example that measures itself."""

from __future__ import annotations

from rps_jax.app.export import c
from rps_jax.app.export.program import Program

# How the example fills the signals of laws that observe them.
_TAXELS = """\
      seen.line = contact.line;
      for (int k = 0; k < {P}_TAXELS; k++) seen.signal[k] = contact.signal[k];
"""
_ENDS = """\
      seen.even = contact.even;
      seen.front = contact.front;
      for (int k = 0; k < 2; k++) seen.ends[k] = contact.ends[k];
      for (int k = 0; k < 2; k++) seen.seen[k] = contact.seen[k];
      for (int k = 0; k < {P}_TAXELS; k++) seen.signal[k] = contact.signal[k];
      for (int k = 0; k < {P}_TAXELS; k++) seen.alive[k] = contact.alive[k];
"""
_SIGNALS = {"taxels": _TAXELS, "ends": _ENDS}  # by what the law senses


def files(program: Program, prefix: str) -> dict[str, str]:
    """Return the texts of the files, by name."""
    signals = _SIGNALS.get(program.senses, "").format(P=prefix.upper())
    return {
        f"{prefix}.h": c.header(program, prefix),
        "main.c": program.fill("main.c.in", prefix, signals=signals),
    }
