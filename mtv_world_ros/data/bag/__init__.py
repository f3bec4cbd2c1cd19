"""rosbag2 folders: reading, writing, metadata, messages and images."""
