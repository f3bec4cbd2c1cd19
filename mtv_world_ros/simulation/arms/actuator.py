"""Position actuators of a simulated robot."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuator:
    """Drives one joint of the simulated robot to `multiplier * position + offset`.

    Attributes:
        joint: name of the joint in the MJCF.
        column: column of the robot's joint that it follows.
        multiplier: factor of that joint's position; other than 1 for mimic joints of a URDF.
        offset: added to it [rad or m].
        kp: gain [N m/rad or N/m].
        kv: damping [N m s/rad or N s/m].
        max_force: largest torque or force [N m or N].
    """

    joint: str
    column: int
    multiplier: float = 1.0
    offset: float = 0.0
    kp: float
    kv: float
    max_force: float
