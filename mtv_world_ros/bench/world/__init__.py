"""The simulated world: scene, arms, cameras, randomisation."""
