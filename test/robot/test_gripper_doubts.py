"""Grippers whose range of positions is no finger's are named, whatever the unit was."""

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.gripper_doubts import gripper_doubts

ROBOT = """
name: arm
dh:
  - arm: only
    joints:
      - {joint: shoulder, a: 0.3, alpha: 0, d: 0, lower: -2, upper: 2}
      - {joint: elbow, a: 0.2, alpha: 0, d: 0, lower: -2, upper: 2}
    gripper: {joint: gripper, lower: 0, upper: UPPER}
tools: [{arm: only, link: elbow_link, gripper_joint: gripper, gripper_closed: 0.0,
         gripper_open: UPPER}]
"""


@pytest.mark.parametrize(
    ('upper', 'is_named'), [(0.04, False), (0.8, False), (85, True), (100, True), (255, True)]
)
def test_a_range_that_no_finger_has_is_named(tmp_path, capsys, monkeypatch, upper, is_named):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / 'robot.yaml'
    file.write_text(ROBOT.replace('UPPER', str(upper)))
    assert bool(gripper_doubts(load_robot(file))) == is_named
    assert main(['robot', str(file)]) == 0
    said = capsys.readouterr().out
    text = f"suspicious: arm 'only': gripper 'gripper' goes from 0 to {upper} rad or m"
    assert (text in said) == is_named
