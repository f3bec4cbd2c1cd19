"""What do real recordings show, and what is imagined of them whole? Verdicts, carried objects, sharpness.

    python experiments/real_recordings.py verdicts EPISODES [--task TASK.yaml] [--every 8]
    python experiments/real_recordings.py grips EPISODES [--robot ROBOT] [--out FOLDER]
    python experiments/real_recordings.py fingers EPISODES
    python experiments/real_recordings.py shares EPISODES [--every 16] [--stop-holds 0.75]
                                [--contact FOLDER] [--memory off]
    python experiments/real_recordings.py left-out EPISODES [--every 16] [--task TASK.yaml]
                                [--out out/real_left_out]
    python experiments/real_recordings.py carried EPISODES --checkpoint CHECKPOINT
    python experiments/real_recordings.py rollouts EPISODES --checkpoint CHECKPOINT [--memory off]
                                [--foresight off] [--task TASK.yaml] [--out out/real_rollouts]

EPISODES is a folder of imported recordings whose cameras are known (`mtv-world fit camera --apply`)
and whose objects were found (`import ... --objects`).

`verdicts` judges recorded frames by the masks of the import: whole, and cut off after every N
frames, so that most cuts are failures; somebody who looks at the frames says which verdicts are
right. `grips` prints when something stops the fingers, and whether it is held by the masks that
follow, which somebody compares with the frames (--out has pictures of each stop); of
simulated episodes it counts the frames in which an object goes along with a tool, and in which all
are far from it, with the stops among them. `fingers` compares where a dark gripper ends in the
pictures with where it is drawn, along the tool's axis, with the fingers free and drawn below the
table; only frames in which nothing else beside the gripper is dark say something. `shares`
foresees the rest of a recording from later and later frames, by the masks of the import, and
prints the share of futures in which the task succeeds, with and without the memory of what frames
before showed; no picture is imagined.
`left-out` does so with numbers of contact that are fitted on the other recordings, prints the
verdict of the futures (the share of futures with its 95 % interval, no calibration and no
picture), and draws the shares over time of all recordings; run again, it goes on where it
stopped. `carried` compares where objects are foreseen in each chunk, from the recorded frame that it
starts from, with their recorded masks and with the first frame held; no picture is imagined.
`rollouts` imagines recordings whole from their first frame: J of the arm in the first chunk and in
all, PSNR, and J of moving objects, with and without the memory of the background, and foreseen objects. It writes the
scores of each chunk and a contact sheet of each recording; run again, it goes on where it stopped.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import json
from math import isnan, nan
from pathlib import Path
import subprocess
from typing import Any

import cv2
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from page import table

from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.mark_leaks import has_colour
from mtv_world_ros.control.trajectory_video import arm_colour, FINGER_COLOURS
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    FloatArray,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.images import write_png
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data.recordings import commands_at, commands_until
from mtv_world_ros.evaluation.imagined_stretches import (
    imagine_stretch,
    predicted_frames,
    Stretch,
    stretches,
)
from mtv_world_ros.evaluation.metrics.arm_masks import arm_scenes
from mtv_world_ros.evaluation.metrics.jaccard_scores import find_masks, true_masks
from mtv_world_ros.evaluation.metrics.statistics import mean_interval
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.checkpoint_files import load_contact
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.engine.contact_scene import CompiledScene
from mtv_world_ros.physics.fitting.contact_fit import (
    first_settings,
    read_recordings,
    sample_contact,
)
from mtv_world_ros.physics.foreseen_motions import foreseen_of
from mtv_world_ros.physics.grasp_attempts import foreseen_attempts
from mtv_world_ros.physics.grips import watch_fingers
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.physics.sights import Sights
from mtv_world_ros.physics.solid_foresight import SolidForesight, table_in
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.success.estimator import SuccessEstimator, verdict_word
from mtv_world_ros.success.footage_memory import footage_of
from mtv_world_ros.success.foreseen import foreseen_ends
from mtv_world_ros.success.share_fit import ShareFit
from mtv_world_ros.success.task import load_task, load_tasks, match_task, object_called, TaskSpec
from mtv_world_ros.viewing.video import Comparison, contact_sheet
from mtv_world_ros.vision.held_objects import Hold, judge_stops, Stop, tools_in_views
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids

#: size at which recorded frames are judged, and their rate [px], [Hz]
RECORDED_SIZE, RECORDED_FPS = (320, 192), 5.0
#: what the cameras are off where contact is guessed, as `mtv-world fit contact` finds it there [m]
CAMERA_ERROR_M = 0.003


def recordings(folder: Path, spec: WorldModelSpec) -> Iterator[Recording]:
    """Yield the recordings of a folder at a size."""
    robot = load_robot(folder / 'robot' / 'robot.yaml')
    for path in list_episodes(folder):
        yield load_recording(path, spec, robot)


def judge_recorded(arguments: argparse.Namespace) -> None:
    """Print the verdicts on recorded frames, whole and cut off."""
    folder: Path = arguments.episodes
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    known = tuple(load_tasks(share_path('config', 'tasks', 'any_size')))
    known += tuple(load_task(path) for path in arguments.task)
    estimator = SuccessEstimator(known)
    robot, rows = load_robot(folder / 'robot' / 'robot.yaml'), []
    for recording in recordings(folder, spec):
        ends = [*range(arguments.every, len(recording.times), arguments.every)]
        for end in [*ends, len(recording.times)]:
            assert recording.object_ids is not None
            ids, names = recording.object_ids[:, :end], recording.names
            first = masks_from_ids(ids[:, :1], recording.objects, names)
            rest = masks_from_ids(ids[:, 1:], recording.objects, names)
            motion = Motion.of(robot, recording.cameras, recording.positions[:end])
            shown = footage_of(motion, first, rest)
            found = estimator.estimate(shown, recording.instruction, is_real=True).estimate
            rows.append(verdict_row(recording.path.name, recording.times[end - 1], found))
            if isnan(found.probability) and 'no known task' in found.reasons[0]:
                break  # and so it says of every cut
    print(table(('recording', 'until [s]', 'probability', 'verdict', 'first reason'), rows))


def verdict_row(name: str, until_s: float, found: SuccessEstimate) -> tuple[str, ...]:
    """Return the row of an estimate; the verdict is open where the interval reaches the other."""
    return (
        name,
        f'{until_s:.1f}',
        f'{found.probability:.2f}',
        verdict_word(found.probability, found.interval),
        found.reasons[0],
    )


def print_grips(arguments: argparse.Namespace) -> None:
    """Print the stops of fingers, and of simulated episodes how they agree with the objects."""
    folder: Path = arguments.episodes
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    robot = load_robot(robot_path(arguments.robot or folder / 'robot' / 'robot.yaml'))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    rows, counts = [], np.zeros((2, 2), np.int64)
    for path in list_episodes(folder):
        recording = load_recording(path, spec, robot)
        openings = np.asarray(robot.gripper_openings(recording.positions))
        commanded = robot.gripper_openings(commands_at(recording, np.arange(len(recording.times))))
        stopped, _ = watch_fingers(openings, 1 / RECORDED_FPS, commanded=commanded)
        for arm, of_arm in enumerate(stopped):
            runs = runs_of(of_arm)
            for (first, last), stop in zip(runs, judged(recording, robot, arm, runs), strict=True):
                begin, end = recording.times[[first, last]] - recording.times[0]
                opening = f'{openings[arm, first : last + 1].mean():.2f}'
                name = '-' if stop.item is None else recording.names[stop.item]
                told = stop.hold.value
                rows.append(
                    (path.name, str(arm), f'{begin:.1f}', f'{end:.1f}', opening, name, told)
                )
                if arguments.out is not None:
                    picture = stop_picture(recording, stop, motion_of(recording, robot))
                    write_png(arguments.out / f'{path.name}_{begin:04.1f}s.png', picture)
        if recording.object_poses is not None and not recording.masks_by:
            tools = robot.tool_poses(recording.positions)
            for of_tool, of_arm in zip(tools, stopped, strict=True):
                counts += agreement(of_tool, recording.object_poses, of_arm)
    head = ('recording', 'arm', 'from [s]', 'to [s]', 'opening', 'object', 'by the masks')
    print(table(head, rows))
    if counts.any():
        (moves, held), (away, wrong) = counts
        print(f'objects that go along: {moves} frames, {held} of them stops; ', end='')
        print(f'all objects far away: {away} frames, {wrong} of them stops')


#: largest brightness of a pixel of a dark gripper; width and height that are looked at [m]
DARK, BESIDE_M, ALONG_M = 70, 0.07, (0.06, 0.2)
#: heights of drawn fingers above the table at which they are free, and at which they are in it [m]
FREE_M, BELOW_M = 0.06, -0.005


def print_finger_ends(arguments: argparse.Namespace) -> None:
    """Print how much farther from the hand fingers are drawn than seen, free and in the table."""
    folder: Path = arguments.episodes
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    robot, rows = load_robot(folder / 'robot' / 'robot.yaml'), []
    arms = Arms(robot, None)
    scene = CompiledScene.compiled(arms, ())
    for recording in recordings(folder, spec):
        motion = motion_of(recording, robot)
        assert recording.object_ids is not None
        ids = recording.object_ids[:, :1]
        masks = masks_from_ids(ids, recording.objects, recording.names).masks[:, :, 0]
        table_m = table_in(
            recording.names, masks, recording.cameras, list(motion.camera_poses[:, 0])
        )
        spread = arms.drives.spread(recording.positions)
        above = scene.lowest_fingers(spread)[0] - table_m
        rotations = robot.tool_poses(recording.positions)[0][:, :3, 2]
        for view, name in enumerate(arguments.views):
            row = [recording.path.name, name]
            for chosen in (above > FREE_M, above < BELOW_M):
                off = {
                    t: finger_ends(recording, robot, scene, spread[t], motion, view, t)
                    for t in map(int, np.flatnonzero(chosen))
                }
                found = [(t, d - s) for t, (d, s) in off.items() if np.isfinite(d - s)]
                if not found:
                    row += ['0', '-', '-']
                    continue
                ends = np.array([gap for _, gap in found])
                seen = [above[t] - gap * rotations[t, 2] for t, gap in found]
                low, high = 1e3 * np.quantile(ends, (0.1, 0.9))
                shown = f'{1e3 * np.median(ends):.0f} [{low:.0f}, {high:.0f}]'
                row += [str(len(found)), shown, f'{1e3 * np.median(seen):.0f}']
            rows.append(tuple(row))
            print('| ' + ' | '.join(rows[-1]) + ' |', flush=True)
    head = ('free: n', 'drawn beyond seen [mm]', 'seen above the table [mm]')
    print(table(('recording', 'view', *head, 'in the table: n', *head[1:]), rows))


def finger_ends(
    recording: Recording,
    robot: RobotModel,
    scene: CompiledScene,
    positions: FloatArray,
    motion: Motion,
    view: int,
    t: int,
) -> tuple[float, float]:
    """Return how far along the tool's axis fingers are drawn and seen [m]; NaN = out of view.

    Args:
        recording: the recording.
        robot: its robot.
        scene: scene of the robot alone.
        positions: (D,) positions of the arms [rad or m].
        motion: motion of the robot and the cameras.
        view: number of the view.
        t: number of the frame.
    """
    tool = robot.tool_poses(recording.positions[t : t + 1])[0][0]
    link = tool @ np.linalg.inv(robot.tools[0].T_link_tool)
    camera, pose = recording.cameras[view], motion.camera_poses[view, t]
    along = np.arange(ALONG_M[0], ALONG_M[1], 0.001)
    axis = link[:3, 3] + along[:, None] * tool[:3, 2]
    aside = np.cross(tool[:3, 2], pose[:3, 3] - axis[len(axis) // 2])
    beside = np.linspace(-BESIDE_M, BESIDE_M, 85)
    points = axis[:, None] + beside[:, None] * aside / np.linalg.norm(aside)
    pixels = project(camera, pose, points.reshape(-1, 3))[0].reshape(*points.shape[:2], 2)
    middle, (high, wide) = pixels[:, len(beside) // 2], recording.frames.shape[2:4]
    inside = ((middle > 8) & (middle < [wide - 8, high - 8])).all()
    if not (inside and np.isfinite(pixels).all()):
        return nan, nan
    at = pixels.astype(np.float32)
    frame = recording.frames[view, t].max(-1).astype(np.float32)
    dark = cv2.remap(frame, at[..., 0], at[..., 1], cv2.INTER_LINEAR) < DARK
    _, parts = cv2.connectedComponents(dark.astype(np.uint8))
    hand = np.unique(parts[:25, 30:55])  # the body of the gripper, and what hangs on it
    seen = np.isin(parts, hand[hand > 0])
    drawn = np.zeros((3 * high, 3 * wide), np.float32)
    for corners in next(scene.finger_shapes(positions[None])):
        outline = project(camera, pose, corners)[0]
        if np.isfinite(outline).all():
            hull = cv2.convexHull(((outline + 0.5) * 3).astype(np.float32))
            cv2.fillConvexPoly(drawn, np.rint(hull).astype(np.int32), 1.0)
    at = (at + 0.5) * 3 - 0.5
    drawn_there = cv2.remap(drawn, at[..., 0], at[..., 1], cv2.INTER_LINEAR) > 0.5
    in_drawing, in_frame = (np.flatnonzero(found.sum(1) >= 4) for found in (drawn_there, seen))
    if not (len(in_drawing) and len(in_frame)):
        return nan, nan
    return float(along[in_drawing[-1]]), float(along[in_frame[-1]])


def motion_of(recording: Recording, robot: RobotModel) -> Motion:
    """Return the motion of the robot and the cameras in all frames of a recording."""
    return Motion.of(robot, recording.cameras, recording.positions)


def judged(
    recording: Recording, robot: RobotModel, arm: int, runs: Sequence[tuple[int, int]]
) -> tuple[Stop, ...]:
    """Return the stops of an arm's fingers in runs of rows, with the evidence of the masks."""
    stops = [(arm, first, last + 1) for first, last in runs]
    if recording.object_ids is None:
        return tuple(
            Stop(arm=a, closed=c, opened=o, item=None, hold=Hold.NOT_TOLD) for a, c, o in stops
        )
    masks = masks_from_ids(recording.object_ids, recording.objects, recording.names).masks
    return judge_stops(motion_of(recording, robot), masks, stops)


def stop_picture(
    recording: Recording, stop: Stop, motion: Motion, num_columns: int = 5
) -> ByteArray:
    """Return frames of all views from the stop until the fingers open, tool points drawn in."""
    last = min(stop.opened, len(recording.times)) - 1
    columns = np.unique(np.linspace(stop.closed, last, num_columns).round().astype(int))
    pixels = tools_in_views(motion, stop.arm)
    rows = []
    for view in range(recording.frames.shape[0]):
        shown = [recording.frames[view, column].copy() for column in columns]
        for frame, column in zip(shown, columns, strict=True):
            if np.isfinite(pixels[view, column]).all():
                x, y = np.rint(pixels[view, column]).astype(int)
                frame[max(y - 2, 0) : y + 3, max(x, 0) : x + 1] = (255, 0, 255)
                frame[max(y, 0) : y + 1, max(x - 2, 0) : x + 3] = (255, 0, 255)
        rows.append(np.concatenate(shown, axis=1))
    return np.concatenate(rows, axis=0)


def runs_of(mask: BoolArray) -> list[tuple[int, int]]:
    """Return the first and last row of each run of a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


#: distance that an object goes from one frame to the next at least, to be carried [m]
CARRIED_M = 0.008
#: change of its place in the tool meanwhile at most [m]
SAME_PLACE_M = 0.004
#: distance of a carried object from the tool point at most; of one that is far away at least [m]
NEAR_M, FAR_M = 0.06, 0.08


def agreement(tools: FloatArray, objects: FloatArray, stopped: BoolArray) -> NDArray[np.int64]:
    """Return counts (2, 2): frames with a carried object, far objects; all, and stops among them.

    Args:
        tools: (N, 4, 4) T_base_tool [m].
        objects: (N, O, 4, 4) T_base_object [m].
        stopped: (N,) frames in which something stops the fingers.
    """
    points = objects[..., :3, 3]
    inside = np.linalg.inv(tools)[:, None] @ objects
    way = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    change = np.linalg.norm(np.diff(inside[..., :3, 3], axis=0), axis=-1)
    away = np.linalg.norm(points - tools[:, None, :3, 3], axis=-1)[1:]
    carried = ((way > CARRIED_M) & (change < SAME_PLACE_M) & (away < NEAR_M)).any(-1)
    far = (away > FAR_M).all(-1)
    return np.array([[rows.sum(), (rows & stopped[1:]).sum()] for rows in (carried, far)])


class HeldFrames:
    """World model that holds the start frame, where what is foreseen alone is asked."""

    def __init__(self, spec: WorldModelSpec) -> None:
        self.spec = spec

    def predict(self, start_frame: Any, control: Any, **_: Any) -> Any:
        """Return the start frame T times."""
        del control
        return np.repeat(start_frame[:, None], self.spec.num_frames, axis=1)


def open_pipeline(arguments: argparse.Namespace) -> Pipeline:
    """Return the bare pipeline of the checkpoint, with the objects of the import."""
    return Pipeline.load(
        arguments.checkpoint,
        robot=arguments.episodes / 'robot' / 'robot.yaml',
        segmenter=str(arguments.episodes / 'objects.safetensors'),
        num_threads=1,
        camera_check=False,
        calibrated=False,
        task=str(arguments.task[0]) if arguments.task else None,
    )


def compare_carried(arguments: argparse.Namespace) -> None:
    """Print J of what moves: where it is foreseen chunk by chunk, and held."""
    pipeline, rows = open_pipeline(arguments), []
    held = replace(pipeline, world_model=HeldFrames(pipeline.spec), scene_keeper=None)
    for recording in recordings(arguments.episodes, pipeline.spec):
        found = [
            score
            for stretch in stretches(recording, pipeline.spec, 'observe')
            for score in _foreseen(replace(held, objects=recording.names), recording, stretch)
        ]
        scores = np.array(found).reshape(-1, 2)
        rows.append((recording.path.name, str(len(scores)), *_means(scores)))
    print(table(('recording', 'view-objects that move', 'J foreseen', 'J held'), rows))


def _means(scores: FloatArray) -> list[str]:
    return [f'{value:.3f}' for value in scores.mean(0)] if len(scores) else ['-', '-']


def _foreseen(
    pipeline: Pipeline, recording: Recording, stretch: Stretch
) -> Iterator[tuple[float, float]]:
    """Yield J of each view of each object that moves in a chunk: foreseen, and held."""
    options = RolloutOptions(instruction=recording.instruction, objects=recording.names)
    episode = pipeline.begin(recording.observation(0), options)
    if stretch.start:
        rows = np.arange(stretch.start + 1)
        episode.observe(
            recording.frames[:, rows[1:]],
            recording.positions[rows],
            commands=commands_at(recording, rows),
        )
        episode = episode.branch(recording.observation(stretch.start))
    seconds = stretch.num_frames / pipeline.spec.fps
    deque(episode.extend(commands_until(recording, stretch.start, seconds)), maxlen=0)
    objects = episode.objects
    assert objects is not None
    truth = true_masks(
        stretch, pipeline.segmenter, recording.names, recording.objects, use_ids=True
    )
    cameras = episode.observation.cameras
    poses = np.stack([camera_poses(c, pipeline.robot, stretch.positions) for c in cameras])
    times = np.arange(1 + stretch.num_frames) / pipeline.spec.fps
    for item in map(int, np.flatnonzero(truth.moving.any(0))):
        alone = np.zeros_like(objects.cuts)
        alone[:, item] = objects.cuts[:, item]
        shown = replace(objects, cuts=alone).pictures(times, cameras, poses)[..., 3] > 127
        for view in map(int, np.flatnonzero(truth.moving[:, item])):
            true, first = truth.masks.masks[view, item], truth.first.masks[view, item, 0]
            seen = true.any((-2, -1))
            yield (
                float(np.mean(jaccard(shown[view, 1:][seen], true[seen]))),
                float(np.mean(jaccard(first[None], true[seen]))),
            )


def imagine_whole(arguments: argparse.Namespace) -> None:
    """Print scores of whole rollouts; those of an earlier run are read."""
    pipeline = open_pipeline(arguments)
    if arguments.memory == 'off':
        pipeline = replace(pipeline, scene_keeper=None)
    if arguments.foresight == 'off':
        assert isinstance(pipeline.judge, SuccessJudge)
        pipeline = replace(pipeline, judge=replace(pipeline.judge, object_motion=None))
    made_with = {
        'checkpoint': Checkpoint.open(arguments.checkpoint).digest(),
        'code': code_version(),
        'seed': arguments.seed,
        'memory': arguments.memory,
        'foresight': arguments.foresight,
    }
    out = arguments.out = arguments.out or Path('out/real_rollouts')
    out.mkdir(parents=True, exist_ok=True)
    scores: list[dict[str, Any]] = []
    for recording in recordings(arguments.episodes, pipeline.spec):
        file = out / f'{recording.path.name}.json'
        stored = json.loads(file.read_text()) if file.exists() else {}
        if stored.get('made_with') != made_with or not made_with['code']:
            stored = {'made_with': made_with, **_imagine_one(arguments, pipeline, recording)}
            file.write_text(json.dumps(stored, indent=1))
        low, high = stored['interval']
        shown = f'{stored["probability"]:.2f} [{low:.2f}, {high:.2f}]'
        print(recording.path.name, stored['estimate'], shown, stored['verdict'])
        scores += stored['views']
    head = ('recording', 'view', 'J of the arm, first chunk', 'recorded', 'whole', 'recorded',
            'PSNR, whole [dB]', 'held', 'J of moving objects, whole', 'held',
            'pixels a frame with a mark\'s hue', 'recorded')  # fmt: skip
    rows = [
        (
            score['recording'],
            score['view'],
            *(f'{score[key]:.{digits}f}' for key, digits in SCORES),
        )
        for score in scores
    ]
    print(table(head, rows))
    print(table(('mean of views, then of recordings', 'mean', '95 %', 'n'), mean_rows(scores)))


def code_version() -> str:
    """Return the hash of the package's committed files; empty with changes on top."""
    words = [['status', '--porcelain', 'mtv_world_ros'], ['rev-parse', 'HEAD:mtv_world_ros']]
    root = Path(__file__).resolve().parents[1]
    changes, tree = (
        subprocess.run(['git', *part], cwd=root, capture_output=True, text=True, check=True).stdout
        for part in words
    )
    return '' if changes else tree.strip()


#: name of a score of a view -> decimals shown
SCORES = (
    ('arm_first', 3),
    ('arm_first_recorded', 3),
    ('arm', 3),
    ('arm_recorded', 3),
    ('psnr', 2),
    ('psnr_held', 2),
    ('moving', 3),
    ('moving_held', 3),
    ('marks', 1),
    ('marks_recorded', 1),
)
#: differences whose means over recordings are printed: words, the score, what is taken off
DIFFERENCES = (
    ('J of the arm, whole: imagined less recorded frames', ('arm',), ('arm_recorded',)),
    ('J of the arm, imagined: whole less first chunk', ('arm',), ('arm_first',)),
    (
        'and the same of recorded frames taken off',
        ('arm', 'arm_first_recorded'),
        ('arm_first', 'arm_recorded'),
    ),
    ('PSNR, whole: imagined less first frame held [dB]', ('psnr',), ('psnr_held',)),
    ('J of moving objects, whole: imagined less held', ('moving',), ('moving_held',)),
)


def mean_rows(scores: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Return rows of mean differences, with 95 % t intervals over recordings."""
    rows: list[tuple[str, str, str, str]] = []
    for words, plus, minus in DIFFERENCES:
        by_recording: dict[str, list[float]] = {}
        for score in scores:
            value = sum(score[key] for key in plus) - sum(score[key] for key in minus)
            if not isnan(value):
                by_recording.setdefault(score['recording'], []).append(value)
        means = np.array([np.mean(v) for v in by_recording.values()], np.float64)
        mean, ends = mean_interval(
            means[:, None], np.ones((len(means), 1)), low=-np.inf, high=np.inf
        )
        low, high = ends[:, 0]
        shown = '-' if isnan(low) else f'[{low:+.3f}, {high:+.3f}]'
        rows.append((words, f'{mean[0]:+.3f}', shown, str(len(means))))
    return rows


def _imagine_one(
    arguments: argparse.Namespace, pipeline: Pipeline, recording: Recording
) -> dict[str, Any]:
    """Imagine a recording whole; write its contact sheet and return its scores."""
    (stretch,) = stretches(recording, pipeline.spec, 'imagine')
    chunks = imagine_stretch(
        replace(pipeline, objects=recording.names),
        recording,
        stretch,
        actions=recording,
        seed=arguments.seed,
        num_inference_steps=0,
    )
    frames, real = predicted_frames(chunks), stretch.frames[:, 1:]
    drawn = np.concatenate([chunk.trajectory_video.frames[:, 1:] for chunk in chunks], axis=1)
    comparison = Comparison(
        views=pipeline.spec.views,
        times=np.arange(1, 1 + frames.shape[1]) / pipeline.spec.fps,
        real=real,
        trajectory=drawn[:, : frames.shape[1]],
        imagined=frames,
    )
    sheet = contact_sheet(comparison, title=recording.instruction, num_columns=10)
    write_png(arguments.out / f'{recording.path.name}.png', sheet)
    moving = _moving(pipeline, recording, stretch, frames)
    parts, views = load_shape(pipeline.robot).parts, list[dict[str, Any]]()
    for view, scene in enumerate(arm_scenes(recording, pipeline.robot, parts)):
        if scene is None:
            continue
        masks = scene.masks(stretch.positions[1 : 1 + frames.shape[1]])
        length = pipeline.spec.num_frames
        cuts = [slice(k, k + length) for k in range(0, frames.shape[1], length)]
        arm, recorded = (
            [replace(masks, arm=masks.arm[cut]).jaccard(shown[cut]) for cut in cuts]
            for shown in (frames[view], real[view])
        )
        views.append(
            {
                'recording': recording.path.name,
                'view': pipeline.spec.views[view],
                'arm_first': arm[0],
                'arm_first_recorded': recorded[0],
                'arm': masks.jaccard(frames[view]),
                'arm_recorded': masks.jaccard(real[view]),
                'psnr': _psnr(frames[view], real[view]),
                'psnr_held': _psnr(stretch.frames[view, :1], real[view]),
                'moving': float(moving[view][0]),
                'moving_held': float(moving[view][1]),
                'marks': _pixels_of_marks(frames[view], masks.arm),
                'marks_recorded': _pixels_of_marks(real[view], masks.arm),
                'arm_of_chunks': arm,
                'arm_recorded_of_chunks': recorded,
            }
        )
    success = chunks[-1].success
    return {
        'views': views,
        'estimate': list(success.reasons),
        'probability': success.probability,
        'interval': success.interval,
        'verdict': verdict_word(success.probability, success.interval),
    }


def _pixels_of_marks(shown: ByteArray, arm: BoolArray) -> float:
    """Return the pixels a frame (T, H, W, 3) at the arm (T, H, W) with the hue of drawn marks."""
    colours = (arm_colour(0, 1), *FINGER_COLOURS[1:])
    has_hue = np.any([has_colour(shown, colour) for colour in colours], axis=0)
    near = [cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0 for mask in arm]
    return float((has_hue & near).sum() / len(shown))


def _psnr(shown: ByteArray, real: ByteArray) -> float:
    """Return the mean PSNR of frames (T, H, W, 3) [dB]."""
    error = ((shown.astype(float) - real) ** 2).mean((1, 2, 3))
    return float((10 * np.log10(255**2 / error)).mean())


def _moving(
    pipeline: Pipeline, recording: Recording, stretch: Stretch, frames: Any
) -> list[tuple[float, float]]:
    """Return J of moving objects by view: imagined, and of the first frame held."""
    truth = true_masks(
        stretch, pipeline.segmenter, recording.names, recording.objects, use_ids=True
    )
    found, scores = find_masks(frames, truth, pipeline.segmenter), []
    for view in range(len(frames)):
        each = []
        for item in map(int, np.flatnonzero(truth.moving[view])):
            true, first = truth.masks.masks[view, item], truth.first.masks[view, item, 0]
            seen = true.any((-2, -1))
            shown = found.masks[view, item][seen]
            each.append(
                (np.mean(jaccard(shown, true[seen])), np.mean(jaccard(first[None], true[seen])))
            )
        scores.append(tuple(np.mean(each, axis=0)) if each else (nan, nan))
    return scores


def shares_over_time(arguments: argparse.Namespace) -> None:
    """Print the share of futures that succeed, foreseen from later and later recorded frames."""
    folder: Path = arguments.episodes
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    robot = load_robot(folder / 'robot' / 'robot.yaml')
    settings = load_contact(arguments.contact) if arguments.contact else None
    if settings is None:
        settings = guessed_contact(robot, arguments.stop_holds)
    rows: list[tuple[str, ...]] = []
    for path in list_episodes(folder):
        recording = load_recording(path, spec, robot)
        matched = match_task(known_tasks(arguments.task), recording.instruction)
        if matched is None or recording.object_ids is None:
            rows.append((path.name, '-', '-', '-', '-', 'no known task'))
            continue
        for row in _shares_of(
            recording, SolidForesight(robot, None, settings), matched, arguments
        ):
            rows.append((path.name, *row))
            print('| ' + ' | '.join(rows[-1]) + ' |', flush=True)
    print(table(SHARE_HEAD, rows))


#: columns of shares over time
SHARE_HEAD = ('recording', 'from [s]', 'share', 'worth futures', 'kept poses', 'attempts')


def known_tasks(more: Sequence[Path]) -> tuple[TaskSpec, ...]:
    """Return the bundled tasks for objects of any size, and more of files."""
    return (*load_tasks(share_path('config', 'tasks', 'any_size')), *map(load_task, more))


def _shares_of(
    recording: Recording,
    foresight: SolidForesight,
    matched: tuple[TaskSpec, Mapping[str, str]],
    arguments: argparse.Namespace,
) -> Iterator[tuple[str, ...]]:
    """Yield start [s], share, number of futures, kept poses and attempts, from later frames."""
    assert recording.object_ids is not None
    masks = masks_from_ids(recording.object_ids, recording.objects, recording.names).masks
    for start in range(0, len(recording.times) - 2, arguments.every):
        row = _foreseen_from(recording, masks, foresight, matched, start, arguments.memory)
        yield (f'{recording.times[start] - recording.times[0]:.1f}', *row)


def foresee_left_out(arguments: argparse.Namespace) -> None:
    """Print verdicts of futures with contact fitted on the other recordings; draw the shares."""
    folder: Path = arguments.episodes
    out = arguments.out = arguments.out or Path('out/real_left_out')
    out.mkdir(parents=True, exist_ok=True)
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    robot = load_robot(folder / 'robot' / 'robot.yaml')
    fits = fits_left_out(arguments, robot)
    rows, curves = [], dict[str, list[tuple[float, float]] | None]()
    for path in list_episodes(folder):
        recording, curves[path.name] = load_recording(path, spec, robot), None
        matched = match_task(known_tasks(arguments.task), recording.instruction)
        if matched is None or path.name not in fits:
            continue
        settings = ContactSettings.model_validate(fits[path.name])
        file = out / f'{path.name}.json'
        found = json.loads(file.read_text()) if file.exists() else []
        if not found:
            foresight = SolidForesight(robot, None, settings)
            found = list(_shares_of(recording, foresight, matched, arguments))
            file.write_text(json.dumps(found, indent=1))
        curve = curves[path.name] = list[tuple[float, float]]()
        for start, share, worth, _, why in found:
            row: tuple[str, ...] = (start, '-', '-', '-', 'abstains', why)
            if share != '-':
                curve.append((float(start), float(share)))
                row = (start, share, *_verdict_of(float(share), float(worth), settings))
            rows.append((path.name, *row))
            print('| ' + ' | '.join(rows[-1]) + ' |', flush=True)
    head = ('recording', 'from [s]', 'share', 'probability', 'by the share alone', 'verdict')
    print(table((*head, 'doubt'), rows))
    draw_shares(curves, out / 'shares.png')


def _verdict_of(
    share: float, num_futures: float, settings: ContactSettings
) -> tuple[str, str, str, str]:
    """Return probability, the verdict of the share, the one that is given, and the doubt."""
    found = ShareFit().estimate(share, num_futures)
    word = verdict_word(found.probability, (found.low, found.high))
    shown = f'{found.probability:.2f} [{found.low:.2f}, {found.high:.2f}]'
    return shown, word, 'abstains' if settings.doubt else word, settings.doubt


def fits_left_out(arguments: argparse.Namespace, robot: RobotModel) -> dict[str, Any]:
    """Return the contact settings of each recording, fitted on the others; those of a file if any.

    The simulations of one fit serve all: those of the recording that is left out do not count.
    """
    file: Path = arguments.out / 'fits.json'
    if not file.exists():
        paths = list_episodes(arguments.episodes)
        given, skipped = read_recordings(paths, robot, arguments.views)
        for path, reason in skipped.items():
            print(f'left out: {path}: {reason}')
        samples, _ = sample_contact(given, Arms(robot, None), report=print)
        samples.fit(print)
        fits, used = {}, [path for path in paths if str(path) not in skipped]
        for number, path in enumerate(used):
            settings, _ = samples.without(number).fit()
            print(f'without {path.name}: {settings.doubt or "verdicts may rest on it"}')
            fits[path.name] = settings.model_dump(mode='json')
        file.write_text(json.dumps(fits, indent=1))
    return json.loads(file.read_text())


def draw_shares(
    curves: Mapping[str, Sequence[tuple[float, float]] | None], file: Path, num_columns: int = 5
) -> None:
    """Draw the share of futures over the time from which they are foreseen, a panel a recording.

    Args:
        curves: recording -> start [s] and share; None = it has no known task.
        file: PNG to write.
        num_columns: panels in a row.
    """
    num_rows = -(-len(curves) // num_columns)
    figure = Figure(figsize=(2.4 * num_columns, 2.0 * num_rows), layout='constrained')
    FigureCanvasAgg(figure)
    panels = figure.subplots(num_rows, num_columns, sharey=True, squeeze=False).ravel()
    for axes, (name, curve) in zip(panels, curves.items(), strict=False):
        axes.set(title=name, ylim=(-0.05, 1.05))
        axes.axhline(0.5, color='0.8', linewidth=1)
        if curve is None:
            axes.text(0.5, 0.5, 'no known task', ha='center', va='center', color='0.4',
                      transform=axes.transAxes)  # fmt: skip
            axes.set_xticks([])
        elif curve:
            axes.plot(*zip(*curve, strict=True), 'o-', markersize=4)
            axes.set_xlabel('foreseen from [s]')
    for axes in panels[len(curves) :]:
        axes.set_axis_off()
    for axes in panels[::num_columns]:
        axes.set_ylabel('share of futures')
    figure.savefig(file, dpi=110)


def guessed_contact(robot: RobotModel, stop_holds: float) -> ContactSettings:
    """Return guessed numbers of contact for recordings whose commands are measured positions."""
    first = first_settings(Arms(robot, None))
    return first.model_copy(
        update={
            'table_varies': True,
            'squeeze': 0.1,
            'grips_hold': True,
            'stop_holds': stop_holds,
            'spread': first.spread.model_copy(update={'camera_m': CAMERA_ERROR_M}),
        }
    )


def _foreseen_from(
    recording: Recording,
    masks: BoolArray,
    foresight: SolidForesight,
    matched: tuple[TaskSpec, Mapping[str, str]],
    start: int,
    memory: str,
) -> tuple[str, str, str, str]:
    """Return share, number of futures it is worth, kept poses and attempts, in words."""
    robot, names = foresight.robot, recording.names
    motion, period_s = motion_of(recording, robot), 1 / RECORDED_FPS
    given = recording.cameras, list(motion.camera_poses[:, 0])
    tracked = whole = foresight.find(names, masks[:, :, 0], *given)
    words = []
    if start:
        stopped, fingers = watch_fingers(motion.openings[:, : start + 1], period_s)
        seen, kept, held = motion.first(start + 1), (), ()
        if memory == 'on':
            sights = Sights.begin(names, seen)
            sights = sights.after(seen, masks[:, :, : start + 1], stopped, period_s)
            fingers, kept = (
                replace(fingers, is_refuted=sights.refuted),
                sights.kept(seen.last().tools[:, 0]),
            )
            held = sights.held
            words = [
                f'{name} {"held" if one.is_held else "stays"} {one.age_s:.1f} s'
                for name, one in zip(names, kept, strict=True)
                if one is not None
            ]
        given = recording.cameras, list(motion.camera_poses[:, start])
        tracked, _, _ = foresight.find_again(whole, names, masks[:, :, start], *given, kept, held)
        tracked = tracked.with_fingers(fingers)
    views, (height, width) = len(recording.cameras), masks.shape[-2:]
    found = FoundObjects(
        names=names,
        cuts=np.zeros((views, len(names), height, width, 4), np.uint8),
        poses=np.repeat(motion.camera_poses[:, start][:, None], len(names), axis=1),
        tracked=tracked,
    )
    times = recording.times[start:] - recording.times[start]
    fine = np.arange(0.0, times[-1] + 1e-9, tracked.step_s / tracked.commands_a_step)
    fine = fine[: 1 + (len(fine) - 1) // tracked.commands_a_step * tracked.commands_a_step]
    columns = [np.interp(fine, times, column) for column in recording.positions[start:].T]
    found = found.after(np.stack(columns, axis=-1))
    motions = foreseen_of(robot, found, len(found.motions[0].points))
    task, bound = matched
    bound = {role: object_called(name, names) or name for role, name in bound.items()}
    ends = foreseen_ends(motions, task, bound, whole.centres)
    tries = '; '.join(
        f'{a.closed_s:.1f} s {a.name} {a.share:.2f}' for a in foreseen_attempts(motions)
    )
    if ends is None:
        doubts = '; '.join(dict.fromkeys(tracked.doubts.values()))
        return '-', '-', ', '.join(words), doubts or tries
    return f'{ends.share:.2f}', f'{ends.num_effective:.1f}', ', '.join(words), tries


def main() -> None:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n', 1)[0])
    parser.add_argument(
        'what',
        choices=('verdicts', 'grips', 'fingers', 'shares', 'left-out', 'carried', 'rollouts'),
    )
    parser.add_argument('episodes', type=Path)
    parser.add_argument(
        '--views', type=lambda text: tuple(text.split(',')), default=('ext1', 'ext2')
    )
    parser.add_argument('--task', type=Path, nargs='*', default=[])
    parser.add_argument('--every', type=int, default=8, help='frames between two cuts')
    parser.add_argument('--checkpoint', default='')
    parser.add_argument('--robot', help='of grips: YAML or bundled; default: of EPISODES')
    parser.add_argument(
        '--contact',
        type=Path,
        help='of shares: folder with contact.json; default: a guess',
    )
    parser.add_argument(
        '--stop-holds', type=float, default=0.75, help='of shares: of stops that hold, if guessed'
    )
    parser.add_argument('--memory', choices=('on', 'off'), default='on')
    parser.add_argument('--foresight', choices=('on', 'off'), default='on')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, help='of grips: pictures; of others: all')
    arguments = parser.parse_args()
    {
        'verdicts': judge_recorded,
        'grips': print_grips,
        'fingers': print_finger_ends,
        'shares': shares_over_time,
        'left-out': foresee_left_out,
        'carried': compare_carried,
        'rollouts': imagine_whole,
    }[arguments.what](arguments)


if __name__ == '__main__':
    main()
