"""Scores of predictions against recordings, and fits of the success estimate."""
