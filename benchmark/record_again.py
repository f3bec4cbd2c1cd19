"""Records the expert again in the scene that a simulated episode holds, as the bundled one was.

python benchmark/record_again.py resource/demo_episode --out out/demo_episode
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.assembly import robot_path
from mtv_world_ros.bench.collect.record import (
    carry_out,
    expert_generator,
    RecordConfig,
    write_take,
)
from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.world.recorded_scene import recorded_scene
from mtv_world_ros.bench.world.simulator import SimEpisode
from mtv_world_ros.geometry.robot.file import load_robot


def main() -> None:
    """Records."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('episode', type=Path)
    parser.add_argument('--robot', default='yam_bimanual')
    parser.add_argument('--seed', type=int, default=2326626197, help='of tempo and heights')
    parser.add_argument('--hold', type=float, default=0.7, help='after the last command [s]')
    parser.add_argument('--out', type=Path, required=True)
    options = parser.parse_args()
    robot = load_robot(robot_path(options.robot))
    expert, config = Expert(robot), RecordConfig(hold_s=options.hold)
    task, scene = recorded_scene(options.episode, expert.workcell)
    sim = SimEpisode(robot, expert.home)
    try:
        first = sim.load(scene, task)
        commands = expert.plan(task, scene, expert_generator(options.seed), miss=False)
        take = carry_out(sim, task, commands, first, config)
        write_take(options.out, sim, take, None, config)
    finally:
        sim.close()
    print(f'success: {take.ever and take.final}, {len(take.observations)} frames -> {options.out}')


if __name__ == '__main__':
    main()
