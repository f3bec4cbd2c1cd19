"""Newest frames that show each object free, and what has happened to it since.

Where a plan begins while fingers half hide an object, its visible part says little of where it is.
The last frame in which nothing hid it says more: it keeps that pose if nothing moved it since, and
its place in the gripper if fingers hold it. Each kept pose has an age, and an error that grows.

Shape letters: V views, T frames, O objects, A arms, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.mask_geometry import centroids, locate
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.vision.held_objects import grown, Hold, HoldEvidence, STOP_SETTINGS


@dataclass(frozen=True, slots=True, kw_only=True)
class SightSettings:
    """Definition of a free object, and of how long its pose holds.

    Attributes:
        min_area: smallest area in each view, of the largest one so far, at which nothing hides an
            object [fraction].
        min_views: views that have to see it so.
        min_far_area: the same limit while every tool is farther than `far_m`: an object that was
            turned shows less of itself.
        far_m: distance of a tool point from the middle beyond which the hand hides nothing [m].
        inside: smallest share of a visible part within the last free mask at which the object has
            not moved.
        margin: tolerance of that mask [fraction of image width].
        reach_m: largest distance of the tool point from the middle of what fingers stopped at [m].
        near_m: distance of the tool point from the middle below which the hand may move it [m].
        error_m_s: growth of the error of a pose that nothing has touched [m/s].
        near_error_m_s: growth while the hand is near, or holds it [m/s].
        max_error_m: limit of the error [m].
    """

    min_area: float = 0.85
    min_views: int = 2
    min_far_area: float = 0.6
    far_m: float = 0.12
    inside: float = 0.85
    margin: float = 0.015
    reach_m: float = 0.07
    near_m: float = 0.08
    error_m_s: float = 0.0002
    near_error_m_s: float = 0.002
    max_error_m: float = 0.02


_SETTINGS = SightSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptPose:
    """Pose of a half hidden object by the last frame that showed it free.

    Attributes:
        masks: (V, H, W) its masks then.
        cameras: cameras of the V views at the masks' size.
        poses: (V, 4, 4) T_base_camera then.
        moved: (4, 4) its motion since, in the base frame: that of the gripper that holds it.
        is_held: whether fingers stopped at it, and no mask says that it stayed.
        is_told: whether the hand has moved since, so that masks would say so.
        age_s: time since that frame [s].
        error_m: standard deviation of where it is now, beyond that of the fit [m].
    """

    masks: BoolArray
    cameras: tuple[CameraModel, ...]
    poses: FloatArray
    moved: FloatArray
    is_held: bool
    is_told: bool
    age_s: float
    error_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """Last frame that showed an object free.

    Attributes:
        masks: (V, H, W) its masks.
        poses: (V, 4, 4) T_base_camera.
        point: (3,) middle of the object by the rays of two views, or where a gripper that held it
            has let it go since [m].
        largest: (V,) largest area so far [px].
        age_s: time since that frame [s].
        near_s: of it, time in which the hand was near [s].
        is_inside: whether what was seen of it last lies where it was.
        is_moved: whether a gripper that held it has let it go elsewhere.
        arm: number of the gripper whose fingers stopped at it; None = none did.
        tool: (4, 4) T_base_tool when they stopped, or in the frame if that was later [m].
        evidence: evidence since they stopped; None = no fingers stopped at it.
    """

    masks: BoolArray
    poses: FloatArray
    point: FloatArray
    largest: FloatArray
    age_s: float = 0.0
    near_s: float = 0.0
    is_inside: bool = True
    is_moved: bool = False
    arm: int | None = None
    tool: FloatArray | None = None
    evidence: HoldEvidence | None = None

    @property
    def hold(self) -> Hold:
        """Evidence whether the gripper at it holds it."""
        return Hold.NOT_TOLD if self.evidence is None else self.evidence.hold(STOP_SETTINGS)

    @property
    def is_held(self) -> bool:
        """True if fingers stopped at it, and no mask says that it stayed."""
        return self.arm is not None and self.hold is not Hold.NOT_HELD

    def error_m(self, settings: SightSettings = _SETTINGS) -> float:
        """Return the standard deviation of where it is now [m]."""
        held_s = self.age_s if self.is_held else self.near_s
        grown_m = settings.error_m_s * self.age_s + settings.near_error_m_s * held_s
        return min(grown_m, settings.max_error_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sights:
    """Last free sights of the objects of an episode.

    Attributes:
        names: names of the O objects.
        cameras: cameras of the V views at the masks' size.
        of_each: the sight of each object; None = it was never seen free.
        stopped: (A,) whether something stopped the fingers in the last frame.
        tools: (A, 4, 4) T_base_tool in the last frame [m].
    """

    names: tuple[str, ...]
    cameras: tuple[CameraModel, ...]
    of_each: tuple[Sight | None, ...]
    stopped: BoolArray
    tools: FloatArray

    @classmethod
    def begin(cls, names: Sequence[str], motion: Motion) -> Sights:
        """Return the sights before the first frame."""
        return cls(
            names=tuple(names),
            cameras=tuple(motion.cameras),
            of_each=(None,) * len(names),
            stopped=np.zeros(len(motion.tools), np.bool_),
            tools=motion.tools[:, 0],
        )

    def after(
        self,
        motion: Motion,
        masks: BoolArray,
        stopped: BoolArray,
        period_s: float,
        settings: SightSettings = _SETTINGS,
    ) -> Sights:
        """Return the sights after more real frames.

        Args:
            motion: robot and cameras at the T frames.
            masks: (V, O, T, H, W) masks of the objects.
            stopped: (A, T) whether something stops the fingers short of shut.
            period_s: time between two frames [s].
            settings: definition of free.
        """
        sights = self
        for row in range(masks.shape[2]):
            sights = sights._with_frame(
                motion, row, masks[:, :, row], stopped[:, row], period_s, settings
            )
        return sights

    @property
    def refuted(self) -> BoolArray:
        """(A,) whether masks say that stopped fingers hold nothing."""
        found = np.zeros(len(self.stopped), np.bool_)
        for sight in self.of_each:
            if sight is not None and sight.arm is not None and sight.hold is Hold.NOT_HELD:
                found[sight.arm] = True
        return found

    @property
    def held(self) -> tuple[bool, ...]:
        """(O,) whether masks say that an object goes along with stopped fingers."""
        return tuple(
            sight is not None and sight.arm is not None and sight.hold is Hold.HELD
            for sight in self.of_each
        )

    def kept(
        self, tools: FloatArray, settings: SightSettings = _SETTINGS
    ) -> tuple[KeptPose | None, ...]:
        """Return the poses that half hidden objects keep.

        Args:
            tools: (A, 4, 4) T_base_tool now [m].
            settings: growth of the error.

        Returns:
            None for what the last frame shows free, and for what something may have moved.
        """
        return tuple(
            None if sight is None else self._kept(sight, tools, settings) for sight in self.of_each
        )

    def _kept(self, sight: Sight, tools: FloatArray, settings: SightSettings) -> KeptPose | None:
        is_hidden = sight.age_s > 0
        if not is_hidden or sight.is_moved or not (sight.is_held or sight.is_inside):
            return None
        moved = np.eye(4)
        if sight.is_held:
            assert sight.arm is not None and sight.tool is not None
            moved = tools[sight.arm] @ np.linalg.inv(sight.tool)
        return KeptPose(
            masks=sight.masks,
            cameras=self.cameras,
            poses=sight.poses,
            moved=moved,
            is_held=sight.is_held,
            is_told=sight.hold is not Hold.NOT_TOLD,
            age_s=sight.age_s,
            error_m=sight.error_m(settings),
        )

    def _with_frame(
        self,
        motion: Motion,
        row: int,
        masks: BoolArray,
        stopped: BoolArray,
        period_s: float,
        settings: SightSettings,
    ) -> Sights:
        tools, poses = motion.tools[:, row], motion.camera_poses[:, row]
        pixels = np.stack(
            [
                project(camera, pose, tools[:, :3, 3])[0]
                for camera, pose in zip(self.cameras, poses, strict=True)
            ],
            axis=1,
        )
        of_each = [sight and self._let_go(sight, stopped, tools) for sight in self.of_each]
        for arm in map(int, np.flatnonzero(stopped & ~self.stopped)):
            item = _nearest(of_each, tools[arm, :3, 3], settings)
            sight = None if item is None else of_each[item]
            if item is not None and sight is not None:
                # what was carried before lies elsewhere now, and is seen as well as may be
                start = masks[:, item] if sight.is_moved else sight.masks
                evidence = HoldEvidence.begin(start, pixels[arm])
                of_each[item] = replace(sight, arm=arm, tool=tools[arm], evidence=evidence)
        return replace(
            self,
            of_each=tuple(
                self._seen(sight, masks[:, item], poses, tools, pixels, period_s, settings)
                for item, sight in enumerate(of_each)
            ),
            stopped=stopped,
            tools=tools,
        )

    def _let_go(self, sight: Sight, stopped: BoolArray, tools: FloatArray) -> Sight:
        """Return a sight after the fingers at it have opened, if they have."""
        if sight.arm is None or stopped[sight.arm]:
            return sight
        assert sight.tool is not None
        point = sight.point
        if sight.hold is Hold.HELD:
            carried = tools[sight.arm] @ np.linalg.inv(sight.tool)
            point = carried[:3, :3] @ point + carried[:3, 3]
        # what was held is elsewhere now; what stayed is not
        is_moved = sight.is_moved or sight.hold in (Hold.HELD, Hold.NOT_SEEN)
        return replace(sight, point=point, arm=None, tool=None, evidence=None, is_moved=is_moved)

    def _seen(
        self,
        sight: Sight | None,
        masks: BoolArray,
        poses: FloatArray,
        tools: FloatArray,
        pixels: FloatArray,
        period_s: float,
        settings: SightSettings,
    ) -> Sight | None:
        """Return the sight of an object after a frame with its masks (V, H, W)."""
        areas = masks.sum((-2, -1)).astype(np.float64)
        largest = areas if sight is None else np.maximum(sight.largest, areas)
        evidence = None if sight is None else sight.evidence
        arm = None if sight is None else sight.arm
        if evidence is not None and arm is not None:
            evidence = evidence.after(masks, pixels[arm], STOP_SETTINGS)
        counted = largest > 0
        shown = (areas[counted] / largest[counted]).min(initial=1.0)
        found = None
        if counted.sum() >= settings.min_views and shown >= settings.min_far_area:
            found = locate(self.cameras, list(poses), centroids(masks))
        if (
            found is not None
            and np.isfinite(found.point).all()
            and (shown >= settings.min_area or _is_far(tools, found.point, settings))
        ):
            return Sight(
                masks=masks,
                poses=poses,
                point=found.point,
                largest=largest,
                arm=arm,
                tool=None if arm is None else tools[arm],
                evidence=evidence,
            )
        if sight is None:
            return None
        away = np.linalg.norm(tools[:, :3, 3] - sight.point, axis=-1)
        is_near = bool((away < settings.near_m).any())
        return replace(
            sight,
            largest=largest,
            age_s=sight.age_s + period_s,
            near_s=sight.near_s + period_s * is_near,
            # what no view shows although no hand hides it may have left the table
            is_inside=(is_near or bool(masks.any())) and _is_inside(masks, poses, sight, settings),
            evidence=evidence,
        )


def _is_far(tools: FloatArray, point: FloatArray, settings: SightSettings) -> bool:
    """Return whether all tools (A, 4, 4) are too far from a point (3,) to hide it."""
    return bool((np.linalg.norm(tools[:, :3, 3] - point, axis=-1) > settings.far_m).all())


def _nearest(
    sights: Sequence[Sight | None], tool: FloatArray, settings: SightSettings
) -> int | None:
    """Return the object that a tool point (3,) is at; None = none is."""
    away = [
        (float(np.linalg.norm(sight.point - tool)), item)
        for item, sight in enumerate(sights)
        if sight is not None and sight.arm is None
    ]
    nearest_m, item = min(away, default=(np.inf, 0))
    return item if nearest_m < settings.reach_m else None


def _is_inside(masks: BoolArray, poses: FloatArray, sight: Sight, settings: SightSettings) -> bool:
    """Return whether visible parts (V, H, W) lie where an object was; a moved camera says no."""
    margin = round(settings.margin * masks.shape[-1])
    for mask, pose, before, at in zip(masks, poses, sight.masks, sight.poses, strict=True):
        if not mask.any():
            continue
        if not np.allclose(pose, at, atol=1e-3):
            return False
        if (mask & grown(before, margin)).sum() < settings.inside * mask.sum():
            return False
    return True
