"""Gantry arms for every test of the controls."""

from test.support.gantry import gantry, make_camera, one_arm, two_arms

__all__ = ['gantry', 'make_camera', 'one_arm', 'two_arms']
