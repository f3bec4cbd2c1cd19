"""`mtv-world check` on the bundled episode: it passes, and each thing broken in it is found."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.cli import main
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode import Track
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.inspect import delays, Inspector, load_inspector
from mtv_world_ros.inspection.inspection_report import to_markdown
from mtv_world_ros.inspection.motion_residual import (
    measure_residual,
    MotionResidual,
    ResidualSearch,
)
from mtv_world_ros.robot.shape import load_shape, rods
from test.support.crane import write_cuboid
from test.support.tiers import rest_slow

QUICK = ResidualSearch(max_pairs=25, lags_s=(0.0,), rolls_deg=(), zooms=())


@pytest.fixture(scope='module')
def episode():
    """The bundled one, its frames decoded once."""
    read = read_episode(share_path('resource', 'demo_episode'), with_masks=False)
    images = {v: t._replace(frames=np.asarray(t.frames)) for v, t in read.images.items()}
    return replace(read, images=images)


@pytest.fixture(scope='module')
def inspector():
    return load_inspector(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'), QUICK)


def changed(episode, view, **changes):
    """The episode with another calibration of one view, and that view alone."""
    camera = replace(episode.cameras[view], **changes)
    return replace(episode, views=(view,), cameras={view: camera})


def shifted_k(episode, view, x, y):
    K = episode.cameras[view].K.copy()
    K[0, 2] += x
    K[1, 2] += y
    return changed(episode, view, K=K)


def moved_pose(episode, view, matrix):
    return changed(episode, view, T_mount_camera=matrix(episode.cameras[view].T_mount_camera))


def texts(section):
    return ' '.join(finding.text for finding in section.findings)


@pytest.mark.slow
def test_the_command_passes_a_good_recording_and_writes_report_and_pictures(tmp_path, capsys):
    status = main(['check', str(share_path('resource', 'demo_episode')), '--out', str(tmp_path)])
    report = (tmp_path / 'report.md').read_text()
    assert status == 0, report
    assert report.startswith('# ok: demo_episode')
    assert capsys.readouterr().out.splitlines()[-1].startswith('ok: see')
    picture = cv2.imread(str(tmp_path / 'low.png'))
    assert picture.shape == (960, 1280, 3)  # two rows of two frames, 640 x 480 each
    assert '![high](high.png)' in report


@pytest.mark.parametrize(
    ('view', 'shift'),
    rest_slow(
        [('low', (10, 0)), ('high', (-10, 0)), ('low', (0, 10)), ('high', (0, -10))],
        [('low', (10, 0))],
    ),
)
def test_a_principal_point_10_px_off_flips_the_verdict(episode, inspector, view, shift):
    wrong = inspector.inspect(shifted_k(episode, view, *shift)).views[0]
    assert wrong.verdict != 'ok'
    assert 'beside the moving pixels' in texts(wrong)


def test_the_residual_says_where_the_moving_pixels_are(episode, inspector):
    measured = [
        measure_residual(
            e.images['low'], e.cameras['low'], inspector.robot, inspector.shape.parts,
            JointTrack(e.joint_states, inspector.robot), QUICK,
        ).shift_px
        for e in (episode, shifted_k(episode, 'low', 12, -7))
    ]  # fmt: skip
    # moving the principal point moves the drawing, so the pixels seem to move the other way
    assert np.subtract(measured[1], measured[0]) == pytest.approx((-12, 7), abs=1.0)


@pytest.mark.slow
def test_a_camera_3_cm_or_3_degrees_off_is_found(episode, inspector):
    def aside(T):
        T = T.copy()
        T[0, 3] += 0.03
        return T

    def tilted(T):
        c, s = np.cos(np.radians(3)), np.sin(np.radians(3))
        return T @ np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])

    assert inspector.inspect(moved_pose(episode, 'low', aside)).verdict == 'broken'
    assert inspector.inspect(moved_pose(episode, 'high', tilted)).verdict == 'broken'


def test_an_inverted_pose_and_swapped_views_are_broken(episode, inspector):
    inverted = inspector.inspect(moved_pose(episode, 'low', np.linalg.inv))
    assert inverted.verdict == 'broken'
    assert 'in the image' in texts(inverted.views[0]) or 'behind' in texts(inverted.views[0])
    other = replace(episode.cameras['low'], view='high')
    swapped = replace(episode, views=('high',), cameras={'high': other})
    assert inspector.inspect(swapped).views[0].verdict == 'broken'


def test_late_images_are_found(episode, inspector):
    lags = ResidualSearch(lags_s=(0.0, 0.1, 0.2), rolls_deg=(), zooms=())
    inspector = Inspector(inspector.robot, inspector.shape, lags)
    track = episode.images['low']
    late = {'low': track._replace(stamps_ns=track.stamps_ns + 200_000_000)}
    section = inspector.inspect(replace(episode, views=('low',), images=late)).views[0]
    assert section.verdict == 'suspicious'
    assert '+0.2 s later' in texts(section)


def test_images_without_the_robot_do_not_match(episode, inspector):
    generator = np.random.default_rng(3)
    track = episode.images['low']
    noise = generator.integers(0, 255, (len(track.stamps_ns), 288, 384, 3), np.uint8)
    section = inspector.inspect(
        replace(episode, views=('low',), images={'low': track._replace(frames=noise)})
    ).views[0]
    assert section.verdict == 'broken'
    assert 'does not move like the drawn robot' in texts(section)


def test_a_robot_that_stands_still_is_not_called_calibrated(episode, inspector):
    states = episode.joint_states
    still = replace(states, positions=np.repeat(states.positions[:1], len(states.positions), 0))
    section = inspector.inspect(replace(episode, joint_states=still)).views[0]
    assert section.verdict == 'not checked'
    assert 'calibration not checked' in texts(section)


def test_a_camera_on_the_arm_is_not_called_ok(episode, inspector):
    section = inspector.inspect(changed(episode, 'low', mount_link='left_link_6')).views[0]
    assert section.verdict != 'ok'
    assert "the camera moves with 'left_link_6'" in texts(section)


@pytest.mark.slow
def test_joints_in_degrees_are_broken(episode, inspector):
    states = episode.joint_states
    degrees = replace(states, positions=np.degrees(states.positions))
    recording = inspector.inspect(replace(episode, joint_states=degrees)).recording
    assert recording.verdict == 'broken'
    assert "joint 'left_joint2' is outside its limits 0 .. 3.665" in texts(recording)


def test_rods_find_gross_errors_and_pass_nothing(episode, inspector):
    robot = inspector.robot
    lenient = Inspector(robot, rods(robot, 'for a test'), QUICK)
    assert lenient.inspect(changed(episode, 'low')).views[0].verdict == 'not checked'
    assert lenient.inspect(shifted_k(episode, 'low', 45, 0)).views[0].verdict == 'broken'


ROBOT = """
name: lamp
urdf: lamp.urdf
tools: [{arm: one, link: arm, position: [0, 0, 0.3]}]
"""
URDF = """
<robot name="lamp"><link name="base"/><link name="arm"><visual>
<origin xyz="0 0 0.1" rpy="0 0 1.5707963267948966"/><geometry>GEOMETRY</geometry></visual></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>
"""


def lamp(folder: Path, geometry: str):
    from mtv_world_ros.robot.file import load_robot

    (folder / 'lamp.yaml').write_text(ROBOT)
    (folder / 'lamp.urdf').write_text(URDF.replace('GEOMETRY', geometry))
    robot = load_robot(folder / 'lamp.yaml')
    return robot, load_shape(robot)


def test_links_whose_size_does_not_fit_the_arm_are_suspicious(episode, inspector):
    doubt = "link 'left_link2' is 300 m large and the arm 0.7 m long"
    shape = replace(inspector.shape, doubts=(doubt,))
    found = Inspector(inspector.robot, shape, QUICK)._recording(
        episode, JointTrack(episode.joint_states, inspector.robot)
    )
    assert [(f.verdict, f.text) for f in found.findings if 'link2' in f.text] == [
        ('suspicious', doubt)
    ]


def test_boxes_and_meshes_are_drawn_where_a_pinhole_sees_them(tmp_path):
    write_cuboid(tmp_path / 'cuboid.stl', np.array([0.4, 0.2, 0.2]))
    # looks down from 1.1 m on the top face at 0.2 m: 180 px focal length, 0.9 m away
    camera = CameraModel(
        view='top', width=200, height=160,
        K=np.array([[180.0, 0, 99.5], [0, 180, 79.5], [0, 0, 1]]),
        mount_link='base',
        T_mount_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.1], [0, 0, 0, 1]]),
    )  # fmt: skip
    for geometry in ('<box size="0.4 0.2 0.2"/>', '<mesh filename="cuboid.stl"/>',
                     '<mesh filename="package://nowhere/cuboid.stl"/>'):  # fmt: skip
        robot, shape = lamp(tmp_path, geometry)
        if 'nowhere' in geometry:
            assert not shape.is_known and 'nowhere' in shape.source
            assert 'AMENT_PREFIX_PATH=/path/to/install/PACKAGE' in shape.source
            continue
        images = draw_silhouettes(shape.parts, camera, robot, np.array([[0.0], [np.pi / 2]]))
        for image, (across, along) in zip(images, ((0.2, 0.4), (0.4, 0.2)), strict=True):
            rows, columns = np.nonzero(image)
            assert np.ptp(columns) == pytest.approx(180 * across / 0.9, abs=1.5)
            assert np.ptp(rows) == pytest.approx(180 * along / 0.9, abs=1.5)


def test_rods_run_from_joint_to_joint_and_to_the_tool(tmp_path):
    robot, shape = lamp(tmp_path, '<mesh filename="missing.dae"/>')
    assert [part.link for part in shape.parts] == ['arm']
    ends = shape.parts[0].points[:, 2]
    assert (ends.min(), ends.max()) == pytest.approx((0, 0.3))
    assert robot.joint_names == ('turn',)


@pytest.mark.parametrize(
    ('views', 'told'),
    [
        ({'a': (0.4, 0.05)}, {'a'}),
        ({'a': (0.4, 0.02)}, set()),  # fits hardly better, or in one half of the recording alone
        ({'a': (0.4, 0.05), 'b': (-0.4, 0.05)}, set()),  # the same clock cannot be early and late
        ({'a': (0.4, 0.05), 'b': (0.0, 0.0)}, {'a'}),  # a camera of its own may be slow
        ({'a': (0.2, 0.05)}, set()),  # one frame at 5 Hz
        ({'a': (0.2, 0.15)}, {'a'}),
    ],
)
def test_a_delay_is_told_where_the_data_show_it(views, told):
    stamps = np.arange(40, dtype=np.int64) * 200_000_000
    track = Track(stamps, np.zeros((40, 2, 2, 3), np.uint8))
    measured = {
        view: (MotionResidual(lag_s=lag_s, lag_gain=gain, num_pairs=20), track)
        for view, (lag_s, gain) in views.items()
    }
    found = delays(measured)
    assert set(found) == told
    for view in told:
        assert f'{views[view][0]:+.1f} s later' in found[view][0].text


def test_an_arm_that_rests_is_not_checked_and_says_so(episode, inspector):
    states = episode.joint_states
    positions = states.positions.copy()
    left = [index for index, name in enumerate(states.joint_names) if name.startswith('left_')]
    positions[:, left] = positions[0, left]
    view = inspector.inspect(replace(episode, joint_states=replace(states, positions=positions)))
    said = ' '.join(texts(section) for section in view.views)
    assert "arm 'left' is not compared with the images" in said
    assert [section.verdict for section in view.views] == ['ok', 'ok']  # the other arm moves
    assert all(section.unchecked for section in view.views)
    assert "arm 'left' is not compared" in to_markdown(view, {}).partition('| verdict')[0]


@pytest.mark.slow
def test_a_joints_zero_is_named_where_all_views_are_off_alike(episode, inspector):
    states = episode.joint_states
    positions = states.positions.copy()
    positions[:, list(states.joint_names).index('right_joint2')] += 0.25
    found = inspector.inspect(replace(episode, joint_states=replace(states, positions=positions)))
    assert "off alike, and fit better with the zero of joint 'right_joint2' -0.25 rad" in texts(
        found.recording
    )
