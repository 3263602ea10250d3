"""The folder of a law in C: the header, an example that measures itself, and a CMake file."""

from __future__ import annotations

from rps_jax.app.export import c
from rps_jax.app.export.program import Program

# How the example fills what laws of each kind observe extra touch.
_EXTRA = {
    "touch": "",
    "taxels": "      seen.line = contact.line;\n"
    "      for (int k = 0; k < {P}_TAXELS; k++) seen.signal[k] = contact.signal[k];\n",
    "force": "      seen.f_robot[0] = -20; /* [N] of the object on the base */\n",
    "pose": "      seen.p_world_object[0] = seen.p_world_robot[0] + 0.6f;\n"
    "      seen.p_world_object[1] = seen.p_world_robot[1];\n"
    "      seen.r_object = 0.25f; /* [m] */\n",
}

_EXAMPLE = """\
/* Drives a stand-in of a robot that always feels an object left of the middle of its front, and
   prints how long skin and law took. Put your drivers in its place. */

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
{extra}      code = {p}_step(&params, &memory, &seen, &twist);
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

_CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project({p} C)
set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library({p} INTERFACE)
target_include_directories({p} INTERFACE ${{CMAKE_CURRENT_SOURCE_DIR}})
target_link_libraries({p} INTERFACE m)

add_executable({p}_example main.c)
target_compile_options({p}_example PRIVATE -Wall -Wextra -pedantic)
target_link_libraries({p}_example PRIVATE {p})
"""


def files(program: Program, prefix: str) -> dict[str, str]:
    """Return the texts of the files, by name."""
    names = {"p": prefix, "P": prefix.upper()}
    extra = _EXTRA[program.senses].format(**names)
    return {
        f"{prefix}.h": c.header(program, prefix),
        "main.c": _EXAMPLE.format(**names, extra=extra),
        "CMakeLists.txt": _CMAKE.format(**names),
    }
