"""Cameras that are written into episodes: what other readers find, and that nothing is lost."""

from collections import Counter

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores

from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.core.data_types import CameraModel, JointTrajectory
from mtv_world_ros.core.errors import CalibrationError, EpisodeError
from mtv_world_ros.core.files import content_digest
from mtv_world_ros.data import episode_cameras
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode import UNKNOWN_CAMERAS
from mtv_world_ros.data.episode_cameras import is_imported, views_without_info, write_cameras
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.inspection.cameras import shared_camera
from mtv_world_ros.inspection.cameras.shared_estimate import SharedEstimate
from mtv_world_ros.inspection.motion_residual import MotionResidual
from mtv_world_ros.inspection.places import CameraPlaces
from mtv_world_ros.robot.file import load_robot, robot_path

START_NS, PERIOD_NS, FRAMES, SIZE = 10**18, 2 * 10**8, 5, (64, 48)
WIDTH, HEIGHT = SIZE


def camera(view, focal=70.0, x=0.3, size=SIZE):
    pose = np.array([[1, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]], float)
    K = np.array([[focal, 0, size[0] / 2], [0, focal + 2, size[1] / 2], [0, 0, 1]])
    return CameraModel(
        view=view, width=size[0], height=size[1], K=K, mount_link='table', T_mount_camera=pose,
        distortion_model='plumb_bob', distortion=np.array([-0.1, 0.02, 0, 0, 0]),
    )  # fmt: skip


def write(path, infos=(), cameras=()):
    """An episode of a Franka with two views, as an import of videos leaves it."""
    robot = load_robot(robot_path('franka'))
    rest = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8, 0.02])
    unknown = {UNKNOWN_CAMERAS: 'door, side'}
    with EpisodeWriter(path, task='', instruction='lift it', robot='franka', metadata=unknown,
                       cameras=cameras, objects=('cup',)) as writer:  # fmt: skip
        writer.outcome = 'failure'
        writer.write_instruction(START_NS)
        for k in range(FRAMES):
            stamp = START_NS + k * PERIOD_NS
            writer.write_joint_states(stamp, robot.joint_names, rest + 0.01 * k)
            for view in ('door', 'side'):
                for info in (one for one in infos if one.view == view):
                    writer.write_camera_info(view, stamp, info)
                writer.write_image(view, stamp, np.full((HEIGHT, WIDTH, 3), 20 * k, np.uint8))
                writer.write_mask(view, stamp, np.zeros((HEIGHT, WIDTH), np.uint8))
        plan = JointTrajectory(
            joint_names=robot.joint_names, times=np.array([0.5]), positions=rest[None]
        )
        writer.write_trajectory(START_NS, plan)
    return path


def static_poses(path):
    """Parent, translation and quaternion of each frame of the only message of /tf_static."""
    ((_, message),) = found_by_rosbags(path, '/tf_static')
    poses = {}
    for one in message.transforms:
        place, turn = one.transform.translation, one.transform.rotation
        poses[one.child_frame_id] = (
            one.header.frame_id,
            [place.x, place.y, place.z],
            [turn.x, turn.y, turn.z, turn.w],
        )
    return poses


def test_tf_has_the_poses_of_written_cameras_as_of_a_robot_that_publishes_them(tmp_path):
    path = write(tmp_path / 'e')
    assert write_cameras(path, {'door': camera('door')})
    # a camera that looks down: half a turn about x
    expected = ('table', pytest.approx([0.3, 0, 1]), pytest.approx([1, 0, 0, 0]))
    assert static_poses(path) == {'door_optical_frame': expected}
    assert not write_cameras(path, {'door': camera('door')})
    assert write_cameras(path, {'side': camera('side', x=0.7)})
    assert write_cameras(path, {'door': camera('door', x=0.4)})
    poses = static_poses(path)
    assert sorted(poses) == ['door_optical_frame', 'side_optical_frame']
    assert poses['door_optical_frame'][1][0] == pytest.approx(0.4)
    metadata = (path / 'metadata.yaml').read_text()
    name = metadata.index('name: /tf_static')
    assert 'durability: transient_local' in metadata[name : name + 600]
    # without the file, the poses are those of TF
    (path / 'calibration.yaml').unlink()
    found = read_episode(path).cameras
    assert found['door'].mount_link == 'table'
    np.testing.assert_allclose(found['side'].T_mount_camera, camera('side', x=0.7).T_mount_camera)


def test_an_episode_with_camera_info_but_without_tf_gets_its_poses(tmp_path):
    path = write(tmp_path / 'e', infos=[camera('door')])
    save_calibration(path / 'calibration.yaml', {'door': camera('door')})
    assert write_cameras(path, {}, {'door': camera('door')})
    assert list(static_poses(path)) == ['door_optical_frame']
    assert not write_cameras(path, {}, {'door': camera('door')})


def test_a_camera_that_tf_moves_gets_no_static_pose(tmp_path):
    robot = load_robot(robot_path('franka'))
    cameras = [camera('door'), camera('side')]
    with EpisodeWriter(
        tmp_path / 'e', task='', instruction='', robot='franka', cameras=cameras, moving=['door']
    ) as writer:
        for k in range(FRAMES):
            stamp = START_NS + k * PERIOD_NS
            writer.write_joint_states(stamp, robot.joint_names, np.full(8, 0.02))
            for view in ('door', 'side'):
                writer.write_camera_info(view, stamp, camera(view))
                writer.write_image(view, stamp, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            pose = camera('door', x=0.3 + 0.01 * k).T_mount_camera
            writer.write_camera_pose('door', stamp, 'table', pose)
    path = tmp_path / 'e'
    assert list(static_poses(path)) == ['side_optical_frame']
    assert write_cameras(path, {'side': camera('side', x=0.5)}, {'door': camera('door')})
    assert list(static_poses(path)) == ['side_optical_frame']
    read = read_episode(path)
    np.testing.assert_allclose(read.camera_tracks['door'][:, 0, 3], 0.3 + 0.01 * np.arange(FRAMES))
    assert list(read.camera_tracks) == ['door']


def found_by_rosbags(path, topic):
    """Log times and messages of a topic by an independent reader."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(path) as reader:
        return [
            (stamp, store.deserialize_cdr(data, connection.msgtype))
            for connection, stamp, data in reader.messages()
            if connection.topic == topic
        ]


def others(path, *views):
    """Messages of all topics but the CameraInfo of some views, and static poses."""
    topics = {'/tf_static', *(f'/{view}/camera_info' for view in views)}
    return [message for message in BagReader(path).messages() if message.topic not in topics]


def test_each_image_gets_a_camera_info_and_nothing_else_changes(tmp_path):
    path = write(tmp_path / 'e')
    (path / 'notes').mkdir()
    (path / 'notes' / 'by hand.txt').write_text('a cup')
    before, wanted = others(path), camera('door')
    assert write_cameras(path, {'door': wanted})
    assert others(path, 'door') == before
    rows = found_by_rosbags(path, '/door/camera_info')
    images = found_by_rosbags(path, '/door/image_raw/compressed')
    assert [stamp for stamp, _ in rows] == [stamp for stamp, _ in images]
    for (_, info), (_, image) in zip(rows, images, strict=True):
        assert info.header == image.header
        assert (info.width, info.height, info.distortion_model) == (*SIZE, 'plumb_bob')
        np.testing.assert_array_equal(info.k, [70, 0, 32, 0, 72, 24, 0, 0, 1])
        np.testing.assert_array_equal(info.d, [-0.1, 0.02, 0, 0, 0])
    assert found_by_rosbags(path, '/side/camera_info') == []
    info = read_info(path)
    assert (info.outcome, info.objects, info.instruction) == ('failure', ('cup',), 'lift it')
    assert info.metadata[UNKNOWN_CAMERAS] == 'side'  # its camera is not known still
    assert (path / 'notes' / 'by hand.txt').read_text() == 'a cup'
    read = read_episode(path, views=['door'])
    assert not read.warnings and not read.unknown
    np.testing.assert_array_equal(read.cameras['door'].K, wanted.K)
    np.testing.assert_array_equal(read.cameras['door'].T_mount_camera, wanted.T_mount_camera)
    assert [one.name for one in tmp_path.iterdir()] == ['e']


def test_the_same_cameras_twice_leave_the_episode_alone_and_others_replace_them(tmp_path):
    path = write(tmp_path / 'e', infos=[camera('door', focal=55.0), camera('side', focal=60.0)])
    first = {'door': camera('door')}
    assert write_cameras(path, first)
    digest, inode = content_digest(path), path.stat().st_ino
    assert not write_cameras(path, first)
    assert (content_digest(path), path.stat().st_ino) == (digest, inode)
    moved = {'door': camera('door', focal=80.0, x=0.5)}
    assert write_cameras(path, moved)
    focal = [row.k[0] for _, row in found_by_rosbags(path, '/door/camera_info')]
    assert focal == [80.0] * FRAMES
    assert load_calibration(path / 'calibration.yaml')['door'].T_mount_camera[0, 3] == 0.5
    assert [row.k[0] for _, row in found_by_rosbags(path, '/side/camera_info')] == [60.0] * FRAMES
    pose_alone = {'door': camera('door', focal=80.0, x=0.6)}
    assert write_cameras(path, pose_alone)
    assert read_episode(path, views=['door']).cameras['door'].T_mount_camera[0, 3] == 0.6


@pytest.mark.parametrize('stage', ['messages', 'calibration', 'name'])
def test_an_interrupted_call_leaves_the_episode_as_it_was(stage, tmp_path, monkeypatch):
    path = write(tmp_path / 'e', cameras=[camera('side')])
    before = content_digest(path)

    def interrupt(*_):
        raise KeyboardInterrupt

    target = {
        'messages': (episode_cameras, '_info_of'),
        'calibration': (episode_cameras, 'save_calibration'),
        'name': (BagWriter, '_take_name'),
    }[stage]
    monkeypatch.setattr(*target, interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_cameras(path, {'door': camera('door')})
    assert content_digest(path) == before
    assert [one.name for one in tmp_path.iterdir()] == ['e']


def test_what_would_lose_something_or_does_not_fit_is_refused(tmp_path):
    path = write(tmp_path / 'e')
    door = {'door': camera('door')}
    refused = {
        'images of 32x24, the recorded ones are 64x48': (
            path, {'door': camera('door', size=(32, 24))}),
        "no images of view 'wrist'": (path, {'wrist': camera('wrist')}),
        'is no folder of an episode': (path / 'e_0.mcap', door),
        'a recording of your own': (raw_bag(tmp_path / 'raw'), door),
        'would lack a part': (cut(write(tmp_path / 'cut')), door),
    }  # fmt: skip
    for text, (place, cameras) in refused.items():
        before = content_digest(place)
        with pytest.raises(EpisodeError, match=text):
            write_cameras(place, cameras)
        assert content_digest(place) == before
    assert is_imported(path) and not is_imported(tmp_path / 'raw')


def raw_bag(path):
    """A recording that the user made: no record of this package's metadata."""
    with BagWriter(path) as writer:
        for message in BagReader(path.parent / 'e').messages():
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)
    return path


def cut(path):
    """An episode whose index, with the metadata that follows it, is there, but not all data."""
    file = path / f'{path.name}_0.mcap'
    file.write_bytes(file.read_bytes()[:-2000])
    return path


def test_apply_gives_episodes_that_were_calibrated_before_their_camera_info(tmp_path, capsys):
    data = tmp_path / 'data'
    for name in ('a', 'b'):
        path = write(data / name)
        save_calibration(path / 'calibration.yaml', {'door': camera('door')})
        assert views_without_info(path, BagReader(path).topics()) == ['door']
    command = ['fit', 'camera', str(data), '--view', 'door', '--apply']
    assert main(command) == 0
    said = capsys.readouterr().out
    assert 'nothing is estimated' in said
    for name in ('a', 'b'):
        assert (
            f'{name}: door left as in calibration.yaml; its bag has their CameraInfo now' in said
        )
        path = data / name
        assert views_without_info(path, BagReader(path).topics()) == []
        assert Counter(m.topic for m in BagReader(path).messages())['/door/camera_info'] == FRAMES
    assert main(command) == 0
    assert 'CameraInfo now' not in capsys.readouterr().out


#: measures of a recording: its pose fits, does not fit, or nothing could be measured
GOOD = MotionResidual(shift_px=(0.1, 0.0), match=0.6, match_here=0.6)
POOR = MotionResidual(shift_px=(0.1, 0.0), match=0.2, match_here=0.2)
UNMEASURED = MotionResidual(reason='the robot hardly moves')


@pytest.fixture
def measured_as(monkeypatch):
    """Let `fit camera` find cameras whose measures are those given, by view and recording."""

    def measured_as(measures, places=(0, 1)):
        def estimate(episodes, views, *_, **__):
            count = len(episodes)
            return [
                SharedEstimate(
                    cameras=(camera(view),) * count,
                    places=CameraPlaces(
                        place=np.array(places[:count]), apart=np.zeros((count, count)), matches={}
                    ),
                    measures=tuple(measures[view]),
                    guess_measures=(),
                    kept_guess=False,
                    focal_px=70.0,
                    bent=False,
                    fits=np.ones(count),
                    apart_px=np.zeros(0),
                    strays=(),
                )
                for view in views
            ]

        monkeypatch.setattr(shared_camera, 'estimate_shared', estimate)

    return measured_as


@pytest.mark.parametrize('option', ['--apply', '--apply-doubted'])
@pytest.mark.parametrize(
    ('measures', 'places', 'written'),
    [
        ({'door': [GOOD, GOOD], 'side': [GOOD, GOOD]}, (0, 1), ['a door side', 'b door side']),
        ({'door': [POOR, POOR], 'side': [POOR, POOR]}, (0, 1), ['a', 'b']),
        ({'door': [GOOD, POOR], 'side': [GOOD, UNMEASURED]}, (0, 1), ['a door side', 'b']),
        # the camera did not move between them: the other recording confirms its place
        (
            {'door': [GOOD, POOR], 'side': [GOOD, UNMEASURED]},
            (0, 0),
            ['a door side', 'b door side'],
        ),
    ],
)
def test_apply_writes_poses_that_are_not_doubted_and_fails_where_some_are(
    tmp_path, capsys, monkeypatch, measured_as, option, measures, places, written
):
    monkeypatch.chdir(tmp_path)
    for name in ('a', 'b'):
        write(tmp_path / 'data' / name)
    measured_as(measures, places)
    status = main(['fit', 'camera', 'data', '--view', 'door,side', '--robot', 'franka', option])
    if option == '--apply-doubted':
        written = ['a door side', 'b door side']
    said = capsys.readouterr()
    for words in written:
        name, *views = words.split()
        file = tmp_path / 'data' / name / 'calibration.yaml'
        assert sorted(load_calibration(file) if file.is_file() else {}) == views
        topics = BagReader(file.parent).topics()
        assert [view for view in ('door', 'side') if f'/{view}/camera_info' in topics] == views
        for view in {'door', 'side'} - set(views):
            assert f'{name}: {view} not written, as it is doubted' in said.out
    num_left = 4 - sum(len(words.split()) - 1 for words in written)
    assert status == (1 if num_left else 0)
    assert ('--apply-doubted' in said.err) == (num_left > 0)


def test_a_doubted_pose_does_not_matter_where_the_episode_keeps_its_own(
    tmp_path, capsys, monkeypatch, measured_as
):
    monkeypatch.chdir(tmp_path)
    for name in ('a', 'b'):
        write(tmp_path / 'data' / name)
    own = camera('door', x=0.7)
    save_calibration(tmp_path / 'data' / 'a' / 'calibration.yaml', {'door': own})
    measured_as({'door': [POOR, GOOD]})
    command = ['fit', 'camera', 'data', '--view', 'door', '--robot', 'franka', '--apply']
    assert main(command) == 0
    assert 'doubted and were not' not in capsys.readouterr().err
    kept = load_calibration(tmp_path / 'data' / 'a' / 'calibration.yaml')['door']
    np.testing.assert_allclose(kept.T_mount_camera, own.T_mount_camera)
    assert main([*command, '--overwrite']) == 1
    kept = load_calibration(tmp_path / 'data' / 'a' / 'calibration.yaml')['door']
    np.testing.assert_allclose(kept.T_mount_camera, own.T_mount_camera)


def test_apply_leaves_the_bag_of_a_users_own_recording_and_says_what_makes_an_episode(
    tmp_path, capsys
):
    write(tmp_path / 'e')
    path = raw_bag(tmp_path / 'raw')
    save_calibration(path / 'calibration.yaml', {'door': camera('door')})
    before = content_digest(path)
    command = ['fit', 'camera', str(path), '--view', 'door', '--apply', '--robot', 'franka']
    assert main(command) == 0
    assert 'mtv-world import bag' in capsys.readouterr().out
    assert content_digest(path) == before
    command[2] = str(tmp_path / 'e' / 'e_0.mcap')
    assert main(command) == 1
    assert 'import bag' in capsys.readouterr().err


def test_camera_info_is_of_the_videos_size_whatever_size_the_calibration_is_for(tmp_path, capsys):
    path = write(tmp_path / 'e')
    save_calibration(path / 'calibration.yaml', {'door': camera('door', 140.0, size=(128, 96))})
    calibration = (path / 'calibration.yaml').read_bytes()
    command = ['fit', 'camera', str(path), '--view', 'door', '--apply']
    assert main(command) == 0
    infos = [row for _, row in found_by_rosbags(path, '/door/camera_info')]
    assert {(row.width, row.height) for row in infos} == {SIZE}
    assert (path / 'calibration.yaml').read_bytes() == calibration  # kept as it was
    read = read_episode(path, views=['door'])
    np.testing.assert_allclose(infos[0].k.reshape(3, 3), read.cameras['door'].K)
    np.testing.assert_allclose(read.cameras['door'].K[0, 0], 70.0)
    assert not [text for text in read.warnings if "the file's are used" in text]
    save_calibration(path / 'calibration.yaml', {'door': camera('door', size=(128, 72))})
    with pytest.raises(CalibrationError, match=r'64x48.*128x72'):
        read_episode(path, views=['door'])
    assert main(command) == 1
    assert '128x72' in capsys.readouterr().err
