"""An online embodied world model for ROS 2: trajectory in, imagined camera streams out."""
