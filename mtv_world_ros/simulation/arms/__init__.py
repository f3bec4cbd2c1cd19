"""A robot's arms as MJCF, with their actuators."""
