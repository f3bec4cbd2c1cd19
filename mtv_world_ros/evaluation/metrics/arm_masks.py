"""J of the arm: where frames differ from the empty scene against the URDF drawn at the joints.

T frames of a view, H W its size, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import cv2
import numpy as np

from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.core.data_types import BoolArray, ByteArray, CameraModel, FloatArray
from mtv_world_ros.data.recording import Recording
from mtv_world_ros.evaluation.metrics.picture_scores import changed_pixels
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import LinkShape, moving_links

#: frames of a recording whose median the scene without the arm is
_MOST_FRAMES = 60
#: margin around the drawn arm in which frames are compared [fraction of image width]
_MARGIN = 0.06
#: frames in which less of the drawn arm can be compared are not scored [share of the image]
_LEAST_ARM = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmMasks:
    """Masks of the arm in frames, and the scene behind the arm.

    Attributes:
        scene: (H, W, 3) uint8 RGB without the arm.
        compared: (H, W) near the arm in any of the frames, where the scene is known.
        arm: (T, H, W) the drawn arm.
    """

    scene: ByteArray
    compared: BoolArray
    arm: BoolArray

    def jaccard(self, frames: ByteArray) -> float:
        """Return the mean J of the arm over frames (T, H, W, 3); NaN if no frame is comparable."""
        found = []
        for frame, arm in zip(frames, self.arm, strict=True):
            drawn = arm & self.compared
            if drawn.mean() < _LEAST_ARM:
                continue
            seen = changed_pixels(frame, self.scene) & self.compared
            found.append(float((drawn & seen).sum() / (drawn | seen).sum()))
        return float(np.mean(found)) if found else nan


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmScene:
    """Background of a still camera, without the arm.

    Attributes:
        picture: (H, W, 3) uint8 RGB, the median of a recording.
        known: (H, W) pixels that the arm covers in less than half of the recording.
        camera: the still camera.
        robot: kinematics of the arm.
        parts: shapes of the arm's links.
    """

    picture: ByteArray
    known: BoolArray
    camera: CameraModel
    robot: RobotModel
    parts: Sequence[LinkShape]

    def masks(self, positions: FloatArray) -> ArmMasks:
        """Return the arm at joint positions (T, J) [rad or m]."""
        arm = draw_silhouettes(self.parts, self.camera, self.robot, positions)
        size = 2 * round(_MARGIN * self.camera.width) + 1
        near = cv2.dilate(arm.max(axis=0), np.ones((size, size), np.uint8)) > 0
        return ArmMasks(scene=self.picture, compared=near & self.known, arm=arm > 0)


def arm_scenes(
    recording: Recording, robot: RobotModel, parts: Sequence[LinkShape]
) -> list[ArmScene | None]:
    """Return the background of each view of a recording; None for moving cameras."""
    rows = np.linspace(0, len(recording.times) - 1, _MOST_FRAMES).astype(int)
    rows, moving = np.unique(rows), moving_links(robot)
    found: list[ArmScene | None] = []
    for frames, camera in zip(recording.frames, recording.cameras, strict=True):
        if camera.mount_link in moving or camera.view in recording.camera_tracks:
            found.append(None)
            continue
        stood = draw_silhouettes(parts, camera, robot, recording.positions[rows]).mean(axis=0)
        picture = np.median(frames[rows], axis=0).astype(np.uint8)
        scene = ArmScene(
            picture=picture, known=stood < 0.5, camera=camera, robot=robot, parts=parts
        )
        found.append(scene)
    return found
