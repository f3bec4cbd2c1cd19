"""Robots and cameras: forward kinematics, projection, resampling."""
