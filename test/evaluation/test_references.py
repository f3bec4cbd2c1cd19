import numpy as np
import pytest

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.evaluation.references import check_actions, with_actions


@pytest.fixture
def executed(recordings, make_pipeline):
    """Joint positions that the model is given, by name of the actions, in the second chunk."""
    pipeline, recording = make_pipeline(), recordings[0]
    stretch = stretches(recording, pipeline.spec, 'observe')[1]

    def imagine(name):
        actions = with_actions(name, recording, stretch, recordings[1], pipeline.robot)
        chunks = imagine_stretch(
            pipeline, recording, stretch, actions=actions, seed=0, num_inference_steps=1
        )
        return chunks[0].positions

    return imagine, recording.positions[stretch.start], pipeline.robot


def test_joints_rest_where_they_were_under_zero_actions(executed):
    imagine, start, _ = executed
    assert np.allclose(imagine('zero'), start)
    assert not np.allclose(imagine('true'), start)


def test_mirrored_actions_move_the_other_arm_as_in_a_mirror(executed):
    imagine, _, robot = executed
    left, right = robot.tool_poses(imagine('true'))[..., :3, 3]
    new_left, new_right = robot.tool_poses(imagine('mirrored'))[..., :3, 3]
    assert np.allclose(new_right, left * [-1, 1, 1]) and np.allclose(new_left, right * [-1, 1, 1])
    assert np.ptp(left, axis=0).max() > 0.005


def test_shuffled_actions_are_those_of_the_donor(executed, recordings):
    imagine, _, _ = executed
    assert not np.allclose(imagine('shuffled'), imagine('true'))
    assert with_actions('shuffled', recordings[0], None, None, None) is None


def test_unknown_actions_and_missing_true_ones_are_errors():
    check_actions(('mirrored', 'true'))
    with pytest.raises(ConfigError, match="'suffled' .*did you mean 'shuffled'"):
        check_actions(('true', 'suffled'))
    with pytest.raises(ConfigError, match="'true' must be among them"):
        check_actions(('zero',))
