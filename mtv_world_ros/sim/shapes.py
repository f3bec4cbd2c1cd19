"""Shapes of the free objects: their geoms, sizes, and where a gripper takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mtv_world_ros.errors import nearest, SimulatorError
from mtv_world_ros.sim import shape_geoms
from mtv_world_ros.sim.shape_geoms import Rgb, RIM_M, Size
from mtv_world_ros.vision.colour_words import PALETTE


@dataclass(frozen=True, slots=True, kw_only=True)
class Grasp:
    """How a top-down gripper takes a shape; its fingers close along the object's x.

    Attributes:
        height: of the tool over the object's bottom, as a share of the object's height.
        rim_m: thickness of the rim that is held, on the arm's own side; None = across the middle.
        opening: of the gripper on the way down, 0..1.
    """

    height: float = 0.5
    rim_m: float | None = None
    opening: float = 1.0

    def offset(self, size: Size, arm: str) -> float:
        """Returns how far the tool is from the object's centre along its x [m]."""
        if self.rim_m is None:
            return 0.0
        return (size[0] - self.rim_m) / 2 * (-1.0 if arm == 'left' else 1.0)

    def width(self, size: Size) -> float:
        """Returns what is between the closed fingers [m]."""
        return size[0] if self.rim_m is None else self.rim_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A kind of object.

    Attributes:
        geoms: (size, rgb) -> MJCF geoms in the frame of the bounding box's centre.
        smallest: full extents (x, y, z) of the smallest one [m].
        largest: of the largest one; sizes in between keep to the line from one to the other.
        grasp: how it is taken; None for what is never moved.
        colours: words of the palette that it comes in.
        step: turn about z after which it looks the same to a gripper [rad].
        hollow: what is put on it comes to rest on its floor.
    """

    geoms: Callable[[Size, Rgb], str]
    smallest: Size
    largest: Size
    grasp: Grasp | None = Grasp()
    colours: tuple[str, ...] = field(default=tuple(sorted(PALETTE)))
    step: float = np.pi / 2
    hollow: bool = False

    def free(self, taken: set[str]) -> bool:
        """Returns whether one of its colours is not taken yet."""
        return not set(self.colours) <= taken

    def size(self, share: float) -> Size:
        """Returns the extents [m] at `share` 0..1 between the smallest and the largest."""
        low, high = np.asarray(self.smallest), np.asarray(self.largest)
        x, y, z = (low + share * (high - low)).tolist()
        return (x, y, z)


_ACROSS_Y = np.pi  # longer along y: turned by a quarter it would not fit between the fingers


def _round(diameter: float, height: float) -> Size:
    return (diameter, diameter, height)


_RIM = Grasp(height=0.8, rim_m=RIM_M, opening=0.6)

SHAPES = {
    'block': Shape(
        geoms=shape_geoms.block, smallest=(0.04, 0.04, 0.04), largest=(0.055, 0.055, 0.055)
    ),
    'plate': Shape(
        geoms=shape_geoms.plate,
        smallest=_round(0.104, 0.02),
        largest=_round(0.114, 0.02),
        grasp=_RIM,
        hollow=True,
    ),
    'bowl': Shape(
        geoms=shape_geoms.plate,
        smallest=_round(0.07, 0.034),
        largest=_round(0.08, 0.038),
        grasp=_RIM,
        hollow=True,
    ),
    'cup': Shape(
        geoms=shape_geoms.cup,
        smallest=_round(0.046, 0.055),
        largest=_round(0.053, 0.065),
        grasp=Grasp(height=0.55),
    ),
    'bread': Shape(
        geoms=shape_geoms.bread,
        smallest=(0.036, 0.052, 0.03),
        largest=(0.042, 0.06, 0.035),
        step=_ACROSS_Y,
    ),
    'carrot': Shape(
        geoms=shape_geoms.carrot,
        smallest=(0.03, 0.06, 0.03),
        largest=(0.034, 0.068, 0.034),
        colours=('orange',),
        step=_ACROSS_Y,
    ),
    'eggplant': Shape(
        geoms=shape_geoms.eggplant,
        smallest=(0.034, 0.056, 0.034),
        largest=(0.04, 0.064, 0.04),
        colours=('purple',),
        step=_ACROSS_Y,
    ),
    'corn': Shape(
        geoms=shape_geoms.corn,
        smallest=(0.032, 0.06, 0.032),
        largest=(0.036, 0.066, 0.036),
        colours=('yellow',),
        step=_ACROSS_Y,
    ),
    'car': Shape(
        geoms=shape_geoms.car,
        smallest=(0.034, 0.056, 0.036),
        largest=(0.038, 0.062, 0.04),
        step=_ACROSS_Y,
    ),
    'duck': Shape(
        geoms=shape_geoms.duck,
        smallest=(0.034, 0.05, 0.046),
        largest=(0.038, 0.056, 0.052),
        grasp=Grasp(height=0.35),
        step=_ACROSS_Y,
    ),
    'bottle': Shape(
        geoms=shape_geoms.bottle,
        smallest=_round(0.044, 0.1),
        largest=_round(0.05, 0.112),
        grasp=Grasp(height=0.6),
    ),
    'tray': Shape(
        geoms=shape_geoms.container,
        smallest=(0.17, 0.125, 0.014),
        largest=(0.18, 0.135, 0.016),
        grasp=None,
        hollow=True,
    ),
    'basket': Shape(
        geoms=shape_geoms.container,
        smallest=(0.148, 0.12, 0.042),
        largest=(0.154, 0.128, 0.048),
        grasp=None,
        hollow=True,
    ),
    'bin': Shape(
        geoms=shape_geoms.container,
        smallest=(0.155, 0.13, 0.048),
        largest=(0.162, 0.138, 0.054),
        grasp=None,
        hollow=True,
    ),
    # these the tasks of the benchmark never use: they are for the zero-shot sets
    'can': Shape(geoms=shape_geoms.can, smallest=_round(0.042, 0.05), largest=_round(0.048, 0.06)),
    'house': Shape(
        geoms=shape_geoms.house,
        smallest=(0.036, 0.046, 0.048),
        largest=(0.042, 0.054, 0.056),
        grasp=Grasp(height=0.4),
        step=_ACROSS_Y,
    ),
}


def shape_named(name: str) -> Shape:
    """Returns a shape by name.

    Raises:
        SimulatorError: unknown name; the text names the nearest known one.
    """
    if name not in SHAPES:
        raise SimulatorError(
            f"unknown shape '{name}'{nearest(name, SHAPES)}; known are {sorted(SHAPES)}"
        )
    return SHAPES[name]
