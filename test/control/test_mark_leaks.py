"""Colours of drawn marks that a model paints into imagined frames are found and removed."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.control.mark_leaks import (
    find_leaks,
    has_colour,
    leak_remarks,
    without_leaks,
)
from mtv_world_ros.control.trajectory_video import arm_colour, FINGER_COLOURS
from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline

ORANGE, BLUE = (np.rint(255 * arm_colour(arm, 2)).astype(np.uint8) for arm in range(2))
GREY = 160


@pytest.fixture
def scene():
    """Grey frames, a blue mark in the trajectory video and a blue ball where it is."""
    start = np.full((1, 24, 32, 3), GREY, np.uint8)
    frames = np.repeat(start[:, None], 2, axis=1)
    marks = np.zeros_like(frames)
    marks[0, :, 10:12, 10:12] = BLUE
    frames[0, 1, 9:13, 9:13] = BLUE // 2 + 60
    return frames, marks, start


def test_a_ball_in_the_colour_of_the_mark_is_found_and_grey_afterwards(scene):
    frames, marks, start = scene
    leaks = find_leaks(frames, marks, start, None, 2)
    assert leaks[0, 1, 9:13, 9:13].all() and leaks.sum() == 16
    cleaned = without_leaks(frames, leaks)
    assert not has_colour(cleaned, arm_colour(1, 2)).any()
    # the brightness stays, and so does every other pixel
    assert abs(cleaned[0, 1, 10, 10].mean() - frames[0, 1, 10, 10].mean()) < 1
    assert (cleaned[~leaks] == frames[~leaks]).all()


def test_a_colour_of_the_scene_is_kept(scene):
    frames, marks, start = scene
    start[0, 20:, :8] = BLUE  # a blue thing that nobody names
    assert not find_leaks(frames, marks, start, None, 2).any()


def test_where_objects_are_known_a_colour_is_the_scenes_where_the_start_frames_have_it(scene):
    """Brown curtains and wood have the hue of an orange mark, in most real pictures."""
    frames, marks, start = scene
    objects = np.zeros((1, 3, 24, 32, 4), np.uint8)
    start[0, 20:, :8] = BLUE
    assert find_leaks(frames, marks, start, objects, 2).sum() == 16
    # the mark passes before it: what is blue there may be the thing itself
    marks[0, :, 19:21, 2:4] = frames[0, :, 20:, :8] = BLUE
    assert find_leaks(frames, marks, start, objects, 2).sum() == 16


def test_a_blue_object_that_is_drawn_is_kept_and_the_mark_beside_it_is_not(scene):
    frames, marks, start = scene
    start[0, 18:22, 18:22] = frames[0, :, 18:22, 18:22] = BLUE
    objects = np.zeros((1, 3, 24, 32, 4), np.uint8)
    objects[0, :, 18:22, 18:22] = (*BLUE, 255)
    marks[0, :, 18:22, 18:22] = BLUE
    assert find_leaks(frames, marks, start, objects, 2).sum() == 16


def test_colours_far_from_all_marks_are_no_leaks(scene):
    frames, marks, start = scene
    frames[0, 0, 20:22, 25:27] = ORANGE  # e.g. a toy that comes into view
    assert find_leaks(frames, marks, start, None, 2).sum() == 16


def test_many_leaks_are_said_and_few_are_not():
    leaks = np.zeros((2, 3, 8, 8), np.bool_)
    leaks[0, 0, 0, :5] = True
    assert leak_remarks(leaks) == ()
    leaks[1] = True
    (remark,) = leak_remarks(leaks)
    assert 'unlike those of training: 197 pixels' in remark


@pytest.mark.slow
def test_no_imagined_frame_of_random_plans_has_a_colour_of_the_marks():
    """Without an object and away from it, no pixel has the hue of a trail or a finger."""
    pipeline = Pipeline.load(Checkpoint.open('bundled'), num_threads=1)
    robot = pipeline.robot
    recording = load_recording(share_path('resource', 'demo_episode'), pipeline.spec, robot)
    start, times, said = recording.observation(0), np.arange(1, 17) * 0.2, 0
    for seed in range(4):
        rng = np.random.default_rng(75 + seed)
        target = rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 3))
        step = np.clip(target - start.positions, -2.5, 2.5)
        plan = JointTrajectory(
            joint_names=robot.joint_names,
            times=times,
            positions=start.positions + np.linspace(1 / 16, 1, 16)[:, None] * step,
        )
        options = RolloutOptions(
            instruction=recording.instruction, stored_objects=recording.objects, seed=seed
        )
        for chunk in pipeline.begin(start, options).extend(plan):
            frames = chunk.video.frames
            # the blocks are violet and pink, and so is the blur around them
            seen = np.asarray(chunk.masks.masks.any(axis=1), np.uint8).reshape(-1, 72, 96)
            is_object = np.stack([cv2.dilate(mask, np.ones((7, 7))) for mask in seen]) > 0
            is_object = is_object.reshape(frames.shape[:-1])
            for colour in (*(arm_colour(arm, 2) for arm in range(2)), FINGER_COLOURS[1]):
                found = has_colour(frames, colour) & ~is_object
                assert found.sum() <= 12, (seed, colour, found.sum())
            said += 'unlike those of training' in ' '.join(chunk.success.reasons)
    assert said >= 2
