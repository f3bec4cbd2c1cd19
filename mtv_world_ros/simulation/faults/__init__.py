"""Faults of commands and of the surroundings, as data."""
