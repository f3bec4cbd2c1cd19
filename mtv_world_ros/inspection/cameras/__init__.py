"""Estimates of camera poses and focal lengths from recordings."""
