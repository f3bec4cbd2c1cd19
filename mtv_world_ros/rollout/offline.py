"""Offline replay: a recorded episode in, predictions out, MCAP to MCAP, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mtv_world_ros.core.data_types import Observation, SuccessEstimate
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError, ObservationError
from mtv_world_ros.core.estimate_words import estimate_lines
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.observations import instruction_at, newest_observation
from mtv_world_ros.data.recording import DEFAULT, frame_indices, Recording
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.rollout.observed_episode import ObservedEpisode
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.prediction_writer import chunk_values, ERROR, OK, PredictionWriter
from mtv_world_ros.success.own_tasks import own_task, own_tasks


@dataclass(slots=True, kw_only=True)
class ReplaySummary:
    """Counts and results of a replay.

    Attributes:
        out: folder with the predictions.
        num_trajectories: number of imagined trajectories.
        num_chunks: number of imagined chunks.
        num_frames: frames a view written.
        model_s: time spent in the pipeline [s].
        video_s: time the written frames cover [s].
        probabilities: success estimate at the end of each trajectory; NaN = abstains.
        reasons: reasons of these estimates.
        rejected: stamps [ns] and reasons of trajectories that were not imagined.
        warnings: problems of the episode.
    """

    out: Path
    num_trajectories: int = 0
    num_chunks: int = 0
    num_frames: int = 0
    model_s: float = 0.0
    video_s: float = 0.0
    probabilities: list[float] = field(default_factory=list)
    reasons: list[tuple[str, ...]] = field(default_factory=list)
    rejected: list[tuple[int, str]] = field(default_factory=list)
    warnings: tuple[str, ...] = ()

    @property
    def real_time_factor(self) -> float:
        """Seconds of video for a second of computing; NaN before the first chunk."""
        return self.video_s / self.model_s if self.model_s else float('nan')

    def __str__(self) -> str:
        counts = f'{self.num_trajectories} trajectories, {self.num_chunks} chunks'
        lines = [
            f'{counts}, {self.num_frames} frames a view -> {self.out}',
            f'{self.model_s:.1f} s of computing, real-time factor {self.real_time_factor:.2f}',
            *estimate_lines('success after each plan', self.probabilities, self.reasons),
            *(f'rejected at {stamp / 1e9:.3f} s: {why}' for stamp, why in self.rejected),
            *(f'warning: {text}' for text in self.warnings),
        ]
        return '\n'.join(lines)


def replay_offline(
    pipeline: Pipeline,
    episode_path: Path | str,
    out: Path | str,
    *,
    source: EpisodeSource = DEFAULT,
    seed: int = 0,
    num_inference_steps: int = 0,
    overwrite: bool = False,
    show_progress: bool = True,
) -> ReplaySummary:
    """Imagine every joint trajectory of an episode from the newest frames before it.

    The estimates remember the episode's recorded frames since its first trajectory, as the node's
    do in mode observe.

    The predictions hold the recorded images of the same times too. Frames that the next
    trajectory supersedes are left out. What is wrong with one trajectory
    rejects that one alone, with its reason in the summary and in `/world_model/report`.

    Args:
        pipeline: pipeline that imagines.
        episode_path: rosbag2 folder or .mcap file, also one that was cut off.
        out: folder for the predictions; appears only when all is written.
        source: topics and robot of an episode that is not in this package's format.
        seed: seed of the noise; the k-th trajectory uses `seed + 1000 k`.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        overwrite: replace an existing folder of predictions.
        show_progress: show the progress.

    Raises:
        EpisodeError: the episode cannot be read, or none of its trajectories can be imagined.
        CalibrationError: a view is not calibrated.
    """
    spec = pipeline.spec
    episode = read_episode(
        episode_path,
        views=spec.views,
        calibration=source.calibration,
        with_masks=False,
        mapping=source.mapping,
        robot=pipeline.robot,
    )
    if not episode.trajectories:
        raise EpisodeError(f"'{episode_path}' holds no joint_trajectory message to imagine")
    task = own_task(episode.info)
    summary = ReplaySummary(out=Path(out), warnings=episode.warnings)
    observed = ObservedEpisode(pipeline)
    starts = [stamp for stamp, _ in episode.trajectories]
    bar = Progress(total=len(starts), unit='plan', is_shown=show_progress)
    with bar, PredictionWriter(out, pipeline.robot.joint_names, overwrite=overwrite) as writer:
        for index, (stamp, trajectory) in enumerate(episode.trajectories):
            until = starts[index + 1] if index + 1 < len(starts) else None
            try:
                observation = newest_observation(episode, spec.views, pipeline.robot, stamp)
                before = starts[index - 1] if index else stamp
                for seen in _seen_between(episode, pipeline, before, stamp):
                    observed.see(seen)
                text = instruction_at(episode, stamp)
                options = RolloutOptions(
                    instruction=text,
                    stored_objects=episode.info.objects,
                    task=task,
                    seed=seed + 1000 * index,
                    num_inference_steps=num_inference_steps,
                )
                imagined = observed.begin(observation, options)
                plan = Plan.of(trajectory, pipeline.robot, imagined.observation, stamp_ns=stamp)
                _write_rollout(writer, imagined.extend(plan), summary, until, spec.fps)
            except MtvWorldError as error:
                summary.rejected.append((stamp, str(error)))
                writer.write_report(stamp, ERROR, f'rejected: {error}', {})
            bar.update()
        _write_observed(writer, episode, spec.fps)
        if not summary.num_chunks:
            raise EpisodeError(
                f"'{episode_path}': none of its {len(starts)} trajectories can be imagined; the "
                f'first one: {summary.rejected[0][1]}'
            )
    return summary


def _write_rollout(
    writer: PredictionWriter,
    chunks: Iterator[Prediction],
    summary: ReplaySummary,
    until: int | None,
    fps: float,
) -> None:
    last: Prediction | None = None
    for chunk in chunks:
        summary.num_chunks += 1
        summary.model_s += sum(chunk.seconds.values())
        count = writer.write_chunk(chunk, until)
        summary.num_frames += count
        summary.video_s += count / fps
        last = chunk
        end_ns = chunk.stamp_ns + round(float(chunk.video.times[-1]) * 1e9)
        writer.write_report(end_ns, OK, 'imagined', chunk_values(chunk))
        if until is not None and end_ns >= until:
            break
    if last is not None:
        summary.num_trajectories += 1
        summary.probabilities.append(last.success.probability)
        summary.reasons.append(last.success.reasons)


def _write_observed(writer: PredictionWriter, episode: Episode, fps: float) -> None:
    """Return the recorded frames at the predicted times: the nearest within half a frame."""
    reach_ns = round(0.5e9 / fps)
    for view, camera in episode.cameras.items():
        known = episode.images[view].stamps_ns
        chosen = {
            index
            for stamp_ns in writer.frame_stamps
            for index in [int(np.abs(known - stamp_ns).argmin())]
            if abs(int(known[index]) - stamp_ns) <= reach_ns
        }
        for index in sorted(chosen):
            writer.write_observed(camera, int(known[index]), episode.images[view].frames[index])


def _seen_between(
    episode: Episode, pipeline: Pipeline, begin_ns: int, end_ns: int
) -> Iterator[Observation]:
    """Return the observations between two times, one per frame of the model."""
    spec = pipeline.spec
    period_ns = round(1e9 / spec.fps)
    for stamp_ns in range(begin_ns + period_ns, end_ns, period_ns):
        with suppress(ObservationError):
            yield newest_observation(episode, spec.views, pipeline.robot, stamp_ns)


def judge(pipeline: Pipeline, recording: Recording) -> SuccessEstimate:
    """Return the success estimate at the end of a recorded episode.

    Its objects are those that the pipeline names, else its describer, else those stored with the
    episode, else those that the instruction names by colour.

    Args:
        pipeline: finds the objects and judges; see `Pipeline.load`.
        recording: recording of V views on the model's clock, e.g. of `load_recording(path,
            pipeline.spec, pipeline.robot)`.

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
    options = RolloutOptions(
        instruction=recording.instruction,
        stored_objects=recording.objects,
        task=own_tasks([recording.path]).get(recording.path),
    )
    episode = pipeline.begin(recording.observation(0), options)
    return episode.observe(recording.frames[:, rows[1:]], recording.positions[rows]).success
