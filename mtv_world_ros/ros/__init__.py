"""The ROS 2 shell: the only part that imports rclpy and messages."""
