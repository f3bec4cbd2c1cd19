"""Lets a policy act in the world model: it sees predicted frames and answers with commands.

    python examples/rollout_policy.py [EPISODE]

The policy here only moves one arm to and fro. Put your own into `act`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    ImaginedWorld,
    JointTrajectory,
    load_recording,
    Observation,
    Pipeline,
    Prediction,
    RolloutOptions,
    run_policy,
    share_path,
)

NUM_CHUNKS = 3


class SwingingPolicy:
    """Swings the left arm about its base."""

    name = 'swinging'

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        self._joint_names = joint_names
        self._way = 0.2

    def reset(self, *, seed: int) -> None:
        """Begin an episode."""
        del seed
        self._way = 0.2

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return commands for 3.2 s; their times count from the observation's stamp."""
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


def tell(prediction: Prediction) -> None:
    """Print the estimate at the end of a chunk."""
    success = prediction.success
    print(
        f'{prediction.imagined_seconds:.1f} s imagined: '
        f'success {success.probability:.2f}; {success.reasons[0]}'
    )


world = ImaginedWorld(
    pipeline,
    recording.observation(0),
    RolloutOptions(instruction=recording.instruction),
    on_chunk=tell,
)
run = run_policy(SwingingPolicy(pipeline.robot.joint_names), world, max_chunks=NUM_CHUNKS)
print(f'{run.num_chunks} answers; it ended because: {run.end}')
