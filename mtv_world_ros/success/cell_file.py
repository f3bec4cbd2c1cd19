"""File that keeps the evidence of a robot cell on contact parameters from elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from hashlib import sha256
import os
from pathlib import Path
import re

from pydantic import ValidationError

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.config import Schema
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import write_json
from mtv_world_ros.core.writer_lock import turn_to_write
from mtv_world_ros.success.confirmation import ContactConfirmation, TaskEvidence

#: folder of the files in ROS_HOME
FOLDER = Path('mtv_world', 'cells')
#: most characters of a cell's name in the name of its file
_NAME_LENGTH = 60


class _Contents(Schema):
    """Contents of the file.

    Attributes:
        place: name of the robot cell.
        robot: name of the robot.
        fit: digest of the fitted contact parameters and arm response.
        tasks: evidence by name of the task.
    """

    place: str
    robot: str
    fit: str
    tasks: dict[str, TaskEvidence]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFile:
    """File with the evidence on contact parameters in one robot cell.

    Attributes:
        place: name of the robot cell; not empty.
        robot: name of the robot.
        fit: digest of the fitted contact parameters.
        folder: folder of such files.
    """

    place: str
    robot: str
    fit: str
    folder: Path

    @classmethod
    def at_home(cls, *, place: str, robot: str, fit: str) -> CellFile | None:
        """Return the file in `$ROS_HOME/mtv_world/cells`; None = no cell or no fit is known."""
        if not place or not fit:
            return None
        try:
            home = Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')
        except RuntimeError:  # there is no home
            return None
        return cls(place=place, robot=robot, fit=fit, folder=home / FOLDER)

    @property
    def path(self) -> Path:
        """Path of the file; another fit or robot has another file."""
        name = re.sub(r'[^A-Za-z0-9_.-]+', '_', self.place).lstrip('.')[:_NAME_LENGTH]
        key = '\0'.join((self.place, self.robot, self.fit))
        return self.folder / f'{name}-{sha256(key.encode()).hexdigest()[:8]}.json'

    def load(self) -> tuple[ContactConfirmation, str]:
        """Return the evidence, and a remark on a file that was damaged; empty = it was not.

        A damaged file is kept under another name, and the evidence begins anew.

        Raises:
            ConfigError: the file is of another cell, robot or fit, or cannot be read.
        """
        path = self.path
        try:
            found = _Contents.model_validate(read_json(path))
        except FileNotFoundError:
            return ContactConfirmation(), ''
        except OSError as error:
            raise ConfigError(
                f"the evidence of robot cell '{self.place}' cannot be read: {error}; make "
                f"'{path}' readable"
            ) from error
        except (ValueError, ValidationError, MtvWorldError) as error:
            return ContactConfirmation(), self._set_aside(' '.join(str(error).split())[:200])
        for what in ('place', 'robot', 'fit'):
            stored, own = getattr(found, what), getattr(self, what)
            if stored != own:
                raise ConfigError(
                    f"'{path}' has evidence on the {what} '{stored}', and this is '{own}'; move "
                    'the file away, then the evidence begins anew'
                )
        return ContactConfirmation(found.tasks), ''

    def update(
        self, confirmation: ContactConfirmation, change: Callable[[ContactConfirmation], object]
    ) -> str:
        """Read the evidence from the file, change it, and write it back.

        The file is locked meanwhile, so that nodes of one robot cell share its evidence.

        Args:
            confirmation: gets the evidence of the file, then the change.
            change: function that changes the evidence.

        Returns:
            A remark on a file that was damaged; empty = it was not.

        Raises:
            ConfigError: the file is of another cell, robot or fit, or cannot be read.
            OSError: the file cannot be written; `confirmation` is changed all the same.
        """
        with ExitStack() as stack:
            try:
                stack.enter_context(turn_to_write(self.path))
            except OSError:
                change(confirmation)
                raise
            found, remark = self.load()
            confirmation.tasks = dict(found.tasks)
            change(confirmation)
            if confirmation.tasks != found.tasks:
                self.store(confirmation)
        return remark

    def store(self, confirmation: ContactConfirmation) -> None:
        """Write the evidence.

        Raises:
            OSError: the file cannot be written.
        """
        values = _Contents(
            place=self.place, robot=self.robot, fit=self.fit, tasks=dict(confirmation.tasks)
        )
        write_json(self.path, values.model_dump())

    def _set_aside(self, why: str) -> str:
        """Rename a damaged file; return a remark that names both.

        Raises:
            ConfigError: it cannot be renamed.
        """
        path, number = self.path, 1
        while (aside := path.with_suffix(f'.damaged{number}')).exists():
            number += 1
        try:
            path.rename(aside)
        except OSError as error:
            raise ConfigError(
                f"'{path}' is damaged ({why}) and cannot be renamed: {error}; move it away"
            ) from error
        return (
            f"'{path}' is damaged ({why}): it is kept as '{aside.name}', and the evidence on "
            f"robot cell '{self.place}' begins anew"
        )
