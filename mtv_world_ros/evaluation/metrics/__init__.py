"""Metrics of predictions: Jaccard, image quality, Frechet distances, agreement, intervals."""
