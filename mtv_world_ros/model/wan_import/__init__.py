"""Conversion of public Wan weights into checkpoints."""
