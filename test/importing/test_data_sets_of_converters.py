"""LeRobot data sets as converters and users write them: what they leave out or call otherwise."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import av
import numpy as np
from pyarrow import parquet
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.cli.imports.common import _import_status
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode import UNKNOWN_CAMERAS
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.importing.convert import ImportSummary
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.lerobot_episodes import import_dataset, read_frames
from mtv_world_ros.importing.mapping import guess_mapping, load_mapping

FPS = 10
KNOWN = ', calibration: calibration.yaml'
ACTION = (
    '  joints: {shoulder: {column: shoulder.pos, unit: deg}, '
    'elbow: {column: 1, sign: -1, offset: 0.5},\n'
    '           gripper: {column: gripper.pos, closed: 100, open: 0}}\n'
)


@pytest.fixture
def copied(datasets, tmp_path):
    """Return a function that copies a data set, to be changed."""
    return lambda kind: Path(shutil.copytree(datasets(kind), tmp_path / 'set'))


def change_info(root: Path, change) -> None:
    file = root / 'meta/info.json'
    info = json.loads(file.read_text())
    change(info)
    file.write_text(json.dumps(info))


def drop_columns(root: Path, names: list[str]) -> None:
    for file in (root / 'data').rglob('*.parquet'):
        parquet.write_table(parquet.read_table(file).drop_columns(names), file)
    change_info(root, lambda info: [info['features'].pop(name) for name in names])


def shown(path: Path, view: str) -> list[float]:
    """Return the mean grey level of each frame of an imported view."""
    frames = read_episode(path, with_cameras=False).images[view].frames
    return [float(np.asarray(frame).mean()) for frame in frames]


@pytest.mark.parametrize('kind', ['v2.1', 'v3.0'])
def test_a_view_without_calibration_is_imported_and_marked(datasets, make_mapping, tmp_path, kind):
    top = f'  top: {{feature: observation.images.top{KNOWN}}}\n'
    mapping = make_mapping((KNOWN, ''), ('state:\n', f'{top}state:\n'))
    (tmp_path / 'mapping/calibration.yaml').write_text(
        (tmp_path / 'mapping/calibration.yaml').read_text().replace('front:', 'top:')
    )
    summary = import_dataset(datasets(kind), mapping, tmp_path / 'out', episodes=[1])
    assert not summary.failed
    said = [line for line in summary.warnings[1] if 'not known' in line]
    assert len(said) == 1 and 'fit camera' in said[0] and '--view front' in said[0]
    path = tmp_path / 'out/episode_000001'
    assert read_info(path).metadata[UNKNOWN_CAMERAS] == 'front'
    episode = read_episode(path, unknown_mount='base')
    assert episode.unknown == {'front': 'pose and intrinsics'}
    assert episode.cameras['top'].K[0, 0] == 70  # half of the calibration's, as the images are
    np.testing.assert_allclose(shown(path, 'front'), 23 + 16 * np.arange(9), atol=3)


def test_a_robot_alone_makes_every_colour_camera_a_view(copied, make_mapping, tmp_path, capsys):
    root = copied('v2.1')

    def change(info):
        names = ['shoulder', 'elbow', 'gripper', 'force']
        info['features']['observation.state']['names'] = names
        info['features']['action']['names'] = names
        info['features']['observation.images.top']['info'] = {'video.is_depth_map': True}

    change_info(root, change)
    for file in (root / 'data').rglob('*.parquet'):
        table = parquet.read_table(file)
        zeros = [[0.1, 0.2, 0.01, 5.0]] * table.num_rows
        for name in ('observation.state', 'action'):
            at = table.column_names.index(name)
            table = table.set_column(at, name, [zeros])
        parquet.write_table(table, file)
    robot = make_mapping().parent / 'robot.yaml'
    out = tmp_path / 'out'
    assert main(['import', 'lerobot', str(root), '--robot', str(robot), '--out', str(out)]) == 0
    text = capsys.readouterr()
    assert 'observation.images.top (no colour images)' in text.err
    assert "episode_000000: 1.1 s; frames: front 12; '" in text.out
    assert 'cameras not known: front' in text.out
    assert read_episode(out / 'episode_000001', with_cameras=False).views == ('front',)


def test_views_are_named_by_the_part_of_their_names_that_differs(datasets):
    class Set:
        root = Path('set')
        features = dict.fromkeys(
            ('observation.images.left.rgb', 'observation.images.right.rgb'), {'dtype': 'video'}
        ) | {'observation.state': {'dtype': 'float32'}, 'action': {'dtype': 'float32'}}

        def colour_features(self):
            return tuple(self.features)[:2]

    values = guess_mapping(Set(), 'franka', None)
    assert values['views'] == {
        'left_rgb': {'feature': 'observation.images.left.rgb'},
        'right_rgb': {'feature': 'observation.images.right.rgb'},
    }


def test_own_columns_that_a_converter_left_out_stand_in(copied, make_mapping, tmp_path):
    """Row k is frame k at the rate of the data set, and has the episode's only task."""
    root = copied('v2.1')
    rows = [json.loads(line) for line in (root / 'meta/episodes.jsonl').read_text().splitlines()]
    for number, row in enumerate(rows):
        row['tasks'] = [row['tasks'][number]]
    text = ''.join(json.dumps(row) + '\n' for row in rows)
    (root / 'meta/episodes.jsonl').write_text(text)
    whole = import_dataset(root, make_mapping(), tmp_path / 'whole')
    drop_columns(root, ['timestamp', 'frame_index', 'index', 'task_index'])
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == whole.made == [0, 1]
    for number, task in enumerate(('put the red block on the blue block', 'stop')):
        name = f'episode_{number:06d}'
        found = read_episode(tmp_path / 'out' / name, with_cameras=False)
        expected = read_episode(tmp_path / 'whole' / name, with_cameras=False)
        np.testing.assert_allclose(  # the table's are of 32 bits
            found.joint_states.stamps_ns, expected.joint_states.stamps_ns, atol=200, rtol=0
        )
        np.testing.assert_array_equal(
            found.joint_states.positions, expected.joint_states.positions
        )
        assert found.info.instruction == task


def test_columns_that_only_info_json_lacks_are_read_from_the_table(copied, make_mapping, tmp_path):
    root = copied('v3.0')
    own = ('timestamp', 'frame_index', 'episode_index', 'index', 'task_index')
    change_info(root, lambda info: [info['features'].pop(name) for name in own])
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1]
    episode = read_episode(tmp_path / 'out/episode_000001', with_cameras=False)
    assert [words for _, words in episode.instructions] == [
        'put the red block on the blue block', 'stop',
    ]  # fmt: skip


def test_several_tasks_without_a_column_that_tells_them_are_refused(
    copied, make_mapping, tmp_path
):
    root = copied('v2.1')
    drop_columns(root, ['task_index'])
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert "no column 'task_index', and episode 0 has 2 of the 2 tasks" in summary.failed[0]
    mapping = make_mapping(('task: stack', 'instruction: put it down'))
    summary = import_dataset(root, mapping, tmp_path / 'out')
    assert summary.made == [0, 1]


def test_a_chunk_may_be_named_as_in_the_later_format(copied, make_mapping, tmp_path):
    root = copied('v2.1')

    def change(info):
        for key in ('data_path', 'video_path'):
            info[key] = info[key].replace('{episode_chunk', '{chunk_index')

    change_info(root, change)
    assert import_dataset(root, make_mapping(), tmp_path / 'out').made == [0, 1]


@pytest.mark.parametrize('kind', ['v2.1', 'v3.0'])
def test_a_folder_of_videos_with_another_name_is_named(copied, make_mapping, tmp_path, kind):
    root = copied(kind)
    (root / 'videos').rename(root / 'video')
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    said = summary.failed[0]
    assert "; 'video/" in said and "is: correct 'video_path' in 'meta/info.json'" in said


def test_as_many_frames_as_rows_belong_to_each_other_at_whatever_rate(
    copied, make_mapping, tmp_path
):
    """Rows have the times of a clock, the video the rate that the converter was given."""
    root = copied('v2.1')
    for number, file in enumerate(sorted((root / 'data').rglob('*.parquet'))):
        table = parquet.read_table(file)
        times = np.arange(table.num_rows) * 0.117 + 0.003 * (np.arange(table.num_rows) % 3)
        at = table.column_names.index('timestamp')
        parquet.write_table(table.set_column(at, 'timestamp', [times]), file)
        assert number < 2
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    said = "view 'front': 12 frames last 1.10 s by the video and 1.29 s by the rows: frame k is"
    assert sum(said in line for line in summary.warnings[0]) == 1
    path = tmp_path / 'out/episode_000000'
    np.testing.assert_allclose(shown(path, 'front'), 20 + 16 * np.arange(12), atol=3)
    stamps = read_episode(path, with_cameras=False).images['front'].stamps_ns
    assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(11 * 0.117 + 0.006, abs=1e-6)
    # the page on which boxes are drawn shows the same frames
    data, mapping = LeRobotDataset(root), load_mapping(make_mapping())
    frames = read_frames(data, data.episodes[0], mapping).images['front'].frames
    assert float(frames[7].mean()) == pytest.approx(20 + 16 * 7, abs=3)


def test_a_video_with_times_of_its_own_is_not_matched_by_number(copied, make_mapping, tmp_path):
    root = copied('v2.1')
    video = next((root / 'videos').rglob('observation.images.front/episode_000000.mp4'))
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format='rgb24') for frame in container.decode(video=0)]
    with av.open(str(video), 'w') as container:
        stream = container.add_stream('libx264', rate=1000)
        stream.width, stream.height, stream.pix_fmt = 64, 48, 'yuv420p'
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format='rgb24')
            picture.pts = 100 * number + (400 if number > 5 else 0)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    summary = import_dataset(root, make_mapping(), tmp_path / 'out', episodes=[0])
    assert 'has no frame at 0.6000 s' in summary.failed[0]


def test_commands_without_columns_of_their_own_have_those_of_the_state(
    datasets, make_mapping, tmp_path
):
    expected = import_dataset(datasets('v2.1'), make_mapping(), tmp_path / 'given')
    short = make_mapping((ACTION, ''))
    summary = import_dataset(datasets('v2.1'), short, tmp_path / 'out')
    assert summary.made == expected.made == [0, 1]
    for name in ('episode_000000', 'episode_000001'):
        found, given = (
            read_episode(tmp_path / folder / name, with_cameras=False).trajectories
            for folder in ('out', 'given')
        )
        assert len(found) == len(given) > 1
        for (_, one), (_, other) in zip(found, given, strict=True):
            np.testing.assert_array_equal(one.positions, other.positions)


def test_a_unit_of_commands_means_columns_that_are_named_like_joints(
    datasets, make_mapping, tmp_path
):
    mapping = make_mapping((ACTION, '  unit: deg\n'))
    summary = import_dataset(datasets('v2.1'), mapping, tmp_path / 'out')
    assert "feature 'action' has no column 'shoulder'" in summary.failed[0]


def test_one_reason_of_many_episodes_is_one_line(datasets, make_mapping, tmp_path, capsys):
    mapping = make_mapping((ACTION, '  unit: deg\n'))
    out = tmp_path / 'out'
    arguments = [str(datasets('v2.1')), '--mapping', str(mapping), '--out', str(out)]
    assert main(['import', 'lerobot', *arguments]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if 'no column' in line]
    assert len(lines) == 1 and lines[0].startswith('episode 0, episode 1: ')


def test_names_of_many_recordings_are_a_list_below_what_is_said_of_them(capsys):
    summary = ImportSummary[int](
        failed=dict.fromkeys(range(40), 'the same fault') | {40: 'another fault'},
        warnings={0: ('odd',), 1: ('odd',)},
    )
    assert _import_status(summary, lambda number: f'episode {number}') == 1
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == ['episode 0, episode 1: odd', '40 recordings: the same fault']
    assert said[-1] == 'episode 40: another fault'
    listed = said[2:-1]
    assert all(line.startswith('    episode') and len(line) < 100 for line in listed)
    names = ' '.join(line.strip() for line in listed).split(', ')
    assert names == [f'episode {number}' for number in range(40)]


#: an arm with the joints of an SO-101; its shape does not matter here
SO101 = """
name: so101
dh:
  - arm: arm
    joints:
      - {joint: shoulder_pan, a: 0.03, alpha: 1.57, d: 0.1, lower: -1.92, upper: 1.92}
      - {joint: shoulder_lift, a: 0.11, alpha: 0, d: 0, lower: -1.745, upper: 1.745}
      - {joint: elbow_flex, a: 0.13, alpha: 0, d: 0, lower: -1.69, upper: 1.69}
      - {joint: wrist_flex, a: 0.06, alpha: 1.57, d: 0, lower: -1.658, upper: 1.658}
      - {joint: wrist_roll, a: 0, alpha: 0, d: 0.1, lower: -2.744, upper: 2.841}
    gripper: {joint: gripper, lower: -0.1745, upper: 1.745}
tools: [{arm: arm, link: wrist_roll_link, gripper_joint: gripper, gripper_closed: -0.1745,
         gripper_open: 1.745}]
"""


def test_the_mapping_of_an_so101_reads_degrees_and_the_share_of_the_gripper(copied, tmp_path):
    root = copied('v3.0')
    motors = ['shoulder_pan', 'shoulder_lift', 'elbow_flex', 'wrist_flex', 'wrist_roll', 'gripper']
    named = {'dtype': 'float32', 'shape': [6], 'names': [f'{motor}.pos' for motor in motors]}
    change_info(
        root, lambda info: info['features'].update({'observation.state': named, 'action': named})
    )
    rows = [[10.0, -30.0 + k, 45.0, 98.0, -90.0, 5.0 * (k % 20)] for k in range(21)]
    file = next((root / 'data').rglob('*.parquet'))
    table = parquet.read_table(file).drop_columns(['observation.state', 'action'])
    table = table.append_column('observation.state', [rows]).append_column('action', [rows])
    parquet.write_table(table, file)
    shutil.copy(share_path('config', 'datasets', 'so101.yaml'), tmp_path / 'mapping.yaml')
    (tmp_path / 'so101.yaml').write_text(SO101)
    summary = import_dataset(root, tmp_path / 'mapping.yaml', tmp_path / 'out', episodes=[0])
    assert not summary.failed
    positions = read_episode(
        tmp_path / 'out/episode_000000', with_cameras=False
    ).joint_states.positions
    np.testing.assert_allclose(np.rad2deg(positions[:, :5]), np.array(rows)[:12, :5], atol=1e-4)
    share = np.array(rows)[:12, 5] / 100
    np.testing.assert_allclose(positions[:, 5], -0.1745 + 1.9195 * share, atol=1e-6)
