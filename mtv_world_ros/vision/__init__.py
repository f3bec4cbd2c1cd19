"""Objects in camera frames: segmenters, describers, the Jaccard index."""
