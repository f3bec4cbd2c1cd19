"""Calibrations of other programs: read, put together with TF, and their directions checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros.cameras.foreign_calibrations import ForeignCalibration, read_foreign
from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse, pose, quaternion
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode_reader import read_episode
from test.support.bags import bag_cameras, FRAMES, MAPPING, record
from test.support.crane import load, make_positions

K = [300.0, 0, 158.5, 0, 300, 121.5, 0, 0, 1]
BENT = [0.1, -0.05, 0.001, 0.002, 0.0]
TOPICS = {'door': '/cell/door/color/image_raw', 'palm': '/cell/palm/color/image_raw'}


def write_ros(file: Path, name: str = 'narrow_stereo', **more: Any) -> Path:
    """A file as camera_calibration of image_pipeline writes it."""
    rows = {'rows': 3, 'cols': 3, 'data': K}
    values = {
        'image_width': 320, 'image_height': 240, 'camera_name': name, 'camera_matrix': rows,
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': BENT},
        'rectification_matrix': {'rows': 3, 'cols': 3, 'data': np.eye(3).ravel().tolist()},
        'projection_matrix': {'rows': 3, 'cols': 4, 'data': np.zeros(12).tolist()},
    } | more  # fmt: skip
    file.write_text(yaml.safe_dump(values))
    return file


def write_opencv(file: Path, distortion: list[float] = BENT, **more: Any) -> Path:
    """A file that OpenCV itself writes, in the format of the suffix."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write('image_width', 320)
    storage.write('image_height', 240)
    storage.write('camera_matrix', np.reshape(K, (3, 3)))
    storage.write('distortion_coefficients', np.reshape(distortion, (-1, 1)))
    for name, value in more.items():
        storage.write(name, value)
    storage.release()
    return file


def write_kalibr(file: Path, **cameras: dict[str, Any]) -> Path:
    """A camchain of kalibr."""
    row = {
        'camera_model': 'pinhole', 'distortion_model': 'radtan', 'cam_overlaps': [1],
        'distortion_coeffs': BENT[:4], 'intrinsics': [300.0, 300.0, 158.5, 121.5],
        'resolution': [320, 240],
    }  # fmt: skip
    file.write_text(yaml.safe_dump({name: row | more for name, more in cameras.items()}))
    return file


def write_handeye(file: Path, T: np.ndarray, *, on_hand: bool, parent: str, child: str,
                  version: int) -> Path:  # fmt: skip
    """A file of easy_handeye (1) or easy_handeye2 (2)."""
    x, y, z, w = (float(v) for v in quaternion(T[:3, :3]))
    place = dict(zip('xyz', T[:3, 3].tolist(), strict=True))
    frames = {
        'robot_base_frame': 'plinth' if on_hand else parent,
        'robot_effector_frame': parent if on_hand else 'hand',
        'tracking_base_frame': child, 'tracking_marker_frame': 'marker',
    }  # fmt: skip
    if version == 1:
        values = {'parameters': frames | {'eye_on_hand': on_hand},
                  'transformation': place | {'qx': x, 'qy': y, 'qz': z, 'qw': w}}  # fmt: skip
    else:
        kind = 'eye_in_hand' if on_hand else 'eye_on_base'
        values = {'parameters': frames | {'name': 'mine', 'calibration_type': kind},
                  'transform': {'translation': place,
                                'rotation': {'x': x, 'y': y, 'z': z, 'w': w}}}  # fmt: skip
    file.write_text(yaml.safe_dump(values))
    return file


def write_moveit(file: Path, T: np.ndarray, parent: str, child: str) -> Path:
    """A launch file as moveit_calibration writes it, for ROS 1 (XML) or 2 (Python)."""
    q = quaternion(T[:3, :3]).tolist()
    numbers = dict(zip(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), [*T[:3, 3].tolist(), *q],
                       strict=True))  # fmt: skip
    if file.suffix == '.launch':
        text = ' '.join(map(str, numbers.values()))
        file.write_text(
            f'<launch>\n  <!-- xyz rpy -->\n  <node pkg="tf2_ros" '
            'type="static_transform_publisher" name="camera_link_broadcaster"\n      '
            f'args="{text} {parent} {child}" />\n</launch>\n'
        )
        return file
    options = ', '.join(f'"--{key}", "{value}"' for key, value in numbers.items())
    file.write_text(
        'from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n'
        'def generate_launch_description():\n    return LaunchDescription([Node(package="tf2_ros",'
        'executable="static_transform_publisher", output="log", arguments=["--frame-id", '
        f'"{parent}", "--child-frame-id", "{child}", {options}])])\n'
    )
    return file


def lens_of(found: ForeignCalibration | None, view: str) -> Any:
    assert found is not None
    return found.lenses[view]


# Lenses


@pytest.mark.parametrize('suffix', ['.yaml', '.yml', '.json', '.xml'])
def test_opencvs_files_are_read_in_all_its_formats(tmp_path, suffix):
    found = lens_of(read_foreign(write_opencv(tmp_path / f'door{suffix}'), TOPICS), 'door')
    np.testing.assert_allclose(found.K.ravel(), K)
    assert (found.width, found.height, found.distortion_model) == (320, 240, 'plumb_bob')
    np.testing.assert_allclose(found.distortion, BENT)


@pytest.mark.parametrize(
    ('distortion', 'more', 'model', 'count'),
    [
        ([0.1] * 4, {}, 'plumb_bob', 4),
        ([0.1] * 4, {'fisheye_model': 1}, 'equidistant', 4),
        ([0.1] * 8, {}, 'rational_polynomial', 8),
        ([0.1] * 8 + [0.0] * 6, {}, 'rational_polynomial', 8),
    ],
)
def test_opencvs_model_follows_from_the_number_of_coefficients(
    tmp_path, distortion, more, model, count
):
    file = write_opencv(tmp_path / 'door.yaml', distortion, **more)
    found = lens_of(read_foreign(file, TOPICS), 'door')
    assert found.distortion_model == model and len(found.distortion) == count


def test_camera_calibrations_file_is_of_the_view_that_it_or_its_camera_is_called(tmp_path):
    named = read_foreign(write_ros(tmp_path / 'ost.yaml', 'palm'), TOPICS)
    assert set(named.lenses) == {'palm'}
    np.testing.assert_allclose(named.lenses['palm'].distortion, BENT)
    filed = read_foreign(write_ros(tmp_path / 'door_1.yaml', 'palm'), TOPICS)
    assert set(filed.lenses) == {'door'}
    only = read_foreign(write_ros(tmp_path / 'ost.yaml', 'any'), {'door': ''})
    assert set(only.lenses) == {'door'}
    with pytest.raises(CalibrationError, match=r'which view is it of\? .* door, palm; give a fol'):
        read_foreign(write_ros(tmp_path / 'ost.yaml', 'any'), TOPICS)


def test_kalibrs_cameras_are_found_by_their_topics_and_chained(tmp_path):
    T = pose([0.1, 0.2, 0.3], [0.1, 0.2, 0.3, 0.9])
    file = write_kalibr(
        tmp_path / 'camchain.yaml',
        cam0={'rostopic': '/cell/palm/color/image_raw/compressed'},
        cam1={'rostopic': '/cell/door/color/image_raw', 'T_cn_cnm1': T.tolist(),
              'distortion_model': 'equidistant'},
        cam2={'rostopic': '/other', 'T_cn_cnm1': T.tolist()},
    )  # fmt: skip
    found = read_foreign(file, TOPICS)
    assert set(found.lenses) == {'door', 'palm'}
    assert found.lenses['palm'].distortion_model == 'plumb_bob'
    assert found.lenses['door'].distortion_model == 'equidistant'
    (link,) = found.chain
    assert (link.before, link.view) == ('palm', 'door')
    # p_door = T p_palm, so that the origin of the door camera in palm is inv(T)
    np.testing.assert_allclose(link.T_before_view @ T, np.eye(4), atol=1e-12)
    assert found.notes == [f"'{file}': cam2 (/other) is of no view"]


# Poses


@pytest.mark.parametrize('version', [1, 2])
@pytest.mark.parametrize('on_hand', [True, False])
def test_easy_handeyes_pose_is_the_tracking_frames_in_effector_or_base(tmp_path, version, on_hand):
    T = pose([0.5, -0.2, 0.7], [0.3, 0.1, 0.2, 0.8])
    parent = 'hand' if on_hand else 'plinth'
    file = write_handeye(tmp_path / 'mine.calib', T, on_hand=on_hand, parent=parent,
                         child='door_optical', version=version)  # fmt: skip
    (found,) = read_foreign(file, TOPICS).poses
    assert (found.parent, found.child) == (parent, 'door_optical')
    np.testing.assert_allclose(found.T_parent_child, T, atol=1e-9)


@pytest.mark.parametrize('name', ['camera.launch', 'camera.launch.py'])
def test_moveits_launch_files_are_parsed_and_not_run(tmp_path, name):
    T = pose([0.5, -0.2, 0.7], [0.3, 0.1, 0.2, 0.8])
    file = write_moveit(tmp_path / name, T, 'hand', 'palm_optical')
    if file.suffix == '.py':
        file.write_text(f'{file.read_text()}\nopen({str(tmp_path / "ran")!r}, "w")\n')
    (found,) = read_foreign(file, TOPICS).poses
    assert (found.parent, found.child) == ('hand', 'palm_optical')
    np.testing.assert_allclose(found.T_parent_child, T, atol=1e-6)
    assert not (tmp_path / 'ran').exists()


def test_angles_of_static_transform_publisher_are_about_fixed_axes(tmp_path):
    from scipy.spatial.transform import Rotation

    right = Rotation.from_euler('xyz', [0.3, -0.4, 1.2]).as_matrix()
    file = tmp_path / 'a.launch'
    node = '<node pkg="tf2_ros" type="static_transform_publisher" name="n" args="{}" />'
    file.write_text(f'<launch>{node.format("1 2 3 1.2 -0.4 0.3 base cam")}</launch>')
    (old,) = read_foreign(file, TOPICS).poses
    np.testing.assert_allclose(old.T_parent_child[:3, :3], right, atol=1e-12)
    file = tmp_path / 'a.launch.py'
    file.write_text(
        'x = ["--roll", "0.3", "--pitch", "-0.4", "--yaw", "1.2", "--x", "-1", "--frame-id", '
        '"base", "--child-frame-id", "cam"]'
    )
    (new,) = read_foreign(file, TOPICS).poses
    np.testing.assert_allclose(new.T_parent_child[:3, :3], right, atol=1e-12)
    assert new.T_parent_child[0, 3] == -1


# What is not read

_ZERO_TURN = """
parameters: {robot_base_frame: a, tracking_base_frame: b}
transformation: {x: 1, y: 1, z: 1, qx: 0, qy: 0, qz: 0, qw: 0}
"""


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('a: 1\n', 'holds a, which is no calibration; read are camera_calibration'),
        ('[1, 2]', 'holds no calibration'),
        ('{', 'is no YAML'),
        ('camera_matrix: {data: [1, 2]}\nimage_width: 3\nimage_height: 4\n', 'has 2 numbers'),
        ('camera_matrix: {data: [300, 0, 1, 0, 300, 1, 0, 0, 1]}\n', "no 'image_width'"),
        ('cam0: {camera_model: omni, distortion_model: radtan, intrinsics: [1, 1, 1, 1]}\n',
         "camera_model 'omni' with distortion_model 'radtan' is not read"),
        ('parameters: {eye_on_hand: true}\ntransformation: {x: 1}\n', 'robot_effector_frame'),
        ('parameters: {robot_base_frame: a, tracking_base_frame: b}\ntransformation: {x: 1}\n',
         'transform has no'),
        (_ZERO_TURN, "'a' -> 'b'"),
        ('<launch></launch>', 'starts no static_transform_publisher'),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_the_file(tmp_path, text, said):
    file = tmp_path / 'door.yaml'
    file.write_text(text)
    with pytest.raises(CalibrationError, match=said) as found:
        read_foreign(file, TOPICS)
    assert str(file) in str(found.value)


def test_links_out_of_the_folder_are_not_followed(tmp_path):
    folder = tmp_path / 'calibrations'
    folder.mkdir()
    (folder / 'door.yaml').symlink_to(write_ros(tmp_path / 'elsewhere.yaml'))
    with pytest.raises(CalibrationError, match='leads out of its folder and is not followed'):
        read_foreign(folder, TOPICS)


def test_the_packages_own_file_is_left_to_its_own_reader(tmp_path):
    file = tmp_path / 'calibration.yaml'
    file.write_text('views: {door: {}}\n')
    assert read_foreign(file, TOPICS) is None
    with pytest.raises(CalibrationError, match='holds no calibration'):
        (tmp_path / 'empty').mkdir()
        read_foreign(tmp_path / 'empty', TOPICS)


# Imports


@pytest.fixture(scope='module')
def crane(tmp_path_factory):
    return load(tmp_path_factory.mktemp('crane'))


@pytest.fixture(scope='module')
def recorded(crane, tmp_path_factory):
    """A moving arm, whose bag has neither TF nor a CameraInfo of the door's camera."""
    folder = tmp_path_factory.mktemp('recorded')
    positions = make_positions(4.0)
    full = record(folder / 'full', crane, bag_cameras(), positions)
    left_out = {'ceiling', FRAMES['door']}
    with BagWriter(folder / 'bag') as writer:
        for message in BagReader(full).messages():
            data = message.data
            if message.topic == '/cell/door/color/camera_info':
                continue
            if message.topic == '/tf_static':
                told = messages.deserialize(message.msgtype, data)
                told.transforms = [
                    one for one in told.transforms if one.child_frame_id not in left_out
                ]
                data = messages.serialize(message.msgtype, told)
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, data)
    return folder / 'bag'


@pytest.fixture
def bring_in(recorded, tmp_path, capsys):
    def imported(calibration: Path) -> tuple[int, str, Path]:
        file = tmp_path / 'mapping.yaml'
        views = {view: f'/cell/{view}/color/image_raw' for view in FRAMES}
        file.write_text(yaml.safe_dump(MAPPING | {'views': views}))
        status = main(['import', 'bag', str(recorded), '--topics', str(file), '--calibration',
                       str(calibration), '--out', str(tmp_path / 'out')])  # fmt: skip
        said = capsys.readouterr()
        return status, said.out + said.err, tmp_path / 'out/bag'

    return imported


@pytest.mark.parametrize('writer', ['easy_handeye', 'easy_handeye2', 'moveit'])
@pytest.mark.parametrize('is_wrong', [False, True], ids=['as it is', 'turned round'])
def test_direction_of_a_pose_is_checked_by_the_arm(tmp_path, bring_in, writer, is_wrong):
    right = bag_cameras()['door'].T_mount_camera
    T = inverse(right) if is_wrong else right
    folder = tmp_path / 'calibrations'
    folder.mkdir()
    write_opencv(folder / 'door_lens.xml', [0.0] * 5)
    if writer == 'moveit':
        write_moveit(folder / 'door.launch.py', T, 'plinth', FRAMES['door'])
    else:
        version = 2 if writer == 'easy_handeye2' else 1
        write_handeye(folder / 'door.yaml', T, on_hand=False, parent='plinth',
                      child=FRAMES['door'], version=version)  # fmt: skip
    status, said, episode = bring_in(folder)
    assert status == 0, said
    what = "view 'door': the direction of 'plinth' -> 'door_optical' "
    how = 'was turned round: so the drawn arm fits' if is_wrong else 'is confirmed by the arm'
    assert what + how in said, said
    camera = read_episode(episode).cameras['door']
    assert camera.mount_link == 'plinth'
    np.testing.assert_allclose(camera.T_mount_camera, right, atol=1e-6)
    np.testing.assert_allclose(camera.K.ravel(), K)
    other = read_episode(episode).cameras['palm']  # its TF and CameraInfo hold
    np.testing.assert_allclose(
        other.T_mount_camera, bag_cameras()['palm'].T_mount_camera, atol=1e-6
    )


def test_a_lens_alone_leaves_the_pose_to_be_estimated(tmp_path, bring_in):
    status, said, episode = bring_in(write_ros(tmp_path / 'door.yaml'))
    assert status == 0, said
    assert "view 'door': pose not known" in said
    found = read_episode(episode, unknown_mount='plinth')
    assert found.unknown == {'door': 'pose'}
    np.testing.assert_allclose(found.cameras['door'].distortion, BENT)
    np.testing.assert_allclose(found.cameras['door'].K.ravel(), K)


def test_kalibrs_chain_gives_the_pose_of_a_camera_by_that_of_another(tmp_path, bring_in, crane):
    """The chain holds while the palm stands still; here it is the pose at which it was made."""
    T = pose([0.1, 0.2, 0.3], [0.1, 0.2, 0.3, 0.9])
    file = write_kalibr(
        tmp_path / 'chain.yaml',
        cam0={'rostopic': TOPICS['palm']},
        cam1={'rostopic': TOPICS['door'], 'T_cn_cnm1': T.tolist()},
    )
    status, said, episode = bring_in(file)
    assert status == 0, said
    cameras = read_episode(episode).cameras
    assert cameras['door'].mount_link == 'hand'
    right = bag_cameras()['palm'].T_mount_camera @ inverse(T)
    np.testing.assert_allclose(cameras['door'].T_mount_camera, right, atol=1e-6)
    assert crane.link_names


def test_a_frame_of_no_view_is_named_with_the_frames_of_the_views(tmp_path, bring_in):
    T = bag_cameras()['door'].T_mount_camera
    folder = tmp_path / 'calibrations'
    folder.mkdir()
    write_opencv(folder / 'door_lens.yaml')
    write_handeye(folder / 'door.yaml', T, on_hand=False, parent='plinth', child='camera_link',
                  version=2)  # fmt: skip
    status, said, _ = bring_in(folder)
    assert status == 0, said
    assert "frame 'camera_link' carries no view; views have the frames door door_optical" in said
    assert "view 'door': pose not known" in said


def test_other_commands_say_which_import_reads_such_a_file(tmp_path):
    from mtv_world_ros.cameras.calibration_file import load_calibration

    with pytest.raises(CalibrationError, match='import bag --calibration` and `import videos'):
        load_calibration(write_ros(tmp_path / 'ost.yaml'))


@pytest.mark.parametrize('has_pose', [False, True])
def test_videos_take_a_folder_of_lens_and_pose(tmp_path, capsys, has_pose):
    from mtv_world_ros.viewing.video import encode_video

    raw = tmp_path / 'raw'
    raw.mkdir()
    grey = np.stack([np.full((240, 320, 3), 20 + 10 * k, np.uint8) for k in range(12)])
    (raw / 'a.mp4').write_bytes(encode_video(grey, 5))
    names = [f'q{k}' for k in range(8)]
    rest = '0,-0.3,0,-2.2,0,2.0,0.8,0.02'
    (raw / 'a.csv').write_text('\n'.join([','.join(names), *[rest] * 12]) + '\n')
    joints = [*(f'panda_joint{k}' for k in range(1, 8)), 'panda_finger_joint1']
    mapping = tmp_path / 'm.yaml'
    mapping.write_text(yaml.safe_dump({
        'robot': 'franka', 'rows': '{name}.csv', 'views': {'front': '{name}.mp4'}, 'fps': 5,
        'state': {'feature': '', 'joints': dict(zip(joints, names, strict=True))},
    }))  # fmt: skip
    folder = tmp_path / 'calibrations'
    folder.mkdir()
    write_ros(folder / 'front.yaml')
    T = pose([1.5, 0.3, 0.8], [0.6, 0.7, 0.3, 0.2])
    if has_pose:
        write_handeye(folder / 'front_pose.calib', T, on_hand=False, parent='panda_link0',
                      child='optical', version=2)  # fmt: skip
    out = tmp_path / 'out'
    command = ['import', 'videos', str(raw), '--mapping', str(mapping), '--out', str(out)]
    assert main([*command, '--calibration', str(folder)]) == 0
    said = capsys.readouterr().err
    found = read_episode(out / 'a', unknown_mount='panda_link0')
    np.testing.assert_allclose(found.cameras['front'].distortion, BENT)
    assert found.unknown == ({} if has_pose else {'front': 'pose'})
    if has_pose:
        np.testing.assert_allclose(found.cameras['front'].T_mount_camera, T, atol=1e-9)
        assert "direction of 'panda_link0' -> 'optical' was not checked" in said  # a resting arm
