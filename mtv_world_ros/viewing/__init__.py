"""Recordings, predictions and evaluations as pictures: a viewer, contact sheets, videos."""
