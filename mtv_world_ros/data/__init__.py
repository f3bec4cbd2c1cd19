"""Episodes on disk: rosbag2 MCAP folders and the clips cut from them."""
