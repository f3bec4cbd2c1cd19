"""LeRobot datasets become episodes: same frames, times, joints, commands and words."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import termios

import numpy as np
import pytest

pytest.importorskip('pyarrow', reason='pyarrow is not installed (pip install .[import])')

from pyarrow import compute, parquet

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError, EpisodeError, MtvWorldError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.lerobot_episodes import import_dataset
from mtv_world_ros.importing.video_frames import frames_at
from mtv_world_ros.vision.segmenters.examples import ObjectExamples

START_NS = 1_000_000_000
KINDS = ('v2.0', 'v2.1', 'v3.0', 'v3.0, unnamed index', 'images')


def imported(dataset: Path, mapping: Path, out: Path, number: int = 0):
    summary = import_dataset(dataset, mapping, out)
    assert summary.failed == {}
    return read_episode(out / f'episode_{number:06d}')


def expected_positions(episode: int, rows: np.ndarray) -> np.ndarray:
    """From conftest's `state`: degrees, a turned joint with another zero, percent closed."""
    shoulder = np.radians(3.0 * rows + episode)
    elbow = 0.5 - (0.1 * rows - 0.2)
    gripper = 0.04 * (5.0 * rows / 100)
    return np.stack([shoulder, elbow, gripper], axis=1)


@pytest.mark.parametrize('kind', KINDS)
def test_every_format_gives_the_same_episode(kind, datasets, make_mapping, tmp_path):
    episode = imported(datasets(kind), make_mapping(), tmp_path / 'out', 1)
    assert episode.warnings == ()
    track = episode.images['front']
    assert (track.stamps_ns - START_NS) * 1e-9 == pytest.approx(np.arange(9) / 10, abs=2e-6)
    frames = np.asarray(track.frames)
    assert frames.shape == (9, 48, 64, 3)
    levels = frames.mean(axis=(1, 2, 3))
    assert levels == pytest.approx(23 + 16 * np.arange(9), abs=4)  # the second episode's own
    states = episode.joint_states
    assert states.joint_names == ('shoulder', 'elbow', 'gripper')
    assert states.positions == pytest.approx(expected_positions(1, np.arange(9)), abs=1e-6)
    assert np.array_equal(states.stamps_ns, track.stamps_ns)


def test_actions_become_chunks_that_are_reached_one_row_later(datasets, make_mapping, tmp_path):
    episode = imported(datasets('v2.1'), make_mapping(), tmp_path / 'out')
    stamps = [(stamp - START_NS) / 1e9 for stamp, _ in episode.trajectories]
    assert stamps == pytest.approx([0.0, 0.5, 1.0], abs=2e-6)
    assert [len(t.times) for _, t in episode.trajectories] == [5, 5, 2]
    assert episode.trajectories[1][1].times == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5], abs=2e-6)
    # the action beside row k is the state of row k + 1
    assert episode.trajectories[1][1].positions == pytest.approx(
        expected_positions(0, np.arange(6, 11)), abs=1e-6
    )


def test_without_joint_actions_the_measured_rows_are_the_commands(
    datasets, make_mapping, tmp_path
):
    mapping = make_mapping(('action:\n  feature: action\n', 'action: state\nignored:\n'))
    text = mapping.read_text()
    mapping.write_text(text[: text.index('ignored:')] + 'chunk_s: 9\n')
    episode = imported(datasets('v2.1'), mapping, tmp_path / 'out')
    ((stamp, trajectory),) = episode.trajectories
    assert stamp == START_NS
    assert trajectory.times == pytest.approx(np.arange(1, 12) / 10, abs=2e-6)
    assert trajectory.positions == pytest.approx(expected_positions(0, np.arange(1, 12)), abs=1e-6)


@pytest.mark.parametrize('kind', KINDS)
def test_boxes_teach_from_the_frame_in_which_they_are_drawn(
    kind, datasets, make_mapping, tmp_path, capsys
):
    """`--objects`, and the page with the first frame of each episode."""
    mapping, page = make_mapping(), tmp_path / 'boxes.html'
    command = ['import', 'lerobot', str(datasets(kind)), '--mapping', str(mapping), '--out']
    assert main([*command, str(tmp_path / 'out'), '--click', str(page)]) == 0
    assert page.read_text().count('data-seconds="0.0"') == 2 and not (tmp_path / 'out').exists()
    box = [0.3, 10, 10, 30, 30]
    values = {'boxes': {'front': {'episode_000001': {'thing': [box]}}}}
    (tmp_path / 'objects.yaml').write_text(json.dumps(values))
    more = ['--objects', str(tmp_path / 'objects.yaml')]
    assert main([*command, str(tmp_path / 'out'), *more, '--episodes', '1']) == 0
    (example,) = ObjectExamples.load(tmp_path / 'out' / 'objects.safetensors').examples
    assert example.frame.mean() == pytest.approx(23 + 16 * 3, abs=4)
    episode = read_episode(tmp_path / 'out' / 'episode_000001')
    assert episode.info.objects == ('thing',) and episode.masks is not None
    values['boxes']['front']['episode_000007'] = {'thing': [box]}
    (tmp_path / 'objects.yaml').write_text(json.dumps(values))
    capsys.readouterr()
    assert main([*command, str(tmp_path / 'other'), *more]) == 0
    printed = capsys.readouterr()
    assert 'episode_000007' in printed.out + printed.err  # of another folder: said, not refused


def test_words_outcome_and_source_are_kept(datasets, make_mapping, tmp_path):
    mapping = make_mapping(
        ('task: stack', 'task: stack\noutcome_feature: next.success\nobjects: [red block]')
    )
    outcomes = []
    for number in (0, 1):
        episode = imported(datasets('v3.0'), mapping, tmp_path / 'out', number)
        outcomes.append(episode.info.outcome)
        assert episode.info.metadata['source_episode'] == str(number)
    assert outcomes == ['success', 'failure']
    assert episode.info.task == 'stack'
    assert episode.info.objects == ('red block',)
    assert episode.info.robot == 'two_joints'
    # the task changes in row 8
    assert [(round((s - START_NS) / 1e8), t) for s, t in episode.instructions] == [
        (0, 'put the red block on the blue block'),
        (8, 'stop'),
    ]


def test_a_calibration_file_is_scaled_to_the_video(datasets, make_mapping, tmp_path):
    camera = imported(datasets('v2.1'), make_mapping(), tmp_path / 'out').cameras['front']
    assert (camera.width, camera.height) == (64, 48)
    # half of 128 x 96; pixel centres at integers: (63.5 + 0.5) / 2 - 0.5 = 31.5
    assert pytest.approx(np.array([[70, 0, 31.5], [0, 70, 23.5], [0, 0, 1.0]])) == camera.K
    assert camera.T_mount_camera[:3, 3] == pytest.approx([0.1, 0.2, 0.3])


def test_training_reads_what_was_imported(datasets, make_mapping, tmp_path):
    from mtv_world_ros.core.data_types import WorldModelSpec
    from mtv_world_ros.data.recording import load_recording
    from mtv_world_ros.data.recordings import clip_starts, cut_clip
    from mtv_world_ros.robot.file import load_robot

    mapping = make_mapping()
    import_dataset(datasets('v3.0'), mapping, tmp_path / 'out')
    spec = WorldModelSpec(
        views=('front',), fps=5, num_frames=3, width=32, height=24, robot='two_joints'
    )
    robot = load_robot(mapping.parent / 'robot.yaml')
    recording = load_recording(tmp_path / 'out/episode_000000', spec, robot)
    clip = cut_clip(recording, int(clip_starts(recording, spec)[2]), spec)
    # rows 2, 4, 6, 8: the command of a frame is what the joints then have
    assert clip.positions == pytest.approx(expected_positions(0, np.array([2, 4, 6, 8])), abs=1e-5)


@pytest.fixture
def broken_dataset(datasets, tmp_path):
    """Its first episode's video is cut in the middle."""
    root = tmp_path / 'broken'
    shutil.copytree(datasets('v2.1'), root)
    video = root / 'videos/chunk-000/observation.images.front/episode_000000.mp4'
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    return root, video, data


def test_a_failed_episode_is_named_and_the_rest_goes_on(
    broken_dataset, make_mapping, tmp_path, capsys
):
    root, video, data = broken_dataset
    out, mapping = tmp_path / 'out', make_mapping()
    arguments = ['import', 'lerobot', str(root), '--mapping', str(mapping), '--out', str(out)]
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert '1 made, 0 kept, 1 failed' in said.out
    assert 'episode 0:' in said.err and 'episode_000000.mp4' in said.err
    names = {path.name for path in out.iterdir()}
    assert names == {'episode_000001', 'robot'}  # no half folder
    video.write_bytes(data)
    assert main(arguments) == 0
    assert '1 made, 1 kept, 0 failed' in capsys.readouterr().out
    assert main([*arguments, '--episodes', '1']) == 0
    assert '0 made, 1 kept, 0 failed' in capsys.readouterr().out


def test_episodes_of_another_mapping_are_not_taken_for_finished(datasets, make_mapping, tmp_path):
    out = tmp_path / 'out'
    import_dataset(datasets('v2.1'), make_mapping(), out, episodes=[1])
    changed = make_mapping(('offset: 0.5', 'offset: 0.4'))
    summary = import_dataset(datasets('v2.1'), changed, out, episodes=[1])
    assert 'another mapping' in summary.failed[1]


def test_a_video_with_a_hole_or_too_short_fails_the_episode(
    datasets, make_mapping, write_video, tmp_path
):
    root = tmp_path / 'holes'
    shutil.copytree(datasets('v2.1'), root)
    folder = root / 'videos/chunk-000/observation.images.front'
    write_video(folder / 'episode_000000.mp4', [50] * 12, skip=4)
    write_video(folder / 'episode_000001.mp4', [50] * 6)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert 'no frame at 0.4000 s: there is one at 0.3000 s' in summary.failed[0]
    assert '3 frames are missing' in summary.failed[1]


def test_joints_in_another_unit_fail_with_advice(datasets, make_mapping, tmp_path):
    mapping = make_mapping(('{column: shoulder.pos, unit: deg}', 'shoulder.pos'))
    summary = import_dataset(datasets('v2.1'), mapping, tmp_path / 'out')
    assert summary.made == []
    assert "joint 'shoulder' is 3 at point 1" in summary.failed[0]
    assert 'are unit, sign, offset' in summary.failed[0]


CAMERA = '{file: a.json, intrinsics: K, extrinsics: T, mount_link: base}'


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('views:', 'view:', "unknown key 'view' (did you mean 'views'?)"),
        ('chunk_s: 0.5', 'chunk_s: -1', "'chunk_s' is -1, must be positive"),
        ('feature: action', 'feature: actions', "no feature 'actions' (did you mean 'action'?)"),
        ('observation.images.front', 'observation.images.fron',
         "no image or video feature 'observation.images.fron' (did you mean"),
        ('    elbow: {column: 1, sign: -1, offset: 0.5}\n', '', "joints ['elbow'] of robot"),
        ('    elbow:', '    elbo:', "unknown key 'elbo' (did you mean 'elbow'?)"),
        ('sign: -1, offset: 0.5}\n    g', 'sign: -2, offset: 0.5}\n    g', "'sign' is -2"),
        ('unit: deg}\n    e', 'unit: degree}\n    e', "'unit' is 'degree' (did you mean 'deg'?)"),
        ('closed: 100, open: 0}\na', 'closed: 100}\na', "do not go together"),
        ('closed: 100, open: 0}\na', 'closed: 1, open: 1}\na', 'both ends of the range are 1'),
        ('calibration: calibration.yaml', 'calibration: cal.yaml', "cal.yaml' does not exist"),
        ('calibration: calibration.yaml',
         f'calibration: calibration.yaml, camera: {CAMERA}', "give either 'calibration'"),
        ('calibration: calibration.yaml', 'calibration: 5', 'must be the name of a file'),
        ('robot: robot.yaml', 'robot: robot.yml', 'robot.yml'),
        ('robot: robot.yaml', 'robot: [1]', 'must be the name of a bundled robot'),
        ('task: stack', 'outcome: won', "outcome 'won' is not one of"),
    ],
)  # fmt: skip
def test_a_wrong_mapping_is_an_error_that_helps(
    old, new, message, datasets, make_mapping, tmp_path
):
    with pytest.raises(MtvWorldError) as caught:
        import_dataset(datasets('v2.1'), make_mapping((old, new)), tmp_path / 'out')
    assert message in str(caught.value)
    assert not (tmp_path / 'out').exists()


def test_an_unknown_column_names_the_nearest(datasets, make_mapping, tmp_path):
    mapping = make_mapping(('column: gripper.pos', 'column: griper.pos'))
    summary = import_dataset(datasets('v2.1'), mapping, tmp_path / 'out')
    assert "no column 'griper.pos' (did you mean 'gripper.pos'?)" in summary.failed[0]


@pytest.mark.parametrize('is_there', [True, False])
def test_a_stale_file_index_is_the_reason(is_there, datasets, make_mapping, tmp_path):
    root = Path(shutil.copytree(datasets('v3.0'), tmp_path / 'set'))
    data = root / 'data/chunk-000/file-000.parquet'
    table = parquet.read_table(data)
    parts = [table.filter(compute.equal(table['episode_index'], k)) for k in (0, 1)]
    parquet.write_table(parts[1], data.with_name('file-001.parquet'))
    parquet.write_table(parts[0], data)
    if not is_there:
        data.rename(data.with_name('file-002.parquet'))
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == ([0] if is_there else [])
    said = summary.failed[1]
    assert ('has 0 rows of episode 1' if is_there else 'is not there') in said
    assert "rows of it are in 'data/chunk-000/file-001.parquet': the file index" in said
    assert 'earlier state of the dataset' in said


@pytest.mark.parametrize('is_there', [True, False])
def test_a_stale_video_index_is_the_reason(is_there, datasets, make_mapping, tmp_path):
    """Videos were split anew, and meta/ still says where they were."""
    root = Path(shutil.copytree(datasets('v3.0'), tmp_path / 'set'))
    video = root / 'videos/observation.images.front/chunk-000/file-000.mp4'
    for episode, name in enumerate(('file-000.mp4', 'file-001.mp4')):
        own = f'videos/chunk-000/observation.images.front/episode_{episode:06d}.mp4'
        shutil.copy(datasets('v2.1') / own, video.with_name(name))
    if not is_there:
        video.rename(video.with_name('file-002.mp4'))
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == ([0] if is_there else [])
    said = summary.failed[1]
    assert ('ends at 1.1000 s' if is_there else 'is not there') in said
    assert "no episode names 'videos/observation.images.front/chunk-000/file-001.mp4'" in said
    assert 'the video index in meta/ is of an earlier state of the dataset' in said


@pytest.mark.slow
def test_bars_with_the_time_left_are_drawn_on_a_terminal_only(datasets, make_mapping, tmp_path):
    command = ['import', 'lerobot', str(datasets('v2.1')), '--mapping', str(make_mapping())]
    words = [sys.executable, '-m', 'mtv_world_ros.cli', *command]
    main_end, process_end = os.openpty()
    termios.tcsetwinsize(process_end, (24, 100))
    shown = subprocess.run(
        [*words, '--out', str(tmp_path / 'seen')], stderr=process_end, check=True
    )
    os.close(process_end)
    drawn = os.read(main_end, 1 << 16).decode()
    assert shown.returncode == 0 and re.search(r'2/2 \[\d\d:\d\d<\d\d:\d\d', drawn), drawn
    piped = subprocess.run(
        [*words, '--out', str(tmp_path / 'log')], capture_output=True, text=True, check=True
    )
    assert '2/2' not in piped.stderr and '%|' not in piped.stderr


def test_what_is_no_readable_dataset_is_refused(datasets, make_mapping, tmp_path):
    with pytest.raises(EpisodeError, match='is no LeRobot dataset'):
        import_dataset(tmp_path, make_mapping(), tmp_path / 'out')
    root = tmp_path / 'old'
    shutil.copytree(datasets('v2.1'), root)
    info = root / 'meta/info.json'
    info.write_text(info.read_text().replace('"v2.1"', '"v1.6"'))
    with pytest.raises(EpisodeError, match=r"format 'v1.6'; readable are v2.0, v2.1, v3.0"):
        import_dataset(root, make_mapping(), tmp_path / 'out')
    info.write_text(info.read_text().replace('"v1.6"', '"v2.1"').replace('data/chunk', '../x'))
    with pytest.raises(EpisodeError, match='outside the dataset'):
        import_dataset(root, make_mapping(), tmp_path / 'out')
    with pytest.raises(ConfigError, match='has no episode 7; it has 2, from 0 to 1'):
        import_dataset(datasets('v2.1'), make_mapping(), tmp_path / 'out', episodes=[7])


def test_without_pyarrow_the_error_says_how_to_get_it(
    datasets, make_mapping, tmp_path, monkeypatch
):
    root = datasets('v2.1')
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    with pytest.raises(ConfigError, match=r"pip install 'mtv_world_ros\[import\]'"):
        import_dataset(root, make_mapping(), tmp_path / 'out')


def test_columns_that_are_named_like_the_joints_need_no_mapping(
    datasets, make_mapping, tmp_path, capsys
):
    folder = make_mapping().parent
    robot = (folder / 'robot.yaml').read_text()
    for old, new in (('shoulder', 'shoulder.pos'), ('elbow', 'elbow.pos')):
        robot = robot.replace(f'joint: {old}', f'joint: {new}').replace(
            f'{old}_link', f'{new}_link'
        )
    robot = robot.replace('joint: gripper', 'joint: gripper.pos').replace('2}', '200}')
    robot = robot.replace('upper: 0.04', 'upper: 200').replace('lower: -2', 'lower: -200')
    (folder / 'robot.yaml').write_text(robot)
    command = ['import', 'lerobot', str(datasets('v3.0')), '--out', str(tmp_path / 'out')]
    assert main(command) == 1
    assert 'give --mapping' in capsys.readouterr().err
    files = ['--robot', str(folder / 'robot.yaml')]
    files += ['--calibration', str(folder / 'calibration.yaml')]
    assert main([*command, *files]) == 0, capsys.readouterr().err
    assert '(images of no view of the mapping)' in capsys.readouterr().err
    episode = read_episode(tmp_path / 'out' / 'episode_000000')
    assert list(episode.views) == ['front'] and episode.trajectories
    states = episode.joint_states
    assert states.joint_names == ('shoulder.pos', 'elbow.pos', 'gripper.pos')
    assert states.positions[3] == pytest.approx([9.0, 0.1, 85.0], abs=1e-5)
    assert (tmp_path / 'out' / 'robot' / 'robot.yaml').is_file()
    again = ['--mapping', str(tmp_path / 'out' / 'mapping.yaml')]
    assert main([*command, *again]) == 0
    assert '0 made, 2 kept' in capsys.readouterr().out


@pytest.mark.parametrize(
    'mark',
    [
        {'info': {'is_depth_map': True}},
        {'info': {'video.is_depth_map': True}},
        {'video_info': {'video.is_depth_map': True}},
        {'is_depth_map': True},
    ],
)
@pytest.mark.parametrize('kind', ['v2.1', 'v3.0', 'images'])
def test_a_depth_map_is_no_view_and_the_colour_cameras_are_named(
    kind, mark, datasets, make_mapping, tmp_path
):
    root = Path(shutil.copytree(datasets(kind), tmp_path / 'set'))
    file = root / 'meta/info.json'
    described = json.loads(file.read_text())
    described['features']['observation.images.front'] |= mark
    file.write_text(json.dumps(described))
    with pytest.raises(ConfigError, match='is a depth map .* observation.images'):
        import_dataset(root, make_mapping(), tmp_path / 'out')


def test_a_camera_that_is_said_to_be_no_depth_map_is_one(datasets, make_mapping, tmp_path):
    root = Path(shutil.copytree(datasets('v2.1'), tmp_path / 'set'))
    file = root / 'meta/info.json'
    described = json.loads(file.read_text())
    described['features']['observation.images.front']['info'] = {'video.is_depth_map': False}
    file.write_text(json.dumps(described))
    assert import_dataset(root, make_mapping(), tmp_path / 'out').made


def test_reports_9_and_10_times_of_hardware_find_their_frames_or_are_named(write_video, tmp_path):
    """Of docs/importing_cases.md; by the frame number times would be those of other frames."""
    levels = list(range(20, 200, 15))
    write_video(tmp_path / 'v.mp4', levels)
    period = 0.1
    times = period * (np.arange(len(levels)) + np.resize([0.2, -0.2, 0.1], len(levels)))
    found = [frame.mean() for frame in frames_at(tmp_path / 'v.mp4', times, period / 4)]
    np.testing.assert_allclose(found, levels, atol=4)
    with pytest.raises(EpisodeError, match='has no frame at'):
        list(frames_at(tmp_path / 'v.mp4', times[:5] + period * 0.4, period / 4))
    with pytest.raises(EpisodeError, match='3 frames are missing'):
        more = np.append(times, times[-1] + period * np.arange(1, 4))
        list(frames_at(tmp_path / 'v.mp4', more, period / 4))


def test_a_table_of_too_many_values_is_refused_before_it_is_read(datasets, monkeypatch):
    """A file of 20 kB may state hundreds of millions of equal rows."""
    dataset = LeRobotDataset(datasets('v3.0'))
    entry = dataset.episodes[0]
    count = parquet.read_metadata(entry.data_file).num_rows * 3  # with frame and episode index
    monkeypatch.setenv('MTV_WORLD_MAX_TABLE_VALUES', str(count))
    dataset.rows(entry, ['timestamp'])
    monkeypatch.setenv('MTV_WORLD_MAX_TABLE_VALUES', str(count - 1))
    with pytest.raises(EpisodeError, match=rf'has {count} values; at most .*TABLE_VALUES'):
        dataset.rows(entry, ['timestamp'])


@pytest.mark.parametrize('fps', [0, -5, 1e-400, 1e6, float('nan'), 'x', None])
def test_a_rate_that_no_recording_has_is_named(datasets, fps, tmp_path):
    folder = shutil.copytree(datasets('v2.1'), tmp_path / 'x')
    info = json.loads((folder / 'meta/info.json').read_text()) | {'fps': fps}
    (folder / 'meta/info.json').write_text(json.dumps(info))
    with pytest.raises(EpisodeError, match='fps is|float|convert'):
        LeRobotDataset(folder)
