"""Last free sights of objects: poses that are kept while fingers hide or hold them."""

from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.cameras.camera import project, unknown_camera
from mtv_world_ros.physics.sights import Sights
from mtv_world_ros.vision.held_objects import Hold

CAMERAS = tuple(unknown_camera(view, 160, 96, 'base') for view in ('left', 'right'))
BLOCK = np.array([0.1, 0.05, 1.0])
PERIOD_S = 0.2
#: half the width of what is drawn of a block [px]
HALF = 7


def _poses(count):
    poses = np.tile(np.eye(4), (2, count, 1, 1))
    poses[1, :, 0, 3] = 0.25
    return poses


def _motion(tools):
    """Return a robot of one arm at tool points (T, 3)."""
    poses = np.tile(np.eye(4), (1, len(tools), 1, 1))
    poses[0, :, :3, 3] = tools

    def first(count):
        return _motion(tools[:count])

    return SimpleNamespace(
        cameras=CAMERAS, camera_poses=_poses(len(tools)), tools=poses, first=first
    )


def _masks(points, shown):
    """Return (2, 1, T, 96, 160) squares around points (T, 3), a share of whose rows is shown."""
    masks = np.zeros((2, 1, len(points), 96, 160), np.bool_)
    for view, (camera, pose) in enumerate(zip(CAMERAS, _poses(1)[:, 0], strict=True)):
        for row, (point, share) in enumerate(zip(points, shown, strict=True)):
            x, y = np.rint(project(camera, pose, point)[0]).astype(int)
            low = y + HALF - round(2 * HALF * share)
            masks[view, 0, row, low : y + HALF, x - HALF : x + HALF] = True
    return masks


def _watched(tools, points, shown, stopped):
    tools, points = np.asarray(tools, float), np.asarray(points, float)
    motion = _motion(tools)
    sights = Sights.begin(('block',), motion)
    return sights.after(motion, _masks(points, shown), np.asarray(stopped, bool)[None], PERIOD_S)


def _still(count):
    return np.tile(BLOCK, (count, 1))


def _lifted(count, step=-0.02):
    return BLOCK + np.arange(count)[:, None] * [0.0, step, 0.0]


ABOVE = BLOCK - [0.0, 0.1, 0.0]


def test_what_the_last_frame_shows_free_needs_no_memory():
    sights = _watched([ABOVE] * 3, _still(3), [1, 1, 1], [0, 0, 0])
    np.testing.assert_allclose(sights.of_each[0].point, BLOCK, atol=0.01)
    assert sights.kept(_motion([ABOVE]).tools[:, 0]) == (None,)


def test_a_half_hidden_object_stays_where_it_was_seen_free_and_its_error_grows():
    errors = []
    for hidden in (2, 5):
        sights = _watched([BLOCK] * (2 + hidden), _still(2 + hidden), [1, 1] + [0.4] * hidden,
                          [0] * (2 + hidden))  # fmt: skip
        (kept,) = sights.kept(_motion([BLOCK]).tools[:, 0])
        assert kept is not None and not kept.is_held
        np.testing.assert_array_equal(kept.moved, np.eye(4))
        assert kept.age_s == pytest.approx(hidden * PERIOD_S)
        errors.append(kept.error_m)
    assert 0 < errors[0] < errors[1]


def test_an_object_that_was_pushed_while_it_was_hidden_is_not_kept():
    points = _still(6)
    points[3:, 0] += 0.15
    assert _watched([BLOCK] * 6, points, [1, 1, 0.4, 0.4, 0.4, 0.4], [0] * 6).kept(
        _motion([BLOCK]).tools[:, 0]
    ) == (None,)


def test_what_fingers_hold_keeps_its_place_in_the_gripper():
    way = np.concatenate([_still(3), _lifted(8, -0.03)])
    stopped = [0, 0] + [1] * 9
    sights = _watched(way, way, [1, 1] + [0.4] * 9, stopped)
    assert sights.of_each[0].hold is Hold.HELD and not sights.refuted.any()
    assert sights.held == (True,)
    (kept,) = sights.kept(_motion(way[-1:]).tools[:, 0])
    assert kept.is_held
    np.testing.assert_allclose(kept.moved[:3, 3], way[-1] - BLOCK, atol=1e-9)


def test_a_second_grip_of_an_object_that_was_never_free_in_between_is_seen():
    """It is let go where the hand is, which keeps hiding a part of it, and is gripped again."""
    first = _lifted(8, -0.03)
    way = np.concatenate([_still(3), first, np.tile(first[-1], (3, 1)), first[-2:1:-1]])
    stopped = [0, 0] + [1] * 9 + [0] * 2 + [1] * 6
    sights = _watched(way, way, [1, 1] + [0.4] * 17, stopped)
    assert sights.held == (True,)
    np.testing.assert_allclose(sights.of_each[0].point, first[-1], atol=0.01)
    # it is visible now, and looked for there; the place from before the first grip is not kept
    assert sights.kept(_motion(way[-1:]).tools[:, 0]) == (None,)


def test_a_stop_that_held_nothing_leaves_the_object_where_it_was():
    way = np.concatenate([_still(3), _lifted(8)])
    shown = [1, 1] + [0.4] * 3 + [0.55] * 6
    sights = _watched(way, _still(11), shown, [0, 0] + [1] * 9)
    assert sights.of_each[0].hold is Hold.NOT_HELD and sights.refuted.tolist() == [True]
    (kept,) = sights.kept(_motion(way[-1:]).tools[:, 0])
    assert not kept.is_held
    np.testing.assert_array_equal(kept.moved, np.eye(4))


def test_an_object_that_was_let_go_elsewhere_and_is_hidden_is_looked_for():
    way = np.concatenate([_still(3), _lifted(8)])
    sights = _watched(way, way, [1, 1] + [0.4] * 9, [0, 0] + [1] * 8 + [0])
    assert sights.of_each[0].is_moved
    assert sights.kept(_motion(way[-1:]).tools[:, 0]) == (None,)


@pytest.mark.parametrize('tool', [ABOVE, BLOCK])
def test_an_object_that_leaves_the_table_is_kept_only_where_a_hand_may_hide_it(tool):
    masks = _masks(_still(8), [1] * 8)
    masks[:, :, 3:] = False
    motion = _motion(np.tile(tool, (8, 1)))
    sights = Sights.begin(('block',), motion).after(
        motion, masks, np.zeros((1, 8), np.bool_), PERIOD_S
    )
    (kept,) = sights.kept(motion.tools[:, -1])
    assert (kept is not None) == (tool is BLOCK)


def test_an_object_that_was_never_seen_free_by_two_views_has_no_sight():
    masks = _masks(_still(3), [1, 1, 1])
    masks[1] = False
    motion = _motion(np.tile(ABOVE, (3, 1)))
    sights = Sights.begin(('block',), motion).after(
        motion, masks, np.zeros((1, 3), np.bool_), PERIOD_S
    )
    assert sights.of_each == (None,) and sights.kept(motion.tools[:, -1]) == (None,)


def test_a_robot_without_a_gripper_holds_nothing():
    motion = _motion(np.tile(ABOVE, (3, 1)))
    motion.tools = motion.tools[:0]
    sights = Sights.begin(('block',), motion).after(
        motion, _masks(_still(3), [1, 0.4, 0.4]), np.zeros((0, 3), np.bool_), PERIOD_S
    )
    assert not len(sights.refuted)
    assert sights.kept(motion.tools[:, -1])[0].age_s == pytest.approx(2 * PERIOD_S)


def test_an_object_that_was_turned_is_free_again_once_the_hand_is_far():
    """It shows less of itself than before; while the hand is near, it may be hidden."""
    away = np.concatenate([_still(3), _lifted(8)])
    shown = [1, 1] + [0.7] * 9
    still_near = _watched(_still(11), _still(11), shown, [0] * 11)
    assert still_near.of_each[0].age_s == pytest.approx(9 * PERIOD_S)
    assert _watched(away, _still(11), shown, [0] * 11).of_each[0].age_s == 0.0
