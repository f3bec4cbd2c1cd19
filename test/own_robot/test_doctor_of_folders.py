"""`mtv-world check FOLDER`: each kind of bad recording is named, with its episode."""

from dataclasses import replace
import json
from pathlib import Path
import shutil

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.data_types import JointTrajectory, WorldModelSpec
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.inspection.folder import (
    broken_parts,
    folder_markdown,
    folder_text,
    FolderInspection,
    inspect_folder,
    table,
)
from mtv_world_ros.inspection.inspect import Inspector
from mtv_world_ros.inspection.inspection_report import (
    EXIT_STATUS,
    Inspection,
    not_checked,
    Section,
    suspicious,
    to_json,
    to_text,
)
from mtv_world_ros.inspection.motion_residual import ResidualSearch
from mtv_world_ros.inspection.stored_masks import check_masks
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.training.training_run import check_recording
from test.support.crane import (
    FPS,
    load,
    looking_at,
    make_cameras,
    make_positions,
    render,
    START_NS,
    write_robot,
)

SECONDS = 3.0
QUICK = ResidualSearch(lags_s=(0.0,), rolls_deg=(), zooms=())


def write(path, robot, camera, positions, frames, *, states=None, every=1, spare=0):
    """An episode of one view whose parts may contradict each other.

    `states` are recorded in place of the positions, of the frames every n-th, and joint states
    go on for some rows after the last frame.
    """
    states = positions if states is None else states
    with EpisodeWriter(
        path, task='', instruction='move', robot=robot.name, cameras=[camera]
    ) as writer:
        stamps = [START_NS + round(k * 1e9 / FPS) for k in range(len(positions) + spare)]
        times = np.arange(1, len(positions)) / FPS
        plan = JointTrajectory(joint_names=robot.joint_names, times=times, positions=states[1:])
        writer.write_trajectory(stamps[0], plan)
        for k, stamp in enumerate(stamps):
            row = states[min(k, len(states) - 1)]
            writer.write_joint_states(stamp, robot.joint_names, row)
            if k < len(positions) and k % every == 0:
                writer.write_camera_info(camera.view, stamp, camera)
                writer.write_image(camera.view, stamp, np.ascontiguousarray(frames[k]))


def load_longer(folder):
    """The robot with longer arms, as another URDF would have them."""
    file = write_robot(folder)
    urdf = file.with_suffix('.urdf')
    text = urdf.read_text().replace('xyz="0 0 0.36"', 'xyz="0 0 0.5"')
    urdf.write_text(text.replace('xyz="0 0 0.3"', 'xyz="0 0 0.42"'))
    return load_robot(file)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Robot and a folder: two good episodes, and one of each kind of bad ones."""
    place = tmp_path_factory.mktemp('folder')
    robot = load(place)
    camera = make_cameras()['door']
    data = place / 'data'
    for number in (0, 1):
        positions = make_positions(SECONDS, seed=number)
        write(data / f'good{number}', robot, camera, positions, render(robot, camera, positions))
    positions = make_positions(SECONDS, seed=2)
    frames = render(robot, camera, positions)

    def bad(name, shown=frames, **more):
        write(data / name, robot, camera, positions, shown, **more)

    bad('degrees', states=np.degrees(positions))
    bad('frozen', np.repeat(frames[:1], len(frames), axis=0))
    bad('longer', spare=round(4 * FPS))
    bad('mirrored', frames[:, :, ::-1])
    bad('upside', frames[:, ::-1, ::-1])
    bad('slow', every=FPS)
    noise = np.random.default_rng(0).normal(0, 4, frames.shape)
    empty = np.median(frames, axis=0) + noise  # the arm is elsewhere
    bad('unseen', np.clip(empty, 0, 255).astype(np.uint8))
    other = make_cameras()['window']
    bad('mixed', render(robot, other, positions))
    longer = load_longer(place / 'longer_arm')
    bad('urdf', render(longer, camera, positions))
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
    moved = replace(camera, T_mount_camera=camera.T_mount_camera @ turn)
    write(data / 'moved', robot, moved, positions, render(robot, moved, positions))
    return robot, data


@pytest.fixture(scope='module')
def inspected(folder):
    """What is found in the folder, and as text."""
    robot, data = folder
    inspector = Inspector(robot, load_shape(robot), QUICK)
    found, pictures = inspect_folder(list_episodes(data), inspector, read_episode)
    assert set(pictures) == set(found.episodes)
    return found, folder_text(found)


@pytest.mark.parametrize(
    ('name', 'verdict', 'said'),
    [
        ('degrees', 'broken', 'outside its limits'),
        ('frozen', 'broken', 'show the same picture for more than'),
        ('longer', 'suspicious', 'after the last frame'),
        ('mirrored', 'broken', 'image mirrored left to right'),
        ('upside', 'broken', 'image turned by 180 degrees'),
        ('slow', 'suspicious', '1 frames a second'),
        ('unseen', 'broken', 'does not move like the drawn robot'),
        ('mixed', 'broken', 'shares no background with any other episode'),
        ('urdf', 'broken', 'check K, T_mount_camera and the tool offset'),
    ],
)
def test_what_is_wrong_is_named_in_its_own_row(inspected, name, verdict, said):
    found, text = inspected
    rows = [line for line in text.splitlines() if line.startswith(f'{name} ')]
    assert any(said in row and verdict in row for row in rows), rows


@pytest.mark.parametrize('name', ['mirrored', 'upside'])
def test_turned_pictures_are_said_without_what_follows_from_them(inspected, name):
    """Focal lengths and delays fit turned pictures by chance."""
    found, _ = inspected
    (view,) = found.episodes[name].views
    assert not [t for t in view.wrong if 'focal length' in t or 's later' in t or 'px beside' in t]


@pytest.mark.slow
def test_pictures_of_something_else_are_not_called_mirrored(inspected):
    """Of two unrelated motions one always correlates more; .02 against -.05 says nothing."""
    found, _ = inspected
    for name in ('mixed', 'unseen', 'slow', 'longer'):
        said = [str(finding) for view in found.episodes[name].views for finding in view.findings]
        assert not [text for text in said if 'moves like the image' in text], said


@pytest.mark.slow
def test_training_is_told_what_is_broken(inspected):
    found, _ = inspected
    parts = broken_parts(found)
    assert parts['good0'] == parts['good1'] == parts['slow'] == {}
    for name in ('frozen', 'mirrored', 'unseen', 'mixed', 'urdf'):
        assert 'door' in parts[name], name
    assert 'outside its limits' in ' '.join(parts['degrees'].values())


@pytest.mark.slow
def test_good_episodes_are_not_blamed(inspected):
    found, text = inspected
    for name in ('good0', 'good1'):
        assert found.episodes[name].verdict == 'ok', text


@pytest.mark.slow
def test_a_moved_camera_and_who_belongs_where_are_named(inspected):
    found, text = inspected
    assert found.place('door', 'good0') == found.place('door', 'good1')
    assert found.place('door', 'moved') != found.place('door', 'good0')
    line = next(line for line in text.splitlines() if 'the camera stands at' in line)
    assert 'moved' in line and line.startswith('suspicious')
    assert found.verdict == 'broken'


@pytest.mark.slow
def test_another_scene_before_the_right_camera_is_no_fault(tmp_path):
    """Nothing of the background is that of the others, but the robot moves as it is drawn."""
    robot, camera = load(tmp_path), make_cameras()['door']
    for number, name in enumerate(('good0', 'good1', 'painted')):
        positions = make_positions(SECONDS, seed=number)
        frames = render(robot, camera, positions)
        if name == 'painted':
            empty = np.median(frames, axis=0).astype(np.uint8)
            other = np.random.default_rng(0).integers(90, 190, (24, 32, 3)).astype(np.uint8)
            other = other.repeat(10, axis=0).repeat(10, axis=1)
            frames = np.where((frames == empty).all(axis=-1, keepdims=True), other, frames)
        write(tmp_path / 'data' / name, robot, camera, positions, frames)
    inspector = Inspector(robot, load_shape(robot), QUICK)
    found, _ = inspect_folder(list_episodes(tmp_path / 'data'), inspector, read_episode)
    text = folder_text(found)
    assert found.verdict == 'ok', text
    assert "painted: view 'door' shares no background" in text and 'another scene' in text


def test_what_was_not_checked_is_said_once_with_its_episodes():
    wrist = Section(name='wrist', findings=(not_checked('pose not known'),))
    rest = Section(name='recording')
    episode = Inspection(episode=Path('a'), robot='', views=(wrist,), recording=rest)
    found = FolderInspection(
        episodes={'a': episode, 'b': episode}, failed={}, places={}, members={}, findings=()
    )
    assert 'not checked in a b: wrist: pose not known' in folder_text(found).splitlines()
    assert '- not checked in a b: wrist: pose not known' in folder_markdown(found, '').splitlines()


def test_numbers_of_two_good_views_are_not_hidden_by_a_camera_that_is_not_known():
    """A row a view; what is wrong stands apart from what could not be checked."""
    numbers = {'residual_px': 1.26, 'match': 0.8, 'delay_s': 0.0}
    views = (
        Section(name='ext1', numbers=numbers),
        Section(
            name='ext2', numbers=numbers, findings=(suspicious('late'), not_checked('only rods')),
        ),
        Section(name='wrist', findings=(not_checked('pose not known'),)),
    )  # fmt: skip
    episode = Inspection(
        episode=Path('a'), robot='', views=views, recording=Section(name='recording')
    )
    found = FolderInspection(
        episodes={'a': episode}, failed={'b': 'no bag'}, places={}, members={}, findings=()
    )
    assert [row[:6] for row in table(found)] == [
        ['episode', 'view', 'verdict', 'residual [px]', 'match', 'delay [s]'],
        ['a', 'ext1', 'ok', '1.3', '0.80', '+0.0'],
        ['a', 'ext2', 'suspicious', '1.3', '0.80', '+0.0'],
        ['a', 'wrist', 'not checked', '-', '-', '-'],
        ['b', '-', 'broken', '-', '-', '-'],
    ]
    assert [row[-1] for row in table(found)] == ['wrong', '', 'late', '', 'no bag']
    text = folder_text(found)
    assert '3 views: 1 ok, 1 not checked, 1 suspicious' in text.splitlines()
    values = to_json(found.episodes, found.failed)
    assert values['a']['views']['ext1'] == {
        'verdict': 'ok', **numbers, 'wrong': [], 'not_checked': []
    }  # fmt: skip
    assert values['a']['views']['ext2']['wrong'] == ['late']
    assert values['a']['views']['ext2']['not_checked'] == ['only rods']
    wrist = values['a']['views']['wrist']
    assert (wrist['residual_px'], wrist['not_checked']) == (None, ['pose not known'])
    assert values['b']['recording']['wrong'] == ['no bag']
    assert to_text(episode).splitlines()[1].split() == ['ext1', 'ok', '1.3', '0.80', '+0.0']
    unknown_alone = replace(episode, views=(views[0], views[2]))
    assert EXIT_STATUS[unknown_alone.verdict] == 3 and EXIT_STATUS[episode.verdict] == 1


@pytest.mark.slow
@pytest.mark.parametrize('has_own_pose', [True, False])
def test_a_moved_camera_is_a_fault_only_with_the_pose_of_before(folder, tmp_path, has_own_pose):
    robot, data = folder
    for name in ('good0', 'good1'):
        (tmp_path / name).symlink_to(data / name)
    if has_own_pose:
        (tmp_path / 'moved').symlink_to(data / 'moved')
    else:
        shutil.copytree(data / 'moved', tmp_path / 'moved')
        shutil.copy(data / 'good0' / 'calibration.yaml', tmp_path / 'moved')
    inspector = Inspector(robot, load_shape(robot), QUICK)
    found, _ = inspect_folder(list_episodes(tmp_path), inspector, read_episode)
    line = folder_text(found).splitlines()[-1]
    assert 'the camera stands at 2 places (good0 good1; moved)' in line
    if has_own_pose:
        assert found.verdict == 'ok' and line.startswith('view')
    else:
        assert 'moved has the pose of good0' in line and line.startswith('suspicious')


@pytest.mark.parametrize(
    ('rows', 'said'),
    [((0, 6), ''), ((0, 0), 'is found in 0% of the frames'), ((0, 40), 'more than 15%')],
)
def test_masks_of_an_import_that_cannot_be_the_object_are_named(tmp_path, rows, said):
    robot, camera = load(tmp_path), make_cameras()['door']
    ids = np.zeros((camera.height, camera.width), np.uint8)
    ids[rows[0] : round(rows[1] / 40 * camera.height)] = 1
    ids[:, camera.width // 2 :] = 0
    with EpisodeWriter(
        tmp_path / 'one', task='', instruction='move', robot=robot.name, cameras=[camera],
        objects=['blue block'], metadata={'masks_by': 'colour'},
    ) as writer:  # fmt: skip
        for stamp in (START_NS, START_NS + 10**9):
            writer.write_image(camera.view, stamp, np.zeros((*ids.shape, 3), np.uint8))
            writer.write_mask(camera.view, stamp, ids)
    measures, findings = check_masks(read_episode(tmp_path / 'one', with_cameras=False))
    assert measures == {'blue block, seen in': f'door {100 if rows[1] else 0}%'}
    assert [said in finding.text for finding in findings] == [True] * bool(said)


def test_a_gripper_with_open_and_closed_swapped_is_named(tmp_path):
    robot = load(tmp_path)
    near = looking_at((0.95, 0.3, 1.1), (0.6, 0.12, 0.65))
    camera = replace(make_cameras()['door'], T_mount_camera=near)
    moves = make_positions(4.0, seed=0)
    moves[:, :5] = moves.mean(0)[:5] + 0.3 * (moves - moves.mean(0))[:, :5]
    swapped = moves.copy()
    swapped[:, 5] = 0.04 - moves[:, 5]  # of 0 .. 0.04
    frames = render(robot, camera, moves)
    write(tmp_path / 'data' / 'right', robot, camera, moves, frames)
    write(tmp_path / 'data' / 'swapped', robot, camera, moves, frames, states=swapped)
    inspector = Inspector(robot, load_shape(robot), QUICK)
    found, _ = inspect_folder(list_episodes(tmp_path / 'data'), inspector, read_episode)
    text = folder_text(found)
    for line in text.splitlines()[1:]:
        said = "fingers move like those of 'jaw_left' with open and closed swapped" in line
        assert said == line.startswith('swapped  door'), text


def test_the_command_writes_a_table_and_a_picture(folder, tmp_path, capsys):
    robot, data = folder
    few = tmp_path / 'few'
    few.mkdir()
    for name in ('good0', 'frozen'):
        (few / name).symlink_to(data / name)
    command = ['check', str(few), '--robot', str(robot.file), '--out', str(tmp_path / 'report')]
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert 'good0' in printed and 'frozen' in printed and 'broken: see' in printed
    assert (tmp_path / 'report' / 'episodes.png').is_file()
    assert '| frozen | door | broken |' in (tmp_path / 'report' / 'report.md').read_text()
    values = json.loads((tmp_path / 'report' / 'check.json').read_text())
    assert (values['verdict'], values['exit_status']) == ('broken', 1)
    good = values['episodes']['good0']['views']['door']
    assert good['verdict'] == 'ok' and good['residual_px'] < 3 and good['match'] > 0.5
    assert values['episodes']['frozen']['views']['door']['wrong']


def test_training_leaves_out_what_would_teach_nonsense(folder):
    robot, data = folder
    spec = WorldModelSpec(
        views=('door',), width=64, height=48, num_frames=4, fps=5.0, robot='crane'
    )
    reasons = {}
    for name in ('good0', 'degrees', 'frozen'):
        recording = load_recording(data / name, spec, robot)
        try:
            check_recording(recording, robot)
        except MtvWorldError as error:
            reasons[name] = str(error)
    assert set(reasons) == {'degrees', 'frozen'}
    assert 'its limits are' in reasons['degrees'] and "view 'door'" in reasons['frozen']


def test_training_leaves_out_a_view_that_never_sees_the_arm(folder):
    robot, data = folder
    spec = WorldModelSpec(
        views=('door',), width=64, height=48, num_frames=4, fps=5.0, robot='crane'
    )
    recording = load_recording(data / 'good0', spec, robot)
    check_recording(recording, robot)
    (camera,) = recording.cameras
    about = camera.T_mount_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])  # it looks away
    turned = replace(recording, cameras=(replace(camera, T_mount_camera=about),))
    with pytest.raises(EpisodeError, match="'door' never sees the arm.*--views"):
        check_recording(turned, robot)
