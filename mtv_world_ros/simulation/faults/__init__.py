"""Faults of scripted policies: functions from a plan to a plan, by name."""
