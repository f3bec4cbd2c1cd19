"""Baselines of the scores: other actions, the held first frame, the autoencoder's round trip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, JointTrajectory
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.recording import Recording
from mtv_world_ros.evaluation.imagined_stretches import Stretch
from mtv_world_ros.rollout.pipeline import WorldModel

#: true: the recorded ones; shuffled: another episode's; zero: the joints stay where they are at
#: the start of the rollout
ACTIONS = ('true', 'shuffled', 'zero')
#: sends (V, 1 + T, H, W, 3) uint8 RGB frames through the autoencoder; returns the last T
Reconstruct = Callable[[ByteArray], ByteArray]


def check_actions(actions: Sequence[str]) -> None:
    """Raise ConfigError if a name is not in `ACTIONS`, or `true` is missing."""
    for name in actions:
        if name not in ACTIONS:
            raise ConfigError.unknown('actions', name, ACTIONS, listed=' is not one of')
    if 'true' not in actions:
        raise ConfigError(
            f"actions are {', '.join(actions) or 'empty'}; 'true' must be among them, since the "
            'others are compared with it'
        )


def with_actions(
    name: str,
    recording: Recording,
    stretch: Stretch,
    donor: Recording | None,
) -> Recording | None:
    """Return the episode whose commands are executed for a stretch.

    None = `shuffled`, but there is no episode, the donor, to lend its commands.
    """
    commands = recording.commands
    if name == 'shuffled':
        return donor
    if name == 'zero':
        held = np.repeat(recording.positions[stretch.start][None], len(commands.times), axis=0)
        still = JointTrajectory(
            joint_names=commands.joint_names, times=commands.times, positions=held
        )
        return replace(recording, commands=still)
    return recording


def round_trip(world_model: WorldModel) -> Reconstruct | None:
    """Return the round trip through a world model's autoencoder; None if it has none.

    The frames go through in chunks, each after the real frame before it and the last one filled
    up with its last frame, so that the autoencoder sees what it sees in the model.
    """
    autoencoder = getattr(world_model, 'autoencoder', None)
    if autoencoder is None:
        return None
    length = world_model.spec.num_frames

    def reconstruct(frames: ByteArray) -> ByteArray:
        starts = range(0, frames.shape[1] - 1, length)
        chunks = [_through(autoencoder, frames[:, k : k + length + 1], length) for k in starts]
        return np.concatenate(chunks, axis=1)

    return reconstruct


def _through(autoencoder: Any, frames: ByteArray, length: int) -> ByteArray:
    import torch

    from mtv_world_ros.model.conditioning import decode_frames, encode_chunk

    num_frames = frames.shape[1] - 1
    rest = np.repeat(frames[:, -1:], length - num_frames, axis=1)
    chunk = torch.from_numpy(np.concatenate([frames, rest], axis=1))[None].to(autoencoder.device)
    with torch.inference_mode():
        back = decode_frames(autoencoder, encode_chunk(autoencoder, chunk))
    return back[0, :, :num_frames].cpu().numpy()
