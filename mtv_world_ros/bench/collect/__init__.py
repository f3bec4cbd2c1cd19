"""Records datasets of simulated episodes."""
