"""Figures by theme: functions that return a figure of matplotlib."""
