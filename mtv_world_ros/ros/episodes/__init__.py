"""Runs and records episodes of a policy in the world model."""
