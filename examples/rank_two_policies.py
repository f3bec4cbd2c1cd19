"""Ranks two policies in imagination, from the first frame of a recorded episode.

    python examples/rank_two_policies.py [EPISODE]

One repeats the recorded commands, the other does the same without ever closing a gripper. Rank
over many episodes before you believe it, and compare with truth: `mtv-world rank`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from mtv_world_ros import (
    ImaginedWorld,
    load_recording,
    Pipeline,
    RecordedPolicy,
    RolloutOptions,
    run_policy,
    share_path,
)

parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
options = parser.parse_args()

pipeline = Pipeline.load('bundled')
recording = load_recording(options.episode, pipeline.spec, pipeline.robot)

commands = recording.commands
positions = commands.positions.copy()
for tool in pipeline.robot.tools:
    if tool.gripper_joint is not None:
        positions[:, commands.joint_names.index(tool.gripper_joint)] = tool.gripper_open
policies = {
    'as recorded': RecordedPolicy(commands, hold_s=0.6),
    'never grasps': RecordedPolicy(replace(commands, positions=positions), hold_s=0.6),
}

options_of_rollouts = RolloutOptions(instruction=recording.instruction)
world = ImaginedWorld(pipeline, recording.observation(0), options_of_rollouts)
found = {}
for name, policy in policies.items():
    run_policy(policy, world, seed=0)
    found[name] = world.success.probability if world.success else 0.0

for name, probability in sorted(found.items(), key=lambda item: -item[1]):
    print(f'{name:<12} success {probability:.2f}')
