"""Trajectory videos: the control signal drawn into each view."""
