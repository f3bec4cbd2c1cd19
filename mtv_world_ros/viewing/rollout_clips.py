"""A stored rollout as a short video and a contact sheet, masks outlined."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.video import Comparison, contact_sheet, encode_small_video, side_by_side
from mtv_world_ros.vision.jaccard import mean_of_known

#: outline colours of objects, in order: bright colours that few real objects have
OUTLINES = (
    (255, 0, 255),  # magenta
    (0, 255, 255),  # cyan
    (255, 235, 0),  # yellow
    (80, 255, 60),  # lime
    (255, 140, 0),  # orange
    (70, 110, 255),  # blue
)
#: RGB colour of the outlines of recorded masks over imagined frames
_RECORDED_COLOUR = (255, 255, 255)
#: RGB colour of the dark border of these outlines
_SHADOW_COLOUR = (0, 0, 0)
#: width up to which small frames of a video are enlarged [px]
_VIDEO_TILE_PX = 320
#: width up to which small frames of a contact sheet are enlarged [px]
_SHEET_TILE_PX = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutClip:
    """Files of one rollout.

    Attributes:
        video: MP4 with the columns real, trajectory and imagined, and one row per view.
        num_frames: number of frames of the video.
        width: width of the video [px].
        height: height of the video [px].
        sheet: WebP; some of the same frames; empty = not wanted.
        outlines: (object, RGB) pairs.
    """

    video: bytes
    num_frames: int
    width: int
    height: int
    sheet: bytes
    outlines: tuple[tuple[str, tuple[int, int, int]], ...]


def make_clip(
    rollout: StoredRollout,
    *,
    max_bytes: int,
    tile_width: int = _VIDEO_TILE_PX,
    with_sheet: bool = True,
) -> RolloutClip:
    """Return a rollout's video and contact sheet, masks outlined.

    Args:
        rollout: frames and masks to show.
        max_bytes: the video's quality is lowered until it takes no more, down to a limit.
        tile_width: width up to which small frames are enlarged in the video [px].
        with_sheet: whether the contact sheet is made, too.
    """
    shown = outlined(rollout, tile_width)
    frames = side_by_side(shown, tile_width=shown.real.shape[3])
    return RolloutClip(
        video=encode_small_video(frames, rollout.fps, max_bytes),
        num_frames=len(frames),
        width=frames.shape[2],
        height=frames.shape[1],
        sheet=_sheet(rollout) if with_sheet else b'',
        outlines=tuple(
            (name, OUTLINES[index % len(OUTLINES)]) for index, name in enumerate(rollout.objects)
        ),
    )


def _sheet(rollout: StoredRollout) -> bytes:
    """Return some frames as a WebP."""
    small = outlined(rollout, _SHEET_TILE_PX)
    sheet = contact_sheet(small, num_columns=6, tile_width=_SHEET_TILE_PX)
    done, data = cv2.imencode('.webp', sheet[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 80])
    assert done
    return data.tobytes()


def outlined(rollout: StoredRollout, tile_width: int) -> Comparison:
    """Return the frames, enlarged, with the masks' outlines drawn over and J as captions.

    Recorded frames carry the recorded masks in the objects' colours; imagined frames the masks
    found in them in the same colours, and the recorded ones in white. Frames are enlarged by whole
    factors, up to `tile_width` [px].
    """
    factor = max(tile_width // rollout.real.shape[3], 1)
    real, trajectory, imagined = (
        frames.repeat(factor, axis=2).repeat(factor, axis=3)
        for frames in (rollout.real, rollout.trajectory, rollout.imagined)
    )
    for v in range(len(rollout.views)):
        for t in range(len(rollout.times)):
            for o in range(len(rollout.objects)):
                colour = OUTLINES[o % len(OUTLINES)]
                true, found = rollout.true_masks[v, o, t], rollout.masks[v, o, t]
                _outline(real[v, t], true, factor, colour)
                _outline(imagined[v, t], true, factor, _RECORDED_COLOUR, shadow=True)
                _outline(imagined[v, t], found, factor, colour)
    mean = mean_of_known(rollout.j, axis=1)
    return Comparison(
        views=rollout.views,
        times=rollout.times,
        real=real,
        trajectory=trajectory,
        imagined=imagined,
        captions=tuple(tuple(map(_caption, row)) for row in mean.tolist()),
    )


def _caption(j: float) -> str:
    return f'J {j:.2f}' if np.isfinite(j) else 'J not scored'


def _outline(
    image: ByteArray,
    mask: BoolArray,
    factor: int,
    colour: tuple[int, int, int],
    *,
    shadow: bool = False,
) -> None:
    """Draw the outline of an (H, W) mask over the enlarged image, in place."""
    if not mask.any():
        return
    large = mask.astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)
    contours, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if shadow:
        cv2.drawContours(image, contours, -1, _SHADOW_COLOUR, 3)
    cv2.drawContours(image, contours, -1, colour, 1 if shadow else 2)
