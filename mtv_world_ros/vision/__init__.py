"""Who is where in the frames: segmenters, describers, the Jaccard index."""
