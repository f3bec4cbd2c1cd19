"""Policies ranked in imagination, and how well that agrees with the simulator."""
