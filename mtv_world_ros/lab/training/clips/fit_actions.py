"""Statistics and tokens of actions, fitted to the training clips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data.recording import clip_starts, commanded, Recording
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.training_config import TrainingConfig
from mtv_world_ros.model.actions import ActionEncoding, STATISTICS, TRAJECTORY_VIDEO

#: number of clips used, spread evenly
_MOST_CLIPS = 4096


def fit_actions(
    control: str, recordings: Sequence[Recording], spec: WorldModelSpec, robot: RobotModel
) -> ActionEncoding:
    """Returns the action encoding of a control that does not draw them, fitted to the clips.

    Raises:
        TrainingError: no episode is long enough for a clip.
    """
    clips = [(recording, int(s)) for recording in recordings for s in clip_starts(recording, spec)]
    if not clips:
        raise TrainingError(
            f'none of {len(recordings)} episodes is long enough for a clip of {spec.num_frames} '
            f'frames at {spec.fps} Hz; record longer ones or lower video.num_frames'
        )
    chosen = np.linspace(0, len(clips) - 1, min(len(clips), _MOST_CLIPS)).round().astype(int)
    times = np.arange(spec.num_frames + 1) / spec.fps
    chunks = [commanded(clips[i][0], clips[i][1], times) for i in chosen]
    return ActionEncoding.fit(control, robot, chunks)


def kept_actions(
    folder: Path,
    control: str,
    recordings: Sequence[Recording],
    spec: WorldModelSpec,
    robot: RobotModel,
    *,
    initial: Path | None = None,
) -> ActionEncoding | None:
    """Returns the action encoding stored in the folder, or fits and stores it.

    A new run that starts from the weights of a checkpoint takes over its encoding.

    Raises:
        CheckpointError: the folder holds that of another control.
    """
    if control == TRAJECTORY_VIDEO:
        return None
    for known in (folder, initial):
        if known is not None and (known / STATISTICS).is_file():
            encoding = ActionEncoding.load(known, control)
            break
    else:
        encoding = fit_actions(control, recordings, spec, robot)
    folder.mkdir(parents=True, exist_ok=True)
    encoding.save(folder)
    return encoding


def transformer_arguments(
    config: TrainingConfig, actions: ActionEncoding | None
) -> dict[str, Any]:
    """Returns the preset's arguments of the transformer, with the control's."""
    if actions is None:
        return dict(config.transformer)
    return {**config.transformer, 'control': config.video.control, 'action_dim': actions.dim}
