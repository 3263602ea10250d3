"""MuJoCo, also where MUJOCO_GL names no OpenGL library of this machine.

MuJoCo then refuses to be imported, although only images need OpenGL. So all modules import it from
here.
"""

import contextlib
import os
import sys

FAULT = ""  # why MuJoCo cannot draw, and how to fix it
try:
    import mujoco as mujoco
    from mujoco import rollout as rollout
except Exception as error:  # of any kind, by a missing library
    if not (name := os.environ.get("MUJOCO_GL")):
        raise
    FAULT = (
        f"MUJOCO_GL = {name} is not allowed on this machine ({error}): set it to egl, osmesa or "
        "glfw, to disable for runs without images, or unset it."
    )
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco as mujoco
    from mujoco import rollout as rollout

    for path, module in list(sys.modules.items()):  # the first import has loaded some
        parent, _, child = path.rpartition(".")
        if parent.partition(".")[0] == "mujoco":
            with contextlib.suppress(KeyError):
                setattr(sys.modules[parent], child, module)
