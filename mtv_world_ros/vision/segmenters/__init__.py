"""Masks of named objects: by colour, with public weights, as recorded."""
