"""MuJoCo, imported also where MUJOCO_GL names no OpenGL library of this machine.

MuJoCo then refuses to be imported, although only images need OpenGL.
"""

import os

FAULT = ""  # why MuJoCo cannot draw, and how to fix it
try:
    import mujoco
except Exception as error:  # of any kind, by a missing library
    if not (name := os.environ.get("MUJOCO_GL")):
        raise
    FAULT = (
        f"MUJOCO_GL = {name} is not allowed on this machine ({error}): set it to egl, osmesa or "
        "glfw, to disable for runs without images, or unset it."
    )
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco as mujoco
