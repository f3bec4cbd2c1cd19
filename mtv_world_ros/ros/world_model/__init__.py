"""The node `world_model`."""
