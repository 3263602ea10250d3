"""The robot: what its skin feels, and what its base believes and does."""
