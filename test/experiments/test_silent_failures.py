"""When a future leaves the truth, and how far joint zeros move what is seen."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.core.transforms import about_z
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def scripts():
    with imported_scripts('silent_failures', 'joint_zeros') as modules:
        yield modules


def course(heights, yaws):
    """Poses (T, 1, 4, 4) of an object that rises and turns."""
    poses = np.tile(np.eye(4), (len(heights), 1, 1, 1))
    poses[:, 0, 2, 3] = heights
    poses[:, 0, :3, :3] = [about_z(yaw) for yaw in yaws]
    return poses


def test_a_future_leaves_the_truth_where_it_lifts_or_turns_otherwise(scripts):
    silent, _ = scripts
    still, lifted = np.zeros(20), np.clip(0.01 * (np.arange(20) - 8), 0, 0.1)
    seen = SimpleNamespace(poses=course(still, still))
    future = course(lifted, still)
    motions = SimpleNamespace(
        points=future[None, ..., :3, 3], rotations=future[None, ..., :3, :3], step_s=0.1
    )
    at_s, text = silent.apart(seen, motions, 0)
    assert at_s == '1.0' and 'future +70 mm up' in text and '100 mm apart at the end' in text
    assert silent.apart(SimpleNamespace(poses=future), motions, 0)[0] == '–'
    turning = SimpleNamespace(poses=course(lifted, np.deg2rad(3.0 * np.arange(20))))
    at_s, text = silent.apart(turning, motions, 0)
    assert at_s == '0.4' and 'truth +10 mm up, yaw +27' in text


def test_yaws_of_a_square_agree_up_to_a_quarter_turn(scripts):
    silent, _ = scripts
    assert silent.yaw_error(0.1 + np.pi / 2, 0.0, True) == pytest.approx(0.1)
    assert silent.yaw_error(0.1 + np.pi / 2, 0.0, False) == pytest.approx(0.1 - np.pi / 2)


def test_what_was_seen_counts_once_a_scene(scripts):
    _, zeros = scripts
    line = {'moved_mm': [20.0, 40.0], 'turned_deg': [1.0, 1.5], 'tool': 10.0, 'found': 4.0}
    other = {'moved_mm': [10.0, 20.0], 'turned_deg': [0.0, 0.5], 'tool': 20.0, 'found': 2.0}
    job = ('joint_zeros_1deg', 'stack', 0, 5)
    lines = [
        {'job': (*job, 'expert'), **line},
        {'job': (*job, 'expert-turn-0.8'), **line},
        {'job': (*job[:3], 6, 'expert'), **other},
    ]
    assert zeros.seen_cells(lines) == ['2', '15.0', '15.0, 30.0', '0.5, 1.0', '3.0']
