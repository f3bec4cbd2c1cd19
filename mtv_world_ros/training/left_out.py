"""What a training leaves out of its episodes, counted by reason before the first step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from mtv_world_ros.data.recording import clip_starts, Recording
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.errors import EpisodeError


def check_clips(recording: Recording, spec: WorldModelSpec) -> None:
    """Refuses an episode that no clip can be cut from.

    Raises:
        EpisodeError: it is too short, or frames are missing everywhere.
    """
    if not len(clip_starts(recording, spec)):
        raise EpisodeError(
            f"episode '{recording.path}' is too short, or has too large gaps, for a clip of "
            f'{spec.num_frames} frames at {spec.fps} Hz ({spec.chunk_seconds:.1f} s)'
        )


def counted(skipped: Mapping[str, str]) -> list[str]:
    """Returns a line a reason, without the paths in it, the most frequent first.

    Args:
        skipped: reasons by the episode's path.
    """
    reasons = Counter(
        reason.replace(path, '...').replace(Path(path).name, '...')
        for path, reason in skipped.items()
    )
    return [f'{count} x {reason}' for reason, count in reasons.most_common()]


def num_dropped(recordings: Sequence[Recording], spec: WorldModelSpec) -> int:
    """Returns how many clips cannot be cut because frames are missing within them."""
    dropped = 0
    for recording in recordings:
        last = recording.times[-1] - spec.chunk_seconds + 1e-6
        dropped += int((recording.times <= last).sum())
        dropped -= int((recording.times[clip_starts(recording, spec)] <= last).sum())
    return dropped
