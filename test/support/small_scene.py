"""A scene for tests of contact: settings of a block and two fingers, and batches of futures."""

from __future__ import annotations

from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.engine.engine import Batch, Engine
from mtv_world_ros.physics.engine.futures import draw_futures
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel

SETTINGS = ContactSettings(
    finger_stiffness=400.0,
    finger_damping=10.0,
    finger_mass_kg=0.05,
    grip_friction=1.0,
    table_friction=0.5,
    density=500.0,
    tray_kg=0.4,
    num_motions=1,
)


def batch_of(robot: RobotModel, *solids: Solid, threads: int = 1, **changed: float) -> Batch:
    """Return futures of solids; `changed` are settings."""
    engine = Engine(Arms(robot, None), threads)
    settings = SETTINGS.model_copy(update=changed)
    return engine.begin(draw_futures(settings, solids, engine.arms.drives))
