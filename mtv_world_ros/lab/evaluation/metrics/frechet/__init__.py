"""Fréchet distances of images (FID) and videos (FVD)."""
