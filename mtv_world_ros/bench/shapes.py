"""Shapes of the free objects: their geoms, sizes, and where a gripper takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mtv_world_ros.errors import nearest, SimulatorError
from mtv_world_ros.success.relations import FLOOR_M
from mtv_world_ros.vision.segmenters.colour import PALETTE

Rgb = tuple[float, float, float]
Size = tuple[float, float, float]

WOOD, PLASTIC = 400.0, 150.0  # kg/m3; plastic stands for hollow or thin-walled things
#: walls of plates and bowls; a gripper holds on to their rim [m]
RIM_M = 0.012
#: walls of containers [m]; how heavy an empty container is [kg]
WALL_M, CONTAINER_KG = 0.006, 0.8
_NUM_RING = 16
_GREEN = (0.14, 0.65, 0.22)
#: long round things would roll away on a friction of points alone
_ROLLS = 'condim="6" friction="0.9 0.01 0.004"'


def _geom(
    kind: str,
    size: tuple[float, ...],
    rgb: Rgb,
    *,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    more: str = '',
) -> str:
    """One geom; half sizes as MuJoCo wants them, `turn` as Euler angles [rad]."""
    numbers = [' '.join(f'{value:.9g}' for value in values) for values in (size, at, turn, rgb)]
    return (
        f'<geom class="object" type="{kind}" size="{numbers[0]}" pos="{numbers[1]}" '
        f'euler="{numbers[2]}" rgba="{numbers[3]} 1" {more}/>'
    )


def _mass(density: float) -> str:
    return f'density="{density}"'


def _shaded(rgb: Rgb, factor: float) -> Rgb:
    red, green, blue = rgb
    return (red * factor, green * factor, blue * factor)


#: drawn, but neither hit nor weighed
_DRAWN = 'contype="0" conaffinity="0" mass="0"'


def block(size: Size, rgb: Rgb) -> str:
    """A cube or brick."""
    return _geom('box', (size[0] / 2, size[1] / 2, size[2] / 2), rgb, more=_mass(WOOD))


def _ring(radius: float, thickness: float, bottom: float, top: float, rgb: Rgb) -> str:
    """Upright wall around z; `radius` is the outer one."""
    middle = radius - thickness / 2
    half = (thickness / 2, middle * np.tan(np.pi / _NUM_RING) * 1.02, (top - bottom) / 2)
    angles = np.arange(_NUM_RING) * 2 * np.pi / _NUM_RING
    return ''.join(
        _geom(
            'box',
            half,
            rgb,
            at=(middle * np.cos(angle), middle * np.sin(angle), (top + bottom) / 2),
            turn=(0.0, 0.0, float(angle)),
            more=_mass(PLASTIC),
        )
        for angle in angles
    )


def _vessel(size: Size, rgb: Rgb, wall: float) -> str:
    """A round vessel, open at the top; the inside is a little darker."""
    radius, half = size[0] / 2, size[2] / 2
    base = _geom(
        'cylinder',
        (radius - wall / 2, FLOOR_M / 2),
        _shaded(rgb, 0.8),
        at=(0.0, 0.0, FLOOR_M / 2 - half),
        more=_mass(PLASTIC),
    )
    return base + _ring(radius, wall, -half, half, rgb)


def plate(size: Size, rgb: Rgb) -> str:
    """A vessel with a rim that a gripper can hold: a plate, or a bowl."""
    return _vessel(size, rgb, RIM_M)


def cup(size: Size, rgb: Rgb) -> str:
    """A vessel with a thin wall."""
    return _vessel(size, rgb, 0.005)


def bread(size: Size, rgb: Rgb) -> str:
    """A loaf: a box with a round top."""
    x, y, z = (extent / 2 for extent in size)
    low = 0.6
    top = _geom(
        'ellipsoid', (x, y, z * 2 * (1 - low)), rgb, at=(0, 0, z * (2 * low - 1)), more=_DRAWN
    )
    box = _geom('box', (x, y, z * low), rgb, at=(0, 0, z * (low - 1)), more=_mass(PLASTIC))
    return box + top


def carrot(size: Size, rgb: Rgb) -> str:
    """Tapers along y, with a little green."""
    thick, length = size[0] / 2, size[1]
    parts = ''
    for share, at in ((1.0, 0.18), (0.85, -0.02), (0.65, -0.22)):
        radius = thick * share
        parts += _geom(
            'capsule',
            (radius, length * 0.1),
            rgb,
            at=(0.0, at * length, radius - thick),
            turn=(np.pi / 2, 0.0, 0.0),
            more=f'{_mass(WOOD)} {_ROLLS}',
        )
    leaf = (thick * 0.4, length * 0.09, thick * 0.4)
    return parts + _geom('ellipsoid', leaf, _GREEN, at=(0, length * 0.43, 0), more=_DRAWN)


def eggplant(size: Size, rgb: Rgb) -> str:
    """An egg along y with a small stalk."""
    x, y, z = (extent / 2 for extent in size)
    body = _geom('ellipsoid', (x, y * 0.92, z), rgb, more=f'{_mass(WOOD)} {_ROLLS}')
    stalk = (x * 0.45, y * 0.12, x * 0.45)
    return body + _geom('ellipsoid', stalk, _GREEN, at=(0, y * 0.9, 0), more=_DRAWN)


def corn(size: Size, rgb: Rgb) -> str:
    """A cob along y in the rest of its husk."""
    radius, half = size[0] / 2, size[1] / 2
    turn = (np.pi / 2, 0.0, 0.0)
    cob = _geom('capsule', (radius, half - radius), rgb, turn=turn, more=f'{_mass(WOOD)} {_ROLLS}')
    husk = (radius * 1.03, half * 0.3, radius * 1.03)
    return cob + _geom('ellipsoid', husk, _GREEN, at=(0, half * 0.72, 0), more=_DRAWN)


def car(size: Size, rgb: Rgb) -> str:
    """A toy car along y: body, cabin, dark wheels."""
    x, y, z = (extent / 2 for extent in size)
    wheel = z * 0.42
    body = _geom('box', (x, y, z * 0.62), rgb, at=(0, 0, -z * 0.3), more=_mass(WOOD))
    cabin = _geom(
        'box', (x * 0.85, y * 0.5, z * 0.36), _shaded(rgb, 0.85), at=(0, 0, z * 0.64),
        more=_mass(PLASTIC),
    )  # fmt: skip
    wheels = ''.join(
        _geom(
            'cylinder',
            (wheel, 0.002),
            (0.1, 0.1, 0.1),
            at=(side * x, end * y * 0.6, wheel - z),
            turn=(0.0, np.pi / 2, 0.0),
            more=_DRAWN,
        )
        for side in (-1, 1)
        for end in (-1, 1)
    )
    return body + cabin + wheels


def duck(size: Size, rgb: Rgb) -> str:
    """A bath duck that looks along -y; it stands on a flat foot."""
    x, y, z = (extent / 2 for extent in size)
    foot = _geom('box', (x, y * 0.75, z * 0.5), rgb, at=(0, 0, -z * 0.5), more=_mass(WOOD))
    belly = _geom('ellipsoid', (x, y, z * 0.55), rgb, at=(0, 0, -z * 0.3), more=_DRAWN)
    head = _geom('sphere', (x * 0.72,), rgb, at=(0, -y * 0.35, z - x * 0.72), more=_DRAWN)
    beak = _geom(
        'ellipsoid', (x * 0.3, y * 0.22, x * 0.15), _shaded(rgb, 0.6),
        at=(0, -y * 0.35 - x * 0.8, z - x * 0.8), more=_DRAWN,
    )  # fmt: skip
    return foot + belly + head + beak


def bottle(size: Size, rgb: Rgb) -> str:
    """Body, neck and cap around z."""
    radius, height = size[0] / 2, size[2]
    parts = (
        (radius, 0.0, 0.7, 1.0),
        (radius * 0.45, 0.7, 0.86, 1.0),
        (radius * 0.6, 0.86, 1.0, 0.6),
    )
    return ''.join(
        _geom(
            'cylinder',
            (wide, (top - bottom) * height / 2),
            _shaded(rgb, shade),
            at=(0, 0, ((top + bottom) / 2 - 0.5) * height),
            more=_mass(WOOD),
        )
        for wide, bottom, top, shade in parts
    )


def container(size: Size, rgb: Rgb) -> str:
    """A box without a lid; heavy, for it is not to be pushed about."""
    x, y, z = (extent / 2 for extent in size)
    floor = _geom(
        'box', (x, y, FLOOR_M / 2), _shaded(rgb, 0.8), at=(0, 0, FLOOR_M / 2 - z),
        more=f'mass="{CONTAINER_KG}"',
    )  # fmt: skip
    wall = WALL_M / 2
    sides = (
        (wall, y, x - wall, 0),
        (wall, y, wall - x, 0),
        (x, wall, 0, y - wall),
        (x, wall, 0, wall - y),
    )
    return floor + ''.join(
        _geom('box', (half_x, half_y, z), rgb, at=(at_x, at_y, 0), more='mass="0.02"')
        for half_x, half_y, at_x, at_y in sides
    )


def can(size: Size, rgb: Rgb) -> str:
    """A closed cylinder around z."""
    return _geom('cylinder', (size[0] / 2, size[2] / 2), rgb, more=_mass(WOOD))


def house(size: Size, rgb: Rgb) -> str:
    """A box under a roof of two slopes."""
    x, y, z = (extent / 2 for extent in size)
    walls = _geom('box', (x, y, z * 0.65), rgb, at=(0, 0, -z * 0.35), more=_mass(WOOD))
    slope = float(np.arctan2(z * 0.7, y))
    length = float(np.hypot(z * 0.7, y)) / 2
    roof = ''.join(
        _geom(
            'box',
            (x, length, 0.002),
            _shaded(rgb, 0.6),
            at=(0, side * y / 2, z * 0.65),
            turn=(-side * slope, 0, 0),
            more=_DRAWN,
        )  # fmt: skip
        for side in (-1.0, 1.0)
    )
    return walls + roof


@dataclass(frozen=True, slots=True, kw_only=True)
class Grasp:
    """How a top-down gripper takes a shape; its fingers close along the object's x.

    Attributes:
        height: height of the tool over the object's bottom, as a share of the object's height.
        rim_m: thickness of the rim that is held, on the object's side of the table; None = across
            the middle.
        opening: of the gripper on the way down, 0..1.
    """

    height: float = 0.5
    rim_m: float | None = None
    opening: float = 1.0

    def offset(self, size: Size, side: float) -> float:
        """Returns how far the tool is from the object's centre along its x [m].

        Args:
            size: of the object [m].
            side: on which a rim is held, -1 left, 1 right.
        """
        if self.rim_m is None:
            return 0.0
        return (size[0] - self.rim_m) / 2 * side

    def width(self, size: Size) -> float:
        """Returns what is between the closed fingers [m]."""
        return size[0] if self.rim_m is None else self.rim_m


@dataclass(frozen=True, slots=True)
class Shape:
    """A kind of object.

    Attributes:
        geoms: (size, rgb) -> MJCF geoms in the frame of the bounding box's centre.
        smallest: full extents (x, y, z) of the smallest one [m].
        largest: of the largest one; sizes in between keep to the line from one to the other.
        grasp: how a gripper holds it; None = it is never moved.
        colours: words of the palette that it comes in.
        step: turn about z after which it looks the same to a gripper [rad].
        hollow: objects placed on it rest on its inner floor.
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


_RIM = Grasp(height=0.8, rim_m=RIM_M, opening=0.6)
#: longer along y: turned by a quarter it would not fit between the fingers
_LONG: dict[str, Any] = {'step': np.pi}
_HELD_BY_ITS_RIM: dict[str, Any] = {'grasp': _RIM, 'hollow': True}
_NEVER_MOVED: dict[str, Any] = {'grasp': None, 'hollow': True}


def _round(diameter: float, height: float) -> Size:
    return (diameter, diameter, height)


SHAPES = {
    'block': Shape(block, (0.04, 0.04, 0.04), (0.055, 0.055, 0.055)),
    'plate': Shape(plate, _round(0.104, 0.02), _round(0.114, 0.02), **_HELD_BY_ITS_RIM),
    'bowl': Shape(plate, _round(0.07, 0.034), _round(0.08, 0.038), **_HELD_BY_ITS_RIM),
    'cup': Shape(cup, _round(0.046, 0.055), _round(0.053, 0.065), grasp=Grasp(height=0.55)),
    'bread': Shape(bread, (0.036, 0.052, 0.03), (0.042, 0.06, 0.035), **_LONG),
    'carrot': Shape(
        carrot, (0.03, 0.06, 0.03), (0.034, 0.068, 0.034), colours=('orange',), **_LONG
    ),
    'eggplant': Shape(
        eggplant, (0.034, 0.056, 0.034), (0.04, 0.064, 0.04), colours=('purple',), **_LONG
    ),
    'corn': Shape(corn, (0.032, 0.06, 0.032), (0.036, 0.066, 0.036), colours=('yellow',), **_LONG),
    'car': Shape(car, (0.034, 0.056, 0.036), (0.038, 0.062, 0.04), **_LONG),
    'duck': Shape(
        duck, (0.034, 0.05, 0.046), (0.038, 0.056, 0.052), grasp=Grasp(height=0.35), **_LONG
    ),
    'bottle': Shape(bottle, _round(0.044, 0.1), _round(0.05, 0.112), grasp=Grasp(height=0.6)),
    'tray': Shape(container, (0.17, 0.125, 0.014), (0.18, 0.135, 0.016), **_NEVER_MOVED),
    'basket': Shape(container, (0.148, 0.12, 0.042), (0.154, 0.128, 0.048), **_NEVER_MOVED),
    'bin': Shape(container, (0.155, 0.13, 0.048), (0.162, 0.138, 0.054), **_NEVER_MOVED),
    # these the tasks of the benchmark never use: they are for the zero-shot sets
    'can': Shape(can, _round(0.042, 0.05), _round(0.048, 0.06)),
    'house': Shape(
        house, (0.036, 0.046, 0.048), (0.042, 0.054, 0.056), grasp=Grasp(height=0.4), **_LONG
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
