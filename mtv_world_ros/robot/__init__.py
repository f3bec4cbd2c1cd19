"""Robots: URDF and Denavit-Hartenberg files, kinematics, limits, link shapes."""
