"""What makes prediction fast: compilation, float8, several GPUs."""
