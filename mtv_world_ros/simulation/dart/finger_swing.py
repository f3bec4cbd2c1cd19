"""Swing of fingers under the acceleration of the hand: each is a mass on a compliant drive.

A gripper reports the mean of its fingers. A swing of both fingers to the same side is therefore
not measured, although both fingers may be millimetres off next to an object.

Shape letters: T steps, F fingers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.core.data_types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerDrives:
    """Drives of F fingers, in the units of their joints; all (F,).

    Attributes:
        stiffness: stiffness of the drive [N/m or N m/rad].
        damping: damping of the drive [N s/m or N m s/rad].
        mass: mass of finger and drive [kg or kg m^2].
        lower: lower joint limits [m or rad].
        upper: upper joint limits [m or rad].
    """

    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    lower: FloatArray
    upper: FloatArray

    def swings(
        self, pulls: FloatArray, ways: FloatArray, step_s: float, start: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return deviations (1 + T, F) of fingers from their ways, and the last row of `start`.

        Args:
            pulls: (T, F) forces of the moving hand [N or N m].
            ways: (1 + T, F) positions of fingers that do not swing [m or rad].
            step_s: time between rows [s].
            start: (2, F) deviations in the first row and their rates.
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
        return np.stack(rows), np.stack([off, speed])
