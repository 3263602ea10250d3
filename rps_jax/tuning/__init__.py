"""Tuning the law: a space of its parameters, searched by evolution or by gradients.

`run` drives every tuner in a folder that can be killed and continued.
"""
