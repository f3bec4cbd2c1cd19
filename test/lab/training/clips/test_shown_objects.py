"""Where the objects that a clip's trajectory video shows are cut out."""

from dataclasses import replace

import numpy as np

from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.training_config import load_training_config
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def test_objects_are_cut_out_of_the_recordings_first_frame(episode, robot):
    config = load_training_config(
        'small',
        {
            'rendering.object_motion': True,
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
    assert not any(same)
