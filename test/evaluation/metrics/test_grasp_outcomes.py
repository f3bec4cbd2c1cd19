"""Outcomes of grasps: an object that goes along, one that stays, and one that is dreamt."""

from types import SimpleNamespace

import numpy as np

from mtv_world_ros.cameras.camera import unknown_camera
from mtv_world_ros.evaluation.metrics.grasp_outcomes import Dreams, grasp_outcomes, GraspOutcome

_WIDTH, _HEIGHT, _FRAMES = 96, 72, 14
_START, _CLOSED = (30, 40), 4


def _camera():
    camera = unknown_camera('front', _WIDTH, _HEIGHT, 'base')
    return camera


def _motion(offset_px=0.0):
    """Return a tool that closes at a block in frame 4 and goes 4 px a frame to the right."""
    camera = _camera()
    focal, centre = camera.K[0, 0], camera.K[:2, 2]
    columns = _START[0] + offset_px + 4.0 * np.maximum(np.arange(_FRAMES) - _CLOSED, 0)
    pixels = np.stack([columns, np.full(_FRAMES, float(_START[1]))], axis=1)
    points = np.concatenate([(pixels - centre) / focal, np.ones((_FRAMES, 1))], axis=1)
    openings = np.where(np.arange(_FRAMES) < _CLOSED, 1.0, 0.3)
    poses = np.broadcast_to(np.eye(4), (_FRAMES, 4, 4))
    return SimpleNamespace(
        openings=openings[None],
        tool_points=points[None],
        cameras=(camera,),
        camera_poses=poses[None],
    )


def _masks(*columns_by_frame):
    """Return (1, 1, N, H, W) masks of 8x8 px blocks around columns, by frame."""
    masks = np.zeros((1, 1, _FRAMES, _HEIGHT, _WIDTH), bool)
    for frame in range(_FRAMES):
        for columns in columns_by_frame:
            left = round(columns[frame]) - 4
            masks[0, 0, frame, _START[1] - 4 : _START[1] + 4, left : left + 8] = True
    return masks


_STAYS = np.full(_FRAMES, _START[0])
_GOES = _START[0] + 4.0 * np.maximum(np.arange(_FRAMES) - _CLOSED, 0)


def _outcome(real, imagined, offset_px=0.0):
    return grasp_outcomes(_motion(offset_px), ('red block',), real, imagined)


def test_an_object_that_goes_along_with_the_gripper_is_grasped():
    (found,) = _outcome(_masks(_GOES), _masks(_GOES))
    assert (found.name, found.frame, found.real, found.imagined) == ('red block', 5, True, True)


def test_one_that_stays_is_a_missed_grasp_and_one_that_goes_in_imagination_a_dream():
    (found,) = _outcome(_masks(_STAYS), _masks(_GOES))
    assert (found.real, found.imagined) == (False, True)


def test_a_second_object_in_the_gripper_is_a_dream_although_the_first_one_stays():
    (found,) = _outcome(_masks(_STAYS), _masks(_STAYS, _GOES))
    assert (found.real, found.imagined) == (False, True)


def test_an_object_that_is_pushed_another_way_is_not_grasped():
    (found,) = _outcome(_masks(_START[0] - (_GOES - _START[0]) / 2), _masks(_STAYS))
    assert (found.real, found.imagined) == (False, False)


def test_a_gripper_that_closes_far_from_every_object_attempts_nothing():
    assert _outcome(_masks(_STAYS), _masks(_STAYS), offset_px=20.0) == ()


def test_an_object_without_a_mask_is_not_attempted():
    empty = np.zeros_like(_masks(_STAYS))
    assert _outcome(empty, empty) == ()


def _entered(masks, frame=2):
    """Return the masks, empty before a frame."""
    masks[:, :, :frame] = False
    return masks


def test_an_object_that_enters_later_is_judged_from_where_it_was_seen_last():
    (found,) = _outcome(_entered(_masks(_GOES)), _entered(_masks(_GOES)))
    assert (found.real, found.imagined) == (True, True)
    (found,) = _outcome(_entered(_masks(_STAYS)), _entered(_masks(_GOES)))
    assert (found.real, found.imagined) == (False, True)


def test_a_grasp_of_an_object_that_imagination_never_shows_is_missed():
    nothing = np.zeros_like(_masks(_STAYS))
    (found,) = _outcome(_entered(_masks(_GOES)), nothing)
    assert (found.real, found.imagined) == (True, False)
    (found,) = _outcome(_entered(_masks(_STAYS)), nothing)
    assert (found.real, found.imagined) == (False, False)


def test_shares_of_dreams_count_misses_and_grasps_apart():
    def attempt(real, imagined):
        return GraspOutcome(stretch=0, frame=1, arm=0, name='a', real=real, imagined=imagined)

    grasps = [attempt(False, True), attempt(False, False), attempt(True, True)]
    found = Dreams.of(grasps, [(True, True), (False, True), (True, False)])
    assert (found.dreamt.hits, found.dreamt.count) == (1, 2)
    assert (found.missed.hits, found.missed.count) == (0, 1)
    assert found.precision.value == found.recall.value == 0.5
    assert found.line.startswith('missed grasps dreamt: 1 of 2 (0.50 [')
    assert '; of what moves in imagination, moves in truth: 1 of 2 (' in found.line


def test_no_attempt_has_no_line():
    assert Dreams.of([], [(True, False)]).line == ''  # `tables.md` has these shares
    assert Dreams.of([], []).dreamt.text == 'none'
