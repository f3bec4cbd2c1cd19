"""Messages are refused by their size before anything decodes them."""

import struct
import time

import numpy as np
import pytest

from mtv_world_ros.core.bounded_input import LimitError
from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.message_sizes import check_size
from test.support.large_messages import empty_points

PLAN = messages.JOINT_TRAJECTORY


def serialised(names, points):
    plan = JointTrajectory(
        joint_names=names,
        times=np.arange(1, points + 1) * 0.1,
        positions=np.zeros((points, len(names))),
    )
    made = messages.make_joint_trajectory(10**9, plan)
    return messages.serialize(PLAN, made)


@pytest.mark.parametrize('order', ['<', '>'])
def test_a_million_points_are_refused_by_their_number_at_once(order):
    data = empty_points(10**6, order=order)
    begin_s = time.process_time()
    with pytest.raises(LimitError, match='the trajectory has 1000000 points; at most 20000'):
        check_size(PLAN, data)
    assert time.process_time() - begin_s < 0.1


def test_plans_within_the_limits_pass():
    check_size(PLAN, empty_points(20_000))
    check_size(PLAN, serialised(('joint one', 'j2', 'left_gripper'), 30))
    with pytest.raises(LimitError, match='20001 points'):
        check_size(PLAN, empty_points(20_001))


def test_points_are_counted_behind_names_of_every_length(monkeypatch):
    monkeypatch.setenv('MTV_WORLD_MAX_TRAJECTORY_POINTS', '29')
    for length in range(1, 9):
        with pytest.raises(LimitError, match='30 points'):
            check_size(PLAN, serialised(('a' * length, 'b' * (9 - length)), 30))


def test_too_many_joint_names_are_refused():
    with pytest.raises(LimitError, match='the trajectory has 1001 names'):
        check_size(PLAN, serialised(tuple(f'j{at}' for at in range(1001)), 1))


@pytest.mark.parametrize('length', [0, 3, 4, 12, 17, 20, 25, 27])
def test_bytes_that_end_early_are_left_to_the_decoder(length):
    check_size(PLAN, empty_points(10**6)[:length])
    check_size(PLAN, struct.pack('<4sQII', b'\0\1\0\0', 0, 2**32 - 1, 2**32 - 1)[:length])


@pytest.mark.parametrize(
    ('msgtype', 'size'),
    [(messages.STRING, 2**18 + 1), ('diagnostic_msgs/msg/DiagnosticArray', 2**18 + 1),
     (messages.JOINT_STATE, 2**18 + 1), (PLAN, 2**25 + 1), (messages.COMPRESSED_IMAGE, 2**26 + 1)],
)  # fmt: skip
def test_larger_messages_of_other_types_are_refused(msgtype, size):
    data = bytes(size)
    with pytest.raises(LimitError, match='MTV_WORLD_MAX_'):
        check_size(msgtype, data)
    check_size(msgtype, data[:1000])
