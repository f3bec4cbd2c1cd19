from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.recordings import commands_until
from mtv_world_ros.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.evaluation.references import check_actions, with_actions
from mtv_world_ros.rollout.rollout import Rollout


@pytest.fixture
def executed(recordings, make_pipeline):
    """Joint positions that the model is given, by name of the actions, in the second chunk."""
    pipeline, recording = make_pipeline(), recordings[0]
    stretch = stretches(recording, pipeline.spec, 'observe')[1]

    def imagine(name):
        actions = with_actions(name, recording, stretch, recordings[1])
        chunks = imagine_stretch(
            pipeline, recording, stretch, actions=actions, seed=0, num_inference_steps=1
        )
        return chunks[0].positions

    return imagine, recording.positions[stretch.start]


def test_joints_rest_where_they_were_under_zero_actions(executed):
    imagine, start = executed
    assert np.allclose(imagine('zero'), start)
    assert not np.allclose(imagine('true'), start)


def test_shuffled_actions_are_those_of_the_donor(executed, recordings):
    imagine, _ = executed
    assert not np.allclose(imagine('shuffled'), imagine('true'))
    assert with_actions('shuffled', recordings[0], None, None) is None


def test_unknown_actions_and_missing_true_ones_are_errors():
    check_actions(('zero', 'true'))
    with pytest.raises(ConfigError, match="'suffled' .*did you mean 'shuffled'"):
        check_actions(('true', 'suffled'))
    with pytest.raises(ConfigError, match="'mirrored' is not one of true, shuffled, zero"):
        check_actions(('true', 'mirrored'))
    with pytest.raises(ConfigError, match="'true' must be among them"):
        check_actions(('zero',))


@pytest.fixture
def fluent(recordings):
    """A recording whose commands have velocities."""
    sent = recordings[0].commands
    speeds = np.gradient(sent.positions, sent.times, axis=0)
    return replace(recordings[0], commands=replace(sent, velocities=speeds))


def test_all_commands_are_imagined_as_they_were_sent(fluent, make_pipeline, monkeypatch):
    pipeline, recording = make_pipeline(), fluent
    stretch = stretches(recording, pipeline.spec, 'observe')[1]
    given = []
    whole = Rollout.extend

    def extend(self, trajectory, **more):
        given.append(trajectory)
        return whole(self, trajectory, **more)

    monkeypatch.setattr(Rollout, 'extend', extend)
    imagine_stretch(pipeline, recording, stretch, actions=recording, seed=0, num_inference_steps=1)
    sent, seconds = recording.commands, stretch.num_frames / pipeline.spec.fps
    begins = recording.times[stretch.start]
    due = (sent.times > begins + 1e-6) & (sent.times < begins + seconds - 1e-6)
    assert due.sum() > stretch.num_frames  # more often than the model's frames
    assert np.allclose(given[0].positions[:-1], sent.positions[due])
    assert np.allclose(given[0].velocities[:-1], sent.velocities[due])
    assert given[0].times[-1] == pytest.approx(seconds)


def test_arms_hold_still_past_the_end_of_their_commands(fluent):
    late = commands_until(fluent, 0, float(fluent.commands.times[-1]) + 2.0)
    assert np.allclose(late.positions[-1], fluent.commands.positions[-1])
    assert not late.velocities[-1].any() and (np.diff(late.times) > 0).all()
