"""A checkpoint folder, opened once: its card, its robot, its default cameras, its parts."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mtv_world_ros.control.control import Control, ControlOptions
from mtv_world_ros.control.registry import CONTROL_FILE, load_control
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import CalibrationError, CheckpointError, ConfigError
from mtv_world_ros.core.files import content_digest, ROBOT_YAML, share_path
from mtv_world_ros.model.card import (
    ADAPTER_FOLDER,
    CAMERAS,
    CARD,
    CheckpointCard,
    OBJECT_MOTION_FOLDER,
    read_card,
    ROBOT_FOLDER,
)
from mtv_world_ros.model.trained_episodes import TrainedEpisodes
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.model import RobotModel

BUNDLED = 'bundled'
#: folders of `resource` with the checkpoints that ship with the package, by name; the second one
#: was trained the paper's way: trails and first masks, no object motion
BUNDLED_FOLDERS = {BUNDLED: 'checkpoint', 'bundled-paper': 'checkpoint_paper'}
_YAML = ('.yaml', '.yml')


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """A checkpoint folder whose card was read.

    `Checkpoint.open` makes it from a name or a path; commands, nodes and training pass it on.

    Attributes:
        name: name or path as it was given.
        folder: folder of the checkpoint.
        card: contents of its `world_model.json`.
        adapter: LoRA adapter that is used with it, in place of its own; None = its own, if any.
    """

    name: str
    folder: Path
    card: CheckpointCard
    adapter: Path | None = None

    @classmethod
    def open(cls, name: str | Path | Checkpoint = BUNDLED) -> Checkpoint:
        """Return the checkpoint of a name of `BUNDLED_FOLDERS` or of a folder.

        Raises:
            CheckpointError: there is no such folder, or it is no checkpoint.
        """
        if isinstance(name, Checkpoint):
            return name
        folder = checkpoint_folder(name)
        return cls(name=str(name), folder=folder, card=read_card(folder))

    def with_adapter(self, adapter: Path | None) -> Checkpoint:
        """Return the checkpoint with an adapter, whose control counts where its card names one.

        Args:
            adapter: folder or file; None = the checkpoint's own adapter, if it has one.

        Raises:
            CheckpointError: the adapter's card cannot be used.
        """
        used = adapter
        if used is None and (self.folder / ADAPTER_FOLDER).is_dir():
            used = self.folder / ADAPTER_FOLDER
        if used is None or not (used / CARD).is_file():
            return replace(self, adapter=adapter)
        card = self.card.replace(control=read_card(used).control)
        return replace(self, adapter=used, card=card)

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        # another machine has the package's checkpoints elsewhere
        return Checkpoint.open, (self.name,)

    @property
    def is_bundled(self) -> bool:
        """True if the checkpoint is part of the installed package, which is read-only."""
        return self.name in BUNDLED_FOLDERS

    @property
    def spec(self) -> WorldModelSpec:
        """Views, frame size and rate of the model."""
        return self.card.spec

    @property
    def trained_episodes(self) -> TrainedEpisodes:
        """Episodes that its weights, and those of its adapter, were trained on."""
        found = TrainedEpisodes.of_card(self.card.trained_on)
        if self.adapter is None:
            return found
        if not (self.adapter / CARD).is_file():
            return found | TrainedEpisodes()
        return found | TrainedEpisodes.of_card(read_card(self.adapter).trained_on)

    @property
    def object_motion(self) -> Path | None:
        """Folder of the contact settings and the arms' response; None = it has none."""
        folder = self.folder / OBJECT_MOTION_FOLDER
        return folder if folder.is_dir() else None

    @property
    def object_motion_digest(self) -> str:
        """Digest of the object motion that estimates are fitted to; empty = there is none."""
        folder = self.object_motion
        return '' if folder is None else content_digest(folder)[:16]

    @property
    def cameras_file(self) -> Path:
        """Default calibration: the one that it carries or, of older checkpoints, the robot's.

        Raises:
            CalibrationError: neither the checkpoint nor the robot has one.
        """
        carried = self.folder / ROBOT_FOLDER / CAMERAS
        if carried.is_file():
            return carried
        try:
            return share_path('config', 'robots', self.card.robot, 'cameras.yaml')
        except ConfigError as error:
            raise CalibrationError(
                f"checkpoint '{self.name}' has no default calibration (its episodes were recorded "
                "with different ones): set 'calibration_file' (on commands, --calibration) to "
                "that of the cameras as they stand now, e.g. an episode's calibration.yaml "
                f'({error})'
            ) from error

    def load_robot(self, file: str | Path | None = None) -> RobotModel:
        """Return the robot that it carries or, of older checkpoints, names.

        Args:
            file: another file of the same robot, or the name of a bundled one.

        Raises:
            CheckpointError: the file describes a robot of another name.
            ConfigError: there is no file of the robot.
        """
        trained = self.card.robot
        carried = self.folder / ROBOT_FOLDER / ROBOT_YAML
        default = carried if carried.is_file() else trained
        robot = load_robot(robot_path(file or default))
        # older cards name the file of a robot that is not bundled
        if robot.name != trained and Path(trained).suffix not in _YAML:
            raise CheckpointError(
                f"the checkpoint was trained with robot '{trained}', 'robot_file' describes "
                f"'{robot.name}'; use the trained one or train on this robot's episodes"
            )
        return robot

    def load_control(self, robot: RobotModel) -> Control:
        """Return how plans of a robot enter the model.

        Raises:
            ConfigError: no such control, or it cannot be imported or created.
            CheckpointError: what it was fitted to cannot be read.
        """
        options, folder = control_options(self.card, robot), self.folder
        if self.adapter is not None and (self.adapter / CONTROL_FILE).is_file():
            folder = self.adapter
        return load_control(self.card.control, options, folder)

    def can_foresee(self, robot: RobotModel) -> bool:
        """Return whether it foresees object motion and was trained to see it."""
        return self.object_motion is not None and self.load_control(robot).shows_objects

    def digest(self, without: Collection[str] = ()) -> str:
        """Return a digest of all its files.

        Args:
            without: names of files that do not count.
        """
        return content_digest(self.folder, without)


def checkpoint_folder(name: str | Path) -> Path:
    """Return the folder of a checkpoint, given by path or by a name of `BUNDLED_FOLDERS`.

    Raises:
        CheckpointError: no folder, and nearly the name of one that ships with the package.
    """
    folder = BUNDLED_FOLDERS.get(str(name))
    if folder is not None:
        return share_path('resource', folder)
    path = Path(name)
    if not path.exists() and path.name.replace('_', '-').startswith(BUNDLED):
        raise CheckpointError.unknown(
            'checkpoint',
            str(name),
            BUNDLED_FOLDERS,
            is_not=' is no folder and no checkpoint of the package',
            listed='; those are',
        )
    return path


def control_options(card: CheckpointCard, robot: RobotModel) -> ControlOptions:
    """Return the options that the control of a checkpoint is created with."""
    return ControlOptions(
        robot=robot,
        rendering=card.rendering,
        object_mask=card.object_mask,
        num_frames=card.num_frames,
    )
