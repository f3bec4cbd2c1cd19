"""The arm's outline tells where cameras are, in pictures of the simulator."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import Observation, SuccessEstimate
from mtv_world_ros.core.files import bundled
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape, rods
from mtv_world_ros.simulation.expert.expert import home_positions
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.success.trust import with_notes, without_verdict
from mtv_world_ros.vision.camera_check import CameraCheck, CameraChecker

ROBOT = load_robot(bundled('robots', 'yam_bimanual', '--robot'))
CHECKER = CameraChecker(ROBOT, load_shape(ROBOT))
TASKS = ('place_block_a2b_left', 'collect_food')
#: where objects lie [m]
PLACES = np.array([[x, y, 0.03] for x in (-0.2, 0.0, 0.2) for y in (0.2, 0.35)])


def off(camera, metres, degrees, rng):
    way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    pose = np.array(camera.T_mount_camera)
    pose[:3, :3] = cv2.Rodrigues(axis * np.deg2rad(degrees))[0] @ pose[:3, :3]
    pose[:3, 3] += metres * way
    return replace(camera, T_mount_camera=pose)


def apart(one, other):
    """Mean distance in the picture of what both cameras see where objects lie [px]."""
    ends = [project(c, c.T_mount_camera, PLACES)[0] for c in (one, other)]
    return float(np.linalg.norm(ends[0] - ends[1], axis=-1).mean())


@pytest.fixture(scope='module')
def scenes():
    sim = SimEpisode(ROBOT, home_positions(ROBOT))
    found = []
    for seed in range(4):
        seen = sim.reset(seed, TASKS[seed % 2])
        cameras = sim.scene.cameras
        frames = np.stack([seen.images[camera.view] for camera in cameras])
        found.append(
            Observation(cameras=cameras, frames=frames, positions=seen.positions, stamp_ns=1)
        )
    sim.close()
    return found


def test_exact_cameras_are_left_alone(scenes):
    for scene in scenes:
        check = CHECKER.check(scene)
        assert [fit.status for fit in check.fits] == ['fits', 'fits']
        assert max(fit.offset_px for fit in check.fits) < 1.0
        assert check.corrected_observation(scene) is scene and not check.notes


@pytest.mark.parametrize(('metres', 'degrees'), [(0.01, 1.0), (0.015, 1.5)])
def test_small_errors_are_corrected_where_objects_lie(scenes, metres, degrees):
    rng = np.random.default_rng(3)
    before, after = [], []
    for scene in scenes:
        told = tuple(off(camera, metres, degrees, rng) for camera in scene.cameras)
        check = CHECKER.check(replace(scene, cameras=told))
        assert {fit.status for fit in check.fits} <= {'corrected', 'fits'}
        for true, wrong, found in zip(scene.cameras, told, check.corrected(told), strict=True):
            before.append(apart(true, wrong))
            after.append(apart(true, found))
    assert np.mean(before) > 8.0
    assert max(after) < 1.5 and np.mean(after) < 0.6
    assert all('corrected for this episode' in note for note in check.notes)


def test_corrections_hold_at_the_models_size(scenes):
    scene = scenes[0]
    told = tuple(off(c, 0.01, 1.0, np.random.default_rng(4)) for c in scene.cameras)
    check = CHECKER.check(replace(scene, cameras=told))
    small = [replace(c, width=96, height=72, K=np.diag([0.25, 0.25, 1]) @ c.K) for c in told]
    for corrected, found in zip(check.corrected(told), check.corrected(small), strict=True):
        assert np.allclose(corrected.T_mount_camera, found.T_mount_camera)


def test_large_errors_refuse_the_verdict(scenes):
    rng, statuses = np.random.default_rng(5), []
    for scene in scenes:
        told = tuple(off(camera, 0.03, 4.5, rng) for camera in scene.cameras)
        check = CHECKER.check(replace(scene, cameras=told))
        statuses += [fit.status for fit in check.fits if fit.status != 'unchecked']
        for camera, fit in zip(told, check.fits, strict=True):
            if fit.status == 'refused':
                assert 'fit camera' in check.refusal and camera.view in check.refusal
    assert statuses.count('refused') >= 4 and 'fits' not in statuses


def test_what_was_not_checked_is_never_called_fitting(scenes):
    blank = replace(scenes[0], frames=np.full_like(scenes[0].frames, 128))
    noise = np.random.default_rng(6).integers(0, 255, scenes[0].frames.shape, dtype=np.uint8)
    unknown = CameraChecker(ROBOT, rods(ROBOT, 'a test'))
    for check in (
        CHECKER.check(blank),
        CHECKER.check(replace(scenes[0], frames=noise)),
        unknown.check(scenes[0]),
    ):
        assert [fit.status for fit in check.fits] == ['unchecked', 'unchecked']
        assert len(check.notes) == 2 and 'not checked' in check.text
    assert CameraCheck().text == 'not checked'


def test_a_refusal_takes_the_verdict_and_notes_leave_it():
    estimate = SuccessEstimate(
        probability=0.8, interval=(0.7, 0.9), jaccard=np.zeros((2, 1)), reasons=('why',)
    )
    assert with_notes(estimate, ()) is estimate and without_verdict(estimate, '') is estimate
    noted = with_notes(estimate, ['look'])
    assert noted.probability == 0.8 and noted.reasons == ('why', 'look')
    refused = without_verdict(estimate, 'the camera is off')
    assert np.isnan(refused.probability) and np.isnan(refused.interval).all()
    assert refused.reasons == ('cannot tell, because the camera is off', 'why')
