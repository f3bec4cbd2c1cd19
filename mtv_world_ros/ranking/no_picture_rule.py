"""A judge that sees the commands and the first frame alone, and imagines no picture.

What a world model has to beat: an object sticks to a gripper that closes near its centre, moves
with the tool, and where the gripper opens it comes to rest on what is below.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.cameras.mask_geometry import block_size, centroids, locate
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import CannotTell
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.success.relations import FLOOR_M
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import ever_and_final, match_task, TaskSpec

#: maximum horizontal distance of a closing tool from the centre of an object that it grasps [m]
REACH_M = 0.02
#: maximum vertical distance of a closing tool from the centre of an object that it grasps [m]
REACH_HEIGHT_M = 0.03
#: opening below which a gripper has closed [fraction of its opening before]
CLOSES_BELOW = 0.5
#: increase of the opening at which a closed gripper opens again [fraction of its range]
OPENS_BY = 0.1
#: commands between two samples of the situation: 10 Hz, as where the simulator is judged
_STRIDE = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Thing:
    """An object as the first frame shows it.

    Attributes:
        name: name of the object in the instruction.
        centre: (3,) position of the centre [m].
        size: full extents (x, y, z) [m].
        is_rim_held: whether it is taken by its rim, not across the middle.
    """

    name: str
    centre: FloatArray
    size: FloatArray
    is_rim_held: bool = False

    @property
    def is_hollow(self) -> bool:
        """True if objects lie in it, not on it."""
        shape = SHAPES.get(self.name.split()[-1])
        return shape is not None and shape.hollow

    def is_within_reach(self, tool: FloatArray) -> bool:
        """Return whether a gripper that closes at `tool` (3,) takes it."""
        away = np.abs(tool - self.centre)
        reach = REACH_M + (self.size[0] / 2 if self.is_rim_held else 0.0)
        return bool(np.hypot(*away[:2]) < reach and away[2] < REACH_HEIGHT_M)

    def resting(self, others: Sequence[Thing]) -> Thing:
        """Return it at rest on whatever is below it: another object, or the table."""
        height = self.size[2] / 2
        for other in others:
            if np.hypot(*(self.centre - other.centre)[:2]) < max(other.size[:2]) / 2:
                base = other.centre[2] + (-0.5 if other.is_hollow else 0.5) * other.size[2]
                base += FLOOR_M if other.is_hollow else 0.0
                height = max(height, base + self.size[2] / 2)
        return replace(self, centre=np.array([*self.centre[:2], height]))


def judge_without_pictures(pipeline: Pipeline, episode: Rollout, commands: FloatArray) -> bool:
    """Return whether the task is done at the end, by the rule.

    Args:
        pipeline: knows the tasks and finds the objects.
        episode: episode at its first observation, where the objects are found; its instruction
            says which task's relations judge.
        commands: (C, J) joint positions at the simulator's control rate [rad or m].

    Raises:
        CannotTell: the instruction fits no task, an object is not seen in two views, or a
            relation asks for what poses do not tell.
    """
    instruction = episode.options.instruction
    estimator = pipeline.judge.estimator.for_task(episode.options.task)
    found = match_task(estimator.tasks, instruction)
    if found is None:
        raise CannotTell(f"'{instruction}' is no known task")
    task, bound = found
    things = find_things(pipeline, episode)
    missing = [name for name in bound.values() if name not in things]
    if missing:
        raise CannotTell(f"'{missing[0]}' is not seen in two views of the first frame")
    return is_done(task, bound, things, pipeline.robot, commands)


def is_done(
    task: TaskSpec,
    bound: Mapping[str, str],
    things: Mapping[str, Thing],
    robot: RobotModel,
    commands: FloatArray,
) -> bool:
    """Return whether the task is done at the end, by the rule.

    Args:
        task: the task whose relations decide.
        bound: placeholder -> name of its object.
        things: the objects at the start, by name.
        robot: the commanded robot.
        commands: (C, J) joint positions at the simulator's control rate [rad or m].

    Raises:
        CannotTell: a relation asks for what poses do not tell.
    """
    roles = {
        role: replace(
            things[name],
            size=np.asarray(task.sizes_m.get(role, things[name].size)),
            is_rim_held=name.split()[-1] in task.rims,
        )
        for role, name in bound.items()
    }
    poses = carried(robot, commands, roles)
    return ever_and_final(task.holds(poses, poses.openings))[1]


def find_things(pipeline: Pipeline, episode: Rollout) -> dict[str, Thing]:
    """Return the objects of the episode's present frame by name, those that two views see."""
    start, names = episode.observation, episode.names
    masks = pipeline.segmenter.segment(start.frames[:, None], names).masks[:, :, 0]
    cameras = start.cameras
    poses = [camera_poses(camera, pipeline.robot, start.positions[None])[0] for camera in cameras]
    return things_in(names, masks, cameras, poses)


def things_in(
    names: Sequence[str],
    masks: BoolArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
) -> dict[str, Thing]:
    """Return the objects that are visible in at least two views, by name.

    Args:
        names: names of the O objects.
        masks: (V, O, H, W) masks of one frame.
        cameras: V cameras at the masks' size.
        poses: (4, 4) poses T_base_camera of the V cameras [m].
    """
    things = {}
    for name, seen in zip(names, masks.swapaxes(0, 1), strict=True):
        location = locate(cameras, poses, centroids(seen))
        if location is None:
            continue
        centre = location.point
        edge = block_size(cameras, poses, seen.sum((-2, -1)).astype(float), centre)
        thing = Thing(name=name, centre=centre, size=np.full(3, edge))
        width = _width(cameras, poses, seen, centre) if thing.is_hollow else edge
        # it stands on the table
        size = np.array([width, width, 2 * max(float(centre[2]), FLOOR_M)])
        things[name] = replace(thing, size=size)
    return things


def carried(robot: RobotModel, commands: FloatArray, roles: Mapping[str, Thing]) -> TruePoses:
    """Return where the objects are while commands (C, J) are executed, by the rule.

    Args:
        robot: commanded.
        commands: (C, J) [rad or m].
        roles: objects at the start by their role in the task.
    """
    tools, openings = robot.tool_poses(commands), robot.gripper_openings(commands)
    now = dict(roles)
    turns = {role: np.eye(3) for role in roles}
    grippers = [_Gripper(float(opening)) for opening in openings[:, 0]]
    samples = []
    for number in range(len(commands)):
        for gripper, tool, opening in zip(
            grippers, tools[:, number], openings[:, number], strict=True
        ):
            gripper.follow(tool, float(opening), now, turns)
        if number % _STRIDE == 0:
            samples.append(({r: t.centre for r, t in now.items()}, dict(turns)))
    return TruePoses(
        positions={role: np.stack([at[role] for at, _ in samples]) for role in roles},
        rotations={role: np.stack([turned[role] for _, turned in samples]) for role in roles},
        sizes={role: tuple(map(float, thing.size)) for role, thing in now.items()},  # type: ignore[misc]
        openings=openings[:, ::_STRIDE],
    )


class _Gripper:
    """One gripper and what sticks to it."""

    def __init__(self, opening: float) -> None:
        self._level = opening  # the widest since it opened, or the narrowest since it closed
        self._is_closed = False
        self._held: dict[str, FloatArray] = {}  # role -> T_tool_object

    def follow(
        self,
        tool: FloatArray,
        opening: float,
        now: dict[str, Thing],
        turns: dict[str, FloatArray],
    ) -> None:
        """Move the held objects with the tool's pose (4, 4); take and drop."""
        for role, T_tool_object in self._held.items():
            pose = tool @ T_tool_object
            now[role], turns[role] = replace(now[role], centre=pose[:3, 3]), pose[:3, :3]
        if self._is_closed and opening > self._level + OPENS_BY:
            self._is_closed, self._level = False, opening
            self._drop(now, turns)
        elif not self._is_closed and opening < CLOSES_BELOW * self._level:
            self._is_closed, self._level = True, opening
            self._take(tool, now, turns)
        else:
            self._level = (min if self._is_closed else max)(self._level, opening)

    def _take(
        self, tool: FloatArray, now: Mapping[str, Thing], turns: Mapping[str, FloatArray]
    ) -> None:
        near = [role for role, thing in now.items() if thing.is_within_reach(tool[:3, 3])]
        for role in near[:1]:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turns[role], now[role].centre
            self._held[role] = np.linalg.inv(tool) @ pose

    def _drop(self, now: dict[str, Thing], turns: dict[str, FloatArray]) -> None:
        for role in self._held:
            others = [thing for other, thing in now.items() if other != role]
            now[role], turns[role] = now[role].resting(others), np.eye(3)
        self._held = {}


def _width(
    cameras: Sequence[CameraModel], poses: Sequence[FloatArray], masks: BoolArray, at: FloatArray
) -> float:
    """Return the width of masks (V, H, W) of an object at (3,) [m], the median of the views."""
    found = []
    for camera, pose, mask in zip(cameras, poses, masks, strict=True):
        columns = np.flatnonzero(mask.any(0))
        if len(columns):
            depth = float(pose[:3, 2] @ (at - pose[:3, 3]))
            found.append((np.ptp(columns) + 1) * depth / camera.K[0, 0])
    return float(np.median(found))
