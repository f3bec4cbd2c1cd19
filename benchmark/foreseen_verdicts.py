"""How well do object motion networks tell success alone, without a picture? To choose networks by.

    mtv-world collect --task all --episodes 24 --faults calibrate --seed 1391 --pictures first --out data/left
    python benchmark/foreseen_verdicts.py data/left bundled runs/a+runs/b --repeats 360 --workers 2

Every episode's plan is foreseen whole from the masks of its first frame, by the networks of a
checkpoint or of several folders joined by `+`, 13 motions in all, and as rigid bodies where the
first has `contact.json`. A row of a name judges by the share of the motions that succeed, those of
bodies counting twice as much as those of networks: half or more is a success; of `networks alone` and `bodies
alone` only their own motions count. `shown` is the one motion that pictures show, `expected` the
first one of the networks. Beside them stands the rule that imagines nothing: an object sticks to a
gripper that closes near it. Differences are to the first row of networks; intervals:
Wilson of shares, jackknife of AUROC, bootstrap of differences, over episodes. What is chosen by this must not be measured by
it: kinds of the split `test` are refused. With `--recorded-arms` the networks and the rule are told
where the arms really went, which nobody knows ahead: what that costs.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from page import parse_arguments, publish, table
import torch

from mtv_world_ros.assembly import checkpoint_path, checkpoint_robot, fingerprint
from mtv_world_ros.bench.ranking.no_picture_rule import is_done, Thing
from mtv_world_ros.bench.ranking.optimism import area_interval
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data.recorded_policies import refuse_test_kinds
from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.object_motion import FoundObjects
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.evaluation.metrics.statistics import wilson
from mtv_world_ros.lab.evaluation.metrics.success_agreement import area_under_roc
from mtv_world_ros.lab.training.object_motion.tracks import (
    fine_commands,
    first_frame,
    FirstFrame,
    recorded_positions,
)
from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
from mtv_world_ros.model.object_motion.predictor import (
    load_predictor,
    ObjectMotionPredictor,
    TrackedObjects,
)
from mtv_world_ros.success.foreseen import foreseen_of
from mtv_world_ros.success.task import load_tasks, match_task, TaskSpec

VIEWS = ('low', 'high')
RULE = 'no pictures, no networks: the rule'
HEAD = ('judged by', 'n', 'right', 'AUROC', 'false success', 'false failure', 'Brier of the share')
#: what is said by networks: what follows their name
SAID = ('', ', networks alone', ', bodies alone', ', shown', ', expected')
_DRAWS = 2000


def more(parser: argparse.ArgumentParser) -> None:
    """Adds options."""
    parser.add_argument('dataset', type=Path)
    parser.add_argument('networks', nargs='+', help='checkpoints; DIR+DIR = their networks')
    parser.add_argument('--workers', type=int, default=1, help='processes')
    parser.add_argument('--recorded-arms', action='store_true', help='not as commanded')


def load(names: str, recorded_arms: bool = False) -> ObjectMotionPredictor:
    """Returns the networks of one or several checkpoints, or of what `train-motion` wrote.

    Args:
        names: folders joined by `+`.
        recorded_arms: arms are where they are said to be, they need not follow.
    """
    folders = [checkpoint_path(name) for name in names.split('+')]
    robot = checkpoint_robot('bundled')
    found = [load_predictor(folder / OBJECT_MOTION_FOLDER, robot) for folder in folders]
    members = [member for one in found for member in one.members]
    if recorded_arms:
        members = [replace(member, response=None) for member in members]
    return ObjectMotionPredictor(members, robot, found[0].contact)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """An episode as it is judged.

    Attributes:
        success: how it really ended.
        task: what is asked.
        bound: placeholder -> name of its object.
        names: of O objects.
        frame: the first.
        positions: (N, J) commanded, `PERIOD_S` apart [rad or m]; or the arms' as recorded.
    """

    success: bool
    task: TaskSpec
    bound: dict[str, str]
    names: tuple[str, ...]
    frame: FirstFrame
    positions: FloatArray


def read_plan(path: Path, robot: RobotModel, recorded_arms: bool = False) -> Plan | None:
    """Reads an episode; None = its task is not known, or an object of it not seen."""
    episode = read_episode(path, views=VIEWS)
    found = match_task(load_tasks(share_path('config', 'tasks')), episode.info.instruction)
    states = episode.joint_states
    if found is None or states is None or episode.masks is None:
        return None
    names = tuple(episode.info.objects)
    frame = first_frame(episode, robot, VIEWS)
    bound = [names.index(name) for name in found[1].values()]
    if not np.isfinite(frame.points()[bound]).all():
        return None
    times, positions = fine_commands(episode, robot, VIEWS)
    if recorded_arms:
        grippers = {tool.gripper_joint for tool in robot.tools}
        arms = [name not in grippers for name in robot.joint_names]
        stamp = int(episode.masks[VIEWS[0]].stamps_ns[0])
        positions[:, arms] = recorded_positions(states, robot, stamp + times * 1e9)[:, arms]
    return Plan(
        success=episode.info.outcome == 'success',
        task=found[0],
        bound=found[1],
        names=names,
        frame=frame,
        positions=positions,
    )


def found_by(plan: Plan, predictor: ObjectMotionPredictor) -> TrackedObjects:
    """Returns the objects of a plan's first frame."""
    return predictor.find(plan.names, plan.frame.masks, plan.frame.cameras, plan.frame.poses)


def foreseen_by(plan: Plan, tracked: TrackedObjects) -> list[float]:
    """Returns what motions say by `SAID`, 0 to 1; empty = they do not tell."""
    frame = plan.frame
    objects = FoundObjects.at(
        names=plan.names,
        frames=np.zeros((*frame.masks[:, 0].shape, 3), np.uint8),
        masks=frame.masks,
        poses=np.stack(frame.poses),
        tracked=tracked,
    )
    (ahead,) = objects.foresee([plan.positions])
    foreseen = foreseen_of(tracked.model.robot, ahead, len(ahead.motions[0].points))
    ends = foreseen.ends(plan.task, plan.bound, np.full_like(tracked.reference, np.nan))
    if ends is None:
        return []
    shown = ahead.medoid(ends.as_most)
    count = 1 + tracked.model.num_disturbed
    alone = [float(np.mean(part)) for part in (ends.done[:count], ends.done[count:]) if len(part)]
    return [ends.share, alone[0], alone[-1], float(ends.done[shown]), float(ends.done[0])]


def ruled(plan: Plan, tracked: TrackedObjects) -> float:
    """Returns whether a plan succeeds by the rule, which is given the same places and sizes."""
    things = {
        name: Thing(name=name, centre=centre, size=size)
        for name, centre, size in zip(plan.names, tracked.reference, tracked.sizes[0], strict=True)
    }
    return float(is_done(plan.task, plan.bound, things, tracked.model.robot, plan.positions))


def judged(
    path: Path, networks: Sequence[str], recorded_arms: bool
) -> tuple[bool, list[float]] | None:
    """Returns an outcome, and what the rule and the networks say; None = one cannot tell.

    Args:
        path: of an episode.
        networks: see `load`.
        recorded_arms: see `load`.
    """
    torch.set_num_threads(1)
    if not _LOADED:
        _LOADED.update({names: load(names, recorded_arms) for names in networks})
    first, *_ = _LOADED.values()
    plan = read_plan(path, first.robot, recorded_arms)
    if plan is None:
        return None
    found = [found_by(plan, predictor) for predictor in _LOADED.values()]
    said = [foreseen_by(plan, tracked) for tracked in found]
    if not all(said):
        return None
    return plan.success, [ruled(plan, found[0]), *(value for values in said for value in values)]


#: in a worker: the networks by their names
_LOADED: dict[str, ObjectMotionPredictor] = {}


def scores(said: FloatArray, real: BoolArray) -> dict[str, float]:
    """Returns what can be said of shares (N,) against outcomes (N,)."""
    called = said >= 0.5
    return {
        'right': float(np.mean(called == real)),
        'AUROC': area_under_roc(said, real) or 0.0,
        'false success': float(np.mean(called[~real])),
        'false failure': float(np.mean(~called[real])),
        'Brier': float(np.mean((said - real) ** 2)),
    }


def row(name: str, said: FloatArray, real: BoolArray) -> list[str]:
    """Returns a row of the table, with intervals."""
    found, called = scores(said, real), said >= 0.5
    _, area = area_interval([said], real, [('', k) for k in range(len(real))])
    intervals = {
        'right': wilson(float((called == real).sum()), len(real)),
        'AUROC': area,
        'false success': wilson(float(called[~real].sum()), float((~real).sum())),
        'false failure': wilson(float((~called[real]).sum()), float(real.sum())),
    }
    cells = [f'{found[key]:.3f} [{low:.3f}, {high:.3f}]' for key, (low, high) in intervals.items()]
    return [name, str(len(real)), *cells, f'{found["Brier"]:.4f}']


def difference(name: str, first: FloatArray, said: FloatArray, real: BoolArray, seed: int) -> str:
    """Returns a line: how much others differ from the first, over the same episodes."""
    rng, drawn = np.random.default_rng(seed), []
    for _ in range(_DRAWS):
        rows = rng.integers(0, len(real), len(real))
        if real[rows].all() or not real[rows].any():
            continue
        one, other = scores(first[rows], real[rows]), scores(said[rows], real[rows])
        drawn.append([other[key] - one[key] for key in one])
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
    one, other = scores(first, real), scores(said, real)
    parts = [
        f'{key} {other[key] - one[key]:+.3f} [{a:+.3f}, {b:+.3f}]'
        for key, a, b in zip(one, low, high, strict=True)
    ]
    return f'- `{name}` less the first: {"; ".join(parts)}.'


def outcomes(
    paths: Sequence[Path], networks: Sequence[str], workers: int, recorded_arms: bool
) -> list[tuple[bool, list[float]]]:
    """Returns what `judged` says of all episodes that it can judge."""
    judge = partial(judged, networks=networks, recorded_arms=recorded_arms)
    with ProcessPoolExecutor(workers, get_context('spawn')) as pool:
        return [found for found in pool.map(judge, paths, chunksize=4) if found is not None]


def main() -> None:
    """Prints a row for the rule and each choice of networks, and writes them as a page."""
    options = parse_arguments(__doc__, 360, more)
    paths = list_episodes(options.dataset)
    refuse_test_kinds(paths, 'the choice of networks')
    count = min(options.repeats, len(paths))
    paths = [paths[k] for k in np.linspace(0, len(paths), count, False).astype(int)]
    found = outcomes(paths, options.networks, options.workers, options.recorded_arms)
    if len({real for real, _ in found}) < 2:
        raise MtvWorldError(f"'{options.dataset}' needs episodes that succeed and that fail")
    real = np.array([outcome for outcome, _ in found])
    columns = np.array([said for _, said in found]).T
    names = [name + what for name in options.networks for what in SAID]
    judges = dict(zip((RULE, *names), columns, strict=True))
    lines = [
        difference(name, judges[names[0]], judges[name], real, options.seed) for name in names[1:]
    ]
    publish(
        'foreseen_verdicts',
        'What object motion networks tell without a picture',
        f'python benchmark/foreseen_verdicts.py DIR ..., {fingerprint("bundled")}',
        '\n\n'.join(
            [
                (__doc__ or '').split('\n' * 2)[-1],
                f'{len(real)} episodes of {count}, of which {real.sum()} really succeed.',
                table(HEAD, [row(name, said, real) for name, said in judges.items()]),
                '\n'.join(lines),
            ]
        ),
        options,
        f'{options.workers} processes',
    )


if __name__ == '__main__':
    main()
