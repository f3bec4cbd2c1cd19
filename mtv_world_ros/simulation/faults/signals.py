"""The commands of a plan as signals of arms and grippers, which faults change.

Shape letters: T commands, J joints, A arms, G grippers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel

#: minimum travel of a joint that takes part in a plan [rad]
_MIN_TRAVEL_RAD = 0.2


@dataclass(frozen=True)
class Commands:
    """Commands that a fault changes.

    Attributes:
        positions: (T, J) [rad or m].
        period: period between two rows [s].
        robot: the robot that these joints belong to.
    """

    positions: FloatArray
    period: float
    robot: RobotModel

    def at(self, positions: FloatArray) -> Commands:
        """Return other positions (T, J), within the joints' limits."""
        return replace(self, positions=np.clip(positions, self.robot.lower, self.robot.upper))

    def num(self, seconds: float) -> int:
        """Return how many rows a time has."""
        return round(seconds / self.period)

    @property
    def rows(self) -> FloatArray:
        """(T,) numbers of the rows."""
        return np.arange(len(self.positions), dtype=np.float64)

    @property
    def times(self) -> FloatArray:
        """(T,) times of the rows [s]."""
        return self.rows * self.period

    @cached_property
    def grippers(self) -> list[int]:
        """Columns of the grippers (G,)."""
        joints = [tool.gripper_joint for tool in self.robot.tools]
        return [self.robot.joint_names.index(joint) for joint in joints if joint is not None]

    @cached_property
    def closed(self) -> FloatArray:
        """(G,) positions of the grippers when shut."""
        return np.array([t.gripper_closed for t in self.robot.tools if t.gripper_joint])

    @cached_property
    def travel(self) -> FloatArray:
        """(G,) ways of the grippers from shut to open."""
        opened = [tool.gripper_open for tool in self.robot.tools if tool.gripper_joint]
        return np.array(opened) - self.closed

    @property
    def middles(self) -> FloatArray:
        """(G,) positions of the grippers half-way."""
        return self.closed + self.travel / 2

    @property
    def num_arms(self) -> int:
        """Number of arms; they have equally many columns each, one after the other."""
        return len(self.robot.tools)

    @property
    def arms(self) -> np.ndarray:
        """(A, J / A) columns of the arms' joints, without grippers."""
        columns = np.arange(self.positions.shape[1])
        return np.delete(columns, self.grippers).reshape(self.num_arms, -1)

    def arms_of(self, changed: FloatArray) -> FloatArray:
        """Return positions (T, J) with changed arms and unchanged grippers."""
        whole = changed.copy()
        whole[:, self.grippers] = self.positions[:, self.grippers]
        return whole

    def grippers_of(self, changed: FloatArray) -> FloatArray:
        """Return positions (T, J) with changed grippers (T, G) and unchanged arms."""
        whole = self.positions.copy()
        whole[:, self.grippers] = changed
        return whole

    def moving(self, rng: np.random.Generator) -> int:
        """Return the column of one of the arm joints that move, drawn."""
        travel = np.ptp(self.positions, axis=0)
        travel[self.grippers] = 0.0
        return int(rng.choice(np.flatnonzero(travel >= min(_MIN_TRAVEL_RAD, travel.max()))))

    def delayed(self, num: int) -> tuple[FloatArray, FloatArray]:
        """Return (T + num, J) twice: with the end held, and `num` rows later."""
        first = np.repeat(self.positions[:1], num, axis=0)
        last = np.repeat(self.positions[-1:], num, axis=0)
        return np.concatenate([self.positions, last]), np.concatenate([first, self.positions])

    def pulse(self, begin: float, rises: float, lasts: float, falls: float) -> FloatArray:
        """Return (T,) from 0 to 1 and back, from a row on; times [s] that each part takes."""
        since = (self.rows - begin) * self.period
        return np.interp(since, np.cumsum([0.0, rises, lasts, falls]), [0.0, 1.0, 1.0, 0.0])

    def ramp(self, seconds: float, since: FloatArray | float = 0.0) -> FloatArray:
        """Return (T,) from 0 at a time to 1 after some seconds."""
        return np.clip((self.times - since) / seconds, 0.0, 1.0)


def crossed(positions: FloatArray, to_next: int) -> FloatArray:
    """Return (T, J), from the first row on, the mirrored motion of joints `to_next` before.

    Joints that are at opposite angles in the first row turn to opposite sides.
    """
    home, ways = positions[0], positions - positions[0]
    signs = np.where(home * np.roll(home, to_next) < 0, -1.0, 1.0)
    return signs * np.roll(ways, to_next, axis=1)
