"""Clips whose objects are cut out of their own first frame."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.training_config import load_training_config
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


@pytest.mark.parametrize('share', [0.0, 1.0])
def test_objects_are_cut_out_of_the_frame_where_a_rollout_begins(episode, robot, share):
    config = load_training_config(
        'small',
        {
            'rendering.object_motion': True,
            'augment.begun_share': share,
            'augment.start_noise': 0.0,
            'augment.colour_permutation': 0.0,
            'optimizer.batch_size': 6,
        },
    )
    recording = load_recording(episode, config.spec, robot)
    shape = (len(recording.times), len(recording.objects), 1, 1)
    still = replace(recording, object_poses=np.tile(np.eye(4), shape))
    segmenter = ColourSegmenter()
    source = BatchSource([still], config, robot=robot, segmenter=segmenter, seed=0)
    batch = source.batch(0)
    source.close()
    assert batch.trajectory is not None
    same = []
    for frames, drawn in zip(batch.frames.numpy(), batch.trajectory.numpy(), strict=True):
        seen = segmenter.segment(frames[:, :1], recording.names).masks[:, :, 0].any(1)
        same.append(bool((drawn[:, 0][seen] == frames[:, 0][seen]).all()))
    assert all(same) if share else not any(same)
