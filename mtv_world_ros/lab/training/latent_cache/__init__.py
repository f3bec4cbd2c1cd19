"""Encoded training clips on disk."""
