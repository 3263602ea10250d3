"""Whole runs: sweeps over random worlds, candidates evaluated in them, and single pushes."""
