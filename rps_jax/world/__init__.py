"""The world: the paper's data, the physics, the objects, their scenes, and random domains."""
