"""Scores of predictions against recordings."""
