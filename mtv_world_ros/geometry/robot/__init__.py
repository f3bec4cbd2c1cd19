"""Robots: their files and descriptions, kinematics, mechanics and shapes."""
