"""Failures that the futures call a success: is the pose, the shape or the contact wrong?

    python experiments/silent_failures.py --seeds 3101,3102 --out experiments/results

The expert turns its grasp about the vertical by each of `--turns` [rad]. In each truth of
`--physics` its rollout is simulated, and the plan is foreseen with the parameters of `nominal`,
as `shifted_worlds.py` does. A silent failure is a rollout that fails and is called a success.
For each of them: the errors of the object that is moved as it was found in the masks; the share
of futures that succeed as found, and where the objects have their true pose and size; when the
undisturbed future leaves the truth by more than 10 mm or 10 degrees, and how far the object is
then turned in each. If the true pose makes the share fall below .5, the pose was wrong; else
contact or shape is: shape, if the object is no box or cylinder in the simulator. Rollouts that
are near to it, failures of which a third of the futures succeed or more, are listed, too.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from page import parse_arguments, publish, table
from shifted_worlds import observed, Scenes, TASKS

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.core.data_types import BoolArray, FloatArray, Observation
from mtv_world_ros.core.errors import PolicyError, SimulatorError
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.foreseen_motions import foreseen_of, ForeseenMotions
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.physics.solid_foresight import SolidForesight, TrackedSolids
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed
from mtv_world_ros.simulation.collect.record import carry_out, RecordConfig, Take
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.success.estimator import estimate_of_futures, verdict
from mtv_world_ros.success.foreseen import foreseen_feature
from mtv_world_ros.success.share_fit import ShareFit

HEAD = ('truth', 'task', 'turn [rad]', 'object', 'estimate', 'place error [mm]', 'size error [mm]',
        'yaw error [deg]', 'share as found', 'share, true pose and size', 'apart from [s] on',
        'what happens there', 'wrong')  # fmt: skip
#: share of futures from which a failure is listed
LISTED_FROM = 1 / 3
#: distance and angle from which a future has left the truth [m], [rad]
APART_M, APART_RAD = 0.01, np.deg2rad(10)
#: shapes of the simulator that are boxes or upright cylinders
EXACT = ('block', 'bottle', 'can')
_RECORD = RecordConfig(pictures='first')


class Seen:
    """A rollout in a truth, and its first frame.

    Args:
        pipeline: the pipeline.
        scenes: makes plans.
        job: physics, task, number, seed and policy.
    """

    def __init__(self, pipeline: Pipeline, scenes: Scenes, job: tuple) -> None:
        self.pipeline = pipeline
        plan, home = scenes._plan(job, pipeline.robot)
        sim = SimEpisode(pipeline.robot, home, physics=job[0])
        try:
            seen = sim.reset(job[3], job[1])
            self.first: Observation = observed(sim, seen)
            self.take: Take = carry_out(sim, task_named(job[1]), plan, seen, _RECORD)
            self.objects = {item.name: item for item in sim.scene.objects}
            self.instruction, home = sim.instruction, sim.home
        finally:
            sim.close()
        end = self.take.control_positions.shape[0] * CONTROL_PERIOD_S
        self.commands = resample(self.take.commands, home, np.arange(0.0, end, PERIOD_S))
        self.names = tuple(self.objects)
        self.poses = self.take.object_poses

    def find(self) -> tuple[TrackedSolids, BoolArray, FloatArray]:
        """Return the objects as found, their masks and the camera poses."""
        pipeline, first = self.pipeline, self.first
        assert isinstance(pipeline.judge, SuccessJudge)
        model = pipeline.judge.object_motion
        assert isinstance(model, SolidForesight)
        masks = pipeline.segmenter.segment(first.frames[:, None], self.names).masks[:, :, 0]
        poses = np.stack(
            [camera_poses(c, pipeline.robot, first.positions[None])[0] for c in first.cameras]
        )
        return model.find(self.names, masks, first.cameras, list(poses)), masks, poses

    def as_true(self, tracked: TrackedSolids) -> TrackedSolids:
        """Return the objects with their true pose and size."""
        solids = list(tracked.solids)
        for number, name in enumerate(self.names):
            solid, pose = solids[number], self.poses[0, number]
            if solid is not None:
                yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
                size = np.array(self.objects[name].size, float)
                solids[number] = replace(solid, centre=pose[:3, 3], size=size, yaw=yaw)
        return replace(tracked, solids=tuple(solids))

    def foresee(
        self, tracked: TrackedSolids, masks: BoolArray, poses: FloatArray
    ) -> ForeseenMotions:
        """Return the motions of the futures."""
        found = FoundObjects.at(self.names, self.first.frames, masks, poses, tracked)
        (ahead,) = found.foresee([self.commands])
        return foreseen_of(self.pipeline.robot, ahead, len(ahead.motions[0].points))


def yaw_error(found: float, true: float, quarter: bool) -> float:
    """Return the difference of two yaws of a box [rad], up to a quarter or half a turn."""
    step = np.pi / 2 if quarter else np.pi
    return float((found - true + step / 2) % step - step / 2)


def examined(seen: Seen, job: tuple) -> tuple[bool, bool, list[str] | None]:
    """Return whether a rollout succeeds, is called a success, and its row if it is listed."""
    tracked, masks, poses = seen.find()
    motions = seen.foresee(tracked, masks, poses)
    estimator = seen.pipeline.judge.estimator
    ends = estimator.foresee(motions, seen.instruction)
    if ends is None:
        return seen.take.final, False, None
    calibration = estimator.calibration
    fit = (None if calibration is None else calibration.futures) or ShareFit()
    features = {'foreseen': foreseen_feature(ends), 'futures': ends.num_effective}
    one = estimate_of_futures(fit, features)
    called = verdict(one.probability, one[1:]) == 1
    if seen.take.final or ends.share < LISTED_FROM:
        return seen.take.final, called, None
    other = estimator.foresee(seen.foresee(seen.as_true(tracked), masks, poses), seen.instruction)
    moved = np.linalg.norm(np.ptp(seen.poses[:, :, :3, 3], axis=0), axis=-1)
    ahead = np.linalg.norm(np.ptp(np.nan_to_num(motions.points[0]), axis=0), axis=-1)
    item = int(np.argmax(np.maximum(moved, ahead)))
    name, solid = seen.names[item], tracked.solids[item]
    true = seen.objects[name]
    assert solid is not None
    size = np.array(true.size, float)
    yaw = float(np.arctan2(seen.poses[0, item, 1, 0], seen.poses[0, item, 0, 0]))
    place = 1e3 * np.linalg.norm(solid.centre - seen.poses[0, item, :3, 3])
    square = abs(size[0] - size[1]) < 1e-6
    sizes = sorted(np.abs(np.sort(solid.size[:2]) - np.sort(size[:2]))) + [
        abs(solid.size[2] - size[2])
    ]
    turn = '–' if solid.is_round else f'{np.rad2deg(yaw_error(solid.yaw, yaw, square)):+.1f}'
    true_share = float('nan') if other is None else other.share
    wrong = 'pose or size'
    if not true_share < 0.5:
        wrong = 'contact' if true.shape in EXACT else 'contact or shape'
    at_s, text = apart(seen, motions, item)
    row = [
        job[0], job[1], job[4].rpartition('-')[2], f'{name} ({true.shape})',
        f'{one.probability:.2f} [{one.low:.2f}, {one.high:.2f}]{" silent" if called else ""}',
        f'{place:.1f}', f'{1e3 * max(sizes):.1f}', turn, f'{ends.share:.2f}',
        f'{true_share:.2f}', at_s, text, wrong,
    ]  # fmt: skip
    return False, called, row


def apart(seen: Seen, motions: ForeseenMotions, item: int) -> tuple[str, str]:
    """Return when the undisturbed future of an object leaves the truth, and what each does."""
    each = round(motions.step_s / _RECORD.frame_period_s)
    real = seen.poses[:: max(each, 1), item]
    num = min(len(real), motions.points.shape[1])
    ways = motions.points[0, :num, item] - motions.points[0, 0, item]
    trues = real[:num, :3, 3] - real[0, :3, 3]
    turned = real[:num, :3, :3] @ real[0, :3, :3].T
    between = np.swapaxes(turned, -1, -2) @ motions.rotations[0, :num, item]
    angles = np.arccos(np.clip((np.trace(between, axis1=-2, axis2=-1) - 1) / 2, -1, 1))
    gaps = np.linalg.norm(ways - trues, axis=-1)
    off = np.flatnonzero((gaps > APART_M) | (angles > APART_RAD))
    if not len(off):
        return '–', f'never; {1e3 * gaps[-1]:.0f} mm apart at the end'
    at = int(off[0])

    def told(way: FloatArray, turn: FloatArray) -> str:
        yaw = np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0]))
        tilt = np.rad2deg(np.arccos(np.clip(turn[2, 2], -1, 1)))
        return f'{1e3 * way[2]:+.0f} mm up, yaw {yaw:+.0f}, tilt {tilt:.0f} deg'

    last = min(at + 5, num - 1)
    text = (
        f'truth {told(trues[last], turned[last])}; future '
        f'{told(ways[last], motions.rotations[0, last, item])}; '
        f'{1e3 * gaps[-1]:.0f} mm apart at the end'
    )
    return f'{at * motions.step_s:.1f}', text


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('--seeds', required=True, help='comma-separated')
    parser.add_argument('--turns', default='0.5,0.64,0.8', help='of the grasp [rad]')
    parser.add_argument('--physics', default=f'{NOMINAL},dart')
    parser.add_argument('--tasks', default=','.join(TASKS))


def main() -> None:
    """Print the table."""
    options = parse_arguments(__doc__, 1, more)
    pipeline = Pipeline.load('bundled')
    scenes = Scenes(
        {'': pipeline}, argparse.Namespace(physics=NOMINAL, contact=None, pictures='', real='')
    )
    counts: dict[str, Any] = {p: np.zeros(4, int) for p in options.physics.split(',')}
    rows = []
    for seed in map(int, options.seeds.split(',')):
        for turn in options.turns.split(','):
            for task in options.tasks.split(','):
                for physics in options.physics.split(','):
                    scenes._known.clear()
                    number = episode_seed(seed, task, 0, 0)
                    job = physics, task, 0, number, f'expert-turn-{turn}'
                    try:
                        final, called, row = examined(Seen(pipeline, scenes, job), job)
                    except (PolicyError, SimulatorError) as error:
                        print(f'{job}: {error}')
                        continue
                    counts[physics] += 1, not final, called, called and not final
                    if row is not None:
                        rows.append(row)
                        print(*row, sep=' | ', flush=True)
    said = '; '.join(
        f'`{p}`: {c[0]} rollouts, {c[1]} fail, {c[2]} called a success, {c[3]} of these fail'
        for p, c in counts.items()
    )
    asked = ('seeds', 'turns', 'physics', 'tasks')
    command = ' '.join(f'--{key} {getattr(options, key)}' for key in asked)
    options.seed = int(options.seeds.split(',')[0])
    publish(
        'silent_failures',
        'Failures that the futures call a success',
        f'python experiments/silent_failures.py {command}',
        '\n\n'.join(
            [(__doc__ or '').split('\n' * 2, 2)[2].strip(), said + '.', table(HEAD, rows)]
        ),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
