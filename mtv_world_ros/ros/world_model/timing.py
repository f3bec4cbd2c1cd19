"""When a trajectory starts, counted from the observation it is imagined from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mtv_world_ros.data_types import JointTrajectory
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.messages.stamps import NANO


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeLimits:
    """Limits [s] beyond which a trajectory is refused."""

    trajectory_age: float
    horizon: float


def from_observation(
    trajectory: JointTrajectory, stamp_ns: int, observation_ns: int, limits: TimeLimits
) -> JointTrajectory:
    """Returns the trajectory with times from the observation's stamp.

    Args:
        trajectory: its times count from `stamp_ns`.
        stamp_ns: when it starts [ns]; 0 = at the observation.
        observation_ns: stamp of the observation [ns].
        limits: what is too old and what too long.

    Raises:
        Rejection: it starts too long ago, has ended already, or ends too late.
    """
    offset = (stamp_ns - observation_ns) / NANO if stamp_ns else 0.0
    end = offset + float(trajectory.times[-1])
    if -offset > limits.trajectory_age:
        raise Rejection(
            Reason.TRAJECTORY_STALE,
            f'the trajectory is stamped {-offset:.3f} s before the observation it would start '
            f"from; 'max_trajectory_age_s' allows {limits.trajectory_age:g} s",
        )
    if end < 0:
        raise Rejection(
            Reason.TRAJECTORY_STALE,
            f'the trajectory ended {-end:.3f} s before the observation it would start from',
        )
    if end > limits.horizon:
        raise Rejection(
            Reason.TRAJECTORY_TOO_LONG,
            f"the trajectory ends {end:.3f} s after its observation; 'max_horizon_s' allows "
            f'{limits.horizon:g} s (do its stamp and the images come from the same clock?)',
        )
    return replace(trajectory, times=trajectory.times + offset) if offset else trajectory
