"""Small LeRobot datasets in their true formats: parquet by pyarrow, video by PyAV."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.writer import BagWriter
from test.support.robot_recordings import Edit, Event, events, NANO, ns, VIEWS

pyarrow = pytest.importorskip('pyarrow', reason='pyarrow is not installed (pip install .[import])')

from pyarrow import parquet  # noqa: E402

FPS, WIDTH, HEIGHT = 10, 64, 48
LENGTHS = (12, 9)
TASKS = ('put the red block on the blue block', 'stop')
COLUMNS = ('shoulder.pos', 'elbow.pos', 'gripper.pos', 'force')
VIDEOS = ('observation.images.front', 'observation.images.top')

ROBOT = """
name: two_joints
dh:
  - arm: only
    joints:
      - {joint: shoulder, a: 0.3, alpha: 0, d: 0, lower: -2, upper: 2}
      - {joint: elbow, a: 0.2, alpha: 0, d: 0, lower: -2, upper: 2}
    gripper: {joint: gripper, lower: 0, upper: 0.04}
tools: [{arm: only, link: elbow_link, gripper_joint: gripper, gripper_closed: 0.0,
         gripper_open: 0.04}]
"""
CALIBRATION = """
views:
  front:
    width: 128
    height: 96
    K: [140, 140, 63.5, 47.5]
    mount_link: base
    position: [0.1, 0.2, 0.3]
    quaternion_xyzw: [0, 0, 0, 1]
"""
MAPPING = """
robot: robot.yaml
views:
  front: {feature: observation.images.front, calibration: calibration.yaml}
state:
  feature: observation.state
  joints:
    shoulder: {column: shoulder.pos, unit: deg}
    elbow: {column: 1, sign: -1, offset: 0.5}
    gripper: {column: gripper.pos, closed: 100, open: 0}
action:
  feature: action
  joints: {shoulder: {column: shoulder.pos, unit: deg}, elbow: {column: 1, sign: -1, offset: 0.5},
           gripper: {column: gripper.pos, closed: 100, open: 0}}
chunk_s: 0.5
task: stack
"""


def grey(episode: int, row: int, camera: int) -> int:
    """Grey level that names a frame."""
    return 20 + 16 * row + 6 * camera + 3 * episode


def state(episode: int, row: int) -> list[float]:
    """Degrees; radians; percent closed; a column that is not a joint."""
    return [3.0 * row + episode, 0.1 * row - 0.2, 100.0 - 5 * row, 1000.0]


def action(episode: int, row: int) -> list[float]:
    return state(episode, row + 1)


def write_video(path: Path, levels: list[int], *, skip: int | None = None) -> None:
    """One flat grey frame a level, at FPS; `skip` leaves a frame out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=FPS, options={'crf': '12', 'g': '2'})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, 'yuv420p'
        stream.time_base = Fraction(1, FPS)
        for index, level in enumerate(levels):
            if index == skip:
                continue
            image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format='rgb24')
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def rows_of(episode: int, first_index: int) -> dict[str, list]:
    count = LENGTHS[episode]
    rows = range(count)
    return {
        'observation.state': [state(episode, k) for k in rows],
        'action': [action(episode, k) for k in rows],
        'sensors.top.K': [[[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]] * count,
        'sensors.top.pose': [[[1.0, 0, 0, 0.1 * episode], [0, -1, 0, 0], [0, 0, -1, 2]]] * count,
        'next.success': [episode == 0 and k == count - 1 for k in rows],
        'timestamp': [k / FPS for k in rows],
        'frame_index': list(rows),
        'episode_index': [episode] * count,
        'index': [first_index + k for k in rows],
        'task_index': [int(k >= 8) for k in rows],
    }


def table_of(episodes: list[int]):
    merged: dict[str, list] = {}
    for episode in episodes:
        for name, values in rows_of(episode, sum(LENGTHS[:episode])).items():
            merged.setdefault(name, []).extend(values)
    numbers = pyarrow.float32()
    types = {
        'observation.state': pyarrow.list_(numbers, 4),
        'action': pyarrow.list_(numbers),
        'timestamp': numbers,
    }
    return pyarrow.table(
        {name: pyarrow.array(values, type=types.get(name)) for name, values in merged.items()}
    )


def info(version: str) -> dict:
    named = {'dtype': 'float32', 'shape': [4], 'names': list(COLUMNS)}
    v3 = version == 'v3.0'
    video = {
        'dtype': 'video',
        'shape': [HEIGHT, WIDTH, 3],
        'names': ['height', 'width', 'channels'],
    }
    plain = ('timestamp', 'frame_index', 'episode_index', 'index', 'task_index', 'next.success',
             'sensors.top.K', 'sensors.top.pose')  # fmt: skip
    return {
        'codebase_version': version,
        'robot_type': 'two_joints',
        'total_episodes': len(LENGTHS),
        'total_frames': sum(LENGTHS),
        'total_tasks': len(TASKS),
        'chunks_size': 1000,
        'fps': FPS,
        'data_path': 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
        if v3
        else 'data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet',
        'video_path': 'videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4'
        if v3
        else 'videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4',
        'features': {
            'observation.state': named,
            # as datasets of v2.0 name motors
            'action': {**named, 'names': {'motors': list(COLUMNS)}},
            **dict.fromkeys(VIDEOS, video),
            **{key: {'dtype': 'float32', 'shape': [1], 'names': None} for key in plain},
        },
    }


def write_lines(path: Path, rows: list[dict]) -> None:
    path.write_text(''.join(json.dumps(row) + '\n' for row in rows))


def write_v21(root: Path, version: str = 'v2.1') -> Path:
    (root / 'meta').mkdir(parents=True)
    (root / 'meta/info.json').write_text(json.dumps(info(version)))
    lengths = enumerate(LENGTHS)
    write_lines(
        root / 'meta/episodes.jsonl',
        [{'episode_index': e, 'tasks': list(TASKS), 'length': n} for e, n in lengths],
    )
    write_lines(
        root / 'meta/tasks.jsonl', [{'task_index': i, 'task': t} for i, t in enumerate(TASKS)]
    )
    (root / 'data/chunk-000').mkdir(parents=True)
    for episode, length in enumerate(LENGTHS):
        name = f'episode_{episode:06d}'
        parquet.write_table(table_of([episode]), root / f'data/chunk-000/{name}.parquet')
        for camera, key in enumerate(VIDEOS):
            levels = [grey(episode, k, camera) for k in range(length)]
            write_video(root / f'videos/chunk-000/{key}/{name}.mp4', levels)
    return root


def write_v30(root: Path, task_column: str = 'task') -> Path:
    """Both episodes in one data file and one video a camera."""
    (root / 'meta/episodes/chunk-000').mkdir(parents=True)
    (root / 'meta/info.json').write_text(json.dumps(info('v3.0')))
    tasks = {'task_index': list(range(len(TASKS))), task_column: list(TASKS)}
    parquet.write_table(pyarrow.table(tasks), root / 'meta/tasks.parquet')
    rows = []
    for episode, length in enumerate(LENGTHS):
        start = sum(LENGTHS[:episode])
        row = {'episode_index': episode, 'tasks': list(TASKS), 'length': length,
               'data/chunk_index': 0, 'data/file_index': 0, 'dataset_from_index': start,
               'dataset_to_index': start + length, 'stats/timestamp/min': [0.0]}  # fmt: skip
        for key in VIDEOS:
            row |= {f'videos/{key}/chunk_index': 0, f'videos/{key}/file_index': 0,
                    f'videos/{key}/from_timestamp': start / FPS,
                    f'videos/{key}/to_timestamp': (start + length) / FPS}  # fmt: skip
        rows.append(row)
    episodes = pyarrow.Table.from_pylist(rows)
    parquet.write_table(episodes, root / 'meta/episodes/chunk-000/file-000.parquet')
    (root / 'data/chunk-000').mkdir(parents=True)
    table = table_of(list(range(len(LENGTHS))))
    parquet.write_table(table, root / 'data/chunk-000/file-000.parquet')
    for camera, key in enumerate(VIDEOS):
        levels = [grey(e, k, camera) for e, n in enumerate(LENGTHS) for k in range(n)]
        write_video(root / f'videos/{key}/chunk-000/file-000.mp4', levels)
    return root


def with_images(root: Path) -> Path:
    """A v2.1 dataset whose front camera is PNG images in the table."""
    write_v21(root)
    described = info('v2.1')
    described['features'][VIDEOS[0]]['dtype'] = 'image'
    (root / 'meta/info.json').write_text(json.dumps(described))
    for episode, length in enumerate(LENGTHS):
        pictures = [np.full((HEIGHT, WIDTH, 3), grey(episode, k, 0), np.uint8)
                    for k in range(length)]  # fmt: skip
        cells = [
            {'bytes': cv2.imencode('.png', p)[1].tobytes(), 'path': 'x.png'} for p in pictures
        ]
        table = table_of([episode]).append_column(VIDEOS[0], pyarrow.array(cells))
        parquet.write_table(table, root / f'data/chunk-000/episode_{episode:06d}.parquet')
    return root


WRITERS = {
    'v2.0': lambda root: write_v21(root, 'v2.0'),
    'v2.1': write_v21,
    'v3.0': write_v30,
    'v3.0, unnamed index': lambda root: write_v30(root, '__index_level_0__'),
    'images': with_images,
}


@pytest.fixture(scope='session')
def datasets(tmp_path_factory):
    """Return the folder of a dataset by kind; it must not be changed."""
    made: dict[str, Path] = {}

    def dataset(kind: str) -> Path:
        if kind not in made:
            made[kind] = WRITERS[kind](tmp_path_factory.mktemp('datasets') / 'data_set')
        return made[kind]

    return dataset


@pytest.fixture
def make_mapping(tmp_path):
    """Write robot, calibration and a mapping with some texts replaced; return its path."""

    def make(*replacements: tuple[str, str]) -> Path:
        folder = tmp_path / 'mapping'
        folder.mkdir(exist_ok=True)
        (folder / 'robot.yaml').write_text(ROBOT)
        (folder / 'calibration.yaml').write_text(CALIBRATION)
        text = MAPPING
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        (folder / 'mapping.yaml').write_text(text)
        return folder / 'mapping.yaml'

    return make


@pytest.fixture(name='write_video')
def write_video_fixture():
    return write_video


@pytest.fixture
def record(tmp_path):
    """Write a recording whose stamps [ns] are edited; messages without one are left out."""

    def make(
        edit: Edit = lambda _topic, _seconds, stamp: stamp,
        more: list[Event] | None = None,
        name: str = 'bag',
        received: Callable[[float], float] = lambda seconds: seconds,
        change: Callable[[str, float, Any], None] = lambda *_: None,
    ) -> Path:
        with BagWriter(tmp_path / name) as writer:
            recorded: list[Event] = [*events(), *(more or [])]
            recorded.sort(key=lambda event: event[0])
            for seconds, topic, kind, message in recorded:
                told: Any = message
                items = [told] if hasattr(told, 'header') else getattr(told, 'transforms', [])
                stamps = [messages.header_stamp(item) for item in items]
                edited = [edit(topic, seconds, stamp) for stamp in stamps]
                kept = [stamp for stamp in edited if stamp is not None]
                if len(kept) < len(edited):
                    continue
                for item, stamp in zip(items, kept, strict=True):
                    item.header.stamp.sec, item.header.stamp.nanosec = divmod(stamp, NANO)
                change(topic, seconds, message)
                data = messages.serialize(kind, message)
                writer.write_raw(topic, kind, ns(received(seconds)), data)
        return tmp_path / name

    return make


@pytest.fixture
def run(tmp_path, capsys):
    """Import a bag; return the exit status and what was printed."""

    def imported(bag: Path, *more: str, **mapping: Any) -> tuple[int, str]:
        file = tmp_path / 'mapping.yaml'
        views = {view: f'/{view}/image_raw' for view in VIEWS}
        file.write_text(yaml.safe_dump({'robot': 'franka', 'views': views, **mapping}))
        out = str(tmp_path / 'out')
        status = main(['import', 'bag', str(bag), '--topics', str(file), '--out', out, *more])
        printed = capsys.readouterr()
        return status, printed.out + printed.err

    return imported
