"""Import of LeRobot datasets and of a robot's own bags as episodes; export to LeRobot."""
