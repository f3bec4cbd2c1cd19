"""Object motion under commands on MuJoCo, and its numbers."""
