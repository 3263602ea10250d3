"""Tuning a law: a space of its parameters, searched by evolution or by slopes; and learning."""
