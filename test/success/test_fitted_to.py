from dataclasses import replace
from shutil import copytree

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration as load_cameras
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.success.calibration import Calibration, Fits, load_fit, load_fits, save_fit
from mtv_world_ros.success.fitted_to import CameraRange, FittedTo, Setting

ROBOT = Checkpoint.open('bundled').load_robot()
HERE = Setting.of(ROBOT, 'contact')
CAMERAS = tuple(load_cameras(Checkpoint.open('bundled').cameras_file).values())
FITTED = FittedTo.episodes(HERE, [CAMERAS])


def turned(degrees):
    """A turn about the optical axis."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def moved(metres=0.0, degrees=0.0, focal=1.0, view='low'):
    """The cameras, of which one stands elsewhere."""
    found = []
    for camera in CAMERAS:
        pose, K = camera.T_mount_camera @ turned(degrees), camera.K * [[focal], [focal], [1]]
        pose[0, 3] += metres
        same = camera.view != view
        found.append(camera if same else replace(camera, K=K, T_mount_camera=pose))
    return tuple(found)


def test_where_it_was_fitted_nothing_is_objected():
    assert FITTED.objection(HERE, CAMERAS, is_foreseen=True) == ''


@pytest.mark.parametrize(
    ('change', 'is_other'),
    [
        ({'metres': 0.01, 'degrees': 1.0}, False),
        ({'metres': 0.08}, True),
        ({'metres': -0.08}, True),
        ({'degrees': 10.0}, True),
        ({'focal': 1.3}, True),
    ],
)
def test_a_camera_that_stands_elsewhere_is_named(change, is_other):
    found = FITTED.objection(HERE, moved(**change), is_foreseen=True)
    assert found == ('fitted with other cameras of low' if is_other else '')


def test_between_the_cameras_of_the_episodes_is_within():
    fitted = FittedTo.episodes(HERE, [CAMERAS, moved(metres=0.2)])
    assert fitted.objection(HERE, moved(metres=0.1), is_foreseen=True) == ''
    assert 'low' in fitted.objection(HERE, moved(metres=0.3), is_foreseen=True)


def test_the_size_of_pictures_does_not_count():
    large = [
        replace(
            camera, width=2 * camera.width, height=2 * camera.height, K=camera.K * [[2], [2], [1]]
        )
        for camera in CAMERAS
    ]
    assert FITTED.objection(HERE, large, is_foreseen=True) == ''


def test_a_view_that_was_not_there_is_named():
    other = [replace(camera, view='wrist') for camera in CAMERAS[:1]]
    assert FITTED.objection(HERE, other, is_foreseen=True).endswith('cameras of wrist')


def test_another_foresight_counts_where_motions_are_foreseen():
    other = HERE.replace(foresight='another')
    assert 'another foresight' in FITTED.objection(other, CAMERAS, is_foreseen=True)
    assert FITTED.objection(other, CAMERAS, is_foreseen=False) == ''


def test_another_robot_and_a_longer_arm_are_other_robots():
    franka = load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))
    assert "'franka'" in FITTED.objection(Setting.of(franka), CAMERAS, is_foreseen=False)
    for metres, is_other in ((0.01, False), (0.05, True)):
        tools = np.array(HERE.tools) + [metres, 0, 0]
        arm = HERE.replace(tools=tuple(map(tuple, tools.tolist())))
        assert bool(FITTED.objection(arm, CAMERAS, is_foreseen=False)) == is_other


def test_other_numbers_of_contact_are_another_setting(tmp_path):
    own = tmp_path / 'own'
    copytree(share_path('resource', 'checkpoint'), own)
    assert Setting.of(ROBOT, Checkpoint.open(own).object_motion_digest) == Setting.of(
        ROBOT, Checkpoint.open('bundled').object_motion_digest
    )
    file = own / 'object_motion' / 'contact.json'
    file.write_text(file.read_text().replace('"table_friction": 0.8', '"table_friction": 0.4'))
    assert Setting.of(ROBOT, Checkpoint.open(own).object_motion_digest) != Setting.of(
        ROBOT, Checkpoint.open('bundled').object_motion_digest
    )


def test_the_bundled_estimate_is_calibrated_for_its_own_foresight_and_cameras():
    calibration = load_fit(share_path('resource', 'checkpoint'), Calibration)
    here = Setting.of(ROBOT, Checkpoint.open('bundled').object_motion_digest)
    assert calibration.elsewhere(here, CAMERAS, is_foreseen=True) == ''
    found = calibration.elsewhere(HERE, CAMERAS, is_foreseen=True)
    assert found.startswith('fitted with another foresight')
    assert not calibration.elsewhere(HERE, CAMERAS, is_foreseen=False)
    old = calibration.replace(fitted_to=None, made={'versions': 'mtv_world_ros 0.1.0, torch 2'})
    found = old.elsewhere(here, CAMERAS, is_foreseen=True)
    assert found == 'fitted with the foresight of mtv_world_ros 0.1.0'


def test_weights_are_those_of_rollouts_of_the_same_kind():
    calibration = load_fit(share_path('resource', 'checkpoint'), Calibration)
    here = Setting.of(ROBOT, Checkpoint.open('bundled').object_motion_digest)
    assert calibration.given(False) is calibration.unforeseen
    seen_alone = calibration.replace(unforeseen=None)
    found = seen_alone.elsewhere(here, CAMERAS, is_foreseen=False)
    assert found == 'fitted to rollouts with foreseen object motion'
    pictures = calibration.replace(fitted_to=calibration.fitted_to.replace(foresight=''))
    assert pictures.is_of_pictures and not calibration.is_of_pictures
    assert pictures.given(False) is pictures
    assert pictures.elsewhere(here, CAMERAS, is_foreseen=False) == ''
    assert 'another foresight' in pictures.elsewhere(here, CAMERAS, is_foreseen=True)


def test_fits_to_rollouts_without_foresight_have_files_of_their_own(tmp_path):
    calibration, horizon = load_fits(share_path('resource', 'checkpoint'))
    pictures = calibration.replace(fitted_to=calibration.fitted_to.replace(foresight=''))
    save_fit(tmp_path, calibration)
    save_fit(tmp_path, horizon)
    assert load_fits(tmp_path, of_pictures=True) == Fits(None, None)
    save_fit(tmp_path, pictures, of_pictures=True)
    assert load_fits(tmp_path) == Fits(calibration, horizon)
    assert load_fits(tmp_path, of_pictures=True) == Fits(pictures, None)


def test_older_fits_without_foresight_are_used_where_nothing_is_foreseen(tmp_path):
    calibration, horizon = load_fits(share_path('resource', 'checkpoint'))
    older = calibration.replace(fitted_to=calibration.fitted_to.replace(foresight=''))
    save_fit(tmp_path, older)
    save_fit(tmp_path, horizon)
    assert load_fits(tmp_path, of_pictures=True) == Fits(older, horizon)


def test_it_is_read_back_as_it_was_written():
    assert FittedTo(**FITTED.model_dump(mode='json')) == FITTED


def test_a_range_of_too_few_numbers_is_refused():
    with pytest.raises(ConfigError, match='10 numbers'):
        CameraRange(mount_link='base', low=(0.0,), high=(1.0,))
