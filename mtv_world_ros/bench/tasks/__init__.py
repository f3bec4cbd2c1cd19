"""The simulated tasks and when they are done."""
