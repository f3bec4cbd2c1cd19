"""Public datasets become episodes: LeRobot v2.0, v2.1 and v3.0, with a mapping to the robot."""
