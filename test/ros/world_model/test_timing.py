"""Trajectory times counted from the observation."""

import numpy as np
import pytest

from mtv_world_ros.data_types import JointTrajectory
from mtv_world_ros.ros.messages.conversions import NANO
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.worker import from_observation

LIMITS = Settings(max_horizon_s=10.0)
PLAN = JointTrajectory(joint_names=('a',), times=[0.5, 1.0], positions=[[0.0], [1.0]])


def test_stamp_zero_starts_at_the_observation():
    assert from_observation(PLAN, 0, 123 * NANO, LIMITS) is PLAN


@pytest.mark.parametrize(('offset_s', 'times'), [(0.25, [0.75, 1.25]), (-0.75, [-0.25, 0.25])])
def test_stamp_moves_the_times(offset_s, times):
    stamp_ns = 100 * NANO + round(offset_s * NANO)
    moved = from_observation(PLAN, stamp_ns, 100 * NANO, LIMITS)
    np.testing.assert_allclose(moved.times, times)


@pytest.mark.parametrize(
    ('stamp_s', 'limits', 'reason'),
    [
        (98.5, LIMITS, Reason.TRAJECTORY_STALE),
        (98.9, Settings(max_trajectory_age_s=5.0), Reason.TRAJECTORY_STALE),  # is over
        (109.5, LIMITS, Reason.TRAJECTORY_TOO_LONG),
    ],
)
def test_too_old_or_too_long_is_refused(stamp_s, limits, reason):
    with pytest.raises(Rejection) as refused:
        from_observation(PLAN, round(stamp_s * NANO), 100 * NANO, limits)
    assert refused.value.reason == reason
