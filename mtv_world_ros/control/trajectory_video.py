"""Control `trajectory_video`: tool points projected into each view, as fading glowing trails.

Paper, Trajectory Representation. A arms, V views, T frames, N trail points, O objects, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import colorsys
from dataclasses import dataclass
from itertools import islice
from typing import Annotated, Any, ClassVar, Self

import cv2
import numpy as np
from pydantic import Field

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.arm_pictures import arm_pictures
from mtv_world_ros.control.control import (
    Control,
    ControlInputs,
    ControlOptions,
    ControlScene,
    InputLayout,
)
from mtv_world_ros.control.glow import (
    Box,
    FAINTEST,
    GlowArray,
    intersection,
    is_empty,
    make_stamps,
    NO_BOX,
    region,
    Stamps,
    Trail,
    union,
)
from mtv_world_ros.core.config import expected, Schema, Share
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    CameraModel,
    FloatArray,
    MultiViewVideo,
)
from mtv_world_ros.core.errors import ObservationError, TrajectoryError
from mtv_world_ros.robot.shape import LinkShape, load_shape

#: grey level of the canvas that marks clips without simulated objects, for a model of both kinds
UNFORESEEN_GREY = 24
#: drawn length of a finger [m]
_FINGER_LENGTH_M = 0.03
#: most trail points from one frame to the next
_MOST_POINTS = 32
#: pieces that a link is drawn in, to follow lens distortion and end at the camera plane
_PIECES = 4
#: fractional bits of pixel positions
_SHIFT = 4
#: pieces that end further than this many image sizes away are not drawn
_FARTHEST = 4.0

_Length = Annotated[float, Field(gt=0, le=1000), expected('positive and at most 1000')]


class TrajectoryVideoConfig(Schema):
    """Appearance of trajectory videos; a model is served as it was trained."""

    section: ClassVar = 'rendering'

    half_life_s: _Length = Field(
        default=0.5, description='time after which a point of the trail is half as bright [s]'
    )
    point_radius_m: _Length = Field(
        default=0.012, description="standard deviation of the glow, at the point's depth [m]"
    )
    min_radius_px: _Length = Field(
        default=0.8, description='smallest standard deviation of the glow [px]'
    )
    object_fill: Share = Field(default=0.35, description='brightness of object fills')
    show_gripper: bool = Field(
        default=True,
        description='the newest point has a core, the whiter the more the gripper is closed',
    )
    points_per_frame: Annotated[int, expected('a whole number from 1 to 100')] = Field(
        default=3,
        ge=1,
        le=100,
        description='least number of trail points from one frame to the next',
    )
    max_gap_m: _Length | None = Field(
        default=None,
        description='largest distance between trail points [m], so that trails of fast arms have '
        'no gaps; null = as `points_per_frame` says',
    )
    link_width_m: _Length | None = Field(
        default=None,
        description='width of lines along each arm, from joint to joint, under the trails [m]; '
        'null = none, as in the paper',
    )
    finger_width_m: _Length | None = Field(
        default=None,
        description='width of a line along each finger [m], white and magenta, as far apart as '
        'the gripper is commanded to open; null = none, as in the paper',
    )
    arm_pictures: bool = Field(
        default=False,
        description='each link of the robot is drawn as the start frame shows it, under the '
        'trails, where the commands move it; else as lines, or as in the paper not at all',
    )
    object_motion: bool = Field(
        default=False,
        description='objects are drawn as they look, over the trails, where they are expected to '
        'be; where their motion is not foreseen they are not drawn. false = the masks of the '
        'first frame are drawn, as in the paper',
    )

    foreseen_ratio: Share = Field(
        default=1.0,
        description='with `object_motion`: share of training clips that show objects where they '
        'are expected to be; the others show the masks of the first frame on a grey canvas, so '
        'that one model knows both',
    )

    @property
    def draws_masks(self) -> bool:
        """True if a model of this rendering was trained with the masks of the first frame."""
        return not self.object_motion or self.foreseen_ratio < 1


#: the core that shows a closed gripper, as a share of the glow's standard deviation
_CORE_SHARE = 0.55
#: smallest standard deviation of the core, so that it shows between pixels too [px]
_LEAST_CORE_PX = 0.7
#: brightness of an arm's lines, as a share of its trail's
_LINK_SHARE = 0.5
#: points and lines nearer than this are drawn as large as at this depth [m]
_NEAREST_SIZE_M = 0.05
_WHITE = np.ones(3)
#: colours of an arm's two fingers
FINGER_COLOURS = (_WHITE, np.array([1.0, 0.0, 1.0]))


def render_trajectory_video(
    *,
    motion: Motion,
    times: FloatArray,
    object_masks: BoolArray | None,
    config: TrajectoryVideoConfig,
    objects: ByteArray | None = None,
    arms: ByteArray | None = None,
) -> MultiViewVideo:
    """Draw the trajectory into each view, at the cameras' size.

    Args:
        motion: T states of the robot, and V cameras of one size; frame k shows state k, state 0
            is the current one.
        times: (T,) [s], increasing.
        object_masks: (V, O, H, W) masks of the first frame, held over all frames; or None. Not
            drawn with `config.object_motion`: such a model was never trained with them.
        objects: (V, T, H, W, 4) uint8 of `moved_pictures`, in place of masks; or None.
        config: widths, colours and fading of the trails.
        arms: (V, T, H, W, 4) uint8 of `arm_pictures`, over the arms' lines; or None.

    Returns:
        (V, T, H, W, 3) frames.

    Raises:
        TrajectoryError: motion and times do not fit together.
        ObservationError: cameras of different sizes, or masks of another size.
    """
    cameras, times = motion.cameras, np.asarray(times, np.float64)
    _check(motion, times, object_masks)
    tools = tool_motion(motion, times, config.points_per_frame, config.max_gap_m)
    lines = () if config.link_width_m is None else motion.arm_points
    shape = (len(cameras), len(times), cameras[0].height, cameras[0].width, 3)
    is_marked = objects is None and config.object_motion and config.draws_masks
    canvas = UNFORESEEN_GREY if is_marked else 0
    frames = np.full(shape, canvas, np.uint8)
    has_fills = objects is None and config.draws_masks
    for view, camera in enumerate(cameras):
        masks = object_masks[view] if has_fills and object_masks is not None else ()
        fills = _fills(camera, masks, config.object_fill, canvas)
        poses = motion.camera_poses[view]
        links = ArmLinks(camera, poses, lines, config.link_width_m)
        over = [None if pictures is None else pictures[view] for pictures in (arms, objects)]
        _draw_view(frames[view], fills, camera, poses, links, tools, config, *over)
    return MultiViewVideo(views=tuple(c.view for c in cameras), times=times, frames=frames)


def arm_colour(arm: int, num_arms: int) -> FloatArray:
    """Return the (3,) RGB in 0 .. 1 of an arm: hues spread evenly from orange on."""
    return np.array(colorsys.hsv_to_rgb((0.08 + arm / max(num_arms, 1)) % 1.0, 0.85, 1.0))


def object_colour(index: int, fill: float) -> FloatArray:
    """Return the (3,) RGB in 0 .. 1 of an object's fill, by the golden angle from green on."""
    return np.array(colorsys.hsv_to_rgb((0.36 + index * 0.381966) % 1.0, 0.7, fill))


def _check(motion: Motion, times: FloatArray, masks: BoolArray | None) -> None:
    cameras, positions = motion.cameras, motion.positions
    if times.shape != positions.shape[:1] or len(times) == 0:
        raise TrajectoryError(
            f'positions {positions.shape} and times {times.shape} do not fit together; they must '
            'be (T, J) and (T,) with T >= 1'
        )
    if (np.diff(times) <= 0).any():
        raise TrajectoryError('the times of the trajectory video do not increase')
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise ObservationError(f'the cameras have sizes (H, W) {sorted(sizes)}; one is needed')
    expected = (len(cameras), *sizes.pop())
    if masks is not None and (masks.ndim != 4 or (len(masks), *masks.shape[2:]) != expected):
        raise ObservationError(
            f'object masks have shape {masks.shape}, expected (V, O, H, W) with (V, H, W) = '
            f'{expected}'
        )


def _fills(
    camera: CameraModel, masks: Sequence[BoolArray] | BoolArray, fill: float, grey: int
) -> tuple[Box, ByteArray]:
    """Return the box of all objects in a view and its (h, w, 3) fills on a grey level."""
    canvas = np.full((camera.height, camera.width, 3), grey, np.uint8)
    box = NO_BOX
    for index, mask in enumerate(masks):
        canvas[mask] = np.rint(255 * object_colour(index, fill))
        left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
        box = union(box, (top, top + height, left, left + width))
    return box, region(canvas, box)


def _draw_view(
    frames: ByteArray,
    fills: tuple[Box, ByteArray],
    camera: CameraModel,
    poses: FloatArray,
    links: ArmLinks,
    motion: ToolMotion,
    config: TrajectoryVideoConfig,
    arms: ByteArray | None,
    objects: ByteArray | None,
) -> None:
    """Draw one view onto (T, H, W, 3) frames of one grey level."""
    num_arms = len(motion.points)
    heads, depths = project(camera, poses, motion.points[:, motion.shown_at])
    core_sigmas = np.maximum(_CORE_SHARE * _sigmas(camera, depths, config), _LEAST_CORE_PX)
    cores = [
        make_stamps(heads[arm], core_sigmas[arm], camera.width, camera.height).glows(
            np.arange(len(frames)), np.maximum(motion.closed[arm], 0)
        )
        for arm in range(num_arms)
    ]
    trails = [_trail_frames(camera, poses, motion, arm, config) for arm in range(num_arms)]
    colours = [arm_colour(arm, num_arms) for arm in range(num_arms)]
    paints = [_Paint(colour) for colour in colours]
    fingers = ArmLinks(camera, poses, motion.fingers, config.finger_width_m)
    white = _Paint(_WHITE)
    # far arms first; one that is behind the camera cannot hide another
    orders = np.argsort(-np.where(depths > 0, depths, np.inf), axis=0, kind='stable').T.tolist()
    is_black = not frames[0, 0, 0].any()
    for image in frames:
        region(image, fills[0])[...] = fills[1]
    is_bare = is_black and config.link_width_m is None and arms is None
    painted = fills[0] if is_bare else (0, camera.height, 0, camera.width)
    for k, (image, order, glows) in enumerate(
        zip(frames, orders, zip(*trails, strict=True), strict=True)
    ):
        for arm in order:
            links.draw(image, arm, k, _LINK_SHARE * colours[arm])
        _cover(image, arms, k)
        drawn = [painted]
        for arm in order:
            box, glow = glows[arm]
            paints[arm].lay(image, box, glow, drawn)
            if config.show_gripper:
                box, glow = next(cores[arm])
                white.lay(image, box, glow, drawn)
        for arm in order:
            _draw_fingers(fingers, image, arm, k)
        _cover(image, objects, k)


def _cover(image: ByteArray, pictures: ByteArray | None, frame: int) -> None:
    """Lay one of (T, H, W, 4) pictures, weighed by their cover, over an (H, W, 3) image."""
    if pictures is None:
        return
    picture = pictures[frame]
    rest = 255 - picture[..., 3:].astype(np.uint16)
    image[...] = picture[..., :3] + (image * rest // 255).astype(np.uint8)


def _draw_fingers(fingers: ArmLinks, image: ByteArray, arm: int, frame: int) -> None:
    for side, colour in enumerate(FINGER_COLOURS):
        fingers.draw(image, 2 * arm + side, frame, colour)


def _sigmas(camera: CameraModel, depths: FloatArray, config: TrajectoryVideoConfig) -> FloatArray:
    """Return the standard deviation of the glow [px]: metric size over depth."""
    focal = (camera.K[0, 0] + camera.K[1, 1]) / 2
    pixels = config.point_radius_m * focal / np.maximum(depths, _NEAREST_SIZE_M)
    return np.maximum(pixels, config.min_radius_px)


def _trail_frames(
    camera: CameraModel,
    poses: FloatArray,
    motion: ToolMotion,
    arm: int,
    config: TrajectoryVideoConfig,
) -> Iterator[tuple[Box, GlowArray]]:
    """Yield, by frame, the bounding box of the arm's trail and the trail in it.

    A camera that stands still keeps what is drawn and lets it fade; for one that moves, all
    points that are not too old are projected anew.
    """
    trail = Trail(camera.width, camera.height, config.half_life_s)
    times, shown_times = motion.times, motion.times[motion.shown_at]
    if (poses == poses[0]).all():
        first_shown = np.searchsorted(motion.shown_at, np.arange(len(times)))
        brightness = trail.brightness(shown_times[first_shown] - times)
        shown = np.flatnonzero(brightness)
        stamps = _stamps(camera, poses[0], motion.points[arm], config)
        glows = stamps.glows(shown, brightness[shown])
        num_new = np.bincount(first_shown[shown], minlength=len(poses))
        gaps_s = np.diff(shown_times, prepend=times[0])
        for gap_s, num in zip(gaps_s.tolist(), num_new.tolist(), strict=True):
            trail.fade(gap_s)
            trail.add(islice(glows, num))
            yield trail.box, region(trail.image, trail.box)
        return
    memory_s = config.half_life_s * np.log2(1 / FAINTEST)
    for pose, newest, now in zip(poses, motion.shown_at, shown_times, strict=True):
        trail.clear()
        kept = slice(int(np.searchsorted(times, now - memory_s)), newest + 1)
        brightness = trail.brightness(now - times[kept])
        shown = np.flatnonzero(brightness)
        stamps = _stamps(camera, pose, motion.points[arm, kept], config)
        trail.add(stamps.glows(shown, brightness[shown]))
        yield trail.box, region(trail.image, trail.box)


def _stamps(
    camera: CameraModel, pose: FloatArray, points: FloatArray, config: TrajectoryVideoConfig
) -> Stamps:
    pixels, depths = project(camera, pose, points)
    return make_stamps(pixels, _sigmas(camera, depths, config), camera.width, camera.height)


class _Paint:
    """Blends one colour into an image, with a glow as alpha."""

    def __init__(self, colour: FloatArray) -> None:
        levels = np.arange(256)[:, None]
        self._colour = np.rint(levels * colour).astype(np.uint8)[:, None]

    def lay(self, image: ByteArray, box: Box, glow: GlowArray, drawn: list[Box]) -> None:
        """Blend the colour into an (H, W, 3) image.

        Args:
            image: image that is drawn on.
            box: part of the image that changes.
            glow: (h, w) opacity in the box, 0 to 1.
            drawn: boxes drawn before, the image is black elsewhere; `box` is added.
        """
        if is_empty(box):
            return
        under = NO_BOX
        for other in reversed(drawn):
            under = union(under, intersection(box, other))
            if under == box:
                break
        drawn.append(box)
        levels = cv2.convertScaleAbs(glow, alpha=255)
        covered = region(image, under)
        before = covered.copy()
        cv2.applyColorMap(levels, self._colour, region(image, box))
        if cv2.countNonZero(before.reshape(-1)):
            top, _, left, _ = box
            part = (under[0] - top, under[1] - top, under[2] - left, under[3] - left)
            rest = cv2.cvtColor(cv2.bitwise_not(region(levels, part)), cv2.COLOR_GRAY2BGR)
            cv2.add(covered, cv2.multiply(before, rest, scale=1 / 255), covered)


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolMotion:
    """Tool points over time.

    Attributes:
        times: (N,) times of the points [s].
        points: (A, N, 3) points in the base frame [m].
        closed: (A, T) 0 open .. 1 closed, at the frames.
        shown_at: (T,) index of the point at each frame.
        fingers: two per arm: (2, T, 3) end points of a line along the finger, at the frames [m];
            NaN if the travel of the fingers is unknown.
    """

    times: FloatArray
    points: FloatArray
    closed: FloatArray
    shown_at: np.ndarray
    fingers: tuple[FloatArray, ...]


def tool_motion(
    motion: Motion, times: FloatArray, points_per_frame: int, max_gap_m: float | None
) -> ToolMotion:
    """Interpolate the joints between the frames, so that trails follow the arms' arcs.

    Args:
        motion: motion at the T frames.
        times: (T,) times of the frames [s].
        points_per_frame: least number of points from one frame to the next.
        max_gap_m: largest distance of neighbouring points [m]; None = any.
    """
    counts = np.full(len(times) - 1, points_per_frame)
    if max_gap_m is not None:
        steps = np.linalg.norm(np.diff(motion.tool_points, axis=1), axis=-1).max(
            axis=0, initial=0.0
        )
        needed = np.ceil(np.minimum(steps / max_gap_m, _MOST_POINTS)).astype(int)
        counts = np.maximum(counts, needed)
    shown_at = np.concatenate([[0], np.cumsum(counts)])
    fine = np.interp(np.arange(shown_at[-1] + 1), shown_at, np.arange(len(times)))
    left = np.minimum(fine.astype(int), max(len(times) - 2, 0))
    right, share = np.minimum(left + 1, len(times) - 1), fine - left
    positions = motion.positions
    dense = (1 - share)[:, None] * positions[left] + share[:, None] * positions[right]
    return ToolMotion(
        times=(1 - share) * times[left] + share * times[right],
        points=motion.robot.tool_poses(dense)[..., :3, 3],
        closed=1.0 - motion.openings,
        fingers=_fingers(motion),
        shown_at=shown_at,
    )


def _fingers(motion: Motion) -> tuple[FloatArray, ...]:
    """Two points along each finger, (2, T, 3) [m]: of each arm the left, then the right one."""
    lines = []
    for tool, pose, opening in zip(motion.robot.tools, motion.tools, motion.openings, strict=True):
        apart = np.full(len(pose), np.nan)
        if tool.finger_travel_m is not None:
            apart = tool.finger_travel_m * opening
        for side in (1.0, -1.0):
            tip = pose[:, :3, 3] + (side * apart)[:, None] * pose[:, :3, 1]
            lines.append(np.stack([tip, tip - _FINGER_LENGTH_M * pose[:, :3, 2]]))
    return tuple(lines)


class ArmLinks:
    """Lines along the arms in one view.

    Args:
        camera: the view.
        poses: (T, 4, 4) T_base_camera.
        arms: (N, T, 3) points along each arm, in the base frame [m].
        width_m: width of the lines [m]; None = nothing is drawn.
    """

    def __init__(
        self,
        camera: CameraModel,
        poses: FloatArray,
        arms: Sequence[FloatArray],
        width_m: float | None,
    ) -> None:
        focal = (camera.K[0, 0] + camera.K[1, 1]) / 2
        size = np.array([camera.width, camera.height])
        self._pixels, self._widths = [], []
        for points in () if width_m is None else arms:
            pixels, depths = project(camera, poses, _in_pieces(points))
            far = np.any(np.abs(pixels - size / 2) > _FARTHEST * size, axis=-1, keepdims=True)
            self._pixels.append(np.where(far, np.nan, pixels))
            self._widths.append((width_m or 0.0) * focal / np.maximum(depths, _NEAREST_SIZE_M))

    def draw(self, image: ByteArray, arm: int, frame: int, colour: FloatArray) -> None:
        """Draw one arm onto an (H, W, 3) image; pieces behind the camera are not drawn."""
        if not self._pixels:
            return
        pixels, widths = self._pixels[arm][:, frame], self._widths[arm][:, frame]
        seen = np.isfinite(pixels).all(axis=-1)
        paint = [float(value) for value in np.rint(255 * colour)]
        ends = np.rint(np.where(seen[:, None], pixels, 0) * 2**_SHIFT).astype(int).tolist()
        for n in np.flatnonzero(seen[:-1] & seen[1:]):
            width = max(1, round(float(widths[n])))
            cv2.line(image, ends[n], ends[n + 1], paint, width, cv2.LINE_AA, _SHIFT)


def _in_pieces(points: FloatArray) -> FloatArray:
    """Points (N, T, 3) with interpolated ones between them: (_PIECES * (N - 1) + 1, T, 3)."""
    shares = np.arange(_PIECES)[None, :, None, None] / _PIECES
    between = points[:-1, None] * (1 - shares) + points[1:, None] * shares
    return np.concatenate([between.reshape(-1, *points.shape[1:]), points[-1:]])


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryVideo(Control):
    """The paper's control: trails of the tools and the objects' first masks in every view.

    The frames are encoded as video latents and concatenated by channel.
    Options of the section `rendering` also draw the links, the fingers, the arm's own pixels, and
    the objects where they are expected to be.

    Attributes:
        config: widths, colours and fading; a model is served with what it was trained with.
        object_mask: whether objects are drawn.
        parts: shapes of the robot's links, for `config.arm_pictures`; empty = not drawn.
    """

    config: TrajectoryVideoConfig
    object_mask: bool = True
    parts: tuple[LinkShape, ...] = ()

    @classmethod
    def create(cls, options: ControlOptions) -> Self:
        """Return the control of the sections `rendering` and `video` of a preset."""
        config = TrajectoryVideoConfig(**options.rendering)
        return cls(
            config=config,
            object_mask=options.object_mask,
            parts=load_shape(options.robot).parts if config.arm_pictures else (),
        )

    @property
    def layout(self) -> InputLayout:
        """A video."""
        return InputLayout(video=True)

    @property
    def links(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the links that are drawn."""
        return tuple(dict.fromkeys(part.link for part in self.parts))

    @property
    def uses_masks(self) -> bool:  # type: ignore[override]
        """True if masks of the start frame are drawn."""
        return self.object_mask

    @property
    def shows_objects(self) -> bool:  # type: ignore[override]
        """True if the model is trained with objects drawn at their expected places."""
        return self.object_mask and self.config.object_motion

    @property
    def ablations(self) -> tuple[str, ...]:  # type: ignore[override]
        """Row of the paper's ablation without object masks."""
        return () if self.object_mask else ('w/o Mask',)

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return the drawn frames (V, 1 + T, H, W, 3), at the cameras' size."""
        video = render_trajectory_video(
            motion=scene.motion,
            times=scene.times,
            object_masks=scene.masks if self.object_mask else None,
            objects=scene.objects if self.shows_objects else None,
            arms=arm_pictures(self.parts, scene.motion, scene.start_frames, scene.seen),
            config=self.config,
        )
        return ControlInputs.drawn(video.frames)

    def unmarked(self, scene: ControlScene) -> ByteArray | None:
        """Return the robot and the objects of `make` (V, 1 + T, H, W, 4) without marks.

        Marks are what no camera sees: trails, cores and lines along fingers.
        """
        shown = arm_pictures(self.parts, scene.motion, scene.start_frames, scene.seen)
        if shown is None or scene.objects is None or not self.shows_objects:
            return shown
        rest = 255 - scene.objects[..., 3:].astype(np.uint16)
        return scene.objects + (shown * rest // 255).astype(np.uint8)

    def cache_key(self) -> dict[str, Any]:
        """Return how the plan is drawn."""
        return {
            **{f'rendering.{name}': value for name, value in self.config.model_dump().items()},
            'video.object_mask': self.object_mask,
        }
