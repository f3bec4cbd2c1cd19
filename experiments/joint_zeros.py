"""Why are some pairs of plans ordered wrongly where the zeros of joints are off by 1 degree?

    python experiments/joint_zeros.py --seeds 3301 --policies 6

The expert and drawn faults act in `--physics`. Printed are how far the tool is from where the
robot reports it near the table, what the check of the first picture makes of the arm that stands
elsewhere (it corrects the cameras), and how far objects are found from their true places. Then
pairs of plans of one scene are compared, as `plan_pairs.py` has it, in futures of a cell in which
nothing was fitted, for each spread of the zeros in `--spreads` [rad]; the first is the one in use.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from page import parse_arguments, publish, table
from plan_pairs import outcomes_of, pair_cells
from shifted_worlds import Ahead, foreseen_by, observed, policies_of, Scenes, TASKS

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import PolicyError, SimulatorError
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.solid_foresight import SolidForesight
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed
from mtv_world_ros.simulation.collect.record import carry_out, RecordConfig
from mtv_world_ros.simulation.physics import physics_named
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.success.comparison import RULE
from mtv_world_ros.success.doubts import Grounds
from mtv_world_ros.success.share_fit import ShareEstimate, ShareFit

PAIRS = ('truth', 'spread of zeros [rad]', 'scenes', 'pairs whose outcomes differ', 'ordered',
         'right, of ordered', 'two verdicts tell',
         'ordered, though outcomes are equal')  # fmt: skip
SEEN = ('truth', 'scenes', 'tool beside its reported place near the table [mm]',
        'camera corrections [mm], by view', 'camera corrections [deg], by view',
        'objects beside their true place [mm]')  # fmt: skip
#: a tool lower than this is near the table [m]
LOW_M = 0.08
_RECORD = RecordConfig(pictures='first')
Line = dict[str, Any]


def with_spread(model: SolidForesight, zero_rad: float) -> SolidForesight:
    """Return a foresight of a cell in which nothing was fitted, with a spread of zeros [rad]."""
    elsewhere = model.at_place('another robot cell')
    spread = elsewhere.settings.spread.replace(zero_rad=zero_rad)
    other = SolidForesight(model.robot, model.response, elsewhere.settings.replace(spread=spread))
    other.is_fitted, other.engine = False, model.engine
    return other


def rollout(
    pipeline: Pipeline, models: Sequence[SolidForesight], scenes: Scenes, job: tuple
) -> Line | None:
    """Return the outcome, what each model foresees, and what was seen at first; None = refused."""
    plan, home = scenes._plan(job, pipeline.robot)
    truth = physics_named(job[0])
    sim = SimEpisode(pipeline.robot, home, physics=job[0])
    try:
        seen = sim.reset(job[3], job[1])
        first = observed(sim, seen)
        take = carry_out(sim, task_named(job[1]), plan, seen, _RECORD)
    finally:
        sim.close()
    check = scenes._check(pipeline, job, first)
    if check.refusal:
        return None
    corrected = check.corrected_observation(first)
    end = take.control_positions.shape[0] * CONTROL_PERIOD_S
    commands = resample(take.commands, sim.home, np.arange(0.0, end, PERIOD_S))
    tools = pipeline.robot.tool_poses(plan.positions)[..., :3, 3]
    zeros = truth.joint_zeros(pipeline.robot)
    beside = np.linalg.norm(
        pipeline.robot.tool_poses(plan.positions - zeros)[..., :3, 3] - tools, axis=-1
    )
    moves = [
        np.linalg.inv(old.T_mount_camera) @ new.T_mount_camera
        for old, new in zip(first.cameras, corrected.cameras, strict=True)
    ]
    said = []
    for model in models:
        assert isinstance(pipeline.judge, SuccessJudge)
        judge = replace(
            pipeline.judge,
            camera_checker=None,
            object_motion=model,
            checks_place=False,
            grounds=Grounds(),
        )
        judging = replace(pipeline, judge=judge)
        options = RolloutOptions(instruction=sim.instruction, seed=job[3], num_inference_steps=1)
        ahead: Ahead = foreseen_by(judging, judging.begin(corrected, options), corrected, commands)
        said.append(ahead.said(sim, take))
    items = {item.name: number for number, item in enumerate(sim.scene.objects)}
    columns = [items[name] for name in ahead.names]
    gaps = ahead.points[0, 0] - take.object_poses[0, columns, :3, 3]
    return {
        'job': job,
        'final': take.final,
        'said': said,
        'tool': 1e3 * float(beside[tools[..., 2] < LOW_M].mean()),
        'moved_mm': [1e3 * float(np.linalg.norm(move[:3, 3])) for move in moves],
        'turned_deg': [_angle_deg(move) for move in moves],
        'found': 1e3 * float(np.linalg.norm(gaps, axis=-1).mean()),
    }


def _angle_deg(move: FloatArray) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(move[:3, :3]) - 1) / 2, -1, 1))))


def seen_cells(lines: Sequence[Line]) -> list[str]:
    """Return cells of `SEEN` after the first."""
    scenes = {line['job'][1:4]: line for line in lines}
    views = [np.mean([s[key] for s in scenes.values()], 0) for key in ('moved_mm', 'turned_deg')]
    tool, found = (np.mean([s[key] for s in scenes.values()]) for key in ('tool', 'found'))
    texts = [', '.join(f'{value:.1f}' for value in view) for view in views]
    return [str(len(scenes)), f'{tool:.1f}', *texts, f'{found:.1f}']


def estimate(said: Line) -> ShareEstimate:
    """Return the estimate of a cell in which nothing was fitted."""
    if said['features'] is None:
        return ShareEstimate(np.nan, np.nan, np.nan)
    share, number = (1 + said['features']['foreseen']) / 2, said['features']['futures']
    return ShareFit().estimate(share, number, is_fitted=False)


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('--seeds', required=True, help='comma-separated')
    parser.add_argument('--physics', default='joint_zeros_1deg')
    parser.add_argument('--tasks', default=','.join(TASKS))
    parser.add_argument('--policies', type=int, default=6, help='in each scene, with the expert')
    parser.add_argument('--size', type=float, default=1.1, help='of drawn kinds')
    parser.add_argument('--spreads', default='0.002,0.01', help='[rad]')


def main() -> None:
    """Print the tables."""
    options = parse_arguments(__doc__, 1, more)
    pipeline = Pipeline.load('bundled')
    model = pipeline.judge.object_motion
    assert isinstance(model, SolidForesight)
    spreads = [float(text) for text in options.spreads.split(',')]
    models = [with_spread(model, spread) for spread in spreads]
    scenes = Scenes(
        {'': pipeline}, argparse.Namespace(physics=NOMINAL, contact=None, pictures='', real='')
    )
    lines = []
    for seed in map(int, options.seeds.split(',')):
        for policy in policies_of(f'drawn:{seed}', options.size, options.policies):
            for task in options.tasks.split(','):
                for physics in options.physics.split(','):
                    scenes._known.clear()
                    job = physics, task, 0, episode_seed(seed, task, 0, 0), policy
                    try:
                        line = rollout(pipeline, models, scenes, job)
                    except (PolicyError, SimulatorError):
                        continue
                    if line is not None:
                        lines.append(line)
    pairs, seen = [], []
    for physics in options.physics.split(','):
        own = [line for line in lines if line['job'][0] == physics]
        seen.append([physics, *seen_cells(own)])
        for number, spread in enumerate(spreads):
            said = [line['said'][number] for line in own]
            cells = pair_cells(own, [outcomes_of(s) for s in said], [estimate(s) for s in said])
            pairs.append([physics, f'{spread:g}', *cells])
    asked = ('seeds', 'physics', 'tasks', 'policies', 'size', 'spreads')
    command = ' '.join(f'--{key} {getattr(options, key)}' for key in asked)
    options.seed = int(options.seeds.split(',')[0])
    publish(
        'joint_zeros',
        'Pairs of plans where the zeros of joints are off',
        f'python experiments/joint_zeros.py {command}',
        '\n\n'.join(
            [
                (__doc__ or '').split('\n' * 2, 2)[2].strip(),
                f'{len(lines)} rollouts, of which {sum(r["final"] for r in lines)} succeed.',
                table(SEEN, seen),
                f'{RULE.text}:',
                table(PAIRS, pairs),
            ]
        ),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
