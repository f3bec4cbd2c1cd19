"""Contents of a training batch: clips, their control inputs and latents, and the latent cache."""
