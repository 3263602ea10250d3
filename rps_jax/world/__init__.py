"""The world: the paper's data, the physics, the objects, their scenes, and random domains.

`paper` is data, `physics` says how worlds are stepped, `objects` and `scene` make MuJoCo models
from `mjcf/`, and `domain` draws what differs between random worlds.
"""
