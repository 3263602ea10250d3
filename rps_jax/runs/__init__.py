"""Whole runs: sweeps over random worlds, candidates evaluated in them, and single pushes.

`sweep` runs what a `plan` says, here or on a `cluster`, and `results` gathers it. `evaluate` scores
candidates by an `objective`, and `push` follows one trial.
"""
