"""Nodes, recorder and player as processes."""
