"""`mtv-world train`: from a folder of episodes to a checkpoint."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
import json
import math
from pathlib import Path
import shutil
import signal
import threading
from types import MappingProxyType
from typing import Any

import numpy as np

from mtv_world_ros.cameras.calibration_file import save_calibration
from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.control.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.data_types import CameraModel, WorldModelSpec
from mtv_world_ros.core.errors import (
    ConfigError,
    EpisodeError,
    MtvWorldError,
    TrainingError,
    TrainingInterrupted,
)
from mtv_world_ros.core.files import whole_folder, write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.data.recording import DEFAULT, Recording
from mtv_world_ros.data.recordings import clip_starts, described_objects
from mtv_world_ros.data.splits import find_episodes, spread
from mtv_world_ros.data.unusable import (
    MIN_RATE_RATIO,
    NUM_NAMED,
    reason_lines,
    slow_text,
)
from mtv_world_ros.model.card import CAMERAS, CARD, read_card, ROBOT_FOLDER
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.runtime import check_device, choose_dtype
from mtv_world_ros.model.trained_episodes import TrainedEpisodes
from mtv_world_ros.robot.file import save_robot
from mtv_world_ros.robot.model import check_positions, RobotModel
from mtv_world_ros.robot.shape import moving_links
from mtv_world_ros.training.base_checkpoint import load_base, needs_base
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.clips.episode_index import (
    index_episodes,
    IndexedEpisode,
    RecordingReader,
)
from mtv_world_ros.training.clips.fit_control import fitted_control
from mtv_world_ros.training.clips.latent_cache import cached_batches, CachedSource
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.dry_run import ideal_seconds, measured_peak
from mtv_world_ros.training.log import TrainingLog
from mtv_world_ros.training.resume import check_architecture, disk_errors_named, STATE
from mtv_world_ros.training.trainer import check_processes, Trainer
from mtv_world_ros.training.training_config import TrainingConfig, TrainingRun
from mtv_world_ros.training.unknown_cameras import unknown_camera_lines
from mtv_world_ros.vision.describers.describer import Describer
from mtv_world_ros.vision.segmenters.segmenter import Segmenter


def load_episodes(
    paths: Sequence[Path],
    config: TrainingConfig,
    robot: RobotModel,
    cache: Path,
    source: EpisodeSource = DEFAULT,
    describer: Describer | None = None,
    broken: Mapping[str, str] = MappingProxyType({}),
    processes: Processes | None = None,
) -> tuple[list[IndexedEpisode], dict[str, str]]:
    """Return the usable episodes, and the reason for each one left out, by path.

    Args:
        paths: folders of episodes.
        config: the preset.
        robot: kinematics and limits of the recorded robot.
        cache: folder of the decoded recordings and of their index.
        source: topics and calibration of the episodes.
        describer: names the objects; None = the names stored with the episodes, else those of
            the instructions.
        broken: reasons why episodes are left out, by path.
        processes: processes that train together and read a share each; None = this one alone.

    Raises:
        TrainingError: none is usable.
        DiskError: the cache cannot be written.
    """
    spec = config.spec

    def check(recording: Recording) -> None:
        check_clips(recording, spec)
        check_recording(recording, robot)

    def describe(path: Path) -> tuple[str, ...]:
        assert describer is not None
        return described_objects(path, describer, spec.views[0], source)

    episodes, skipped = index_episodes(
        paths,
        config,
        RecordingReader(spec, robot, cache, source),
        processes or Processes('cpu'),
        check=check,
        describe=describe if describer else None,
        broken=broken,
    )
    if not episodes:
        reasons = '; '.join(reason_lines(skipped) or ['none given'])
        raise TrainingError(f'no usable episode: {_other_robot(paths, robot)}{reasons}')
    return episodes, skipped


#: joints outside their limits by more are of another unit, zero or robot [rad or m]
_LIMIT_TOLERANCE = 0.05
#: joints that move more than this between two frames must change the picture [rad or m]
_MOVES = 0.02
#: mean difference of two frames below which they are the same picture [grey levels]
_SAME_PICTURE = 0.02
#: maximum fraction of the frames with joint motion that repeat the frame before
_MOST_FROZEN = 0.5
#: distance outside of the image at which a joint may still show its link [fraction of image size]
_MARGIN = 0.1


def check_recording(recording: Recording, robot: RobotModel) -> None:
    """Refuse unusable recordings: joints in another unit, views that show no robot.

    Raises:
        TrajectoryError: measured joints are far outside their limits.
        EpisodeError: a view never has the arm in its picture, or hardly changes while the joints
            move.
    """
    check_positions(robot, recording.positions, tolerance=_LIMIT_TOLERANCE)
    _check_arm_is_seen(recording, robot)
    moves = np.abs(np.diff(recording.positions, axis=0)).max(axis=1) > _MOVES
    if moves.sum() < 3:
        return
    for view, frames in zip((camera.view for camera in recording.cameras), recording.frames,
                            strict=True):  # fmt: skip
        pairs = zip(frames[:-1][moves], frames[1:][moves], strict=True)
        changes = np.array([np.abs(b.astype(np.int16) - a).mean() for a, b in pairs])
        share = float((changes < _SAME_PICTURE).mean())
        if share > _MOST_FROZEN:
            raise EpisodeError(
                f"view '{view}': {share:.0%} of the frames in which joints move are the same as "
                'the one before: frozen, or no view of this robot (see mtv-world check)'
            )


def _check_arm_is_seen(recording: Recording, robot: RobotModel) -> None:
    moving = moving_links(robot)
    points = np.concatenate(robot.kinematics(recording.positions).arm_points)
    for camera in recording.cameras:
        if camera.mount_link in moving or camera.view in recording.camera_tracks:
            continue
        poses = camera_poses(camera, robot, recording.positions)
        pixels, _ = project(camera, poses, points)
        size = np.array([camera.width, camera.height])
        if not ((pixels > -_MARGIN * size) & (pixels < (1 + _MARGIN) * size)).all(-1).any():
            raise EpisodeError(
                f"view '{camera.view}' never sees the arm, by its calibration: no joint is ever "
                'in the picture; leave the view out with --views, or calibrate it anew '
                '(mtv-world fit camera)'
            )


def _other_robot(paths: Sequence[Path], robot: RobotModel) -> str:
    """Return the advice if the first episode has a robot of another name; otherwise empty."""
    with suppress(MtvWorldError, IndexError):
        name = read_info(paths[0]).robot
        if name not in ('', robot.name):
            return (
                f"they are of robot '{name}', and video.robot is '{robot.name}'; give --set "
                'video.robot=FILE (of imported episodes: robot/robot.yaml beside them): '
            )
    return ''


def train(
    run: TrainingRun,
    *,
    robot: RobotModel,
    segmenter: Segmenter,
    describer: Describer | None = None,
    held_out: HeldOut | None = None,
) -> Path:
    """Train, resuming what `run.out` holds, and return the folder of the result.

    That is a checkpoint, or an adapter for the checkpoint `run.initial` where the preset trains
    one. Started by `torchrun` or `accelerate launch`, each process trains a share of every step's
    clips, and the main one alone writes; `out` and `cache` must be the same for all.

    Args:
        run: preset, data, device, saving.
        robot: robot of the episodes.
        segmenter: finds the objects of the first frames.
        describer: names the objects; None = see `load_recordings`.
        held_out: scores checkpoints on held-out episodes and keeps the best.

    Raises:
        ConfigError: the device is not there.
        TrainingInterrupted: Ctrl-C or SIGTERM; the state of the last step is saved.
        TrainingError: no usable episode, the loss is not finite, another process is gone, or `out`
            holds a training of another architecture.
        DiskError: a file cannot be written.
    """
    config = run.config.replace(video=run.config.video.replace(robot=robot.name))  # not a path
    out, dtype = run.out, choose_dtype(run.dtype, run.device)
    check_device(run.device)
    processes = Processes(run.device)
    check_processes(config.optimizer, processes)
    with processes.main_first():
        check_architecture(out, config)
    paths = find_episodes(run.dataset) if isinstance(run.dataset, Path) else run.dataset
    episodes, skipped = load_episodes(
        spread(paths, run.num_episodes),
        config,
        robot,
        run.cache or out / 'cache',
        run.source,
        describer,
        run.broken,
        processes,
    )
    out.mkdir(parents=True, exist_ok=True)
    _save_robot(robot, episodes, out / ROBOT_FOLDER, processes)
    with processes.main_first():
        control = fitted_control(out, config, episodes, robot, initial=run.initial)
    source: BatchSource | CachedSource = BatchSource(
        episodes,
        config,
        robot=robot,
        segmenter=segmenter,
        control=control,
        seed=run.seed,
        workers=run.data_workers,
        numbers=processes.share(config.optimizer.batch_size),
        pin=processes.device.type == 'cuda',
    )
    base = None
    if needs_base(config):
        base = load_base(
            config, run.initial, processes.device, dtype, seed=run.seed, layout=control.layout
        )
    if run.latent_cache is not None:
        source = cached_batches(
            source,
            run.latent_cache,
            config,
            base,
            seed=run.seed,
            dtype=dtype,
            processes=processes,
            workers=run.data_workers,
        )
    trainer = Trainer(
        config.with_steps(source.num_clips),
        out,
        seed=run.seed,
        device=run.device,
        dtype=dtype,
        trained_on={
            'episodes': len(episodes),
            'skipped': len(skipped),
            'tasks': sorted({episode.task for episode in episodes}),
            'clips': source.num_clips,
        },
        processes=processes,
        base=base,
        control=control,
    )
    resumed = trainer.load_state()
    trainer.trained_on |= _trained_episodes(
        episodes, run.initial, trainer.result if resumed else None
    ).as_card()
    if run.initial is not None and base is None and not resumed:
        trainer.start_from(run.initial)
    if resumed and processes.of_main(_steps_of(trainer.result)) != trainer.step:
        trainer.export(trainer.result)  # killed after the state was saved
    if processes.is_main:
        num_dropped = sum(episode.num_dropped for episode in episodes)
        write_whole(out / 'skipped.json', json.dumps(skipped, indent=2))
        Progress.write(
            f'{len(episodes)} episodes, {len(skipped)} left out (see {out / "skipped.json"}), '
            f'{source.num_clips} clips, {num_dropped} dropped for '
            f'gaps; {"resumed at" if resumed else "starting from"} step {trainer.step}; '
            f'{processes.count} processes'
        )
        left_out = [f'left out: {line}' for line in reason_lines(skipped)]
        left_out += unknown_camera_lines(skipped, len(episodes) + len(skipped))
        told = training_notes(trainer.config, episodes, None if resumed else run.initial)
        for line in [*left_out, *told]:
            Progress.write(line)
    ideal = None
    if run.peak_tflops is not None and processes.is_main:
        peak = 1e12 * run.peak_tflops or measured_peak(processes.device, dtype)
        ideal = ideal_seconds(config, dtype, peak * processes.count, control.layout)
    try:
        with disk_errors_named(out):
            _loop(trainer, source, run, held_out, ideal)
    finally:
        source.close()
    processes.close()
    return trainer.result


def _trained_episodes(
    episodes: Sequence[IndexedEpisode], initial: Checkpoint | None, earlier: Path | None
) -> TrainedEpisodes:
    """Return the episodes of this training, of its initial weights and of the resumed part."""
    digests = frozenset(episode.digest for episode in episodes)
    found = TrainedEpisodes(digests - {''}, '' not in digests)
    if initial is not None:
        found |= initial.trained_episodes
    if earlier is not None and (earlier / CARD).is_file():
        found |= TrainedEpisodes.of_card(read_card(earlier).trained_on)
    return found


def _save_robot(
    robot: RobotModel, episodes: Sequence[IndexedEpisode], folder: Path, processes: Processes
) -> None:
    """Save the robot and its cameras into a folder, as checkpoints carry them."""
    if robot.file is None or not processes.is_main:
        return
    with disk_errors_named(folder):
        save_robot(robot.file, folder)
        cameras = common_cameras(episodes)
        if cameras is not None:
            save_calibration(folder / CAMERAS, {camera.view: camera for camera in cameras})


def training_notes(
    config: TrainingConfig, episodes: Sequence[IndexedEpisode], initial: Checkpoint | None = None
) -> list[str]:
    """Return notes on a training for the user, before it runs.

    Args:
        config: configuration of the training.
        episodes: episodes of the training set.
        initial: checkpoint of the initial weights; None = no such checkpoint.
    """
    found, optimizer = [], config.optimizer
    if initial is not None:
        found += _drawn_otherwise(config.rendering, initial.card.rendering)
    if optimizer.warmup < optimizer.warmup_steps:
        found.append(
            f'the learning rate warms up over {optimizer.warmup} steps, a fifth of the training, '
            f'instead of optimizer.warmup_steps = {optimizer.warmup_steps}'
        )
    keys = [episode.camera_keys for episode in episodes]
    usual = _common_keys(episodes)
    if usual is None:
        found.append(
            f'the episodes have {len(set(keys))} different calibrations, none of them that of '
            'more than half: the checkpoint gets no default calibration, and the node needs '
            "'calibration_file'"
        )
        return found
    others = [e.path.name for e in episodes if e.camera_keys != usual]
    if others:
        more = ', ...' * (len(others) > NUM_NAMED)
        found.append(
            f'episodes of other calibrations than most: {len(others)} '
            f'({", ".join(others[:NUM_NAMED])}{more}); each is drawn by its own'
        )
    return found


def _drawn_otherwise(now: TrajectoryVideoConfig, before: Mapping[str, Any]) -> list[str]:
    """Return notes on drawing settings that differ from those of the initial checkpoint."""
    other = [
        f'rendering.{name}={json.dumps(value)}'
        for name, value in before.items()
        if value != now.model_dump().get(name)
    ]
    if not other:
        return []
    return [
        'the weights that it starts from were trained with ' + ', '.join(other) + ', which is '
        'drawn otherwise here: give --set for each to go on with what they know'
    ]


def common_cameras(episodes: Sequence[IndexedEpisode]) -> tuple[CameraModel, ...] | None:
    """Return the calibration that more than half of the episodes have, or None."""
    usual = _common_keys(episodes)
    if usual is None:
        return None
    return next(e for e in episodes if e.camera_keys == usual).recording().cameras


def _common_keys(episodes: Sequence[IndexedEpisode]) -> tuple[str, ...] | None:
    keys, count = Counter(e.camera_keys for e in episodes).most_common(1)[0]
    return keys if 2 * count > len(episodes) else None


def _best_score(file: Path) -> float:
    """Return the score of the best checkpoint of earlier runs; -inf if there is none."""
    try:
        return float(read_json(file)['score'])
    except (OSError, ValueError, LookupError, TypeError):
        return -math.inf


def _steps_of(result: Path) -> int | None:
    """Return the steps that a checkpoint or adapter was trained for; None if there is none."""
    card = result / CARD
    return read_card(result).trained_on['steps'] if card.is_file() else None


def _loop(
    trainer: Trainer,
    source: BatchSource | CachedSource,
    run: TrainingRun,
    held_out: HeldOut | None,
    ideal: float | None,
) -> None:
    folder, is_main = trainer.folder, trainer.processes.is_main
    total = trainer.config.optimizer.steps
    log = TrainingLog(folder, step=trainer.step, total=total, active=is_main, ideal_seconds=ideal)
    with StopSignals() as signals, log, trainer.processes.losses_named():
        reports = trainer.run(
            source,
            save_every=run.save_every,
            save_seconds=60 * run.save_minutes,
            on_save=lambda _: trainer.export(trainer.result),
            should_stop=signals.came,
        )
        for report in reports:
            log.add(report)
            if held_out is not None:
                held_out.after(report.step, trainer, log)
    if trainer.step < total:
        raise TrainingInterrupted(
            f"stopped at step {trainer.step} of {total}, which is saved in '{folder / STATE}'",
            signals.number or signal.SIGTERM,
        )


class StopSignals:
    """Handler that records SIGINT and SIGTERM; a second signal has its usual effect.

    A context manager; outside the main thread, which alone gets signals, it does nothing.

    Attributes:
        number: number of the signal that came; 0 = none.
    """

    def __init__(self) -> None:
        self.number = 0
        self._before: dict[signal.Signals, Any] = {}

    def came(self) -> bool:
        """Return True if a stop signal was received."""
        return self.number != 0

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for kind in (signal.SIGINT, signal.SIGTERM):
                self._before[kind] = signal.signal(kind, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)
        self._before.clear()

    def _note(self, number: int, _: object) -> None:
        self.number = number
        Progress.write('saving after this step; once more to stop at once')
        self.__exit__()


def check_clips(recording: Recording, spec: WorldModelSpec) -> None:
    """Refuse an episode too short for a clip.

    Raises:
        EpisodeError: the episode is too short, or frames are missing everywhere.
    """
    if len(clip_starts(recording, spec)):
        return
    periods = np.diff(recording.times)
    rate = 1 / float(np.median(periods)) if len(periods) else 0.0
    if 0 < rate < MIN_RATE_RATIO * spec.fps:
        raise EpisodeError(slow_text(recording.path, rate, spec.fps))
    raise EpisodeError(
        f"episode '{recording.path}' is too short, or has too large gaps, for a clip of "
        f'{spec.num_frames} frames at {spec.fps} Hz ({spec.chunk_seconds:.1f} s)'
    )


_BEST = 'best.json'


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutScores:
    """Score of a checkpoint on held-out episodes (NaN = undefined), and numbers by name."""

    score: float
    numbers: Mapping[str, float]


#: scores the checkpoint in a folder at a step, called by all processes, which share the episodes;
#: injected, since training does not import evaluation
Judge = Callable[[Path, int, Processes], HeldOutScores]


class HeldOut:
    """Evaluation of checkpoints on held-out episodes, at regular steps and at the last step.

    Args:
        judge: function that scores the checkpoint in a folder at a step.
        every: interval of the evaluations [steps].

    Raises:
        ConfigError: `every` is not positive.
    """

    def __init__(self, judge: Judge, every: int) -> None:
        if every < 1:
            raise ConfigError(f'--sample-every is {every}; give at least 1 step')
        self._judge, self._every = judge, every

    def after(self, step: int, trainer: Trainer, log: TrainingLog) -> None:
        """Score the averaged weights if due; the best go to the result's folder with `-best`.

        All processes have to call this; each scores a share, and the main one writes.
        """
        if step % self._every and step != trainer.config.optimizer.steps:
            return
        folder, processes = trainer.folder, trainer.processes
        trainer.export(trainer.result)
        processes.any(False)  # the main process has written it
        judged = self._judge(trainer.result, step, processes)
        if not processes.is_main:
            return
        log.write(step, dict(judged.numbers))
        best = folder / _BEST
        if judged.score > _best_score(best):
            with whole_folder(folder / f'{trainer.result.name}-best') as copy:
                shutil.copytree(trainer.result, copy, dirs_exist_ok=True)
            write_whole(best, json.dumps({'step': step, 'score': judged.score}))
