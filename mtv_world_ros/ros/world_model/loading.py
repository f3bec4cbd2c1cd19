"""What the parameters name: the pipeline and the calibrated cameras of its views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from mtv_world_ros.assembly import checkpoint_cameras, checkpoint_path, load_pipeline
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.errors import CalibrationError, MtvWorldError
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.model.card import read_card, spec_of
from mtv_world_ros.pipeline import Pipeline, WorldModelSpec
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as
from mtv_world_ros.ros.parameters import NodeSettings, Settings


def load_named_pipeline(settings: Settings) -> Pipeline:
    """Loads the checkpoint, on the device and for the robot and task that are set."""
    return load_pipeline(
        settings.checkpoint,
        robot=settings.robot_file or None,
        task=settings.task or None,
        device=settings.device,
        num_threads=settings.num_threads,
        segmenter=settings.segmenter,
        serving=settings.serving,
    )


def load_cameras(settings: NodeSettings, spec: WorldModelSpec) -> tuple[CameraModel, ...]:
    """Loads the calibrated camera of every view, in the model's order.

    Raises:
        CalibrationError: the file is wrong or lacks a view, or there is none.
    """
    path = Path(settings.calibration_file or checkpoint_cameras(settings.checkpoint))
    cameras = load_calibration(path)
    missing = [view for view in spec.views if view not in cameras]
    if missing:
        raise CalibrationError(
            f"'{path}' lacks the views {missing} of the checkpoint; it has {sorted(cameras)}. Add "
            "them, or set 'calibration_file' to a file that has them"
        )
    return tuple(cameras[view] for view in spec.views)


def reload_cameras(settings: NodeSettings, spec: WorldModelSpec) -> tuple[CameraModel, ...]:
    """The same while the node runs.

    Raises:
        Rejection: the file is wrong or lacks a view.
    """
    with rejected_as(Reason.CAMERA_INFO_INVALID):
        return load_cameras(settings, spec)


def check_calibration(
    changed: Sequence[Parameter], settings: NodeSettings, spec: WorldModelSpec
) -> SetParametersResult:
    """Refuses a `calibration_file` that is wrong or lacks a view, before it is taken."""
    for parameter in changed:
        if parameter.name != 'calibration_file':
            continue
        try:
            load_cameras(settings.model_copy(update={'calibration_file': parameter.value}), spec)
        except MtvWorldError as error:
            return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def load_spec(checkpoint: str) -> WorldModelSpec:
    """Returns what a checkpoint takes and gives, without loading it."""
    return spec_of(read_card(checkpoint_path(checkpoint)))
