"""Imagined episodes in the Rerun viewer while they are computed, each in a tab of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, ObjectMasks
from mtv_world_ros.rollout.imagined_episodes import EpisodeStart
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.viewing import rerun_log
from mtv_world_ros.viewing.streams import Streams

#: most tabs that are laid out; older ones stay in the recording
MAX_TABS = 8


class EpisodeViewer:
    """Logs the starts and chunks of episodes.

    Args:
        stream: stream of `rerun_log.recording`.
        save: file that the stream is written to; None = a viewer is open.
    """

    def __init__(self, stream: Any, save: Path | None = None) -> None:
        self._stream, self._save = stream, save
        self._tabs: dict[str, Streams] = {}
        self._root, self._begin_ns = '', 0

    def begin(self, start: EpisodeStart) -> None:
        """Open a tab with the frames that an episode starts from."""
        seen = start.observation
        self._root = f'/episode_{len(self._tabs)}'
        self._begin_ns = seen.stamp_ns
        shown = Streams()
        for view, frame in zip(seen.views, seen.frames, strict=True):
            shown.images[('real', view)] = [(seen.stamp_ns, frame)]
        shown.words.append((seen.stamp_ns, f'instruction: {start.instruction}'))
        self._tabs[self._root] = Streams(images=dict.fromkeys(shown.images, []))
        self._log(shown)

    def add(self, prediction: Prediction) -> None:
        """Log a chunk."""
        shown = streams_of(prediction)
        tab = self._tabs[self._root]
        if not {*shown.images} <= {*tab.images}:
            tab.images.update({key: [] for key in shown.images})
            tab.success.extend(shown.success)
            tabs = dict(list(self._tabs.items())[-MAX_TABS:])
            self._stream.send_blueprint(rerun_log.layout(tabs, active=len(tabs) - 1))
        self._log(shown)

    def close(self) -> None:
        """Wait until the viewer or the file has everything.

        Raises:
            MtvWorldError: the file cannot be written.
        """
        rerun_log.flush(self._stream, self._save)

    def _log(self, shown: Streams) -> None:
        rerun_log.log_streams(self._stream, shown, self._root, self._begin_ns)


def streams_of(prediction: Prediction) -> Streams:
    """Return the streams of a chunk: imagined and trajectory frames, masks, estimate, reasons."""
    video, shown = prediction.video, Streams()
    stamps = [prediction.stamp_ns + round(float(time) * 1e9) for time in video.times]
    for row, view in enumerate(video.views):
        frames = zip(stamps, video.frames[row], strict=True)
        drawn = zip(stamps, prediction.trajectory_video.frames[row, 1:], strict=False)
        shown.images[('imagined', view)] = list(frames)
        shown.images[('trajectory', view)] = list(drawn)
        labels = (_labels(prediction.masks, row, frame) for frame in range(len(stamps)))
        shown.masks[('imagined', view)] = list(zip(stamps, labels, strict=True))
    shown.success.append((stamps[-1], prediction.success.probability))
    shown.words.append((stamps[-1], '; '.join(prediction.success.reasons)))
    return shown


def _labels(masks: ObjectMasks, view: int, frame: int) -> ByteArray:
    """Return (H, W) numbers of the objects in a frame, 0 = none."""
    labels = np.zeros(masks.masks.shape[-2:], np.uint8)
    for number, mask in enumerate(masks.masks[view, :, frame], start=1):
        labels[mask] = number
    return labels
