from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode import LazyFrames
from mtv_world_ros.data.measured_joints import merge_joint_states
from mtv_world_ros.data.recorded_streams import in_order


def joint_state(stamp_ns: int, **positions: float):
    values = list(positions.values())
    return stamp_ns, messages.make_joint_state(stamp_ns, list(positions), values)


def test_joint_states_of_two_arms_become_one_table():
    recorded = [
        joint_state(1, left=1.0),
        joint_state(2, right=2.0),
        joint_state(4, right=4.0, left=5.0),
        joint_state(3, left=3.0),
    ]
    states = merge_joint_states('/joint_states', recorded, [])
    assert states is not None
    assert states.joint_names == ('left', 'right')
    assert states.stamps_ns.tolist() == [2, 3, 4]
    assert states.positions.tolist() == [[1, 2], [3, 2], [5, 4]]


def test_two_arms_of_one_stamp_become_one_row():
    recorded = [joint_state(1, left=1.0), joint_state(1, right=2.0)]
    states = merge_joint_states('/joint_states', recorded, [])
    assert states is not None
    assert states.positions.tolist() == [[1, 2]]


def test_joint_states_without_positions_are_left_out():
    stamp, broken = joint_state(2, a=1.0)
    broken.position = np.empty(0)
    warnings: list[str] = []
    assert merge_joint_states('/joint_states', [(stamp, broken)], warnings) is None
    assert warnings == ["'/joint_states': 1 messages without a position per joint were left out"]


def test_late_and_repeated_stamps_are_sorted_and_counted():
    warnings: list[str] = []
    items = [(30, 'a'), (10, 'b'), (20, 'c'), (30, 'd'), (5, 'e')]
    expected = [(5, 'e'), (10, 'b'), (20, 'c'), (30, 'd')]
    assert in_order('/topic', items, warnings) == expected
    assert warnings == [
        "'/topic': 2 messages were out of order and have been sorted",
        "'/topic': 1 stamps came twice; the later message was kept",
    ]


def test_stamps_in_order_need_no_warning():
    warnings: list[str] = []
    assert in_order('/topic', [(1, 'a'), (2, 'b')], warnings) == [(1, 'a'), (2, 'b')]
    assert warnings == []


def test_frames_of_several_sizes_do_not_become_one_array():
    sizes = [(2, 3, 3), (1, 6, 3)]
    frames = LazyFrames('/low/image_raw', sizes, lambda size: np.zeros(size, np.uint8))
    assert frames[1].shape == (1, 6, 3)
    with pytest.raises(EpisodeError, match=r"'/low/image_raw': .*\[\(1, 6\), \(2, 3\)\]"):
        np.asarray(frames)


def test_only_the_frames_asked_for_are_decoded():
    decoded = []

    def decode(index: int) -> np.ndarray:
        decoded.append(index)
        return np.full((1, 1, 3), index, np.uint8)

    frames = LazyFrames('/low/image_raw', range(100), decode)
    assert frames[[7, 3]][:, 0, 0, 0].tolist() == [7, 3]
    assert decoded == [7, 3]
