"""Object masks, the Jaccard index and the success estimate."""
