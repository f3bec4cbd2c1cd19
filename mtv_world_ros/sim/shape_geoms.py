"""MJCF geoms of the free objects, in the frame of the bounding box's centre."""

from __future__ import annotations

import numpy as np

Rgb = tuple[float, float, float]
Size = tuple[float, float, float]

WOOD, PLASTIC = 400.0, 150.0  # kg/m3; plastic stands for hollow or thin-walled things
#: walls of plates and bowls; a gripper holds on to their rim [m]
RIM_M = 0.012
#: walls of containers, floors of all that is hollow [m]; how heavy an empty container is [kg]
WALL_M, FLOOR_M, CONTAINER_KG = 0.006, 0.005, 0.8
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
