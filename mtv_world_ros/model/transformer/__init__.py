"""The multi-view diffusion transformer."""
