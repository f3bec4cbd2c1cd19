"""How fingers swing as their hand moves: each has a mass and hangs on a drive that gives way.

What a gripper reports is the mean of its fingers, so two that swing to the same side do not show,
though both are millimetres off when they come down beside an object.

Shape letters: K drives, T steps, F fingers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerDrives:
    """Drives of fingers, in the units of their joints; all (F,), or (K, F) to compare K drives.

    Attributes:
        stiffness: [N/m or N m/rad].
        damping: [N s/m or N m s/rad].
        mass: of finger and drive [kg or kg m^2].
        lower: where the stops are [m or rad].
        upper: likewise.
    """

    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    lower: FloatArray
    upper: FloatArray

    def swings(
        self, pulls: FloatArray, ways: FloatArray, step_s: float, start: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns how far fingers are off their ways (..., 1 + T, F), and how it ends.

        Args:
            pulls: (T, F) forces of the moving hand [N or N m].
            ways: (1 + T, F) of fingers that do not swing [m or rad].
            step_s: between rows.
            start: (2, ..., F) how far they are off in the first row, and how fast that grows.
        """
        off, speed = start
        gain = step_s / self.mass
        spring, brake = gain * self.stiffness, gain * self.damping
        rows = [off]
        for pull, way in zip(pulls, ways[1:], strict=True):
            speed = speed + gain * pull - spring * off - brake * speed
            free = off + step_s * speed
            off = np.maximum(free, np.minimum(self.lower - way, 0.0))
            off = np.minimum(off, np.maximum(self.upper - way, 0.0))
            speed = np.where(off == free, speed, 0.0)
            rows.append(off)
        return np.stack(rows, axis=-2), np.stack([off, speed])
