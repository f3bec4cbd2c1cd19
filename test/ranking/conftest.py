"""A pipeline whose world model is the simulator itself, and made-up results."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.ranking.episode_runner import EpisodeRunner, RunnerConfig
from mtv_world_ros.ranking.jobs import Result, StoredEstimate
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.opengl import missing_opengl
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5, num_frames=16, width=192, height=144, robot='yam_bimanual'
)


class PerfectWorldModel:
    """Predicts what the simulator would show: drives a second one by the commands it is given."""

    def __init__(self, robot, home):
        self.spec = SPEC
        self._sim = SimEpisode(robot, home)

    def begin(self, seed, task):
        self._sim.reset(seed, task)

    def predict(self, start_frame, control, *, positions, **options):
        del start_frame, control, options
        seen = [self._sim.step(row, 1 / SPEC.fps) for row in positions[1:]]
        frames = np.stack([[found.images[view] for found in seen] for view in SPEC.views])
        return np.stack([resize_frames(view, SPEC.width, SPEC.height) for view in frames])


@pytest.fixture(scope='session')
def expert(robot):
    return Expert(robot)


@pytest.fixture(scope='session')
def runner(robot, expert):
    """Run policies in the simulator and in a perfect imagination of it."""
    reason = missing_opengl()
    if reason:
        pytest.skip(reason)
    world_model = PerfectWorldModel(robot, expert.home)
    segmenter = ColourSegmenter()
    estimator = SuccessEstimator(load_tasks(share_path('config', 'tasks')))
    pipeline = Pipeline(
        robot=robot,
        world_model=world_model,
        segmenter=segmenter,
        judge=SuccessJudge(robot=robot, estimator=estimator),
        control=TrajectoryVideo(config=TrajectoryVideoConfig()),
    )

    def make_policy(name, task, seed, expert):
        world_model.begin(seed, task)
        return scripted_policy(name, task, seed, expert)

    return EpisodeRunner(pipeline, RunnerConfig(max_chunks=4, make_policy=make_policy))


@pytest.fixture
def make_result():
    """A result with a true outcome and an imagined probability."""

    def make(
        policy, index, final, probability, task='stack_blocks_two', seen=None, rule=None, **more
    ):
        judged = [
            StoredEstimate(
                probability=value, interval=(value, value), jaccard=((value,),), reasons=('why',)
            )
            for value in (
                probability, final if seen is None else seen, final if rule is None else rule
            )
        ]  # fmt: skip
        return Result(
            **{
                'policy': policy, 'task': task, 'index': index, 'seed': 7, 'ever': final,
                'final': final, 'imagined': judged[0], 'seen': judged[1],
                'no_picture': judged[2], 'num_chunks': 3,
                'num_imagined': 3, 'is_over': True,
                'seconds': {'imagining': 2.0, 'physics': 0.1, 'rendering': 0.3},
                **more,
            }
        )  # fmt: skip

    return make
