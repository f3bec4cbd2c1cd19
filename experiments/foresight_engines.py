"""What foresees objects best, and how fast? Engines side by side, in turns, without a picture.

    mtv-world collect --task all --episodes 16 --faults calibrate --seed 5001 --pictures first --out data/cal
    python experiments/foresight_engines.py data/cal --repeats 120
    python experiments/foresight_engines.py --chunks 20

Every episode's plan is foreseen whole from the masks of its first frame. A row judges by the share
of the futures in which the task is done at the end: half or more is a success; a share of .75 is a
verdict. `MuJoCo` is this version's foresight, with its number of futures; `DART` the rigid bodies of
version 0.1.0, with the same numbers of contact; `networks` its 13 motions of networks; `0.1.0` both,
bodies counting twice. The latter three run in a checkout of the tag v0.1.0, which is made in a
temporary folder, in turns with this one; with `--no-old` they are left out. Seconds are those of the
processor for finding and foreseeing a plan, medians; the ratio is of each episode to 0.1.0's, the
median. What is chosen by this must not be measured by it: kinds of the split `test` are refused.

`--robot` and `--contact` judge another robot's episodes with what fit contact found, this version
alone; `--task` gives the files of tasks that are not bundled. Where no two outcomes are known, as of
real recordings, shares stand alone. The no-picture rule (commands and first masks alone: an object sticks to a gripper that closes
near it) stands beside it.

With `--chunks N` both versions imagine N plans of 3.2 s of the bundled episode in turns, each whole
with its pictures; seconds are those of the processor again, one thread each, so that other work on
the machine does not count; in each turn the order is the other way round.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

import numpy as np
from page import old_checkout, parse_arguments, publish, ROOT, table

from mtv_world_ros.cli.shared_options import names
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data.splits import refuse_test_kinds
from mtv_world_ros.evaluation.metrics.statistics import wilson
from mtv_world_ros.evaluation.metrics.success_agreement import area_under_roc
from mtv_world_ros.evaluation.result_settings import fingerprint
from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER
from mtv_world_ros.model.checkpoint import Checkpoint, checkpoint_folder
from mtv_world_ros.physics.checkpoint_files import load_foresight
from mtv_world_ros.physics.fitting.tracks import fine_commands, first_frame
from mtv_world_ros.physics.foreseen_motions import foreseen_of
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.physics.solid_foresight import SolidForesight
from mtv_world_ros.ranking.no_picture_rule import is_done, things_in
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.success.foreseen import foreseen_ends
from mtv_world_ros.success.task import load_task, load_tasks, match_task

OLD, RULE = '0.1.0: networks and DART', 'no-picture rule'
#: plans begin so many frames apart, among the first frames of the bundled episode
_STRIDE, _FRAMES = 7, 60
#: a share from here on is a verdict of success
VERDICT = 0.75
HEAD = ('judged by', 'n', 'right', 'AUROC', 'false success', 'false success from .75',
        'false failure', 'Brier', 'CPU [s]', 'of 0.1.0')  # fmt: skip
_DRAWS = 1000
#: answers a path a line with what 0.1.0 foresees, in its own checkout
_WORKER = """
import json, sys, time
sys.path.insert(0, 'experiments')
from pathlib import Path
import torch
torch.set_num_threads(1)
import foreseen_verdicts as old
predictor = old.load('bundled')
print('ready', flush=True)
for line in sys.stdin:
    plan, answer = old.read_plan(Path(line.strip()), predictor.robot), {}
    if plan is not None:
        begin = time.process_time()
        said = old.foreseen_by(plan, old.found_by(plan, predictor))
        answer = dict(said=said[:3], seconds=time.process_time() - begin)
    print(json.dumps(answer), flush=True)
"""
#: answers the number of a frame with the processor's seconds by stage of a plan that begins there
_CHUNKS = """
import json, sys, time
time.perf_counter = time.process_time  # other work does not count
from dataclasses import replace
import numpy as np
from mtv_world_ros import Pipeline
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.files import share_path
futures = int(sys.argv[1])
pipeline = Pipeline.load('bundled', num_threads=1)
if futures:
    from mtv_world_ros.physics.solid_foresight import SolidForesight
    known = pipeline.judge.object_motion
    settings = known.settings.model_copy(update={'num_motions': futures})
    foresight = SolidForesight(known.robot, known.response, settings)
    pipeline = replace(pipeline, judge=replace(pipeline.judge, object_motion=foresight))
recording = load_recording(
    share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot
)
commands = recording.commands
print(len(recording.times), flush=True)
for line in sys.stdin:
    frame = int(line)
    at = float(recording.times[frame])
    kept = (commands.times > at + 1e-6) & (commands.times <= at + 3.2)
    plan = JointTrajectory(
        joint_names=commands.joint_names,
        times=commands.times[kept] - at,
        positions=commands.positions[kept],
    )
    observation = Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, frame],
        positions=recording.positions[frame],
        stamp_ns=recording.stamp_ns + round(at * 1e9),
    )
    begun = time.process_time()
    episode = pipeline.begin(observation, RolloutOptions(instruction=recording.instruction))
    begun = time.process_time() - begun
    spent = {'begin': begun}
    for prediction in episode.extend(plan):
        for stage, seconds in prediction.seconds.items():
            spent[stage] = spent.get(stage, 0.0) + seconds
    print(json.dumps(spent), flush=True)
"""


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('dataset', type=Path, nargs='?', help='episodes to judge')
    parser.add_argument('--no-old', action='store_true', help='this version alone')
    parser.add_argument('--robot', help="YAML file or bundled name; default: the checkpoint's")
    parser.add_argument('--views', type=names, default='low,high', help='comma-separated')
    parser.add_argument('--contact', default='bundled', help='checkpoint, or of fit contact')
    parser.add_argument('--task', type=Path, nargs='+', default=(), help='files of other tasks')
    parser.add_argument('--chunks', type=int, default=0, help='plans to imagine in turns')
    parser.add_argument('--futures', type=int, nargs='+', default=[16, 64])


class Worker:
    """A version in a process of its own, which answers a line with a line.

    Args:
        folder: its checkout.
        code: that runs there.
        futures: argument of the code.
    """

    def __init__(self, folder: Path, code: str, futures: int = 0) -> None:
        self._process = subprocess.Popen(
            [sys.executable, '-c', code, str(futures)],
            cwd=folder,
            env=os.environ | {'PYTHONPATH': str(folder.resolve()), 'OMP_NUM_THREADS': '1'},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._folder = folder
        self._answer()

    def ask(self, line: object) -> Any:
        """Return what it answers."""
        assert self._process.stdin is not None
        self._process.stdin.write(f'{line}\n')
        self._process.stdin.flush()
        return json.loads(self._answer())

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise MtvWorldError(f"the version in '{self._folder}' does not run")
        return line


class Old:
    """What version 0.1.0 says of episodes."""

    def __init__(self, folder: Path) -> None:
        self._worker = Worker(folder, _WORKER)

    def ask(self, path: Path) -> dict[str, tuple[float, float]]:
        """Return share and seconds by row of the table; empty = it cannot tell."""
        answer = self._worker.ask(path.resolve())
        if not answer.get('said'):
            return {}
        both, networks, bodies = answer['said']
        seconds = answer['seconds']
        return {
            OLD: (both, seconds),
            'networks alone': (networks, np.nan),
            'DART alone': (bodies, np.nan),
        }


class New:
    """This version, with some numbers of futures.

    Args:
        futures: numbers of them.
        contact: checkpoint, or folder of fit contact.
        robot: whose it is; None = the checkpoint's.
        tasks: files of tasks that are looked at before the bundled ones.
    """

    def __init__(
        self, futures: list[int], contact: str, robot: str | None, tasks: Sequence[Path] = ()
    ) -> None:
        self._tasks = (*map(load_task, tasks), *load_tasks(share_path('config', 'tasks')))
        self.robot = (
            Checkpoint.open(contact).load_robot()
            if robot is None
            else load_robot(robot_path(robot))
        )
        found = load_foresight(checkpoint_folder(contact) / OBJECT_MOTION_FOLDER, self.robot)
        if found is None:
            raise MtvWorldError(f"'{contact}' holds no numbers of contact; run fit contact")
        self._engines = {
            f'MuJoCo, {number} futures': SolidForesight(
                self.robot,
                found.response,
                found.settings.model_copy(update={'num_motions': number}),
            )
            for number in futures
        }

    def ask(
        self, path: Path, views: tuple[str, ...]
    ) -> tuple[bool, dict[str, tuple[float, float]]]:
        """Return the outcome, and share and seconds by row; none = it cannot tell."""
        episode = read_episode(path, views=views)
        found = match_task(self._tasks, episode.info.instruction)
        success = episode.info.outcome == 'success'
        if found is None or episode.masks is None or episode.joint_states is None:
            return success, {}
        task, bound = found
        named, frame = tuple(episode.info.objects), first_frame(episode, self.robot, views)
        _, positions = fine_commands(episode, self.robot, views)
        answers = {}
        for row, engine in self._engines.items():
            begin = time.process_time()
            tracked = engine.find(named, frame.masks, frame.cameras, frame.poses)
            ahead = FoundObjects.at(
                names=named,
                frames=np.zeros((*frame.masks[:, 0].shape, 3), np.uint8),
                masks=frame.masks,
                poses=np.stack(frame.poses),
                tracked=tracked,
            ).after(positions)
            foreseen = foreseen_of(self.robot, ahead, len(ahead.motions[0].points))
            ends = foreseen_ends(foreseen, task, bound, np.full((len(named), 3), np.nan))
            if ends is None:
                return success, {}
            answers[row] = ends.share, time.process_time() - begin
        begin = time.process_time()
        things = things_in(named, frame.masks, frame.cameras, frame.poses)
        if not set(bound.values()) <= set(things):
            return success, {}
        done = is_done(task, bound, things, self.robot, positions)
        return success, {**answers, RULE: (float(done), time.process_time() - begin)}


#: row of the table -> share of futures that succeed, and seconds
Said = dict[str, tuple[float, float]]


def answers(options: argparse.Namespace, folder: Path | None) -> Iterator[tuple[bool, Said]]:
    """Yield outcomes and what all say of them, of plans of which all can tell."""
    paths = list_episodes(options.dataset)
    refuse_test_kinds(paths, 'the choice of an engine')
    order = np.random.default_rng(options.seed).permutation(len(paths))[: options.repeats]
    new = New(options.futures, options.contact, options.robot, options.task)
    old = None if folder is None else Old(folder)
    for number, path in enumerate(paths[k] for k in order):
        success, said = new.ask(path, tuple(options.views))
        theirs = old.ask(path) if said and old is not None else {}
        print(f'{number} {path.name}', {k: round(v[0], 2) for k, v in said.items()}, flush=True)
        if said and (theirs or old is None):
            yield success, theirs | said


def row(
    name: str, said: FloatArray, real: BoolArray, seconds: FloatArray, ratio: str
) -> list[str]:
    """Return a row of the table, with intervals: Wilson of shares, bootstrap of AUROC."""
    called, sure = said >= 0.5, said >= VERDICT

    def share(hits: BoolArray) -> str:
        low, high = wilson(float(hits.sum()), len(hits))
        return f'{hits.mean():.3f} [{low:.3f}, {high:.3f}]'

    rng, drawn = np.random.default_rng(0), []
    for _ in range(_DRAWS):
        rows = rng.integers(0, len(real), len(real))
        if 0 < real[rows].sum() < len(real):
            drawn.append(area_under_roc(said[rows], real[rows]) or 0.0)
    low, high = np.percentile(drawn, [2.5, 97.5])
    area = f'{area_under_roc(said, real) or 0.0:.3f} [{low:.3f}, {high:.3f}]'
    known = seconds[np.isfinite(seconds)]
    return [
        name, str(len(real)), share(called == real), area, share(called[~real]),
        share(sure[~real]), share(~called[real]), f'{np.mean((said - real) ** 2):.4f}',
        f'{np.median(known):.2f}' if len(known) else '', ratio,
    ]  # fmt: skip


def judged(options: argparse.Namespace, folder: Path | None) -> str:
    """Return the table of what engines say of episodes."""
    found = list(answers(options, folder))
    real = np.array([success for success, _ in found])
    if not found:
        raise MtvWorldError(f"'{options.dataset}' has no episode of which all can tell")
    if len(set(real.tolist())) < 2:
        shares = [[name, *(f'{said[name][0]:.2f}' for _, said in found)] for name in found[0][1]]
        head = ('share of futures that succeed by', *map(str, range(len(found))))
        return f'No two outcomes are known.\n\n{table(head, shares)}'

    def of(name: str, index: int) -> Any:
        return np.array([said[name][index] for _, said in found])

    rows = []
    for name in found[0][1]:
        ratio = ''
        if folder is not None and np.isfinite(of(name, 1)).all():
            ratio = f'{np.median(of(name, 1) / of(OLD, 1)):.2f}'
        rows.append(row(name, of(name, 0), real, of(name, 1), ratio))
    told = f'{len(real)} episodes of {options.repeats}, of which {real.sum()} really succeed.'
    return f'{told}\n\n{table(HEAD, rows)}'


def imagined(options: argparse.Namespace, folder: Path) -> str:
    """Return the table of what chunks take, old and new in turns."""
    workers = {OLD: Worker(folder, _CHUNKS)}
    for number in options.futures:
        workers[f'MuJoCo, {number} futures'] = Worker(ROOT, _CHUNKS, number)
    spent: dict[str, list[dict[str, float]]] = {name: [] for name in workers}
    try:
        for turn in range(-1, options.chunks):  # the first one warms up
            frame = max(turn, 0) * _STRIDE % _FRAMES
            for name in list(workers)[:: 1 if turn % 2 else -1]:
                seconds = workers[name].ask(frame)
                spent[name] += [seconds] if turn >= 0 else []
    finally:
        for worker in workers.values():
            worker.close()

    def of(name: str, *stages: str) -> FloatArray:
        return np.array([sum(s[stage] for stage in stages or s) for s in spent[name]])

    rows = []
    for name in spent:
        cells = []
        for stages in (('object motion',), ()):
            ratios = of(name, *stages) / of(OLD, *stages)
            low, middle, high = np.percentile(ratios, [5, 50, 95])
            cells += [
                f'{np.median(of(name, *stages)):.3f}',
                f'{middle:.2f} [{low:.2f}, {high:.2f}]',
            ]
        rows.append([name, *cells])
    head = ('version', 'object motion, CPU [s]', 'of 0.1.0', 'chunk, CPU [s]', 'of 0.1.0')
    told = (
        f'{options.chunks} plans of 3.2 s in turns; medians, in brackets the 5th and 95th '
        'percentile of the turns. A chunk: all from the observation to the estimate.'
    )
    return f'{told}\n\n{table(head, rows)}'


def main() -> None:
    """Print what was asked for, and write it as a page."""
    options = parse_arguments(__doc__, 120, more)
    if options.dataset is None and not options.chunks:
        raise MtvWorldError('nothing to do: give a folder of episodes, --chunks, or both')
    is_alone = options.no_old or options.robot is not None
    with old_checkout() as folder:
        parts = []
        if options.dataset is not None:
            parts.append(judged(options, None if is_alone else folder))
        if options.chunks:
            parts.append(imagined(options, folder))
    load = f'Load of the machine: {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores.'
    publish(
        'foresight_engines',
        'What foresees objects, and how fast',
        f'python experiments/foresight_engines.py, {fingerprint(Checkpoint.open())}',
        '\n\n'.join([(__doc__ or '').split('\n' * 2, 2)[-1], *parts, load]),
        options,
        '1 thread each',
    )


if __name__ == '__main__':
    main()
