"""What solids do, against what mechanics says in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.physics.solids import Solid
from test.support.small_scene import batch_of, SETTINGS

G = 9.81
#: away from the hand
BLOCK = Solid(centre=np.array([0.5, 0.0, 0.02]), size=np.array([0.04, 0.04, 0.04]))
REST = np.array([0.3, 0.04])


def moved(batch, seconds, commands=None, **begun):
    """Motion of solids that begin with a velocity (6,) or a quaternion (4,), w first."""
    commands = (
        np.repeat(REST[None], round(seconds / 0.02) + 1, 0) if commands is None else commands
    )
    state = batch.start(commands[0])
    physics, scene = state.physics.copy(), batch._scene
    for name, values in begun.items():
        first = scene.solid_qpos[0] + 4 if name == 'turned' else 1 + scene.model.nq
        first += 0 if name == 'turned' else scene.solid_dofs[0]
        physics[:, first : first + len(values)] = values
    state = replace(state, physics=physics, still=np.zeros(len(physics), int))
    return batch.advance(commands, 1, state)[0]


def test_what_is_let_go_falls(lift):
    high = replace(BLOCK, centre=np.array([0.5, 0.0, 0.32]))
    heights = moved(batch_of(lift, high), 0.2).points[0, :, 0, 2]
    times = np.arange(len(heights)) * 0.02
    np.testing.assert_allclose(heights, 0.32 - G / 2 * times**2, atol=0.005)


@pytest.mark.parametrize('angle', [0.0, np.pi / 4, 2.0])
@pytest.mark.parametrize('friction', [0.3, 0.8])
def test_what_slides_stops_where_friction_has_taken_its_speed(lift, angle, friction):
    """In all directions alike."""
    speed = 0.6
    way = speed * np.array([np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0, 0.0])
    flat = replace(BLOCK, size=np.array([0.06, 0.06, 0.02]), centre=np.array([0.5, 0.0, 0.01]))
    points = moved(batch_of(lift, flat, table_friction=friction), 0.6, fast=way).points[0, :, 0]
    slid = np.linalg.norm(points[-1] - points[0])
    assert slid == pytest.approx(speed**2 / (2 * friction * G), rel=0.06)


@pytest.mark.parametrize(('share', 'falls'), [(0.8, False), (1.2, True)])
def test_what_leans_falls_over_if_its_middle_is_beyond_its_edge(lift, share, falls):
    wide, high = 0.03, 0.09
    lean = share * np.arctan(wide / high)
    # on its edge
    reach = np.hypot(wide, high) / 2
    height = reach * np.cos(np.arctan(wide / high) - lean)
    tall = Solid(centre=np.array([0.5, 0.0, height]), size=np.array([wide, wide, high]))
    turned = [np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0]
    batch = batch_of(lift, tall, table_friction=1.0)
    upright = moved(batch, 1.0, turned=turned).rotations[0, -1, 0, 2, 2]
    assert (upright < 0.1) == falls and (falls or upright > 0.99)


@pytest.mark.parametrize(('share', 'holds'), [(0.7, True), (1.5, False)])
def test_fingers_hold_what_weighs_less_than_their_friction(lift, share, holds):
    """Two fingers press with their stiffness times how far the object holds them apart."""
    wide, friction = 0.04, 0.6
    most_kg = 2 * friction * SETTINGS.finger_stiffness * wide / 2 / G
    size = np.array([0.02, wide, 0.04])
    density = share * most_kg / float(np.prod(size))
    held = Solid(centre=np.array([0.0, 0.0, 0.02]), size=size)
    batch = batch_of(lift, held, grip_friction=friction, density=density)
    times = np.arange(0, 2.0, 0.02)
    rise = 0.02 + 0.1 * np.clip((times - 0.6) / 0.8, 0, 1)
    commands = np.stack([rise, np.where(times < 0.05, 0.04, 0.0)], -1)
    motion = moved(batch, 2.0, commands)
    height = motion.points[0, -1, 0, 2] - 0.02
    assert (height > 0.09) if holds else (height < 0.02)
    if holds:  # the fingers are where the object stops them
        assert motion.joints[0, -1, 1] == pytest.approx(wide / 2, abs=0.002)


@pytest.mark.parametrize(('squeeze', 'holds'), [(0.0, False), (0.3, True)])
def test_fingers_whose_commands_are_measured_positions_hold_by_their_squeeze(lift, squeeze, holds):
    """Measured positions end where the object stops the fingers: they press by nothing."""
    wide = 0.04
    held = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.02, wide, 0.04]))
    times = np.arange(0, 2.0, 0.02)
    rise = 0.02 + 0.1 * np.clip((times - 0.6) / 0.8, 0, 1)
    commands = np.stack([rise, np.where(times < 0.05, 0.04, wide / 2)], -1)
    motion = moved(batch_of(lift, held, squeeze=squeeze), 2.0, commands)
    height = motion.points[0, -1, 0, 2] - 0.02
    assert (height > 0.09) if holds else (height < 0.02)


def test_an_open_gripper_squeezes_nothing(lift):
    commands = np.repeat(REST[None], 26, 0)
    found = [moved(batch_of(lift, BLOCK, squeeze=one), 0.5, commands).joints for one in (0.0, 0.3)]
    assert (found[0] == found[1]).all()


@pytest.mark.parametrize('varies', [False, True])
def test_a_table_of_unknown_height_holds_objects_alone(lift, varies):
    commands = np.stack([np.linspace(0.3, 0.02, 51), np.full(51, 0.04)], -1)
    commands = np.concatenate([commands, np.repeat(commands[-1:], 50, 0)])
    block = replace(BLOCK, centre=np.array([0.5, 0.0, 0.07]))
    motion = moved(batch_of(lift, block, table_m=0.05, table_varies=varies), 2.0, commands)
    # fingers reach 15 mm below the hand
    lowest = motion.joints[0, -1, 0] - 0.015
    assert lowest == pytest.approx(0.005, abs=1e-3) if varies else lowest > 0.03
    assert motion.points[0, -1, 0, 2] == pytest.approx(0.07, abs=1e-3)


def test_what_is_held_stays_where_it_is_held(lift):
    """Friction holds, it does not creep: within 2 mm in 3 s at a third of its limit."""
    held = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.02, 0.03, 0.04]))
    times = np.arange(0, 5.0, 0.02)
    rise = 0.02 + 0.1 * np.clip((times - 0.6) / 0.8, 0, 1)
    commands = np.stack([rise, np.where(times < 0.05, 0.04, 0.0)], -1)
    heights = moved(batch_of(lift, held), 5.0, commands).points[0, :, 0, 2]
    assert heights[100] > 0.1 and heights[-1] - heights[100] > -0.002


@pytest.mark.parametrize('is_round', [False, True])
def test_what_stands_on_something_stays_there(lift, is_round):
    under = replace(BLOCK, size=np.full(3, 0.05), centre=np.array([0.5, 0.0, 0.025]))
    size = np.array([0.04, 0.04, 0.06])
    upper = Solid(centre=np.array([0.51, 0.0, 0.08]), size=size, is_round=is_round)
    motion = moved(batch_of(lift, under, upper), 2.0)
    assert np.abs(motion.points[0, -1] - motion.points[0, 0]).max() < 0.001
    assert motion.rotations[0, -1, :, 2, 2].min() > 0.999


def test_what_falls_into_a_bowl_stays_in_it(lift):
    bowl = Solid(
        centre=np.array([0.5, 0.0, 0.02]),
        size=np.array([0.14, 0.14, 0.04]),
        is_round=True,
        is_open=True,
    )
    ball = Solid(centre=np.array([0.5, 0.01, 0.09]), size=np.full(3, 0.03))
    points = moved(batch_of(lift, bowl, ball), 1.0).points[0, -1]
    assert 0.015 < points[1, 2] < 0.03 and np.abs(points[1, :2] - points[0, :2]).max() < 0.055
