"""What are verdicts of foreseen motions worth where the truth is another physics?

    python benchmark/shifted_worlds.py --physics nominal,bold,camera_off --scenes 2 --log out/shifted.jsonl
    python benchmark/shifted_worlds.py --physics bold --checkpoints bundled,runs/refitted --log out/fitted.jsonl

In each physics of `config/physics.yaml` the expert and policies with drawn faults (of all kinds, in
sizes around the typical ones; the seed draws) act in the simulator; each plan is foreseen from the
pictures of the first frame alone, as the node does: cameras are checked against the arm's outline,
objects are found by the segmenter. Said is the share of foreseen futures that succeed; the world
model makes no picture. From .75 on it is called a success, below .5 a failure. The rule: an object
sticks to a gripper that closes near it. Intervals over scenes: AUROC jackknife, shares clustered
Wilson. The log keeps what was done; the same command goes on. `--no-camera-check` leaves cameras as
they are told.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import json
from math import isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.assembly import fingerprint, load_pipeline
from mtv_world_ros.bench.collect.episode_jobs import episode_seed
from mtv_world_ros.bench.collect.record import carry_out, RecordConfig
from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.expert.faults.catalogue import draw_variant, EXPERT, FAULTS
from mtv_world_ros.bench.expert.scripted_policy import scripted_policy
from mtv_world_ros.bench.ranking.no_picture_rule import judge_without_pictures
from mtv_world_ros.bench.ranking.scores import area_interval
from mtv_world_ros.bench.tasks.tasks import task_named
from mtv_world_ros.bench.world.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.data_types import FloatArray, Observation
from mtv_world_ros.errors import MtvWorldError, PolicyError, SimulatorError
from mtv_world_ros.foresight.arm_response import PERIOD_S
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.geometry.object_motion import FoundObjects
from mtv_world_ros.geometry.resample import resample
from mtv_world_ros.lab.evaluation.metrics.statistics import clustered_wilson
from mtv_world_ros.pipeline import ImaginedEpisode, Pipeline
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.success.foreseen import foreseen_of
from mtv_world_ros.success.situation import CannotTell

TASKS = (
    'place_block_a2b_left', 'stack_blocks_two', 'place_cup_plate', 'collect_toy',
    'place_bread_plate', 'move_object_two',
)  # fmt: skip
HEAD = (
    'truth', 'judged by', 'n', 'succeed', 'AUROC', 'false success', 'false failure', 'no verdict',
    'refused',
)  # fmt: skip
RULE = 'no-picture rule'
#: commands go on so long after the plan [s]
_RECORD = RecordConfig(pictures='first')


def more(parser: argparse.ArgumentParser) -> None:
    """Adds options."""
    parser.add_argument('--physics', default='nominal,bold')
    parser.add_argument('--checkpoints', default='bundled', help='each sees the same rollouts')
    parser.add_argument('--tasks', default=','.join(TASKS))
    parser.add_argument('--scenes', type=int, default=2, help='of each task')
    parser.add_argument('--policies', type=int, default=4, help='in each scene, with the expert')
    parser.add_argument('--log', type=Path, required=True, help='JSON lines of what was done')
    parser.add_argument('--no-camera-check', action='store_true')
    parser.add_argument('--until', type=float, default=1e9, help='begins no rollout after so long')


def policies_of(seed: int, count: int) -> list[str]:
    """Returns the expert and policies with drawn faults."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(21,)))
    drawn = [EXPERT]
    while len(drawn) < count:
        name = draw_variant(tuple(FAULTS), rng).name
        if name not in drawn:
            drawn.append(name)
    return drawn


def share_of(
    pipeline: Pipeline, episode: ImaginedEpisode, observation: Observation, commands: FloatArray
) -> float:
    """Returns the share of futures that succeed under commands (C, J); NaN = they do not tell."""
    model, names = pipeline.object_motion, episode.names
    assert model is not None
    observation = episode.camera_check.corrected_observation(observation)
    masks = pipeline.segmenter.segment(observation.frames[:, None], names).masks[:, :, 0]
    poses = np.stack(
        [
            camera_poses(camera, pipeline.robot, observation.positions[None])[0]
            for camera in observation.cameras
        ]
    )
    tracked = model.find(names, masks, observation.cameras, list(poses))
    objects = FoundObjects.at(names, observation.frames, masks, poses, tracked)
    (ahead,) = objects.foresee([commands])
    motions = foreseen_of(pipeline.robot, ahead, len(ahead.motions[0].points))
    ends = pipeline.estimator.foresee(motions, episode.instruction)
    return nan if ends is None else ends.share


def observed(sim: SimEpisode, seen: Any) -> Observation:
    """Returns what a policy sees, with the cameras as they are told."""
    cameras = sim.told_cameras
    frames = np.stack([seen.images[camera.view] for camera in cameras])
    return Observation(cameras=cameras, frames=frames, positions=seen.positions, stamp_ns=1)


def rollout(
    physics: str, task: str, seed: int, policy: str, pipelines: dict[str, Pipeline]
) -> dict[str, Any]:
    """Returns what really happens, and what each checkpoint and the rule say."""
    robot = next(iter(pipelines.values())).robot
    expert = Expert(robot, physics=physics)
    acting = scripted_policy(policy, task, seed, expert)
    acting.reset(seed=seed)
    plan = acting.plan
    sim = SimEpisode(robot, expert.home, physics=physics)
    try:
        seen = sim.reset(seed, task)
        first = observed(sim, seen)
        take = carry_out(sim, task_named(task), plan, seen, _RECORD)
        end = take.control_positions.shape[0] * CONTROL_PERIOD_S
        times = np.arange(0.0, end, PERIOD_S)
        commands = resample(take.commands, sim.home, times)
        said: dict[str, float] = {}
        refused = False
        for name, pipeline in pipelines.items():
            episode = pipeline.begin(first, instruction=sim.instruction)
            refused |= bool(episode.camera_check.refusal)
            said[name] = (
                nan
                if episode.camera_check.refusal
                else share_of(pipeline, episode, first, commands)
            )
        try:
            said[RULE] = float(judge_without_pictures(episode, commands))
        except CannotTell:
            said[RULE] = nan
    finally:
        sim.close()
    return {'final': take.final, 'said': said, 'refused': refused}


def jobs(options: argparse.Namespace) -> Iterator[tuple[str, str, int, int, str]]:
    """Yields physics, task, number of the scene, its seed, policy: all physics take turns."""
    for index in range(options.scenes):
        for task in options.tasks.split(','):
            seed = episode_seed(options.seed, task, index, 0)
            for policy in policies_of(seed, options.policies):
                for physics in options.physics.split(','):
                    yield physics, task, index, seed, policy


def run(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Runs what is missing in the log; returns all of it that the options ask for."""
    from time import monotonic

    begun = monotonic()
    names = options.checkpoints.split(',')
    pipelines = {
        name: load_pipeline(name, camera_check=not options.no_camera_check) for name in names
    }
    done = {}
    if options.log.is_file():
        lines = [json.loads(line) for line in options.log.read_text().splitlines()]
        done = {tuple(line['job']): line for line in lines}
    options.log.parent.mkdir(parents=True, exist_ok=True)
    found = []
    for job in jobs(options):
        if job not in done:
            if monotonic() - begun > options.until:
                break
            physics, task, _, seed, policy = job
            try:
                done[job] = {'job': job, **rollout(physics, task, seed, policy, pipelines)}
            except (SimulatorError, PolicyError) as error:
                done[job] = {'job': job, 'skipped': str(error)}
            with options.log.open('a') as stream:
                stream.write(json.dumps(done[job]) + '\n')
        if 'skipped' not in done[job]:
            found.append(done[job])
    return found


def row(physics: str, judge: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Returns a row of the table."""
    said = np.array([r['said'][judge] for r in rows], np.float64)
    real = np.array([r['final'] for r in rows], np.bool_)
    scenes = [(r['job'][1], r['job'][2]) for r in rows]
    known = np.isfinite(said)
    calls = np.array([verdict(float(value)) for value in said])
    cells = [physics, judge, str(len(rows)), str(int(real.sum()))]
    auroc = '–'
    if known.any() and len(set(real[known])) == 2:
        chosen = [scene for scene, is_known in zip(scenes, known, strict=True) if is_known]
        value, (low, high) = area_interval([said[known]], real[known], chosen)
        auroc = f'{value:.2f}' + (f' [{low:.2f}, {high:.2f}]' if isfinite(low) else '')
    wrong = [_share(calls == 1, ~real & np.isfinite(calls), scenes),
             _share(calls == 0, real & np.isfinite(calls), scenes)]  # fmt: skip
    none = int((~np.isfinite(calls)).sum())
    refused = str(sum(r['refused'] for r in rows)) if judge != RULE else '–'
    return [*cells, auroc, *wrong, f'{none} of {len(rows)}', refused]


def _share(hits: np.ndarray, among: np.ndarray, scenes: Sequence[tuple[str, int]]) -> str:
    if not among.any():
        return '–'
    names = list(dict.fromkeys(scenes))
    number = np.array([names.index(scene) for scene in scenes])
    counts = [np.bincount(number[among & h], minlength=len(names)) for h in (hits, among)]
    low, high = clustered_wilson(*(c[counts[1] > 0].astype(np.float64) for c in counts))
    interval = f' [{low:.2f}, {high:.2f}]' if isfinite(low) else ''
    return f'{int(counts[0].sum())} of {int(counts[1].sum())}{interval}'


def main() -> None:
    """Prints a row for each physics and judge, and writes them as a page."""
    options = parse_arguments(__doc__, 1, more)
    found = run(options)
    if not found:
        raise MtvWorldError('no rollout was done; give more time (--until)')
    judges = [*options.checkpoints.split(','), RULE]
    rows = [
        row(physics, judge, chosen)
        for physics in options.physics.split(',')
        if (chosen := [r for r in found if r['job'][0] == physics])
        for judge in judges
    ]
    publish(
        'shifted_worlds',
        'Verdicts of foreseen motions where the truth is another physics',
        f'python benchmark/shifted_worlds.py --physics {options.physics} --scenes '
        f'{options.scenes} --policies {options.policies} --seed {options.seed} --checkpoints '
        f'{options.checkpoints}, {fingerprint("bundled")}',
        '\n\n'.join([(__doc__ or '').split('\n' * 2)[-1], table(HEAD, rows)]),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
