"""Robots: their files and descriptions, kinematics and shapes."""
