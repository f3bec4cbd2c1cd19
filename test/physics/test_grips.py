"""What measured fingers hold, on a hand that slides up and down, and in futures of it."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.physics.grips import FingerState, GripCourse, watch_fingers
from mtv_world_ros.physics.solids import Solid
from test.support import small_scene

#: a block that fingers stop at with an opening of 0.025 of 0.04 m
BLOCK = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.03, 0.05, 0.04]))
#: by which cameras may see it too far to the side to be between the fingers
OFF = np.array([0.035, 0.0, 0.0])
HELD_AT = 0.025


def picking(shut=HELD_AT):
    """Measured positions (N, 2) of a pick, a lift, and of fingers that open up there."""
    times = np.arange(0, 3.01, 0.02)
    height = 0.02 + 0.1 * np.clip((times - 1) / 0.5, 0, 1)
    closing = 0.04 - (0.04 - shut) * np.clip((times - 0.3) / 0.3, 0, 1)
    return np.stack([height, np.where(times < 2.2, closing, 0.04)], -1)


def held_in(robot, positions, block=BLOCK, fingers=None):
    course = GripCourse.of(robot, positions, 0.1, fingers)
    grips, poses = {}, np.eye(4)[None].copy()
    poses[0, :3, 3] = block.centre
    rows = []
    for row in range(len(positions)):
        grips, poses = course.after(row, grips, poses, [block])
        rows.append((bool(grips), poses[0, :3, 3].copy()))
    return rows


def test_a_block_between_fingers_that_stopped_goes_along_until_they_open(lift):
    positions = picking()[::5]
    rows = held_in(lift, positions)
    is_held = [held for held, _ in rows]
    assert not any(is_held[:5]) and all(is_held[8:21]) and not any(is_held[23:])
    ways = [point[2] - 0.02 for held, point in rows if held]
    lifted = positions[np.flatnonzero(is_held), 0] - 0.02
    np.testing.assert_allclose(ways, lifted, atol=1e-9)


@pytest.mark.parametrize(
    ('shut', 'block'),
    [
        (0.0, BLOCK),  # fingers met: nothing is between them
        (0.04, BLOCK),  # they never closed
        (HELD_AT, replace(BLOCK, centre=np.array([0.1, 0.0, 0.02]))),  # it lies elsewhere
        (HELD_AT, replace(BLOCK, size=np.array([0.2, 0.2, 0.02]))),  # a plate fits between none
        (0.03, replace(BLOCK, size=np.array([0.01, 0.02, 0.02]))),  # they stop far outside of it
    ],
)
def test_nothing_is_held_by_other_fingers(lift, shut, block):
    assert not any(held for held, _ in held_in(lift, picking(shut)[::5], block))


@pytest.mark.parametrize('holds', [False, True])
def test_futures_hold_what_contact_would_miss(lift, holds):
    block = replace(BLOCK, centre=BLOCK.centre + OFF)
    batch = small_scene.batch_of(lift, block, num_motions=2, grips_hold=holds, squeeze=0.1)
    motion, state = batch.advance(picking(), 5)
    highest = motion.points[:, :, 0, 2].max(1)
    assert (highest > 0.1).all() == holds
    # released, it falls
    assert (motion.points[:, -1, 0, 2] < 0.03).all()
    assert not any(state.grips)


def test_a_grip_goes_on_in_the_next_part_of_a_plan(lift):
    commands = picking()
    block = replace(BLOCK, centre=BLOCK.centre + OFF)
    given = {'num_motions': 2, 'grips_hold': True, 'squeeze': 0.1}
    whole, _ = small_scene.batch_of(lift, block, **given).advance(commands[:101], 5)
    batch = small_scene.batch_of(lift, block, **given)
    _, state = batch.advance(commands[:61], 5)
    assert all(0 in grips for grips in state.grips)
    second, _ = batch.advance(commands[60:101], 5, state)
    np.testing.assert_allclose(second.points[:, -1], whole.points[:, -1], atol=1e-6)


def test_fingers_that_rest_half_open_hold_nothing(lift):
    positions = np.tile([0.02, HELD_AT], (20, 1))
    positions[10:, 0] = 0.1  # the hand rises beside the block
    assert not any(held for held, _ in held_in(lift, positions))


def test_fingers_that_were_seen_to_close_hold_from_the_first_row_on(lift):
    _, fingers = watch_fingers(lift.gripper_openings(picking()[:51]), 0.02)
    positions = np.tile([0.02, HELD_AT], (5, 1))
    assert all(held for held, _ in held_in(lift, positions, fingers=fingers))


@pytest.mark.parametrize('told', [0.0, HELD_AT])
def test_fingers_that_do_not_follow_a_command_to_close_hold(lift, told):
    positions, commands = np.tile([[0.02, HELD_AT]], (6, 1)), np.tile([[0.02, told]], (6, 1))
    openings = lift.gripper_openings(positions)
    stopped, fingers = watch_fingers(openings, 0.1, commanded=lift.gripper_openings(commands))
    assert stopped.all() == (told == 0.0) and stopped.any() == (told == 0.0)
    # nor does the next plan show commands: its positions are measured
    assert all(held == (told == 0.0) for held, _ in held_in(lift, positions, fingers=fingers))


@pytest.mark.parametrize(
    ('openings', 'first', 'last'),
    [
        # a 2F-85 at 5 Hz: closed on a block, carried it, let it go
        ([1, 0.97, 0.72, 0.68, 0.61, 0.55, *[0.41] * 9, 0.42, 0.47, 0.53, 0.77, 1, 1], 6, 15),
        # closed in two steps on a second block after the first was let go
        ([1, 0.6, *[0.42] * 4, 0.47, 0.77, 1, 0.6, *[0.33] * 4, 0.44, 1, 1], 10, 13),
        ([1, 0.97, 0.7, 0.69, 0.69, 0.74, 0.8, 1, 1], None, None),  # turned around on its way
        ([1, 0.93, 0.85, 0.61, 0.57, 0.57, 0.61, 0.86], None, None),  # and so did this
        ([1, 0.7, 0.4, 0.27, 0.25, 0.26], None, None),  # may still close when the recording ends
        ([0.41] * 9, None, None),  # half open from the start
        ([0.2, 0.3, 0.41, *[0.5] * 6], None, None),  # opened half way
        ([1, 0.6, 0.3, 0.1, *[0.02] * 8], None, None),  # shut
        ([0.5, 0.5, 0.5, 0.4, *[0.33] * 5], 4, 8),  # began half open, then closed on something
    ],
)
def test_stops_of_fingers(openings, first, last):
    stopped, _ = watch_fingers(np.array([openings], float), 0.2)
    rows = np.flatnonzero(stopped[0])
    assert (rows[-1] if len(rows) else None) == last
    if first == 10:  # the earlier stop counts as well
        assert rows.tolist() == [2, 3, 4, 5, 10, 11, 12, 13]
    elif first is not None:
        assert rows.tolist() == list(range(first, last + 1))


def test_the_state_of_fingers_does_not_depend_on_how_rows_are_cut():
    openings = np.array([[1, 0.97, 0.72, 0.55, 0.41, 0.41, 0.41, 0.41, 0.41, 0.5, 0.7]])
    whole, end = watch_fingers(openings, 0.2)
    first, state = watch_fingers(openings[:, :6], 0.2)
    second, then = watch_fingers(openings[:, 5:], 0.2, state)
    assert not first.any() and second[0, :4].all()  # known once they have rested for long enough
    assert whole[0].tolist() == [*[False] * 4, *[True] * 5, False, False]
    for name in FingerState.__slots__:
        np.testing.assert_array_equal(getattr(then, name), getattr(end, name))


def _retry():
    """Positions of a grip, a lift, fingers that open up there, and a second grip at the table."""
    once = picking()[:141]  # ends with the fingers open, up there
    down = np.stack([np.linspace(0.12, 0.02, 20), np.full(20, 0.04)], -1)
    return np.concatenate([once, down, picking()])


@pytest.mark.parametrize('is_held', [True, False])
def test_fingers_hold_what_frames_showed_to_go_along_and_not_what_is_nearer(lift, is_held):
    """A block that is about to be put on another one: the tool point is nearer to the lower."""
    upper = replace(BLOCK, centre=np.array([0.0, 0.0, 0.06]), is_held=is_held)
    positions = np.tile([0.035, HELD_AT], (2, 1))
    _, fingers = watch_fingers(lift.gripper_openings(picking()[:51]), 0.02)
    course = GripCourse.of(lift, positions, 0.1, fingers)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = BLOCK.centre, upper.centre
    grips, _ = course.after(0, {}, poses, [BLOCK, upper])
    assert list(grips) == [1 if is_held else 0]


@pytest.mark.parametrize(
    ('other', 'overlap_m', 'raised_m'),
    [
        (BLOCK, 0.01, 0.01),  # it is put upon it: cameras are off by a centimetre
        (BLOCK, 0.03, 0.0),  # it pushes
        (BLOCK, -0.01, 0.0),  # it is above
        (replace(BLOCK, is_open=True), 0.01, 0.0),  # it is put into a bowl
        (replace(BLOCK, centre=np.array([0.1, 0.0, 0.02])), 0.01, 0.0),  # it passes by
    ],
)
def test_what_is_held_is_put_upon_what_it_reaches_into(lift, other, overlap_m, raised_m):
    """Overlapping solids fly apart when the fingers open."""
    positions = np.tile([0.035, HELD_AT], (2, 1))
    _, fingers = watch_fingers(lift.gripper_openings(picking()[:51]), 0.02)
    course = GripCourse.of(lift, positions, 0.1, fingers)
    upper = replace(BLOCK, centre=np.array([0.0, 0.0, 0.06 - overlap_m]), is_held=True)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = other.centre, upper.centre
    grips, _ = course.after(0, {}, poses, [other, upper])
    assert list(grips) == [1]
    _, after = course.after(1, grips, poses, [other, upper])
    assert after[1, 2, 3] - upper.centre[2] == pytest.approx(raised_m, abs=1e-9)


@pytest.mark.parametrize(('share', 'first'), [(1.0, True), (0.5, True), (0.3, False)])
def test_stops_hold_in_their_share_of_the_futures(lift, share, first):
    batch = small_scene.batch_of(
        lift, BLOCK, num_motions=8, grips_hold=True, squeeze=0.0, stop_holds=share,
        grip_friction=0.03,
    )  # fmt: skip
    motion, state = batch.advance(picking()[:101], 5)
    held = motion.points[:, :, 0, 2].max(1) > 0.1
    assert held[0] == first
    np.testing.assert_array_equal(held, state.stops.holds[:, 0])
    assert held.all() == (share == 1.0)
    again, _ = small_scene.batch_of(
        lift, BLOCK, num_motions=8, grips_hold=True, squeeze=0.0, stop_holds=share,
        grip_friction=0.03,
    ).advance(picking()[:101], 5)  # fmt: skip
    np.testing.assert_array_equal(again.points, motion.points)


def test_fingers_that_stop_where_no_solid_is_make_a_future_less_likely(lift):
    """A block that is carried away by the first grip cannot stop the fingers of the second."""
    lift_away = _retry()
    far = replace(BLOCK, centre=np.array([0.2, 0.0, 0.02]))
    given = {'num_motions': 2, 'grips_hold': True, 'squeeze': 0.1}
    _, near_state = small_scene.batch_of(lift, BLOCK, **given).advance(lift_away, 5)
    _, far_state = small_scene.batch_of(lift, far, **given).advance(lift_away, 5)
    assert near_state.stops.count.tolist() == far_state.stops.count.tolist() == [2]
    np.testing.assert_allclose(near_state.stops.weights, 1.0)
    np.testing.assert_allclose(far_state.stops.weights, 0.01)


def test_masks_that_refute_a_stop_let_it_hold_nothing(lift):
    _, fingers = watch_fingers(lift.gripper_openings(picking()[:51]), 0.02)
    refuted = replace(fingers, is_refuted=np.array([True]))
    positions = np.tile([0.02, HELD_AT], (5, 1))
    assert not any(held for held, _ in held_in(lift, positions, fingers=refuted))
    # the next stop, after the fingers opened, may hold again
    _, opened = watch_fingers(np.array([[0.625, 1.0]]), 0.2, refuted)
    assert not opened.is_refuted.any()


#: a wide low block, and one above it that fingers hold
LOWER = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.06, 0.09, 0.04]))
HELD = replace(BLOCK, centre=np.array([0.0, 0.0, 0.061]), is_held=True)


def releasing(height):
    """Measured positions (N, 2) of fingers that hold something, open, and rise; and before."""
    times = np.arange(0, 2.01, 0.02)
    width = HELD_AT + (0.04 - HELD_AT) * np.clip((times - 0.4) / 0.2, 0, 1)
    rising = height + 0.1 * np.clip((times - 1.0) / 0.5, 0, 1)
    return np.stack([rising, width], -1)


@pytest.mark.parametrize(
    ('aside_m', 'height'),
    [
        (0.0, 0.065),  # as seen
        (0.012, 0.065),  # a finger is drawn into the held block
        (0.0, 0.035),  # the fingers are drawn into the lower block
        (0.012, 0.035),
    ],
)
def test_what_fingers_let_go_stays_where_it_was_put(lift, aside_m, height):
    """Fingers that cameras draw into a solid would shoot it away once nothing holds it."""
    _, fingers = watch_fingers(lift.gripper_openings(picking()[:51]), 0.02)
    seen = [LOWER, replace(HELD, centre=HELD.centre + np.array([0.0, aside_m, 0.0]))]
    batch = small_scene.batch_of(lift, *seen, num_motions=2, grips_hold=True, squeeze=0.1)
    commands = releasing(height)
    motion, state = batch.advance(commands, 5, batch.start(commands[0], fingers))
    assert not any(state.grips) and not any(state.passed)
    moved = motion.points[:, -1] - motion.points[:, 0]
    np.testing.assert_allclose(moved, 0.0, atol=0.003)


def test_free_fingers_that_reach_into_a_block_grip_it(lift):
    """They are about to close on it: it is lifted, and not passed through."""
    aside = replace(BLOCK, centre=BLOCK.centre + np.array([0.0, 0.03, 0.0]))
    batch = small_scene.batch_of(
        lift, aside, num_motions=2, grips_hold=True, squeeze=0.1, stop_holds=0.0
    )
    commands = picking(0.02)
    motion, _ = batch.advance(commands, 5)
    assert (motion.points[:, :, 0, 2].max(1) > 0.1).all()
