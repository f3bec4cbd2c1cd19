"""Fingers on drives that give way, under hands that gain speed."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.simulation.dart.finger_swing import FingerDrives

STEP = 0.002
#: two fingers that face each other, both at their outer stop when open
DRIVES = FingerDrives(
    stiffness=np.full(2, 100.0),
    damping=np.full(2, 10.0),
    mass=np.full(2, 0.17),
    lower=np.array([0.0, -0.04]),
    upper=np.array([0.04, 0.0]),
)
STILL = np.zeros((2, 2))


def at(opening: float, count: int) -> np.ndarray:
    return np.tile([opening, -opening], (count + 1, 1))


def test_a_finger_rests_where_its_drive_holds_the_pull():
    pulls = np.full((1500, 2), 0.3)
    off, then = DRIVES.swings(pulls, at(0.02, 1500), STEP, STILL)
    np.testing.assert_allclose(off[-1], 0.003, rtol=1e-3)
    np.testing.assert_allclose(then, [[0.003, 0.003], [0.0, 0.0]], atol=1e-5)


def test_a_stop_holds_the_finger_that_would_swing_out():
    pulls = np.full((1500, 2), 0.3)
    off, _ = DRIVES.swings(pulls, at(0.04, 1500), STEP, STILL)
    np.testing.assert_allclose(off[-1], [0.0, 0.003], atol=1e-5)
    assert (off[:, 0] == 0).all()
    # what was commanded beyond a stop is no force
    off, _ = DRIVES.swings(0 * pulls, at(0.05, 1500), STEP, STILL)
    assert (off == 0).all()


def test_it_goes_on_from_part_to_part():
    pulls = np.random.default_rng(0).normal(0, 1, (400, 2))
    whole, end = DRIVES.swings(pulls, at(0.03, 400), STEP, STILL)
    first, then = DRIVES.swings(pulls[:150], at(0.03, 150), STEP, STILL)
    second, last = DRIVES.swings(pulls[150:], at(0.03, 250), STEP, then)
    np.testing.assert_allclose(np.concatenate([first, second[1:]]), whole, atol=1e-15)
    np.testing.assert_allclose(last, end, atol=1e-15)
