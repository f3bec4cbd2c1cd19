"""The simulated benchmark."""
