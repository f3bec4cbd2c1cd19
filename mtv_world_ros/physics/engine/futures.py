"""Sampling of what is not known before a plan is executed, once for each future.

Shape letters: O solids, D degrees of freedom of the arms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.physics.arms.arms import Drives
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.solids import Solid

#: largest distance from the table of an object that stands on it [m]
STANDS_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Future:
    """Sample of the unknown quantities: one future.

    Attributes:
        settings: contact settings.
        solids: the O solids.
        zeros: (D,) offsets of the joint encoders [rad or m].
        delay_s: extra delay of the arms [s].
        shift: (3,) common position error of all solids, contained in `solids` [m].
    """

    settings: ContactSettings
    solids: tuple[Solid, ...]
    zeros: FloatArray
    delay_s: float = 0.0
    shift: FloatArray = field(default_factory=lambda: np.zeros(3))


def draw_futures(
    settings: ContactSettings,
    solids: Sequence[Solid],
    drives: Drives,
) -> tuple[Future, ...]:
    """Return `settings.num_motions` futures; the first has the best estimates.

    The same number always gives the same draws, so that plans are compared under the same ones.

    Args:
        settings: settings of contact. Futures after the first take the joint samples of their
            `draws` in turn; without them each parameter differs by its `spread`.
        solids: the O solids as found.
        drives: drives of the arms.
    """
    return tuple(
        _drawn(settings, solids, drives, number) for number in range(settings.num_motions)
    )


def _drawn(
    settings: ContactSettings,
    solids: Sequence[Solid],
    drives: Drives,
    number: int,
) -> Future:
    rng, spread, share = np.random.default_rng((2, number)), settings.spread, float(number > 0)

    def scaled(deviation: float) -> float:
        return float(np.exp(share * deviation * rng.normal()))

    changed = {
        'grip_friction': settings.grip_friction * scaled(spread.grip),
        'table_friction': settings.table_friction * scaled(spread.friction),
        'finger_stiffness': settings.finger_stiffness * scaled(spread.force),
        'density': settings.density * scaled(spread.weight),
    }
    if number and settings.draws:
        changed = settings.draws[(number - 1) % len(settings.draws)].model_dump()
        changed['finger_damping'] = (
            settings.finger_damping * changed['finger_stiffness'] / settings.finger_stiffness
        )
    changed['tray_kg'] = settings.tray_kg * changed['density'] / settings.density
    zeros = share * spread.zero_rad * rng.normal(size=len(drives.names))
    delay_s = settings.delay_s + share * spread.delay_s * abs(float(rng.normal()))
    shift = share * spread.camera_m * np.array([*rng.normal(size=2), 0.0])
    if settings.table_varies:  # else its height is known, whatever the cameras say
        shift[2] = share * spread.camera_m * np.random.default_rng((3, number)).normal()
    return Future(
        settings=settings.model_copy(update={**changed, 'table_m': settings.table_m + shift[2]}),
        solids=tuple(shifted(_disturbed(solid, settings, share, rng), shift) for solid in solids),
        zeros=np.where(drives.fingers, 0.0, zeros),
        delay_s=delay_s,
        shift=shift,
    )


def shifted(solid: Solid, shift: FloatArray) -> Solid:
    """Return the solid, shifted by (3,) [m]."""
    return replace(solid, centre=solid.centre + shift)


def _disturbed(
    solid: Solid,
    settings: ContactSettings,
    share: float,
    rng: np.random.Generator,
) -> Solid:
    """Return a solid a little elsewhere, of a little other size.

    What stands on the table still does.
    """
    noise, spread = share * rng.normal(size=5), settings.spread
    wide, long, high = solid.size * np.exp(spread.size * noise[[0, 0, 1]])
    x, y = solid.centre[:2] + np.hypot(spread.place_m, solid.error_m) * noise[2:4]
    bottom = solid.bottom
    if abs(bottom - settings.table_m) < STANDS_M:
        bottom = settings.table_m
    return replace(
        solid,
        centre=np.array([x, y, bottom + high / 2]),
        size=np.array([wide, wide if solid.is_round else long, high]),
        yaw=solid.yaw + spread.turn_rad * float(noise[4]),
    )
