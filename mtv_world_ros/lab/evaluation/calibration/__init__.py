"""Fits the success probability to true outcomes."""
