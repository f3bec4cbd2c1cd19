"""Whether what fingers closed on goes along with the hand, by masks and projected tools."""

from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.cameras.camera import unknown_camera
from mtv_world_ros.vision.held_objects import (
    attempted_places,
    attempts,
    Hold,
    judge_stops,
    tools_in_views,
)

_WIDTH, _HEIGHT, _FRAMES, _CLOSED = 96, 72, 14, 4
_AWAY = 4.0 * np.maximum(np.arange(_FRAMES) - _CLOSED, 0)
_STARTS = (30.0, 60.0)


def _motion(column=_STARTS[0], speed=1.0):
    """Return a tool that closes in frame 4 at a column and goes 4 px a frame to the right."""
    camera = unknown_camera('front', _WIDTH, _HEIGHT, 'base')
    pixels = np.stack([column + speed * _AWAY, np.full(_FRAMES, 40.0)], axis=1)
    rays = (pixels - camera.K[:2, 2]) / camera.K[0, 0]
    return SimpleNamespace(
        tool_points=np.concatenate([rays, np.ones((_FRAMES, 1))], axis=1)[None],
        cameras=(camera,),
        camera_poses=np.broadcast_to(np.eye(4), (1, _FRAMES, 4, 4)),
    )


def _masks(*columns):
    """Return (1, O, N, H, W) masks of 8x8 px blocks around columns (N,); NaN = not seen."""
    masks = np.zeros((1, len(columns), _FRAMES, _HEIGHT, _WIDTH), np.bool_)
    for item, of_item in enumerate(columns):
        for frame, column in enumerate(of_item):
            if np.isfinite(column):
                left = max(round(column) - 4, 0)
                masks[0, item, frame, 36:44, left : round(column) + 4] = True
    return masks


def _judged(*columns, motion=None, opened=_FRAMES):
    motion = motion or _motion()
    (stop,) = judge_stops(motion, _masks(*columns), [(0, _CLOSED, opened)])
    return stop


_STAYS = np.full(_FRAMES, _STARTS[0])
_GOES = _STARTS[0] + _AWAY
_HIDDEN = np.where(np.arange(_FRAMES) < _CLOSED, _STARTS[0], np.nan)


@pytest.mark.parametrize(
    ('columns', 'hold'),
    [
        (_GOES, Hold.HELD),
        (_STAYS, Hold.NOT_HELD),
        (np.where(np.arange(_FRAMES) > _CLOSED, 10.0, _STARTS[0]), Hold.NOT_SEEN),  # pushed away
        (_HIDDEN, Hold.NOT_SEEN),
        # lost for a while, then seen in the hand
        (np.where(np.arange(_FRAMES) < 10, _HIDDEN, _GOES), Hold.HELD),
    ],
)
def test_a_stop_is_held_not_held_or_not_seen(columns, hold):
    stop = _judged(columns)
    assert (stop.item, stop.hold) == (0, hold)


def test_masks_that_swap_their_names_are_no_evidence():
    late = np.arange(_FRAMES) > _CLOSED + 1
    other = np.full(_FRAMES, _STARTS[1] + 30)
    swapped = np.where(late, other, _GOES), np.where(late, _GOES, other)
    assert _judged(*swapped).hold is Hold.NOT_SEEN


def test_a_hand_that_does_not_move_tells_nothing():
    assert _judged(_STAYS, motion=_motion(speed=0.0)).hold is Hold.NOT_TOLD


def test_what_happens_after_the_fingers_open_tells_nothing():
    assert _judged(_STAYS, opened=_CLOSED + 2).hold is Hold.NOT_TOLD


def test_fingers_that_close_far_from_every_object_have_none():
    stop = _judged(_STAYS, motion=_motion(column=50.0))
    assert (stop.item, stop.hold) == (None, Hold.NOT_TOLD)


@pytest.mark.parametrize(
    ('openings', 'expected'),
    [
        ([1, 1, 0.6, 0.3, 0.3, 0.3, 0.9, 1], [(4, 6)]),
        ([1, 1, 1, 1], []),
        ([1, 0.5, 0.5, 0.5], [(2, 4)]),
        ([0.3, 0.3, 0.3, 0.3], []),
        ([1, 0.2, 0.2, 1, 0.2, 0.2], [(2, 3), (5, 6)]),
    ],
)
def test_a_gripper_attempts_when_its_fingers_have_closed(openings, expected):
    assert attempts(np.array(openings, float)) == expected


def _places(columns, openings):
    return attempted_places(_masks(columns), openings, tools_in_views(_motion(), 0))


def test_places_of_an_attempt_are_those_of_the_grasp_and_of_the_miss():
    openings = np.where(np.arange(_FRAMES) < _CLOSED - 1, 1.0, 0.2)
    (closed, _), *_ = attempts(openings)
    grasped, missed = _places(_GOES, openings), _places(_STAYS, openings)
    assert (grasped == missed).all()
    assert not missed[:, :closed].any()
    for columns in (_GOES, _STAYS):
        shown = _masks(columns)[:, 0, closed:]
        assert (shown & ~missed[:, closed:]).sum() == 0


def test_an_object_that_was_never_seen_has_no_place_and_one_that_enters_later_has_its_last():
    openings = np.where(np.arange(_FRAMES) < _CLOSED - 1, 1.0, 0.2)
    tools = tools_in_views(_motion(), 0)
    masks = _masks(_STAYS)
    whole = attempted_places(masks, openings, tools)
    assert not attempted_places(np.zeros_like(masks), openings, tools).any()
    masks[:, :, 0] = False
    assert (attempted_places(masks, openings, tools) == whole).all()


def test_what_a_tool_lets_go_would_stay_where_it_opened():
    frames, opened = np.arange(_FRAMES), _FRAMES - 3
    openings = np.where((frames < _CLOSED - 1) | (frames >= opened), 1.0, 0.2)
    places = _places(_STAYS, openings)
    assert (places[:, opened:] == places[:, opened - 1 : opened]).all()


def test_a_gripper_that_closed_before_the_first_frame_carries_what_it_is_at():
    places = _places(_GOES, np.full(_FRAMES, 0.2))
    assert (_masks(_GOES)[:, 0] & ~places).sum() == 0


def test_a_gripper_that_stays_open_attempts_nothing():
    assert not _places(_STAYS, np.ones(_FRAMES)).any()
