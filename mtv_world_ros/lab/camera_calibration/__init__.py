"""The poses of cameras, from recordings: `mtv-world calibrate-camera`."""
