"""Fits of the physics: contact, the response of arms, tracks of objects."""
