"""Trials: worlds are made, stepped until they end, and judged.

`trial` senses, decides, steps and settles; `batch` runs many in slots that are refilled; `pushes`
and `worlds` make them, from cases and from draws. `stepper` and `env` step by hand.
"""
