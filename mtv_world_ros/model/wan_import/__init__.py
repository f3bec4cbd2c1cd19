"""Public Wan weights become checkpoints."""
