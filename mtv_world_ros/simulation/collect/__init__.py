"""Data sets of simulated episodes with their card."""
