"""Preflight of a recording: do calibration, robot, clocks and pictures belong together?"""
