"""An online embodied world model for ROS 2: trajectory in, imagined camera streams out.

The names of `__all__` are the public API; they are imported when they are asked for:

    Checkpoint       `open(name or folder)` reads the card of a checkpoint
    Pipeline         `load(checkpoint, ...)`; `begin(observation, options)` -> Rollout
    Rollout          `extend(trajectory)` imagines chunk after chunk
    run_policy       a policy acts in a `World`: the simulator, or imagination
    read_episode     a rosbag2 folder -> images, joint states, commands, cameras
    judge            the success estimate on the real frames of a recording

`WorldEnv`, a world as an environment of Gymnasium, needs the extra `gym`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
    from mtv_world_ros.cameras.motion import Motion
    from mtv_world_ros.control.control import Control, ControlInputs
    from mtv_world_ros.control.trajectory_video import (
        render_trajectory_video,
        TrajectoryVideoConfig,
    )
    from mtv_world_ros.core.data_types import (
        CameraModel,
        JointTrajectory,
        ObjectMasks,
        Observation,
        SuccessEstimate,
        WorldModelSpec,
    )
    from mtv_world_ros.core.files import check_free, share_path
    from mtv_world_ros.data.bag_mapping import BagMapping
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.data.episode_writer import EpisodeWriter
    from mtv_world_ros.data.recording import commands_from, load_recording
    from mtv_world_ros.importing.bags import import_bags, with_guessed_views
    from mtv_world_ros.importing.robot_guess import guess_robot
    from mtv_world_ros.inspection.camera_pose import difference as pose_difference
    from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.policies.policy import Policy, RecordedPolicy
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.robot.plan import Plan, PlanLimits
    from mtv_world_ros.robot.shape import load_shape
    from mtv_world_ros.rollout.offline import judge
    from mtv_world_ros.rollout.options import RolloutOptions
    from mtv_world_ros.rollout.pipeline import Pipeline, WorldModel
    from mtv_world_ros.rollout.prediction import Prediction
    from mtv_world_ros.rollout.rollout import Rollout
    from mtv_world_ros.rollout.world import ImaginedWorld, run_policy, World
    from mtv_world_ros.viewing.video import write_video
    from mtv_world_ros.vision.describers.describer import Describer
    from mtv_world_ros.vision.jaccard import jaccard
    from mtv_world_ros.vision.segmenters.segmenter import Segmenter

__all__ = [
    'BagMapping',
    'CameraModel',
    'check_free',
    'Checkpoint',
    'commands_from',
    'Control',
    'ControlInputs',
    'Describer',
    'EpisodeWriter',
    'FixedCamera',
    'guess_robot',
    'ImaginedWorld',
    'import_bags',
    'jaccard',
    'JointTrack',
    'JointTrajectory',
    'judge',
    'load_calibration',
    'load_recording',
    'load_robot',
    'load_shape',
    'Motion',
    'ObjectMasks',
    'Observation',
    'Pipeline',
    'Plan',
    'PlanLimits',
    'Policy',
    'pose_difference',
    'Prediction',
    'read_episode',
    'RecordedPolicy',
    'render_trajectory_video',
    'robot_path',
    'Rollout',
    'RolloutOptions',
    'run_policy',
    'save_calibration',
    'Segmenter',
    'share_path',
    'SuccessEstimate',
    'TrajectoryVideoConfig',
    'with_guessed_views',
    'World',
    'WorldModel',
    'WorldModelSpec',
    'write_video',
]
#: public name -> module, and the name there if it is another one
_PLACES = {
    # the main path
    'Checkpoint': 'model.checkpoint',
    'Pipeline': 'rollout.pipeline',
    'Rollout': 'rollout.rollout',
    'RolloutOptions': 'rollout.options',
    'Observation': 'core.data_types',
    'JointTrajectory': 'core.data_types',
    'Plan': 'robot.plan',
    'PlanLimits': 'robot.plan',
    'Prediction': 'rollout.prediction',
    'SuccessEstimate': 'core.data_types',
    # a policy in the loop
    'run_policy': 'rollout.world',
    'World': 'rollout.world',
    'ImaginedWorld': 'rollout.world',
    'RecordedPolicy': 'policies.policy',
    # recordings
    'read_episode': 'data.episode_reader',
    'load_recording': 'data.recording',
    'commands_from': 'data.recording',
    'judge': 'rollout.offline',
    'EpisodeWriter': 'data.episode_writer',
    'import_bags': 'importing.bags',
    'BagMapping': 'data.bag_mapping',
    'with_guessed_views': 'importing.bags',
    # protocols, and types of their methods
    'Control': 'control.control',
    'Segmenter': 'vision.segmenters.segmenter',
    'Describer': 'vision.describers.describer',
    'WorldModel': 'rollout.pipeline',
    'Policy': 'policies.policy',
    'ControlInputs': 'control.control',
    'ObjectMasks': 'core.data_types',
    'WorldModelSpec': 'core.data_types',
    # robots and cameras
    'load_robot': 'robot.file',
    'robot_path': 'robot.file',
    'guess_robot': 'importing.robot_guess',
    'load_shape': 'robot.shape',
    'Motion': 'cameras.motion',
    'CameraModel': 'core.data_types',
    'load_calibration': 'cameras.calibration_file',
    'save_calibration': 'cameras.calibration_file',
    'FixedCamera': 'inspection.cameras.fixed_camera',
    'JointTrack': 'inspection.clocks',
    'pose_difference': 'inspection.camera_pose:difference',
    # pictures and files
    'render_trajectory_video': 'control.trajectory_video',
    'TrajectoryVideoConfig': 'control.trajectory_video',
    'write_video': 'viewing.video',
    'jaccard': 'vision.jaccard',
    'share_path': 'core.files',
    'check_free': 'core.files',
    # needs an extra, so it is not in __all__
    'WorldEnv': 'rollout.gym_env',
}


def __getattr__(name: str) -> Any:
    """Import one of the public names."""
    if name not in _PLACES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module, _, own = _PLACES[name].partition(':')
    return getattr(import_module(f'{__name__}.{module}'), own or name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])
