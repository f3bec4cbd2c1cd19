"""Checks whether calibration, robot, clocks and images of a recording fit together."""
