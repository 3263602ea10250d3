"""The world: the paper's data, the physics, the objects, their scenes, and random domains."""

from rps_jax.world import opengl as opengl  # before any other module imports MuJoCo
