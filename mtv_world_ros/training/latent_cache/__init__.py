"""Encoded clips, kept on disk."""
