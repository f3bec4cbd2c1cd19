"""Lets a policy act in the world model: it sees predicted frames and answers with commands.

    python examples/policy_in_imagination.py [EPISODE]

The policy here only moves one arm to and fro. Put your own into `act`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import Pipeline
from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.rollout.options import RolloutOptions

NUM_CHUNKS = 3


class SwingingPolicy:
    """Swings the left arm about its base."""

    name = 'swinging'

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        self._joint_names = joint_names
        self._way = 0.2

    def reset(self, *, seed: int) -> None:
        """Begins an episode."""
        del seed
        self._way = 0.2

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Returns commands for 3.2 s; their times count from the observation's stamp."""
        del instruction
        self._way = -self._way
        times = np.linspace(0.2, 3.2, 16)
        positions = np.tile(observation.positions, (len(times), 1))
        positions[:, 0] += np.linspace(0.0, self._way, len(times))
        return JointTrajectory(joint_names=self._joint_names, times=times, positions=positions)


parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
options = parser.parse_args()

pipeline = Pipeline.load('bundled')
recording = load_recording(options.episode, pipeline.spec, pipeline.robot)
observation = recording.observation(0)
policy = SwingingPolicy(pipeline.robot.joint_names)
policy.reset(seed=0)

episode = pipeline.begin(observation, RolloutOptions(instruction=recording.instruction, seed=0))
for _ in range(NUM_CHUNKS):
    answer = policy.act(episode.observation, recording.instruction)
    if answer is None:
        break
    for prediction in episode.extend(answer):
        success = prediction.success
        print(
            f'{prediction.imagined_seconds:.1f} s imagined: '
            f'success {success.probability:.2f}; {success.reasons[0]}'
        )
