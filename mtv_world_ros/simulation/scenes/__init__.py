"""Scenes of the simulator as data and as MJCF: tasks, workcells, objects, places, cameras."""
