"""The multi-view video diffusion transformer: its encoders, sampling, checkpoints, serving."""
