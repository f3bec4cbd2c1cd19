"""Resources that parameters name: pipeline, cameras of its views, live adapter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Protocol, runtime_checkable, TYPE_CHECKING

from rclpy.node import Node
from rclpy.parameter import Parameter

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError, CheckpointError, MtvWorldError
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.pipeline import Pipeline, WorldModel, WorldModelSpec
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as
from mtv_world_ros.ros.parameters import NodeSettings, refusing, Settings

if TYPE_CHECKING:
    from mtv_world_ros.model.lora import Adapter

NAME = 'adapter'
NONE = 'none'


@runtime_checkable
class TakesAdapters(Protocol):
    """A world model whose LoRA adapter can be exchanged; see `DiffusionWorldModel`."""

    own_adapter: Path | None

    def read_adapter(self, path: Path | None) -> Adapter:
        """Read an adapter; raise if it is of another model."""
        ...

    def use_adapter(self, adapter: Adapter) -> None:
        """Replace the present adapter."""
        ...


class AdapterSwitch:
    """Exchanges the world model's adapter when the parameter `adapter` changes.

    A value is refused if its adapter cannot be read, or is of another model.

    Args:
        node: node that has the parameter.
        world_model: model that takes the adapter.
        run_between: function that runs a job between rollouts.

    Raises:
        MtvWorldError: the value at start-up cannot be used.
    """

    def __init__(
        self,
        node: Node,
        world_model: WorldModel,
        run_between: Callable[[Callable[[], None]], None],
    ) -> None:
        self._world_model, self._run_between = world_model, run_between
        self._log = node.get_logger()
        self._read: tuple[str, Adapter] | None = None
        value = str(node.get_parameter(NAME).value)
        #: the value that holds for rollouts that start now
        self.in_use = ''
        if value:
            self._use(value, self._load(value))
        self._node = node
        self._check = refusing(self._read_named)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def close(self) -> None:
        """Stop watching the parameter."""
        self._node.remove_on_set_parameters_callback(self._check)
        self._node.remove_post_set_parameters_callback(self._take)

    def _load(self, value: str) -> Adapter:
        model = self._world_model
        if not isinstance(model, TakesAdapters):
            raise CheckpointError(f"this world model takes no adapter, got '{value}'")
        if not value:
            return model.read_adapter(model.own_adapter)
        return model.read_adapter(None if value == NONE else Path(value))

    def _read_named(self, parameters: list[Parameter]) -> None:
        """Read what is named, so that taking it cannot fail for what the user gave."""
        for parameter in parameters:
            if parameter.name == NAME:
                value = str(parameter.value)
                try:
                    self._read = (value, self._load(value))
                except (MtvWorldError, OSError, ValueError) as error:
                    raise CheckpointError(f'{NAME}: {error}') from error

    def _take(self, parameters: list[Parameter]) -> None:
        if self._read is not None and any(parameter.name == NAME for parameter in parameters):
            self._run_between(partial(self._exchange, *self._read))
            self._read = None

    def _exchange(self, value: str, adapter: Adapter) -> None:
        try:
            self._use(value, adapter)
        except Exception as error:  # such as out of memory: the one before stays
            self._log.error(f"adapter '{value}' is not used, '{self.in_use}' stays: {error}")

    def _use(self, value: str, adapter: Adapter) -> None:
        assert isinstance(self._world_model, TakesAdapters)
        self._world_model.use_adapter(adapter)
        self.in_use = value
        self._log.info(f'adapter: {value or "that of the checkpoint, if it has one"}')


Cameras = tuple[CameraModel, ...]
#: a calibration file that takes longer is given up [s]
_READ_S = 3.0


def load_named_pipeline(settings: Settings) -> Pipeline:
    """Load the checkpoint, on the device and for the robot and task that are set."""
    return Pipeline.load(
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


def load_cameras(
    settings: NodeSettings, spec: WorldModelSpec, checkpoint: Checkpoint | str
) -> tuple[CameraModel, ...]:
    """Load the calibrated camera of every view, in the model's order.

    Args:
        settings: `calibration_file` names the file; empty = the checkpoint's default cameras.
        spec: views of the model.
        checkpoint: checkpoint of the model; its name, where it was not opened.

    Raises:
        CalibrationError: the file is wrong or lacks a view, or there is none.
    """
    path = Path(settings.calibration_file or Checkpoint.open(checkpoint).cameras_file)
    return read_cameras(path, spec)


def read_cameras(path: Path, spec: WorldModelSpec) -> tuple[CameraModel, ...]:
    """Read the calibrated camera of every view, in the model's order.

    Raises:
        CalibrationError: the file is wrong or lacks a view.
    """
    cameras = load_calibration(path)
    missing = [view for view in spec.views if view not in cameras]
    if missing:
        raise CalibrationError(
            f"'{path}' lacks the views {missing} of the checkpoint; it has {sorted(cameras)}. Add "
            "them, or set 'calibration_file' to a file that has them"
        )
    return tuple(cameras[view] for view in spec.views)


def reload_cameras(
    settings: NodeSettings, spec: WorldModelSpec, checkpoint: Checkpoint | str
) -> tuple[CameraModel, ...]:
    """Load the cameras again while the node runs; see `load_cameras`.

    Raises:
        Rejection: the file is wrong, lacks a view, or cannot be read in time.
    """
    with rejected_as(Reason.CAMERA_INFO_INVALID):
        return _in_time(
            lambda: load_cameras(settings, spec, checkpoint), settings.calibration_file
        )


def _in_time(read: Callable[[], Cameras], path: str) -> Cameras:
    """Read in a thread, so that a disk or network that hangs does not hang the node.

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
    changed: Sequence[Parameter],
    settings: NodeSettings,
    spec: WorldModelSpec,
    checkpoint: Checkpoint | str,
) -> None:
    """Refuse a `calibration_file` that is wrong or lacks a view, before it is taken.

    Raises:
        Rejection: the calibration cannot be used.
    """
    for parameter in changed:
        if parameter.name == 'calibration_file':
            changed_settings = settings.model_copy(update={'calibration_file': parameter.value})
            reload_cameras(changed_settings, spec, checkpoint)
