"""The success estimate on the real frames of a recorded episode: nothing is imagined."""

from __future__ import annotations

from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.data_types import SuccessEstimate
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.pipeline import Pipeline


def judge(pipeline: Pipeline, recording: Recording) -> SuccessEstimate:
    """Returns the success estimate at the end of a recorded episode.

    Args:
        pipeline: finds the objects and judges; see `load_pipeline`.
        recording: V views on the model's clock, e.g. of `load_recording(path, pipeline.spec,
            pipeline.robot)`.

    Raises:
        EpisodeError: the recording is shorter than a frame of the model, or has a gap.
        ObservationError: its views are not the model's.
    """
    spec = pipeline.spec
    seconds = float(recording.times[-1] - recording.times[0])
    rows = frame_indices(recording, 0, spec, num_frames=int(seconds * spec.fps + 1e-3))
    if rows is None or len(rows) < 2:
        raise EpisodeError(
            f"'{recording.path}' cannot be judged: it lasts {seconds:.2f} s, has a gap or fewer "
            f'than two frames at {spec.fps:g} Hz; record images without a break'
        )
    episode = pipeline.begin(recording.observation(0), instruction=recording.instruction)
    return episode.observe(recording.frames[:, rows[1:]], recording.positions[rows]).success
