"""Statistics of the training set's chunks for controls that need them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control
from mtv_world_ros.control.registry import CONTROL_FILE, create_control, load_control, save_control
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.data.recordings import cut_clip
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.clips.episode_index import IndexedEpisode
from mtv_world_ros.training.training_config import TrainingConfig

#: largest number of clips that a control is fitted to, spread evenly
MAX_CLIPS = 4096


def fitted_control(
    folder: Path,
    config: TrainingConfig,
    episodes: Sequence[IndexedEpisode],
    robot: RobotModel,
    *,
    initial: Checkpoint | None = None,
) -> Control:
    """Return the control of a training; its statistics are stored in the folder.

    A training that is resumed keeps what it was fitted to. One that starts from the weights of a
    checkpoint takes over the checkpoint's, whose numbers these weights know.

    Args:
        folder: folder of the training.
        config: the preset.
        episodes: episodes that are trained on.
        robot: robot of the episodes.
        initial: checkpoint that weights are taken from; None = weights are new.

    Raises:
        CheckpointError: what is stored is of another control or cannot be used.
        TrainingError: no episode is long enough for a clip.
    """
    name, options = config.video.control, config.control_options(robot)
    control = create_control(name, options)
    for known in (folder, None if initial is None else initial.folder):
        if known is not None and (known / CONTROL_FILE).is_file():
            control = load_control(name, options, known)
            break
    else:
        if control.state():
            control = control.fitted(_motions(config, episodes, robot))
    if control.state():
        folder.mkdir(parents=True, exist_ok=True)
        save_control(control, name, folder)
    return control


def _motions(
    config: TrainingConfig, episodes: Sequence[IndexedEpisode], robot: RobotModel
) -> list[Motion]:
    """Return the motions of clips that are spread evenly over the episodes."""
    spec = config.spec
    clips = [(one, start) for one in episodes for start in one.whole]
    if not clips:
        raise TrainingError(
            f'none of {len(episodes)} episodes is long enough for a clip of {spec.num_frames} '
            f'frames at {spec.fps} Hz; record longer ones or lower video.num_frames'
        )
    chosen = np.linspace(0, len(clips) - 1, min(len(clips), MAX_CLIPS)).round().astype(int)
    cut = [cut_clip(one.recording(), start, spec) for one, start in (clips[i] for i in chosen)]
    return [Motion.of(robot, clip.cameras, clip.positions) for clip in cut]
