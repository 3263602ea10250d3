"""Shapes and frames, with values and derivatives that are finite everywhere."""
