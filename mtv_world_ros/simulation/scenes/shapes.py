"""Shapes of the free objects: their geoms, sizes, and where a gripper takes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.simulation.scenes.mjcf import template
from mtv_world_ros.success.relations import FLOOR_M
from mtv_world_ros.vision.segmenters.colour import PALETTE

Rgb = tuple[float, float, float]
Size = tuple[float, float, float]

#: thickness of the walls of plates and bowls, which a gripper holds at the rim [m]
RIM_M = 0.012
#: thickness of the walls of containers [m]
WALL_M = 0.006
#: mass of an empty container [kg]
CONTAINER_KG = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Grasp:
    """Top-down grasp of a shape; the fingers close along the object's x axis.

    Attributes:
        height: height of the tool over the object's bottom, as a share of the object's height.
        rim_m: thickness of the rim that is held, on the object's side of the table; None = across
            the middle.
        opening: opening of the gripper on the way down, 0..1.
    """

    height: float = 0.5
    rim_m: float | None = None
    opening: float = 1.0

    def offset(self, size: Size, side: float) -> float:
        """Return how far the tool is from the object's centre along its x [m].

        Args:
            size: size of the object [m].
            side: side on which a rim is held, -1 left, 1 right.
        """
        if self.rim_m is None:
            return 0.0
        return (size[0] - self.rim_m) / 2 * side

    def width(self, size: Size) -> float:
        """Return the width between the closed fingers [m]."""
        return size[0] if self.rim_m is None else self.rim_m


@dataclass(frozen=True, slots=True)
class Shape:
    """A kind of object.

    Attributes:
        geoms: name of the macro of `config/mjcf/shapes.xml.j2` that draws it.
        smallest: full extents (x, y, z) of the smallest one [m].
        largest: full extents of the largest one [m]; sizes in between lie on the line from one to
            the other.
        grasp: grasp by a gripper; None = the object is never moved.
        colours: words of the palette that it comes in.
        step: turn about z after which it looks the same to a gripper [rad].
        hollow: objects placed on it rest on its inner floor.
    """

    geoms: str
    smallest: Size
    largest: Size
    grasp: Grasp | None = Grasp()
    colours: tuple[str, ...] = field(default=tuple(sorted(PALETTE)))
    step: float = np.pi / 2
    hollow: bool = False

    def xml(self, size: Size, rgb: Rgb) -> str:
        """Return its MJCF geoms in the frame of the bounding box's centre.

        Args:
            size: full extents (x, y, z) [m].
            rgb: colour, 0..1.
        """
        x, y, z = (extent / 2 for extent in size)
        fixed = {'rim_m': RIM_M, 'wall_m': WALL_M, 'floor_m': FLOOR_M}
        macros = template('shapes').make_module({**fixed, 'container_kg': CONTAINER_KG})
        return str(getattr(macros, self.geoms)(x, y, z, rgb))

    def free(self, taken: set[str]) -> bool:
        """Return whether one of its colours is not taken yet."""
        return not set(self.colours) <= taken

    def size(self, share: float) -> Size:
        """Return the extents [m] at `share` 0..1 between the smallest and the largest."""
        low, high = np.asarray(self.smallest), np.asarray(self.largest)
        x, y, z = (low + share * (high - low)).tolist()
        return (x, y, z)


_RIM = Grasp(height=0.8, rim_m=RIM_M, opening=0.6)
#: longer along y: turned by a quarter it would not fit between the fingers
_LONG: dict[str, Any] = {'step': np.pi}
_HELD_BY_ITS_RIM: dict[str, Any] = {'grasp': _RIM, 'hollow': True}
_NEVER_MOVED: dict[str, Any] = {'grasp': None, 'hollow': True}


def _round(diameter: float, height: float) -> Size:
    return (diameter, diameter, height)


SHAPES = {
    'block': Shape('block', (0.04, 0.04, 0.04), (0.055, 0.055, 0.055)),
    'plate': Shape('plate', _round(0.104, 0.02), _round(0.114, 0.02), **_HELD_BY_ITS_RIM),
    'bowl': Shape('plate', _round(0.07, 0.034), _round(0.08, 0.038), **_HELD_BY_ITS_RIM),
    'cup': Shape('cup', _round(0.046, 0.055), _round(0.053, 0.065), grasp=Grasp(height=0.55)),
    'bread': Shape('bread', (0.036, 0.052, 0.03), (0.042, 0.06, 0.035), **_LONG),
    'carrot': Shape(
        'carrot', (0.03, 0.06, 0.03), (0.034, 0.068, 0.034), colours=('orange',), **_LONG
    ),
    'eggplant': Shape(
        'eggplant', (0.034, 0.056, 0.034), (0.04, 0.064, 0.04), colours=('purple',), **_LONG
    ),
    'corn': Shape(
        'corn', (0.032, 0.06, 0.032), (0.036, 0.066, 0.036), colours=('yellow',), **_LONG
    ),
    'car': Shape('car', (0.034, 0.056, 0.036), (0.038, 0.062, 0.04), **_LONG),
    'duck': Shape(
        'duck', (0.034, 0.05, 0.046), (0.038, 0.056, 0.052), grasp=Grasp(height=0.35), **_LONG
    ),
    'bottle': Shape('bottle', _round(0.044, 0.1), _round(0.05, 0.112), grasp=Grasp(height=0.6)),
    'tray': Shape('container', (0.17, 0.125, 0.014), (0.18, 0.135, 0.016), **_NEVER_MOVED),
    'basket': Shape('container', (0.148, 0.12, 0.042), (0.154, 0.128, 0.048), **_NEVER_MOVED),
    'bin': Shape('container', (0.155, 0.13, 0.048), (0.162, 0.138, 0.054), **_NEVER_MOVED),
    # these the tasks of the benchmark never use: they are for the zero-shot sets
    'can': Shape('can', _round(0.042, 0.05), _round(0.048, 0.06)),
    'house': Shape(
        'house', (0.036, 0.046, 0.048), (0.042, 0.054, 0.056), grasp=Grasp(height=0.4), **_LONG
    ),
}


def shape_named(name: str) -> Shape:
    """Return a shape by name.

    Raises:
        SimulatorError: unknown name; the text names the nearest known one.
    """
    if name not in SHAPES:
        raise SimulatorError.unknown('unknown shape', name, sorted(SHAPES), listed='; known are')
    return SHAPES[name]
