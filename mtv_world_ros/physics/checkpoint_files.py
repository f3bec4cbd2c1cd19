"""Files of a checkpoint's foresight: the arms' response and the contact settings.

A folder holds `arm_response.json`, of `mtv-world fit contact`, and `contact.json`.
"""

from __future__ import annotations

from pathlib import Path

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.config import validated
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import write_json
from mtv_world_ros.physics.arms.arm_response import ArmResponse
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.solid_foresight import SolidForesight
from mtv_world_ros.robot.model import RobotModel

#: file of the contact settings
CONTACT_FILE = 'contact.json'
#: file of the arms' response to commands
RESPONSE_FILE = 'arm_response.json'


def load_foresight(folder: Path, robot: RobotModel, threads: int = 1) -> SolidForesight | None:
    """Read the files of `fit contact`; None = no foresight, verdicts rest on frames alone.

    Args:
        folder: folder that the fit wrote.
        robot: robot of the same joints.
        threads: number of computing threads.

    Raises:
        CheckpointError: a file cannot be used.
        RobotError: contact of the robot cannot be computed.
    """
    contact = load_contact(folder)
    if contact is None:
        return None
    return SolidForesight(robot, load_response(folder, robot), contact, threads)


def load_response(folder: Path, robot: RobotModel) -> ArmResponse | None:
    """Read the arms' response to commands; None = it was not fitted.

    Raises:
        CheckpointError: the file is not whole, or of another robot.
    """
    file = folder / RESPONSE_FILE
    if not file.exists():
        return None
    try:
        return ArmResponse.from_json(read_json(file), robot.joint_names)
    except KeyError as error:
        raise CheckpointError(
            f"'{file}' has no {error}, which robot '{robot.name}' has; run 'mtv-world "
            "fit contact' with episodes of this robot"
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"'{file}' cannot be used: {error}; run mtv-world fit contact again"
        ) from error


def load_contact(folder: Path) -> ContactSettings | None:
    """Read the contact settings; None = there are none.

    Raises:
        CheckpointError: the file cannot be used.
    """
    file = folder / CONTACT_FILE
    if not file.exists():
        return None
    try:
        values = read_json(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"'{file}' cannot be used: {error}; run mtv-world fit contact again"
        ) from error
    return validated(ContactSettings, values, f"'{file}'", error=CheckpointError)


def save_contact(contact: ContactSettings, folder: Path) -> None:
    """Write the contact settings into the folder of a checkpoint's foresight."""
    write_json(folder / CONTACT_FILE, contact.model_dump(mode='json'))


def save_response(response: ArmResponse, folder: Path) -> None:
    """Write the arms' response to commands."""
    write_json(folder / RESPONSE_FILE, response.as_json())
