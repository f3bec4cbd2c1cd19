"""What foresees objects best, and how fast? Engines side by side, in turns, without a picture.

    mtv-world collect --task all --episodes 16 --faults calibrate --seed 5001 --pictures first --out data/cal
    git worktree add ../v0.1.0 v0.1.0
    python benchmark/foresight_engines.py data/cal --old ../v0.1.0 --repeats 120

Every episode's plan is foreseen whole from the masks of its first frame. A row judges by the share
of the futures in which the task is done at the end: half or more is a success; a share of .75 is a
verdict. `MuJoCo` is this version's foresight, with its number of futures; `DART` the rigid bodies of
version 0.1.0, with the same numbers of contact; `networks` its 13 motions of networks; `0.1.0` both,
bodies counting twice. The latter three run in a checkout of v0.1.0 (`--old`), in turns with this one;
without it they are left out. Seconds are those of the processor for finding and foreseeing a plan,
medians; the ratio is of each episode to 0.1.0's, the median. What is chosen by this must not be
measured by it: kinds of the split `test` are refused.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections.abc import Iterator
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.assembly import checkpoint_path, checkpoint_robot, fingerprint
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data.recorded_policies import refuse_test_kinds
from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import share_path
from mtv_world_ros.foresight.loading import load_foresight
from mtv_world_ros.foresight.solid_foresight import SolidForesight
from mtv_world_ros.geometry.object_motion import FoundObjects
from mtv_world_ros.lab.evaluation.metrics.statistics import wilson
from mtv_world_ros.lab.evaluation.metrics.success_agreement import area_under_roc
from mtv_world_ros.lab.training.object_motion.tracks import fine_commands, first_frame
from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
from mtv_world_ros.success.foreseen import foreseen_of
from mtv_world_ros.success.task import load_tasks, match_task

VIEWS = ('low', 'high')
OLD = '0.1.0: networks and DART'
#: a share from here on is a verdict of success
VERDICT = 0.75
HEAD = ('judged by', 'n', 'right', 'AUROC', 'false success', 'false success from .75',
        'false failure', 'Brier', 'CPU [s]', 'of 0.1.0')  # fmt: skip
_DRAWS = 1000
#: answers a path a line with what 0.1.0 foresees, in its own checkout
_WORKER = """
import json, sys, time
sys.path.insert(0, 'benchmark')
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


def more(parser: argparse.ArgumentParser) -> None:
    """Adds options."""
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--old', type=Path, help='a checkout of v0.1.0')
    parser.add_argument('--futures', type=int, nargs='+', default=[16, 64])


class Old:
    """Version 0.1.0 in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, '-c', _WORKER],
            cwd=folder,
            env=os.environ | {'PYTHONPATH': str(folder.resolve()), 'OMP_NUM_THREADS': '1'},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answer()

    def ask(self, path: Path) -> dict[str, tuple[float, float]]:
        """Returns share and seconds by row of the table; empty = it cannot tell."""
        assert self._process.stdin is not None
        self._process.stdin.write(f'{path.resolve()}\n')
        self._process.stdin.flush()
        answer = json.loads(self._answer())
        if not answer.get('said'):
            return {}
        both, networks, bodies = answer['said']
        seconds = answer['seconds']
        return {
            OLD: (both, seconds),
            'networks alone': (networks, np.nan),
            'DART alone': (bodies, np.nan),
        }

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise MtvWorldError("the checkout of '--old' does not run; is it v0.1.0?")
        return line


class New:
    """This version, with some numbers of futures.

    Args:
        futures: numbers of them.
    """

    def __init__(self, futures: list[int]) -> None:
        self.robot = checkpoint_robot('bundled')
        found = load_foresight(checkpoint_path('bundled') / OBJECT_MOTION_FOLDER, self.robot)
        assert found is not None
        self._engines = {
            f'MuJoCo, {number} futures': SolidForesight(
                self.robot,
                found.response,
                found.settings.model_copy(update={'num_motions': number}),
            )
            for number in futures
        }

    def ask(self, path: Path) -> tuple[bool, dict[str, tuple[float, float]]]:
        """Returns the outcome, and share and seconds by row; none = it cannot tell."""
        episode = read_episode(path, views=VIEWS)
        found = match_task(load_tasks(share_path('config', 'tasks')), episode.info.instruction)
        success = episode.info.outcome == 'success'
        if found is None or episode.masks is None or episode.joint_states is None:
            return success, {}
        task, bound = found
        names, frame = tuple(episode.info.objects), first_frame(episode, self.robot, VIEWS)
        _, positions = fine_commands(episode, self.robot, VIEWS)
        answers = {}
        for row, engine in self._engines.items():
            begin = time.process_time()
            tracked = engine.find(names, frame.masks, frame.cameras, frame.poses)
            ahead = FoundObjects.at(
                names=names,
                frames=np.zeros((*frame.masks[:, 0].shape, 3), np.uint8),
                masks=frame.masks,
                poses=np.stack(frame.poses),
                tracked=tracked,
            ).after(positions)
            foreseen = foreseen_of(self.robot, ahead, len(ahead.motions[0].points))
            ends = foreseen.ends(task, bound, np.full((len(names), 3), np.nan))
            if ends is None:
                return success, {}
            answers[row] = ends.share, time.process_time() - begin
        return success, answers


#: row of the table -> share of futures that succeed, and seconds
Said = dict[str, tuple[float, float]]


def answers(options: argparse.Namespace) -> Iterator[tuple[bool, Said]]:
    """Yields outcomes and what all say of them, of plans of which all can tell."""
    paths = list_episodes(options.dataset)
    refuse_test_kinds(paths, 'the choice of an engine')
    order = np.random.default_rng(options.seed).permutation(len(paths))[: options.repeats]
    new = New(options.futures)
    old = None if options.old is None else Old(options.old)
    for number, path in enumerate(paths[k] for k in order):
        success, said = new.ask(path)
        theirs = old.ask(path) if said and old is not None else {}
        print(f'{number} {path.name}', {k: round(v[0], 2) for k, v in said.items()}, flush=True)
        if said and (theirs or old is None):
            yield success, theirs | said


def row(
    name: str, said: FloatArray, real: BoolArray, seconds: FloatArray, ratio: str
) -> list[str]:
    """Returns a row of the table, with intervals: Wilson of shares, bootstrap of AUROC."""
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


def main() -> None:
    """Prints a row for each engine, and writes them as a page."""
    options = parse_arguments(__doc__, 120, more)
    found = list(answers(options))
    real = np.array([success for success, _ in found])
    if len(set(real.tolist())) < 2:
        raise MtvWorldError(f"'{options.dataset}' needs episodes that succeed and that fail")

    def of(name: str, index: int) -> Any:
        return np.array([said[name][index] for _, said in found])

    rows = []
    for name in found[0][1]:
        ratio = ''
        if options.old is not None and np.isfinite(of(name, 1)).all():
            ratio = f'{np.median(of(name, 1) / of(OLD, 1)):.2f}'
        rows.append(row(name, of(name, 0), real, of(name, 1), ratio))
    told = (
        f'{len(real)} episodes of {options.repeats}, of which {real.sum()} really succeed. Load '
        f'of the machine meanwhile: {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores.'
    )
    publish(
        'foresight_engines',
        'What foresees objects, and how fast',
        f'python benchmark/foresight_engines.py DIR --old DIR, {fingerprint("bundled")}',
        '\n\n'.join(
            [
                (__doc__ or '').split('\n' * 2)[-1],
                told,
                table(HEAD, rows),
            ]
        ),
        options,
        '1 thread each',
    )


if __name__ == '__main__':
    main()
