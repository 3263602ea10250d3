"""Tuning the law: a space of its parameters, searched by evolution or by gradients; and learning.

`run` drives every tuner in a folder that can be killed and continued. `learn` does the same for a
law that is learned from touch: `rollout` is what happens in its worlds, `ppo` the algorithm. `gym`
has the worlds for learning loops of others.
"""
