"""What measured fingers hold, on a hand that slides up and down, and in futures of it."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.physics.grips import GripCourse
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


def held_in(robot, positions, block=BLOCK):
    course = GripCourse.of(robot, positions)
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
