"""The multi-view video diffusion transformer and what surrounds it."""
