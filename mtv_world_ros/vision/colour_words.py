"""Colour words that objects may carry, and the colour each word stands for."""

from __future__ import annotations

from types import MappingProxyType

#: colour word -> RGB (uint8). Neighbours lie at least 23 degrees of CIELAB hue apart, and keep
#: apart when the colour is shaded to a third or washed out by a dull highlight.
PALETTE: MappingProxyType[str, tuple[int, int, int]] = MappingProxyType(
    {
        'red': (210, 25, 35),
        'orange': (245, 130, 15),
        'yellow': (240, 220, 30),
        'green': (35, 165, 55),
        'cyan': (20, 195, 200),
        'blue': (15, 105, 220),
        'purple': (125, 40, 185),
        'pink': (245, 105, 180),
    }
)


def colour_of(name: str) -> str | None:
    """Returns the palette word in an object's name, or None."""
    return next((word for word in name.lower().split() if word in PALETTE), None)
