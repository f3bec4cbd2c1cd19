"""Reasons for rejecting a message or a rollout, and the error that carries one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

from mtv_world_ros.core.bounded_input import LimitError
from mtv_world_ros.core.errors import MtvWorldError, PlanError


class Reason(StrEnum):
    """Reason of a rejection, as counted in `/diagnostics` and `~/report`."""

    IMAGE_ENCODING = 'image_encoding'
    IMAGE_DATA = 'image_data'
    IMAGE_MISSING = 'image_missing'
    IMAGE_STALE = 'image_stale'
    VIEWS_OUT_OF_SYNC = 'views_out_of_sync'
    CAMERA_INFO_MISSING = 'camera_info_missing'
    CAMERA_INFO_CHANGED = 'camera_info_changed'
    CAMERA_INFO_INVALID = 'camera_info_invalid'
    CAMERA_POSE_MISSING = 'camera_pose_missing'
    CAMERA_POSE_STALE = 'camera_pose_stale'
    CAMERA_POSE_CHANGED = 'camera_pose_changed'
    ROBOT_DESCRIPTION = 'robot_description'
    JOINT_STATE_INVALID = 'joint_state_invalid'
    JOINT_STATE_MISSING = 'joint_state_missing'
    JOINT_STATE_STALE = 'joint_state_stale'
    TRAJECTORY_EMPTY = 'trajectory_empty'
    TRAJECTORY_MALFORMED = 'trajectory_malformed'
    TRAJECTORY_NOT_FINITE = 'trajectory_not_finite'
    TRAJECTORY_TIMES = 'trajectory_times'
    TRAJECTORY_STALE = 'trajectory_stale'
    TRAJECTORY_TOO_LONG = 'trajectory_too_long'
    JOINT_NAMES = 'joint_names'
    JOINT_LIMITS = 'joint_limits'
    JOINT_SPEEDS = 'joint_speeds'
    INSTRUCTION_TOO_LONG = 'instruction_too_long'
    OBJECTS_TOO_LONG = 'objects_too_long'
    MESSAGE_TOO_LARGE = 'message_too_large'
    MESSAGE_MALFORMED = 'message_malformed'
    NO_CLOCK = 'no_clock'
    NOT_ACTIVE = 'not_active'
    WORLD_MODEL_MISSING = 'world_model_missing'
    ROLLOUT_INVALID = 'rollout_invalid'
    OUT_OF_MEMORY = 'out_of_memory'
    WORKER_STUCK = 'worker_stuck'
    INTERNAL_ERROR = 'internal_error'


class Rejection(MtvWorldError):
    """Refusal of a message or rollout; `reason` is the code in the counters."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@contextmanager
def rejected_as(reason: Reason) -> Iterator[None]:
    """Turn a user error or an exceeded limit into a `Rejection`.

    Args:
        reason: reason that is counted; a faulty plan counts under its own fault.
    """
    try:
        yield
    except Rejection:
        raise
    except PlanError as error:
        raise Rejection(Reason(error.fault), str(error)) from error
    except (MtvWorldError, LimitError) as error:
        raise Rejection(reason, str(error)) from error
