"""The bench: simulates, collects and ranks policies."""
