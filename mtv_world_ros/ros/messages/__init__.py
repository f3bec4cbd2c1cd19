"""ROS messages to and from the package's types."""
