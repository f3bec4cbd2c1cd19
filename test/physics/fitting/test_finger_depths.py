"""Depth of measured fingers below the table, of a hand that slides up and down."""

import numpy as np
import pytest

from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.engine.contact_scene import CompiledScene
from mtv_world_ros.physics.fitting.finger_depths import depth_lines, find_finger_depth

#: heights of the hand in rows .1 s apart; its fingers end 15 mm below it [m]
HEIGHTS = np.array([0.1, 0.05, 0.02, 0.05])


def depth_of(lift, name='0001', table_m=0.0):
    positions = np.stack([HEIGHTS, np.full(len(HEIGHTS), 0.04)], -1)
    scene = CompiledScene.compiled(Arms(lift, None), ())
    return find_finger_depth(name, scene, positions, 0.1, table_m)


def test_fingers_that_end_below_the_table_are_named_with_their_depth(lift):
    found = depth_of(lift, table_m=0.025)
    assert found is not None
    assert found.depth_m == pytest.approx(0.020, abs=1e-6)
    assert found.time_s == pytest.approx(0.2)
    assert found.link in ('left', 'right')
    assert depth_of(lift, table_m=np.nan) is None


def test_depths_that_cameras_explain_are_not_said(lift):
    above, little = depth_of(lift), depth_of(lift, table_m=0.012)
    assert above is not None and above.depth_m == pytest.approx(-0.005, abs=1e-6)
    assert depth_lines([above, little], 0.004) == ()
    assert depth_lines([above, little], 0.001) != ()
    assert depth_lines([], 0.001) == ()


def test_several_deep_recordings_name_the_link_and_one_alone_its_cameras(lift):
    flat = depth_of(lift)
    deep = [depth_of(lift, name, table_m) for name, table_m in (('0006', 0.033), ('0012', 0.036))]
    what, do = depth_lines([flat, *deep], 0.004)
    assert '0006 28 (at 0.2 s), 0012 31 (at 0.2 s); 2 of 3 recordings' in what
    assert f'the link {deep[0].link} of the URDF is 28 to 31 mm too long' in do
    _, do = depth_lines([flat, deep[0]], 0.004)
    assert 'the cameras of 0006 are off' in do and 'too long' not in do
