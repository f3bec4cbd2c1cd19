"""One table of plans: what the reader of recordings refuses, and what the live node refuses.

The reader of recordings does not ask how fast a plan is: what was commanded and done is a fact,
and cutting it would change the data that is learned from. Who imagines a plan asks, live or not.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.joint_plans import read_plan
from mtv_world_ros.robot.plan import Plan

HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
NAN = float('nan')


def moved(radians: float, joint: int = 0) -> list[float]:
    """All joints at home but one."""
    row = HOME.copy()
    row[joint] += radians
    return row.tolist()


def message_of(names, rows, times, velocities):
    """trajectory_msgs/JointTrajectory of rosbags' class."""
    make, nothing = messages.make, np.empty(0)
    points = []
    for number, (row, time_s) in enumerate(zip(rows, times, strict=True)):
        speeds = nothing if velocities is None else np.array(velocities[number])
        rest = round(time_s % 1 * 1e9)
        after = make('builtin_interfaces/msg/Duration', sec=int(time_s), nanosec=rest)
        points.append(
            make(
                'trajectory_msgs/msg/JointTrajectoryPoint', positions=np.array(row),
                velocities=speeds, accelerations=nothing, effort=nothing, time_from_start=after,
            )
        )  # fmt: skip
    header = messages.make_header(0, '')
    return make(messages.JOINT_TRAJECTORY, header=header, joint_names=list(names), points=points)


#: rows, times, velocities -> who refuses it: nobody, both, or the node alone; and the words
CASES = {
    'slow': (([moved(0.1)], [1.0], None), None, ''),
    'no points': (([], [], None), 'both', '0 points'),
    'a joint left out': (([moved(0.1)[:-1]], [1.0], None), 'both', 'point 0 has 13 positions'),
    'no number': (([moved(NAN)], [1.0], None), 'both', 'must be finite'),
    'times that go back': (([moved(0), moved(0.1)], [1.0, 0.5], None), 'both', 'time'),
    'out of the limits': (([moved(9.0)], [9.0], None), 'node', "'left_joint1'"),
    # the URDF has 5.4 rad/s for the shoulder; twice that is accepted
    'points too fast': (
        ([moved(0), moved(0.55)], [0.5, 0.55], None), 'node', r"'left_joint1'.*11 rad/s.*10.8"),
    'a velocity too fast': (
        ([moved(0), moved(0.1)], [0.5, 1.0], [[0.0] * 14, [20.0] + [0.0] * 13]), 'node',
        r"'left_joint1'.*20 rad/s.*10.8"),
}  # fmt: skip


@pytest.mark.parametrize('name', CASES)
def test_who_refuses_a_plan(name, robot):
    (rows, times, velocities), who, words = CASES[name]
    message = message_of(robot.joint_names, rows, times, velocities)

    def refused(by: str):
        is_refused = who == 'both' or who == by
        return pytest.raises(TrajectoryError, match=words) if is_refused else nullcontext()

    with refused('reader'):
        read_plan(message)
    with refused('node'):
        none = np.zeros((0, 1, 1, 3), np.uint8)
        start = Observation(cameras=(), frames=none, positions=HOME, stamp_ns=0)
        Plan.of(read_plan(message), robot, start)
