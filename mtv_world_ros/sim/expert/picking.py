"""How an object is taken: tool pose, gripper openings, and where a grasp misses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.sim.shapes import Grasp, SHAPES
from mtv_world_ros.sim.world.arm import FINGER_THICKNESS_M, FINGER_WIDTH_M
from mtv_world_ros.sim.world.placement import arm_of
from mtv_world_ros.sim.world.scene import SceneObject


@dataclass(frozen=True, slots=True, kw_only=True)
class PickingConfig:
    """Gaps between fingers and objects.

    Attributes:
        release: on either side when the fingers let go; they open wholly above [m].
        miss_margin: between the fingers and an object that is missed, range [m].
        max_miss: largest shift past an object, across the fingers' travel [m].
    """

    release: float = 0.008
    miss_margin: tuple[float, float] = (0.004, 0.01)
    max_miss: float = 0.045


@dataclass(frozen=True, slots=True)
class Pick:
    """How one object is taken.

    Attributes:
        arm: `left` or `right`.
        position: of the tool at the grasp (3,) [m].
        yaw: of the tool [rad].
        opening: of the gripper on the way down, 0..1.
        released: its opening when the object is let go, 0..1.
    """

    arm: str
    position: FloatArray
    yaw: float
    opening: float
    released: float


def grasp_of(subject: SceneObject) -> Grasp:
    """Returns how the object's shape is taken."""
    grasp = SHAPES[subject.shape].grasp
    assert grasp is not None, f'{subject.shape} cannot be grasped'
    return grasp


def tool_yaw(item: SceneObject) -> float:
    """Returns the yaw nearest to none under which the object looks the same to a gripper."""
    step = SHAPES[item.shape].step
    return float((item.yaw + step / 2) % step - step / 2)


def tool_offset(subject: SceneObject, yaw: float) -> FloatArray:
    """Returns the way (3,) from an object's centre, turned by `yaw`, to the tool that holds it."""
    grasp = grasp_of(subject)
    out = grasp.offset(subject.size, arm_of(subject))
    height = (grasp.height - 0.5) * subject.size[2]
    return np.array([out * np.cos(yaw), out * np.sin(yaw), height])


def pick_of(subject: SceneObject, max_gap: float, config: PickingConfig) -> Pick:
    """Returns how an object is taken by the arm on its side.

    Args:
        subject: what is taken, where it lies.
        max_gap: way of one finger from closed to open [m].
        config: gaps.
    """
    yaw, grasp = tool_yaw(subject), grasp_of(subject)
    gap = grasp.width(subject.size) / 2 + config.release
    return Pick(
        arm=arm_of(subject),
        position=np.asarray(subject.position) + tool_offset(subject, yaw),
        yaw=yaw,
        opening=grasp.opening,
        released=min(1.0, gap / max_gap),
    )


def miss_shift(
    subject: SceneObject,
    others: Sequence[SceneObject],
    max_gap: float,
    config: PickingConfig,
    rng: np.random.Generator,
) -> FloatArray:
    """Returns the sideways shift (3,) [m] with which the closing fingers miss the subject.

    Past a rim it goes outwards, past anything else across the fingers' travel, to the side with
    more room.
    """
    yaw, grasp = tool_yaw(subject), grasp_of(subject)
    margin = float(rng.uniform(*config.miss_margin))
    if grasp.rim_m is not None:
        side = np.sign(grasp.offset(subject.size, arm_of(subject)))
        inner = grasp.opening * max_gap + FINGER_THICKNESS_M
        return side * (grasp.rim_m / 2 + inner + margin) * _direction(yaw)
    distance = min(subject.size[1] / 2 + FINGER_WIDTH_M / 2 + margin, config.max_miss)
    across = distance * _direction(yaw + np.pi / 2)
    place = np.asarray(subject.position)

    def room(shift: FloatArray) -> float:
        gaps = [np.linalg.norm((place + shift - item.position)[:2]) for item in others]
        return float(min(gaps, default=1.0))

    return max((across, -across), key=room)


def _direction(yaw: float) -> FloatArray:
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])
