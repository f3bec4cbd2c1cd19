"""Simulated motion of objects under a plan, both read from a file, without camera images.

Shape letters: K futures, T rows, O objects, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import cv2
import numpy as np
from pydantic import Field, model_validator, Strict

from mtv_world_ros.core.config import Length, ListOf, Metres, read_yaml, Schema, validated
from mtv_world_ros.core.data_types import ByteArray, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.mujoco_import import mujoco
from mtv_world_ros.physics.object_motion import ObjectMotion
from mtv_world_ros.physics.solid_foresight import (
    COMMANDS_A_STEP,
    SolidForesight,
    STEP_S,
    TrackedSolids,
)
from mtv_world_ros.physics.solids import is_vessel, Solid
from mtv_world_ros.robot.file import Position
from mtv_world_ros.robot.model import check_positions, RobotModel
from mtv_world_ros.robot.resample import match_joints, resample

#: width of the rendered picture [px]
_WIDTH_PX = 480
#: height of the rendered picture [px]
_HEIGHT_PX = 360
#: distance of the camera from the point it looks at [m]
_CAMERA_DISTANCE_M = 0.9
#: elevation of the camera's viewing direction; negative = it looks down [degrees]
_CAMERA_ELEVATION_DEG = -30.0
#: colour of the table (RGBA)
_TABLE_COLOUR = (0.75, 0.73, 0.7, 1.0)
#: colour of the robot (RGBA)
_ROBOT_COLOUR = (0.45, 0.47, 0.5, 1.0)
#: colours of the objects in turn (RGBA)
_COLOURS = ((0.8, 0.2, 0.2, 1.0), (0.2, 0.4, 0.8, 1.0), (0.2, 0.6, 0.3, 1.0), (0.8, 0.6, 0.1, 1.0))
#: instants that a picture shows, as shares of the plan
_SHOWN = (0.0, 0.5, 1.0)
#: maximum duration of a plan; a longer one probably has another unit [s]
LONGEST_S = 120.0


class SolidEntry(Schema):
    """An object: a box, or an upright cylinder."""

    name: str = Field(description='name; that of a vessel makes it hollow')
    centre: Annotated[tuple[Metres, Metres, Metres], Strict(False)] = Field(
        description='x, y, z in the base frame [m]'
    )
    size: Annotated[tuple[Length, Length, Length], Strict(False)] = Field(
        description='extents along its own x, y, z [m]'
    )
    yaw: float = Field(default=0.0, ge=-10, le=10, description='turn about the vertical [rad]')
    round: bool = Field(default=False, description='whether it is a cylinder, else a box')

    def solid(self) -> Solid:
        """Return the object as foresight takes it."""
        return Solid(
            centre=np.array(self.centre, float),
            size=np.array(self.size, float),
            yaw=self.yaw,
            is_round=self.round,
            is_open=is_vessel(self.name),
        )


class SceneFile(Schema):
    """Objects, and a plan of joint positions."""

    objects: ListOf[SolidEntry] = Field(
        min_length=1, max_length=50, description='objects on the table'
    )
    joints: ListOf[str] | None = Field(
        default=None, description="order of the joints in `positions`; null = the robot's"
    )
    times: ListOf[Annotated[float, Field(ge=0, le=LONGEST_S)]] = Field(
        min_length=2, description='times of the positions, increasing; the first is 0 [s]'
    )
    positions: ListOf[ListOf[Position]] = Field(
        description='joint positions, a row a time [rad or m]'
    )

    @model_validator(mode='after')
    def _is_told_apart_and_begins_now(self) -> Self:
        names = [entry.name for entry in self.objects]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two objects are called '{twice}'; give each a name of its own")
        if self.times[0] != 0:
            raise ValueError(f'times begin at {self.times[0]:g}; the first must be 0')
        return self

    def rows(self, num_joints: int) -> FloatArray:
        """Return the positions (T, J).

        Raises:
            TrajectoryError: a row has another number of joints, or there is none for a time.
        """
        counts = {len(row) for row in self.positions}
        if counts != {num_joints} or len(self.positions) != len(self.times):
            raise TrajectoryError(
                f'{len(self.times)} times and {len(self.positions)} rows of positions, of '
                f'{", ".join(map(str, sorted(counts)))} joints; give a row of {num_joints} for '
                'each time'
            )
        return np.array(self.positions, float)


def load_scene(
    path: Path, robot: RobotModel
) -> tuple[tuple[str, ...], tuple[Solid, ...], FloatArray]:
    """Return names of O objects, the objects, and commands (1 + T * n, J) of a scene file.

    Raises:
        ConfigError: the file is missing or wrong.
        TrajectoryError: the plan does not fit the robot.
    """
    file = validated(SceneFile, read_yaml(path, 'scene', 'the scene'), str(path))
    names = tuple(file.joints or robot.joint_names)
    try:
        # its first row is where the robot stands
        plan = JointTrajectory(
            joint_names=names, times=np.array(file.times), positions=file.rows(len(names))
        )
        plan = match_joints(plan, robot)
        check_positions(robot, plan.positions)
    except TrajectoryError as error:
        raise TrajectoryError(f"'{path}': {error}") from error
    steps = max(round(float(plan.times[-1]) / STEP_S), 1)
    times = np.arange(steps * COMMANDS_A_STEP + 1, dtype=np.float64) * PERIOD_S
    solids = tuple(entry.solid() for entry in file.objects)
    return (
        tuple(entry.name for entry in file.objects),
        solids,
        resample(plan, plan.positions[0], times),
    )


def in_words(names: Sequence[str], motions: Sequence[ObjectMotion]) -> list[str]:
    """Return a line an object: how far it goes in the futures that count."""
    counted = [motion for motion in motions if motion.weight > 0]
    lines = []
    for item, name in enumerate(names):
        ways = np.array([m.points[-1, item] - m.points[0, item] for m in counted])
        if not len(ways) or not np.isfinite(ways).all():
            lines.append(f'{name}: nothing is foreseen')
            continue
        middle, spread = np.median(ways, 0) * 1e3, ways.std(0).max() * 1e3
        x, y, z = middle
        lines.append(
            f'{name}: goes by ({x:.0f}, {y:.0f}, {z:.0f}) mm, and differs by {spread:.0f} mm '
            f'between {len(ways)} futures'
        )
    return lines


def draw_foreseen(tracked: TrackedSolids, commands: FloatArray, out: Path) -> None:
    """Write a PNG of the first future at a few instants, drawn by the engine."""
    foresight = tracked.foresight
    alone = SolidForesight(
        foresight.robot,
        foresight.response,
        foresight.settings.model_copy(update={'num_motions': 1}),
    )
    batch = alone.engine.begin(TrackedSolids(
        foresight=alone, names=tracked.names, solids=tracked.solids
    ).futures())  # fmt: skip
    model, data = batch.model, mujoco.MjData(batch.model)
    _paint(model)
    pictures, state = [], None
    rows = np.unique(np.round(np.array(_SHOWN) * ((len(commands) - 1) // COMMANDS_A_STEP)))
    with mujoco.Renderer(model, _HEIGHT_PX, _WIDTH_PX) as renderer:
        last = 0
        for row in rows.astype(int) * COMMANDS_A_STEP:
            if row > last:
                _, state = batch.advance(commands[last : row + 1], COMMANDS_A_STEP, state)
            shown = state or batch.start(commands[0])
            data.qpos[:] = shown.physics[0, 1 : 1 + model.nq]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, _camera(tracked.solids))
            pictures.append(renderer.render().copy())
            last = int(row)
    write_whole(out, _png(np.concatenate(pictures, axis=1)))


def _camera(solids: Sequence[Solid | None]) -> Any:
    known = [solid.centre for solid in solids if solid is not None]
    camera = mujoco.MjvCamera()
    camera.lookat[:] = np.mean(known, 0) if known else np.zeros(3)
    x, y, _ = camera.lookat  # it looks back to the robot
    camera.azimuth = np.degrees(np.arctan2(-y, -x)) + 25
    camera.distance, camera.elevation = _CAMERA_DISTANCE_M, _CAMERA_ELEVATION_DEG
    return camera


def _paint(model: Any) -> None:
    """Give table, robot and objects colours of their own."""
    model.geom_rgba[:] = _ROBOT_COLOUR
    model.geom_rgba[0] = _TABLE_COLOUR
    model.vis.headlight.ambient[:] = 0.45
    for number in range(model.nbody):
        kind, _, item = model.body(number).name.partition(' ')
        if kind == 'solid':
            of_body = model.geom_bodyid == number
            model.geom_rgba[of_body] = _COLOURS[int(item) % len(_COLOURS)]


def _png(picture: ByteArray) -> bytes:
    return cv2.imencode('.png', picture[..., ::-1])[1].tobytes()
