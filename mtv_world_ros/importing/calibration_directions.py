"""Directions of transforms in files of other programs, checked by the arm in the images."""

from __future__ import annotations

from dataclasses import replace

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.motion_residual import (
    measure_residual,
    MotionResidual,
    ResidualSearch,
)
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape

_HERE = ResidualSearch(lags_s=(0.0,), rolls_deg=(), zooms=())
#: least correlation of drawn and seen motion that says something, as `check` has it
_MIN_MATCH = 0.12
#: one direction fits better by this much, or the images do not tell
_CLEAR_GAIN = 0.08


def settle_directions(episode: Episode, robot: RobotModel) -> Episode:
    """Return an episode whose given poses have the direction that fits the arm in the images.

    A direction that the images contradict is turned round, and that is said. Where they do not
    tell, because the arm does not move or is not seen, the file's own direction is kept, and it is
    said that it was not checked.
    """
    if not episode.other_directions or episode.joint_states is None:
        return episode
    cameras, notes = dict(episode.cameras), list(episode.warnings)
    for view, other in episode.other_directions.items():
        here = _residual(episode, view, cameras[view], robot)
        there = _residual(episode, view, other.camera, robot)
        turns, text = _verdict(here, there)
        notes.append(f"view '{view}': the direction of {other.source} {text}")
        if turns:
            cameras[view] = other.camera
    return replace(episode, cameras=cameras, warnings=tuple(notes), other_directions={})


def _residual(
    episode: Episode, view: str, camera: CameraModel, robot: RobotModel
) -> MotionResidual:
    assert episode.joint_states is not None
    joints = JointTrack(episode.joint_states, robot)
    try:
        parts = load_shape(robot).parts
        return measure_residual(episode.images[view], camera, robot, parts, joints, _HERE)
    except MtvWorldError as error:
        return MotionResidual(reason=str(error))


def _verdict(here: MotionResidual, there: MotionResidual) -> tuple[bool, str]:
    """Return whether a pose is turned round, and what is said."""
    fits, turned = (0.0 if one.reason else one.match_here for one in (here, there))
    if here.reason and there.reason:
        return False, f'was not checked: {here.reason}'
    if turned > max(fits + _CLEAR_GAIN, _MIN_MATCH):
        return True, (
            f'was turned round: so the drawn arm fits the seen one ({turned:.2f}), as it stands '
            f'in the file it does not ({fits:.2f})'
        )
    if fits > max(turned + _CLEAR_GAIN, _MIN_MATCH):
        return False, f"is confirmed by the arm's outline ({fits:.2f}, turned round {turned:.2f})"
    return False, (
        f'was not checked: the arm is not seen clearly either way ({fits:.2f}, turned round '
        f'{turned:.2f}); look at it with mtv-world check'
    )
