"""From episodes to a checkpoint: clips, objective, optimiser, resuming."""
