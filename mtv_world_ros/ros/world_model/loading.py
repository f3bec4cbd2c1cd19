"""What the parameters name: the pipeline and the calibrated cameras of its views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

from rclpy.parameter import Parameter

from mtv_world_ros.assembly import checkpoint_cameras, checkpoint_path, load_pipeline
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.model.card import read_card
from mtv_world_ros.pipeline import Pipeline, WorldModelSpec
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as
from mtv_world_ros.ros.parameters import NodeSettings, Settings

Cameras = tuple[CameraModel, ...]
#: a calibration file that takes longer is given up [s]
_READ_S = 3.0


def load_named_pipeline(settings: Settings) -> Pipeline:
    """Loads the checkpoint, on the device and for the robot and task that are set."""
    return load_pipeline(
        settings.checkpoint,
        robot=settings.robot_file or None,
        task=settings.task or None,
        device=settings.device,
        num_threads=settings.num_threads,
        segmenter=settings.segmenter,
        describer=settings.describer or None,
        serving=settings.serving,
        foresight=settings.foresight,
        camera_check=settings.camera_check,
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
        Rejection: the file is wrong, lacks a view, or cannot be read in time.
    """
    with rejected_as(Reason.CAMERA_INFO_INVALID):
        return _in_time(lambda: load_cameras(settings, spec), settings.calibration_file)


def _in_time(read: Callable[[], Cameras], path: str) -> Cameras:
    """Reads in a thread, so that a disk or network that hangs does not hang the node.

    Raises:
        CalibrationError: it takes too long.
    """
    answers: SimpleQueue[Cameras | Exception] = SimpleQueue()

    def run() -> None:
        try:
            answers.put(read())
        except Exception as error:
            answers.put(error)

    Thread(target=run, name='files', daemon=True).start()
    try:
        answer = answers.get(timeout=_READ_S)
    except Empty:
        raise CalibrationError(
            f"'{path}' was not read within {_READ_S:g} s; is its disk or network there?"
        ) from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def check_calibration(
    changed: Sequence[Parameter], settings: NodeSettings, spec: WorldModelSpec
) -> None:
    """Refuses a `calibration_file` that is wrong or lacks a view, before it is taken.

    Raises:
        Rejection: the calibration cannot be used.
    """
    for parameter in changed:
        if parameter.name == 'calibration_file':
            reload_cameras(settings.model_copy(update={'calibration_file': parameter.value}), spec)


def load_spec(checkpoint: str) -> WorldModelSpec:
    """Returns what a checkpoint takes and gives, without loading it."""
    return read_card(checkpoint_path(checkpoint)).spec
