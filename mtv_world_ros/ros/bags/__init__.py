"""Bags played and recorded over the middleware."""
