"""Memory of a rollout's background: what nothing covers stays as real frames showed it.

A model that starts each chunk from its own last frame draws the background anew each time: what
the arm uncovers becomes a smear, and errors of flat walls grow from chunk to chunk. A camera that
stands still has seen that background before.

Shape letters: V views, O objects, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.cameras.silhouettes import project_part
from mtv_world_ros.control.control import SeenFrame
from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape, load_shape, moving_links


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMemorySettings:
    """Thresholds at which a pixel counts as covered.

    Attributes:
        arm_margin: distance from the drawn robot within which the model's picture counts: cables,
            what a gripper holds, shadows [fraction of the image width].
        object_margin: distance from objects that may have moved, within which the model's picture
            counts [fraction of the image width].
        blend: width of the passage between memory and model [fraction of the image width].
        min_saturation: smallest difference between the colour channels of a mark that is looked
            for, of 255: white ones look like things.
        min_contrast: smallest difference of a mark from what it is drawn on, of 255.
        max_residual: largest difference of a pixel from the mixture of both, of 255; a pixel
            further off shows something else.
    """

    arm_margin: float = 0.05
    object_margin: float = 0.02
    blend: float = 0.012
    min_saturation: int = 70
    min_contrast: int = 40
    max_residual: int = 40


_SETTINGS = SceneMemorySettings()
#: largest difference of the entries of equal camera poses
_SAME_POSE = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMemory:
    """Background of each view, as it was last seen uncovered.

    Attributes:
        pictures: (V, H, W, 3) uint8 RGB.
        known: (V, H, W) pixels that were seen.
        masks: (V, O, H, W) masks of the objects in the last real frame.
        touched: (O,) whether the robot may have moved an object since.
        last: the last real frame.
    """

    pictures: ByteArray
    known: BoolArray
    masks: BoolArray
    touched: BoolArray
    last: SeenFrame


class SceneKeeper:
    """Keeps the background of rollouts.

    Args:
        robot: the robot of the rollouts.
        parts: shapes of its links.
        settings: margins around robot and objects, and limits of marks.
    """

    def __init__(
        self,
        robot: RobotModel,
        parts: Sequence[LinkShape],
        settings: SceneMemorySettings = _SETTINGS,
    ) -> None:
        self._parts, self._settings = tuple(parts), settings
        self._moving = moving_links(robot)
        #: names of the links whose poses `Motion` has to have
        self.links = tuple(dict.fromkeys(part.link for part in self._parts))

    @classmethod
    def of(cls, robot: RobotModel) -> SceneKeeper | None:
        """Return the keeper of a robot; None = its shapes are not known."""
        shape = load_shape(robot)
        return cls(robot, shape.parts) if shape.is_known else None

    def with_robot(self, robot: RobotModel) -> SceneKeeper:
        """Return the same for a robot of the same joints and links."""
        return SceneKeeper(robot, self._parts, self._settings)

    def seen(
        self, memory: SceneMemory | None, motion: Motion, frames: ByteArray, masks: ObjectMasks
    ) -> SceneMemory:
        """Return the memory after real frames.

        Args:
            memory: memory before the frames; None = nothing was seen.
            motion: motion of the robot with `links`, T states.
            frames: (V, T, H, W, 3) uint8 RGB at these states.
            masks: masks of the objects in these frames.
        """
        arms = self._near(self._drawn(motion), self._settings.arm_margin)
        poses = motion.camera_poses[:, -1]
        pictures, known = np.zeros_like(frames[:, 0]), np.zeros(arms[:, 0].shape, np.bool_)
        if memory is not None and memory.pictures.shape == pictures.shape:
            pictures = memory.pictures.copy()
            before = memory.last.motion.camera_poses[:, -1]
            stayed = np.abs(before - poses).max((1, 2)) < _SAME_POSE
            known = memory.known & stayed[:, None, None]
        # what showed an object and is covered since may be empty by now
        shows_object = np.zeros_like(known)
        if memory is not None and memory.masks.shape[-2:] == known.shape[-2:]:
            shows_object = self._near(
                np.asarray(memory.masks.any(1)), self._settings.object_margin
            )
        found = self._near(np.asarray(masks.masks.any(1)), self._settings.object_margin)
        for frame in range(frames.shape[1]):
            free = ~arms[:, frame] & self._stands_still(motion)[:, None, None]
            pictures[free], known = frames[:, frame][free], known | free
            shows_object = np.where(free, found[:, frame], shows_object)
        known = known & ~(shows_object & arms[:, -1])
        last = masks.masks[:, :, -1]
        return SceneMemory(
            pictures=pictures,
            known=known,
            masks=last,
            touched=np.zeros(last.shape[1], np.bool_),
            last=SeenFrame(frames=frames[:, -1], motion=motion.last()),
        )

    def held(
        self,
        memory: SceneMemory,
        motion: Motion,
        frames: ByteArray,
        masks: ObjectMasks,
        drawn: ByteArray | None,
    ) -> tuple[ByteArray, SceneMemory]:
        """Return imagined frames with the background of the memory, and the memory after them.

        Args:
            memory: memory of the background.
            motion: motion of the robot with `links` at the frames, T states.
            frames: (V, T, H, W, 3) uint8 RGB as the model predicts them.
            masks: masks of the objects in these frames.
            drawn: (V, T, H, W, 4) the objects where they are foreseen; None = not foreseen.
        """
        robot, found = self._drawn(motion), masks.masks
        memory = self._after_contact(memory, robot, found, drawn)
        covered = self._near(robot, self._settings.arm_margin)
        covered |= self._moved(memory, found, drawn)
        share = self._shares(memory.known[:, None] & ~covered)
        mixed = frames + share[..., None] * (memory.pictures[:, None].astype(np.float32) - frames)
        frames = np.rint(mixed).astype(np.uint8)
        # what the model uncovers is drawn once, and then stays
        new = ~covered[:, -1] & ~memory.known & self._stands_still(motion)[:, None, None]
        pictures = np.where(new[..., None], frames[:, -1], memory.pictures)
        return frames, replace(memory, pictures=pictures, known=memory.known | new)

    def without_marks(
        self, memory: SceneMemory, frames: ByteArray, drawn: ByteArray, unmarked: ByteArray
    ) -> ByteArray:
        """Return imagined frames without the colours of marks that the model copied.

        The share of a mark in a pixel is the least squares one, between the mark and what would be
        there without it: robot and objects as they are drawn, else the background.

        Args:
            memory: memory of the background.
            frames: (V, T, H, W, 3) uint8 RGB as the model predicts them.
            drawn: (V, T, H, W, 3) the trajectory video.
            unmarked: (V, T, H, W, 4) robot and objects of the trajectory video without marks: RGB
                and cover.
        """
        cover = unmarked[..., 3:].astype(np.float32) / 255
        behind = np.where(memory.known[..., None], memory.pictures, 0)[:, None]
        plain = unmarked[..., :3] + (1 - cover) * behind
        mark = drawn.astype(np.float32) - plain
        saturation = np.ptp(drawn.astype(np.int16), axis=-1)
        is_known = (cover[..., 0] > 0.5) | memory.known[:, None]
        is_mark = (saturation > self._settings.min_saturation) & is_known
        is_mark &= np.abs(mark).max(-1) > self._settings.min_contrast
        # where nothing is drawn the video is black, which is no mark
        is_mark &= np.ptp(unmarked[..., :3].astype(np.int16), axis=-1) < saturation
        power = np.maximum((mark * mark).sum(-1), 1.0)
        share = np.clip(((frames - plain) * mark).sum(-1) / power, 0.0, 1.0)
        left = np.abs(frames - plain - share[..., None] * mark).max(-1)
        share *= is_mark & (left < self._settings.max_residual)
        return np.rint(frames - share[..., None] * mark).clip(0, 255).astype(np.uint8)

    def _drawn(self, motion: Motion) -> BoolArray:
        """(V, T, H, W) masks of the robot."""
        drawn = [
            fill(
                [
                    project_part(part, motion.links[part.link], camera, poses)
                    for part in self._parts
                ],
                camera,
            )
            > 0
            for camera, poses in zip(motion.cameras, motion.camera_poses, strict=True)
        ]
        return np.stack(drawn)

    def _after_contact(
        self, memory: SceneMemory, robot: BoolArray, found: BoolArray, drawn: ByteArray | None
    ) -> SceneMemory:
        """Return the memory with the objects that are approached in all views.

        By the robot, or by an object that it may have moved: what is carried pushes others. A view
        in which both stay away from an object shows that nothing touches it.
        """
        if found.shape[1] != len(memory.touched):
            touched = np.ones(found.shape[1], np.bool_)
            return replace(memory, masks=found[:, :, 0], touched=touched)
        seen = np.asarray(memory.masks.any((-2, -1)))
        touched, before = memory.touched, None
        while before is None or (touched != before).any():
            moving, _ = self._places(memory.masks, touched, found, drawn)
            reach = self._near(robot | moving, self._settings.object_margin)
            near = (reach[:, None] & memory.masks[:, :, None]).any((-2, -1))  # (V, O, T)
            may_touch = (near | ~seen[..., None]).all(0).any(-1)
            before, touched = touched, touched | may_touch
        return replace(memory, touched=touched)

    def _moved(self, memory: SceneMemory, found: BoolArray, drawn: ByteArray | None) -> BoolArray:
        """Return (V, T, H, W) near objects that may have moved: where they were, and are."""
        now, were = self._places(memory.masks, memory.touched, found, drawn)
        return self._near(now | were, self._settings.object_margin)

    def _places(
        self, masks: BoolArray, which: BoolArray, found: BoolArray, drawn: ByteArray | None
    ) -> tuple[BoolArray, BoolArray]:
        """Return (V, T, H, W) where some objects are, and (V, 1 or T, H, W) where they were.

        Where motion is foreseen, the second has the drawn objects too, and masks count near it
        alone: those of imagined frames wander off into smears.
        """
        now = np.asarray(found[:, which].any(1))
        were = np.asarray(masks[:, which].any(1))[:, None]
        if drawn is not None:
            were = were | (drawn[..., 3] > 0)
            now &= self._near(were, self._settings.arm_margin)
        return now, were

    def _stands_still(self, motion: Motion) -> BoolArray:
        """(V,) whether no joint of the robot moves a camera."""
        return np.array([camera.mount_link not in self._moving for camera in motion.cameras])

    @staticmethod
    def _near(masks: BoolArray, margin: float) -> BoolArray:
        """Pixels within a margin [fraction of the image width] of masks (..., H, W)."""
        size = 2 * round(margin * masks.shape[-1]) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        flat = masks.reshape(-1, *masks.shape[-2:])
        grown = [cv2.dilate(mask.view(np.uint8), kernel) > 0 for mask in flat]
        return np.reshape(grown, masks.shape)

    def _shares(self, held: BoolArray) -> np.ndarray:
        """(V, T, H, W) share of the memory in each pixel: 1 inside, less towards the edge."""
        size = 2 * max(round(self._settings.blend * held.shape[-1]), 1) + 1
        flat = held.reshape(-1, *held.shape[-2:]).astype(np.float32)
        soft = [np.minimum(mask, cv2.blur(mask, (size, size))) for mask in flat]
        return np.reshape(soft, held.shape)
