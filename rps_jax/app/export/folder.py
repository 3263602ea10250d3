"""The folder of a law in C: the header, and an example that measures itself."""

from __future__ import annotations

from rps_jax.app.export import c
from rps_jax.app.export.program import Program

# How the example fills the signals of laws that observe them.
_SIGNALS = """\
      seen.line = contact.line;
      for (int k = 0; k < {P}_TAXELS; k++) seen.signal[k] = contact.signal[k];
"""

_EXAMPLE = """\
/* Drives a stand-in of a robot that always feels an object left of the middle of its front, and
   prints how long skin and law took. Put your drivers in its place.

     cc -std=c99 -O2 main.c -lm -o example */

#define _POSIX_C_SOURCE 199309L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "{p}.h"

#define STEPS 200000
#define PERIOD 0.001

static double took[STEPS]; /* [us] */

static int by_size(const void *a, const void *b) {{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}}

int main(void) {{
  const {p}_params params = {P}_PARAMS;
  const {p}_skin_params skin_params = {P}_SKIN_PARAMS;
  {p}_real taxels[{P}_TAXELS] = {{0}};
  {p}_memory memory;
  {p}_skin skin;
  {p}_contact contact;
  {p}_observation seen = {{0}};
  {p}_twist twist = {{0}};
  {p}_init(&params, &memory);
  {p}_skin_init(&skin);
  for (int k = 16; k < 20 && k < {P}_TAXELS; k++) taxels[k] = ({p}_real)0.6;
  seen.p_world_target[0] = -2;
  seen.period = ({p}_real)PERIOD;
  for (int i = 0; i < STEPS; i++) {{
    struct timespec began, ended;
    clock_gettime(CLOCK_MONOTONIC, &began);
    int code = {p}_skin_step(&skin_params, &skin, taxels, ({p}_real)PERIOD, &contact);
    if (code == {P}_OK) {{
      seen.in_contact = contact.in_contact;
      seen.p_robot_contact[0] = contact.p_robot_contact[0];
      seen.p_robot_contact[1] = contact.p_robot_contact[1];
{signals}      code = {p}_step(&params, &memory, &seen, &twist);
    }}
    clock_gettime(CLOCK_MONOTONIC, &ended);
    took[i] = 1e6 * (double)(ended.tv_sec - began.tv_sec)
            + 1e-3 * (double)(ended.tv_nsec - began.tv_nsec);
    if (code != {P}_OK) {{
      printf("step %d: code %d\\n", i, code);
      return 1;
    }}
    const double c = cos((double)seen.yaw), s = sin((double)seen.yaw);
    seen.p_world_robot[0] += ({p}_real)(PERIOD * (c * (double)twist.v_x - s * (double)twist.v_y));
    seen.p_world_robot[1] += ({p}_real)(PERIOD * (s * (double)twist.v_x + c * (double)twist.v_y));
    seen.yaw += ({p}_real)PERIOD * twist.omega;
  }}
  qsort(took, STEPS, sizeof took[0], by_size);
  printf("%d steps: median %.2f us, 99.9th percentile %.2f us\\n", STEPS, took[STEPS / 2],
         took[STEPS / 1000 * 999]);
  printf("base at (%.2f, %.2f) m, heading %.2f rad, twist (%.3f, %.3f) m/s, %.3f rad/s\\n",
         (double)seen.p_world_robot[0], (double)seen.p_world_robot[1], (double)seen.yaw,
         (double)twist.v_x, (double)twist.v_y, (double)twist.omega);
  return 0;
}}
"""


def files(program: Program, prefix: str) -> dict[str, str]:
    """Return the texts of the files, by name."""
    names = {"p": prefix, "P": prefix.upper()}
    signals = _SIGNALS.format(**names) if program.senses == "taxels" else ""
    return {
        f"{prefix}.h": c.header(program, prefix),
        "main.c": _EXAMPLE.format(**names, signals=signals),
    }
