"""A node whose world model only moves the picture: for tests of what is around the model.

Some seeds make it misbehave: see `FakeWorldModel`. Frame k of a chunk carries its seed and k in
its first pixel, so that a subscriber can tell frames apart.
"""

import sys
import time

import numpy as np

from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.errors import ModelMemoryError, RolloutPreempted
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import asked_describer
from mtv_world_ros.rollout.pipeline import Pipeline, WorldModelSpec
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.ros.world_model.node import main
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

VIEWS = ('low', 'high')
WIDTH, HEIGHT, FPS, NUM_FRAMES = 48, 36, 5.0, 4
OUT_OF_MEMORY, BLOCKS, CRASHES, SLOW, STUCK = 1100, 1200, 1300, 1400, 1500
STUCK_S = 3.0
SLOW_S = 0.3


class FakeWorldModel:
    """Moves the start frame to the right by one pixel a frame."""

    spec = WorldModelSpec(
        views=VIEWS,
        fps=FPS,
        num_frames=NUM_FRAMES,
        width=WIDTH,
        height=HEIGHT,
        robot='yam_bimanual',
        num_history=3,
    )

    def predict(
        self,
        start_frame,
        control,
        *,
        positions,
        seed,
        num_inference_steps,
        should_stop,
        history=None,
    ):
        assert control.video.shape == (2, 1 + NUM_FRAMES, HEIGHT, WIDTH, 3)
        assert positions.shape == (1 + NUM_FRAMES, 14)
        if seed // 100 == OUT_OF_MEMORY // 100:
            raise ModelMemoryError('the device ran out of memory (fake)')
        if seed // 100 == CRASHES // 100:
            raise RuntimeError('a fault of the fake model')
        if seed // 100 == STUCK // 100:
            time.sleep(STUCK_S)  # asks nobody whether it is still wanted
        end_s = time.monotonic() + (SLOW_S if seed // 100 == SLOW // 100 else 0)
        while seed // 100 == BLOCKS // 100 or time.monotonic() < end_s:
            time.sleep(0.001)
            if should_stop():
                raise RolloutPreempted('stopped')
        frames = np.stack([np.roll(start_frame, k + 1, axis=2) for k in range(NUM_FRAMES)], axis=1)
        frames[:, :, 0, 0, 0] = seed % 256
        frames[:, :, 0, 0, 1] = np.arange(NUM_FRAMES)
        # the history: how many frames, which one of its chunk the last is, what the anchor shows
        count = history.frames.shape[1]
        frames[:, :, 0, 1, 0] = count
        frames[:, :, 0, 1, 1] = history.frames[:, -1:, 0, 0, 1] if count else 255
        frames[:, :, 0, 2] = history.anchor[:, None, HEIGHT // 2, WIDTH // 2]
        return frames


def load(settings):
    robot, segmenter = load_robot(robot_path('yam_bimanual')), ColourSegmenter()
    estimator = SuccessEstimator(load_tasks(share_path('config', 'tasks')))
    return Pipeline(
        robot=robot,
        world_model=FakeWorldModel(),
        segmenter=segmenter,
        judge=SuccessJudge(robot=robot, estimator=estimator),
        control=TrajectoryVideo(config=TrajectoryVideoConfig()),
        objects=settings.objects,
        describer=asked_describer(settings.describer),
    )


if __name__ == '__main__':
    sys.exit(main(load=load))
