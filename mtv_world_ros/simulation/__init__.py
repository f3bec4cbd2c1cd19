"""The simulator: tasks, scenes, arms, cameras and physics."""
