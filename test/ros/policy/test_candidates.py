"""The policy node asks for several plans, compares them in imagination and says which it took."""

from __future__ import annotations

import shutil

import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.ros.messages.conversions import values_of

pytestmark = pytest.mark.slow


def test_candidates_need_a_checkpoint_that_foresees_object_motion(ros, tmp_path):
    ros.make_checkpoint(tmp_path / 'checkpoint')
    with pytest.raises(ConfigError, match='foresees no object motion.*set candidates to 1'):
        ros.start_policy(tmp_path, 'candidates:=3')


def test_the_report_names_the_chosen_plan(ros, client, tmp_path):
    checkpoint = ros.make_checkpoint(tmp_path / 'checkpoint')
    shutil.copytree(
        checkpoint_folder('bundled') / OBJECT_MOTION_FOLDER, checkpoint / OBJECT_MOTION_FOLDER
    )
    ages = ('max_image_age_s:=3600.0', 'max_joint_state_age_s:=3600.0')
    world = ros.start_node(tmp_path, 'pace:=burst', 'mode:=imagine', *ages)
    policy = ros.start_policy(tmp_path, 'candidates:=3', 'max_chunks:=1', *ages)
    try:
        client.subscribe(ros.REPORT, '/policy/report', 100)
        client.connect_inputs(ros.INPUTS)
        client.call(ros.TRIGGER, '/policy/start', ros.TRIGGER.Request())
        client.send_scene()

        def ends():
            found = map(values_of, client.statuses('/policy/report'))
            return [values for values in found if values['state'] == 'ended']

        client.wait(ends, 'the end of the episode')
        (end,) = ends()
        assert (end['how'], end['num_chunks']) == ('max_chunks', '1'), end
        # the fake pictures do not show the arm: nothing is told, and the policy's first plan acts
        assert end['choice'].startswith("plan 1 of 3: not told, camera 'low'")
    finally:
        assert [process.stop() for process in (policy, world)] == [0, 0]
