"""J of the arm on a drawn robot: whole, half painted over, not there, held."""

import numpy as np
import pytest

from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.evaluation.imagined_stretches import stretches
from mtv_world_ros.evaluation.metrics.arm_masks import arm_scenes
from mtv_world_ros.robot.shape import load_shape
from test.support.crane import FPS, load, make_cameras, make_positions, write_episode


@pytest.fixture(scope='module')
def views(tmp_path_factory):
    """Recorded frames of a stretch, and masks, of a still camera and of one on the hand."""
    folder = tmp_path_factory.mktemp('arm')
    robot = load(folder)
    cameras = make_cameras()
    spec = WorldModelSpec(
        views=('door', 'palm'), width=160, height=120, num_frames=16, fps=FPS, robot='crane'
    )
    shown = {view: cameras[view] for view in spec.views}
    path = write_episode(folder / 'episode', robot, shown, make_positions(8.0, seed=1))
    recording = load_recording(path, spec, robot)
    stretch = stretches(recording, spec, 'observe')[1]
    scenes = arm_scenes(recording, robot, load_shape(robot).parts)
    return stretch.frames[:, 1:], [
        scene and scene.masks(stretch.positions[1:]) for scene in scenes
    ]


@pytest.mark.slow
def test_recorded_frames_show_the_arm_where_it_is_drawn(views):
    frames, (door, _) = views
    assert door is not None
    assert door.jaccard(frames[0]) > 0.8


def test_where_half_of_the_arm_is_missing_its_share_is_missing(views):
    frames, (door, _) = views
    whole = door.jaccard(frames[0])
    left = frames[0].copy()
    column = int(np.median(np.nonzero(door.arm & door.compared)[2]))
    left[:, :, column:] = door.scene[:, column:]
    drawn = door.arm & door.compared
    share = (drawn[:, :, :column].sum((1, 2)) / drawn.sum((1, 2))).mean()
    assert 0.3 < share < 0.7
    assert door.jaccard(left) == pytest.approx(share * whole, abs=0.08)


def test_a_scene_without_the_arm_scores_zero_and_a_held_arm_in_between(views):
    frames, (door, _) = views
    assert door.jaccard(np.repeat(door.scene[None], len(door.arm), axis=0)) == 0
    held = np.repeat(frames[0][:1], len(door.arm), axis=0)
    assert 0 < door.jaccard(held) < door.jaccard(frames[0]) - 0.1


def test_a_camera_on_the_arm_has_none(views):
    assert views[1][1] is None
