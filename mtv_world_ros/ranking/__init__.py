"""Policies on the same scenes in the simulator and in imagination, and how well both agree."""
