"""The paper's tables by one command: data, trainings, evaluations, Tables 1, 2 and 3.

    python experiments/paper_tables.py --out runs/paper_tables --clips 8000

makes the data of the fifteen tasks (half of the episodes for training, half for testing) and the
395 zero-shot episodes, trains every row with the same number of clips, evaluates it with its own
commands and with those of another episode, and writes `tables.md` after each row. The same command
goes on where it was stopped. Rows, seeds and weights for FID and FVD may be added later.

Table 2 needs real recordings as `mtv-world import videos`, `import bag` or `import lerobot` makes
them: `--real data/lab --real-view ext1 --real-segmenter data/lab/objects.safetensors`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import fcntl
from math import ceil, isfinite
from pathlib import Path
import shlex
import shutil
import subprocess
import sys
import time
from typing import Any

from lite_features import distance, lite_features, write_features
from lite_features import NAME as LITE
import numpy as np

from mtv_world_ros.cli import main as mtv_world
from mtv_world_ros.cli.shared_options import machine
from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.control.registry import control_class, TRAJECTORY_VIDEO
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.documents import DASH, Table
from mtv_world_ros.core.errors import ConfigError, MtvWorldError, nearest
from mtv_world_ros.core.files import share_path, write_json, write_whole
from mtv_world_ros.data.splits import CARD_FILE, EVERY, select
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary, Group
from mtv_world_ros.evaluation.metrics.frechet_features import clip_features, frame_features
from mtv_world_ros.evaluation.metrics.statistics import Estimate
from mtv_world_ros.model.card import read_card
from mtv_world_ros.reports.read_back import read_evaluations
from mtv_world_ros.success.task import load_tasks
from mtv_world_ros.training.training_config import load_training_config
from mtv_world_ros.training.training_run import spread

ROOT = Path(__file__).resolve().parents[1]
#: views of the simulated episodes: the paper's View 1 and View 2
VIEWS = ('low', 'high')
SETTINGS, TIMES, TABLES = 'settings.json', 'times.json', 'tables.md'
#: episodes of a task, half of them for training; the paper has 1,492 of 15 tasks
EPISODES_PER_TASK = 100
ZERO_SHOT_EPISODES = 395
ZERO_SHOT_KINDS = 'view,task,object'
#: of four real episodes three train and one tests
REAL_TEST_SHARE = 4
#: small models of real recordings: frames of 16:9, chunks of 1.6 s, colours as they are
REAL_SETTINGS = (
    'video.num_frames=8', 'video.width=160', 'video.height=96', 'augment.colour_permutation=0',
    'transformer.num_views=1',
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A model that is trained for the tables.

    Attributes:
        name: on the command line, and of its folder.
        title: the paper's name of the method.
        control: how the plan enters the model (`video.control`).
        views: it is trained and tested on; empty = both, of real episodes the given one.
        object_mask: whether the trajectory video carries the masks of the first frame.
        is_real: trained on the real recordings, for Table 2.
    """

    name: str
    title: str
    control: str = TRAJECTORY_VIDEO
    views: tuple[str, ...] = ()
    object_mask: bool = True
    is_real: bool = False


ROWS = (
    # World-Eval supports one view, the paper's View 2
    Row(name='policy2vec', title='World-Eval (policy2vec)', control='policy2vec', views=('high',)),
    Row(name='ee_mlp', title='Ctrl-World (ee_mlp)', control='ee_mlp'),
    Row(name='fast_tokens', title='Fast-Token (fast_tokens)', control='fast_tokens'),
    Row(name='single_view_low', title='Single-View', views=('low',)),
    Row(name='single_view_high', title='Single-View', views=('high',)),
    Row(name='without_mask', title='w/o Mask', object_mask=False),
    Row(name='mtv_world', title='MTV-World (trajectory_video)'),
    Row(name='real_ee_mlp', title='Ctrl-World (ee_mlp)', control='ee_mlp', is_real=True),
    Row(
        name='real_fast_tokens',
        title='Fast-Token (fast_tokens)',
        control='fast_tokens',
        is_real=True,
    ),
    Row(name='real_mtv_world', title='MTV-World (trajectory_video)', is_real=True),
)
#: the row whose model is tested on the zero-shot episodes, and the title of that row
FULL, ZERO_SHOT = 'mtv_world', 'Zero-Shot'
HELD = 'First frame held'
#: rows of Table 1 (without the ablations), and of Table 3 in the paper's order
TABLE_1 = ('policy2vec', 'ee_mlp', 'fast_tokens', 'mtv_world')
_ABOUT = (
    'J: of the union of all objects, mean over frames and episodes. J moving: of the objects that '
    "really move. Other commands: J moving where the commands are another episode's; a method "
    'reacts to its actions where the interval of the difference is above 0. Brackets: 95 % t '
    'intervals over episodes of one seed, of Frechet distances jackknife; with several seeds the '
    'least and the greatest value of a seed. A dash: not measured so far, or a view that the '
    'model does not have.'
)


class StepFailed(MtvWorldError):
    """A command of a row that ended with an error or was stopped."""

    def __init__(self, label: str, words: Sequence[str], status: int) -> None:
        super().__init__(
            f'{label}: {shlex.join(["mtv-world", *words])} ended with status {status} (see '
            'above); what is finished is kept, run the same command again to go on'
        )
        self.status = status


#: runs `mtv-world` with words and returns its exit status
Runner = Callable[[list[str]], int]


class PaperTables:
    """The run as a whole: its folders, its commands and its tables.

    Args:
        options: of the command line.
        run: runs a command of `mtv-world`.
    """

    def __init__(self, options: argparse.Namespace, run: Runner = mtv_world) -> None:
        self.options, self._run = options, run
        self.out: Path = options.out
        self.rows = chosen_rows(options.rows, has_real=options.real is not None)
        self.seeds: list[int] = options.seeds

    @property
    def data(self) -> Path:
        """Folder of the episodes of the tasks."""
        return self.options.data or self.out / 'data'

    @property
    def zero_shot(self) -> Path:
        """Folder of the zero-shot episodes."""
        return self.options.zero_shot or self.out / 'zero_shot'

    def run(self) -> None:
        """Do everything that is left, and write the tables after each row.

        Raises:
            StepFailed: a command failed or was stopped.
            ConfigError: options that do not fit together or to what is there.
        """
        self._check_before()
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out):
            check_settings(self.out / SETTINGS, self._settings())
            self._make_data()
            for seed in self.seeds:
                for row in self.rows:
                    self._do_row(row, seed)
                    self.write_tables()
            print(self.write_tables())

    def _check_before(self) -> None:
        """Refuse what would fail after hours: weights of another network, missing packages."""
        options = self.options
        for row in self.rows:
            control_class(row.control)
        if options.fid_weights is not None:
            frame_features(options.fid_weights)
        if options.fvd_weights is not None:
            clip_features(options.fvd_weights)
        if options.lite_features:
            lite_features()
        if options.clips < 1:
            raise ConfigError(f'--clips is {options.clips}; give at least 1')

    def _settings(self) -> dict[str, Any]:
        """What all rows share; a later run with other values would mix two experiments."""
        options = self.options
        return {
            'clips': options.clips,
            'tasks': sorted(options.tasks),
            # what is made in OUT moves with it
            'data': options.data and str(options.data.resolve()),
            'zero_shot': options.zero_shot and str(options.zero_shot.resolve()),
            'test_episodes': options.test_episodes,
            'zero_shot_episodes': options.zero_shot_episodes,
            'preset': str(options.preset),
            'set': sorted(options.set),
        }

    def _make_data(self) -> None:
        options = self.options
        if options.data is None:
            self._command(
                'data', ['collect', '--task', ','.join(options.tasks), '--episodes',
                         str(options.episodes), '--seed', str(options.data_seed), '--out',
                         str(self.data), '--workers', str(options.workers)],
                done=_has_episodes(self.data, options.episodes * len(options.tasks)),
            )  # fmt: skip
        check_tasks(self.data, options.tasks)
        self._link(self.data, 'test', 'test', options.test_episodes)
        if options.zero_shot is None and self._wants_zero_shot:
            self._command(
                'zero-shot data', ['collect', '--zero-shot', ZERO_SHOT_KINDS, '--episodes',
                                   str(options.zero_shot_episodes), '--seed',
                                   str(options.data_seed + 1), '--out', str(self.zero_shot),
                                   '--workers', str(options.workers)],
                done=_has_episodes(self.zero_shot, options.zero_shot_episodes),
            )  # fmt: skip
        if options.real is not None:
            self._split_real()

    @property
    def _wants_zero_shot(self) -> bool:
        has_some = self.options.zero_shot is not None or self.options.zero_shot_episodes > 0
        return has_some and any(row.name == FULL for row in self.rows)

    def _link(self, source: Path, name: str, split: str, count: int | None) -> None:
        """Link a number of episodes of a split, spread over the tasks, into a folder of `OUT`."""
        paths = spread(select(source, split).paths, count)
        link_episodes(paths, self.out / name, source / CARD_FILE)

    def _split_real(self) -> None:
        paths = select(self.options.real, EVERY).paths
        tested = [p for k, p in enumerate(paths) if k % REAL_TEST_SHARE == 1]
        trained = [path for path in paths if path not in tested]
        if not tested or not trained:
            raise ConfigError(
                f"--real '{self.options.real}' holds {len(paths)} episodes; give at least 4, "
                'three to train on and one to test'
            )
        link_episodes(trained, self.out / 'real_train')
        link_episodes(tested, self.out / 'real_test')

    def _do_row(self, row: Row, seed: int) -> None:
        """Train and test a row."""
        label, folder = f'{row.name}, seed {seed}', self.folder(row, seed)
        checkpoint = folder / 'training' / 'checkpoint'
        self._command(
            f'{label}: training', self._training(row, seed),
            done=_is_trained(checkpoint, self.steps), times=folder,
        )  # fmt: skip
        tests = {'test': self.out / ('real_test' if row.is_real else 'test')}
        if row.name == FULL and self._wants_zero_shot:
            tests['zero_shot'] = self.zero_shot
        for name, dataset in tests.items():
            out = folder / name
            self._command(
                f'{label}: {name}', self._evaluation(row, seed, checkpoint, dataset, out),
                done=self._is_evaluated(out), times=folder,
            )  # fmt: skip
            file = folder / f'{name}_features.npz'
            if self.options.lite_features and not file.is_file():
                print(f'{label}: {name}: features of {LITE}', flush=True)
                write_features(read_evaluations(out)[0], lite_features(), file)

    def folder(self, row: Row, seed: int) -> Path:
        """Return the folder of a row's training and evaluations."""
        return self.out / 'rows' / row.name / f'seed_{seed}'

    def _overrides(self, row: Row) -> list[str]:
        """Settings of the preset that a row changes, the user's last."""
        options = self.options
        found: list[str] = []
        if row.is_real:
            robot = options.real_robot or options.real / 'robot' / 'robot.yaml'
            found += [*REAL_SETTINGS, f'video.robot={robot}', f'video.views=[{options.real_view}]']
        elif row.views:
            found += [f'video.views=[{",".join(row.views)}]', 'transformer.num_views=1']
        if row.control != TRAJECTORY_VIDEO:
            found.append(f'video.control={row.control}')
        return [*found, f'video.object_mask={str(row.object_mask).lower()}', *options.set]

    @property
    def batch_size(self) -> int:
        """Clips of a training step, the same for all rows."""
        options = self.options
        config = load_training_config(options.preset, set_overrides(options.set))
        return config.optimizer.batch_size

    @property
    def steps(self) -> int:
        """Training steps of the budget of clips."""
        return ceil(self.options.clips / self.batch_size)

    def _training(self, row: Row, seed: int) -> list[str]:
        dataset = self.out / 'real_train' if row.is_real else self.data
        words = [
            'train', str(dataset), '--out', str(self.folder(row, seed) / 'training'), '--preset',
            str(self.options.preset), '--seed', str(seed), '--cache', str(self.out / 'cache'),
            '--threads', str(self.options.threads), '--split', EVERY if row.is_real else 'train',
        ]  # fmt: skip
        if row.is_real:
            words += self._real_segmenter()
        sets = [*self._overrides(row), f'optimizer.steps={self.steps}']
        return [*words, *(f'--set={text}' for text in sets)]

    def _evaluation(
        self, row: Row, seed: int, checkpoint: Path, dataset: Path, out: Path
    ) -> list[str]:
        options = self.options
        words = [
            'evaluate', f'{row.name}={checkpoint}', str(dataset), '--split', EVERY, '--actions',
            'true,shuffled', '--no-ceiling', '--no-report', '--seed', str(seed), '--threads',
            str(options.threads), '--workers', str(options.workers), '--out', str(out),
        ]  # fmt: skip
        for name in ('fid', 'fvd'):
            file = getattr(options, f'{name}_weights')
            words += [] if file is None else [f'--{name}-weights', str(file)]
        # FID and FVD that are asked for later are measured on frames imagined anew
        words += ['--overwrite'] if (out / 'metrics.json').is_file() else []
        return [*words, *(self._real_segmenter() if row.is_real else [])]

    def _real_segmenter(self) -> list[str]:
        file = self.options.real_segmenter
        return [] if file is None else ['--segmenter', str(file)]

    def _is_evaluated(self, out: Path) -> bool:
        """Whether an evaluation is finished, with all distances that are asked for."""
        if not (out / 'metrics.json').is_file():
            return False
        found = read_evaluations(out)[0].distances.values()
        measured = {name for numbers in found for name in numbers}
        asked = {n for n in ('fid', 'fvd') if getattr(self.options, f'{n}_weights') is not None}
        return asked <= measured

    def _command(
        self, label: str, words: list[str], *, done: bool, times: Path | None = None
    ) -> None:
        """Run a command unless it is done, and add its time to the row's.

        Raises:
            StepFailed: it ended with an error or was stopped.
        """
        if done:
            return
        print(f'{label}: {shlex.join(["mtv-world", *words])}', flush=True)
        begun, cpu = time.monotonic(), time.process_time()
        try:
            status = self._run(words)
        finally:
            if times is not None:
                spent = time.monotonic() - begun, time.process_time() - cpu
                add_time(times / TIMES, label.rpartition(': ')[2], *spent)
        if status:
            raise StepFailed(label, words, status)

    def write_tables(self) -> str:
        """Write the tables of what is finished, and return them."""
        found = Results(self)
        text = '\n\n'.join(found.sections()) + '\n'
        write_whole(self.out / TABLES, text)
        return text


class Results:
    """Finished evaluations as tables.

    Args:
        run: whose rows are read.
    """

    def __init__(self, run: PaperTables) -> None:
        self._run, self._seeds = run, run.seeds
        self._rows = {row.name: row for row in ROWS}
        self._read = {
            (row.name, seed, name): read_evaluations(folder)[0]
            for row in ROWS
            for seed in self._seeds
            for name in ('test', 'zero_shot')
            if ((folder := run.folder(row, seed) / name) / 'metrics.json').is_file()
        }

    def sections(self) -> Iterator[str]:
        """Yield headings, tables and what they mean."""
        options = self._run.options
        seeds = ', '.join(map(str, self._seeds))
        yield (
            f'# Tables of the paper\n\n{options.clips} clips a row, seeds {seeds}, preset '
            f'{options.preset}; commit {commit()}; {machine()}.\n\n{_ABOUT}'
        )
        yield f'## Table 1: methods by view\n\n{self._methods(TABLE_1, VIEWS).text()}'
        yield f'## Do they react to their actions?\n\n{self._reactions().text()}'
        for key, words in (('j_union', 'J x 100'), ('j_moving', 'J moving x 100')):
            yield f'## Table 3: {words} by task and view\n\n{self._by_task(key).text()}'
        real = tuple(row.name for row in ROWS if row.is_real)
        if any(name in real for name, _, _ in self._read):
            views = (options.real_view,)
            table = self._methods(real, views).text()
            yield f'## Table 2: real recordings, one view\n\n{table}'
        yield f'## Clips and time\n\n{self._times().text()}'

    def _evaluations(self, name: str, test: str = 'test') -> list[EvaluationSummary]:
        keys = [(name, seed, test) for seed in self._seeds]
        return [self._read[key] for key in keys if key in self._read]

    def _cell(
        self,
        name: str,
        view: str | None,
        key: str,
        task: str | None = None,
        *,
        test: str = 'test',
        digits: int = 3,
        factor: float = 1.0,
    ) -> str:
        """A number of a row: of one seed with its interval, else mean and range of the seeds."""
        found = [
            evaluated.estimates(view, Group(task=task))[key]
            for evaluated in self._evaluations(name, test)
            if (view is None or view in evaluated.spec.views)
            and evaluated.chosen(Group(task=task))
            and key in evaluated.estimates(view, Group(task=task))
        ]
        return joined(found, digits, factor)

    def _methods(self, names: Sequence[str], views: Sequence[str]) -> Table:
        """Table 1 or 2: FID, FVD, the distance of Lite0, J and J of what moves by view."""
        columns = ('FID', 'FVD', LITE, 'J', 'J moving')
        head = ['Method', *(f'{view} {what}' for view in views for what in columns)]
        rows = []
        for name in names:
            cells = [self._rows[name].title]
            for view in views:
                cells += [self._distance(name, view, key) for key in ('fid', 'fvd')]
                cells.append(self._lite(name, view))
                cells += [self._cell(name, view, key) for key in ('j_union', 'j_moving')]
            rows.append(cells)
        held = [HELD]
        first = next((n for n in reversed(names) if self._evaluations(n)), names[-1])
        for view in views:
            copies = [self._cell(first, view, k) for k in ('j_copy_union', 'j_copy_moving')]
            held += [DASH] * 3 + copies
        return Table(head=head, rows=[*rows, held])

    def _distance(self, name: str, view: str, key: str) -> str:
        if getattr(self._run.options, f'{key}_weights') is None:
            return 'no weights' if self._has_view(name, view) else DASH
        return self._cell(name, view, key, digits=1)

    def _has_view(self, name: str, view: str) -> bool:
        return any(view in evaluated.spec.views for evaluated in self._evaluations(name))

    def _lite(self, name: str, view: str) -> str:
        folders = (self._run.folder(self._rows[name], seed) for seed in self._seeds)
        found = [distance(folder / 'test_features.npz', view) for folder in folders]
        return joined([one for one in found if one is not None], 1)

    def _reactions(self) -> Table:
        """J of moving objects with true and other commands, and whether they differ."""
        head = ['Method', 'J moving', 'other commands', 'difference', 'reacts']
        rows = []
        for row in ROWS:
            if not self._evaluations(row.name):
                continue
            keys = ('j_moving', 'j_shuffled_moving', 'margin_over_shuffled')
            cells = [self._cell(row.name, None, key) for key in keys]
            lows = [
                evaluated.estimates(None)['margin_over_shuffled'].interval[0]
                for evaluated in self._evaluations(row.name)
            ]
            known = [low for low in lows if isfinite(low)]
            reacts = 'cannot tell' if not known else ('yes' if min(known) > 0 else 'not shown')
            where = f' ({row.name})' if row.is_real or row.views else ''
            rows.append([f'{row.title}{where}', *cells, reacts])
        return Table(head=head, rows=rows)

    def _by_task(self, key: str) -> Table:
        """Table 3: the paper's rows, tasks by view, and all tasks together, times 100."""
        tasks = sorted(self._run.options.tasks)
        columns = [(task, view) for task in tasks for view in VIEWS]
        columns += [(None, view) for view in VIEWS]
        head = ['Method', *(f'{task or "Task Averaged"} {view}' for task, view in columns)]
        lines: list[tuple[str, dict[str, str], str, str]] = [
            (self._rows[name].title, dict.fromkeys(VIEWS, name), 'test', key)
            for name in ('policy2vec', 'ee_mlp', 'fast_tokens')
        ]
        single = {view: f'single_view_{view}' for view in VIEWS}
        # the held frame is the same for all rows
        simulated = [row.name for row in reversed(ROWS) if not row.is_real]
        any_row = {
            view: next((name for name in simulated if self._has_view(name, view)), FULL)
            for view in VIEWS
        }
        lines += [
            (ZERO_SHOT, dict.fromkeys(VIEWS, FULL), 'zero_shot', key),
            ('Single-View', single, 'test', key),
            ('w/o Mask', dict.fromkeys(VIEWS, 'without_mask'), 'test', key),
            (self._rows[FULL].title, dict.fromkeys(VIEWS, FULL), 'test', key),
            (HELD, any_row, 'test', key.replace('j_', 'j_copy_')),
        ]
        rows = [
            [
                title,
                *(
                    self._cell(names[view], view, k, task, test=test, digits=1, factor=100.0)
                    for task, view in columns
                ),
            ]
            for title, names, test, k in lines
        ]
        return Table(head=head, rows=rows)

    def _times(self) -> Table:
        head = ['Row', 'seed', 'clips', 'training CPU [h]', 'testing CPU [h]', 'episodes tested']
        rows = []
        for row in ROWS:
            for seed in self._seeds:
                folder = self._run.folder(row, seed)
                checkpoint = folder / 'training' / 'checkpoint'
                if not (checkpoint / 'world_model.json').is_file():
                    continue
                spent = read_json(folder / TIMES) if (folder / TIMES).is_file() else {}
                hours = [f'{spent.get(n, {}).get("cpu_s", 0) / 3600:.2f}' for n in _TIMED]
                held = read_card(checkpoint).trained_on
                steps = held.get('steps', 0)
                tested = sum(len(e.results) for e in self._evaluations(row.name))
                rows.append(
                    [row.name, str(seed), str(steps * self._run.batch_size), *hours, str(tested)]
                )
        return Table(head=head, rows=rows)


_TIMED = ('training', 'test')


def joined(found: Sequence[Estimate], digits: int, factor: float = 1.0) -> str:
    """Return an estimate with its interval; of several seeds their mean and range."""
    known = [one for one in found if isfinite(one.value)]
    if not known:
        return DASH
    values = [factor * one.value for one in known]
    low, high = (factor * end for end in known[0].interval)
    if len(known) > 1:
        low, high = min(values), max(values)
    text = f'{np.mean(values):.{digits}f}'
    return text if not isfinite(low) else f'{text} [{low:.{digits}f}, {high:.{digits}f}]'


def chosen_rows(names: Sequence[str] | None, *, has_real: bool) -> list[Row]:
    """Return the rows to train: those named, else all that there are data for.

    Raises:
        ConfigError: no such row, or a real one without recordings.
    """
    known = {row.name: row for row in ROWS}
    if names is None:
        return [row for row in ROWS if has_real or not row.is_real]
    for name in names:
        if name not in known:
            raise ConfigError(
                f"--rows '{name}' is no row{nearest(name, known)}; rows are {', '.join(known)}"
            )
        if known[name].is_real and not has_real:
            raise ConfigError(
                f"row '{name}' is trained on real recordings: give --real FOLDER and --real-view"
            )
    return [row for row in ROWS if row.name in names]


def check_tasks(dataset: Path, tasks: Sequence[str]) -> None:
    """Refuse a data set of other tasks, or one without the splits `train` and `test`.

    Raises:
        ConfigError: names the tasks.
    """
    try:
        card = read_json(dataset / CARD_FILE)
        entries, splits = card['episodes'], card['splits']
        there = {entry['task'] for entry in entries}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ConfigError(
            f"'{dataset}' has no readable {CARD_FILE} ({error!r}); give a folder that 'mtv-world "
            "collect' made, or leave --data out"
        ) from error
    missing, more = sorted(set(tasks) - there), sorted(there - set(tasks))
    if missing or more:
        raise ConfigError(
            f"'{dataset}' holds other tasks: missing are {', '.join(missing) or 'none'}; not "
            f'asked for are {", ".join(more) or "none"}. Give --tasks, or another folder'
        )
    empty = [name for name in ('train', 'test') if not splits.get(name)]
    if empty:
        raise ConfigError(f"'{dataset}' has no split {' and '.join(empty)} in {CARD_FILE}")


def check_settings(file: Path, settings: dict[str, Any]) -> None:
    """Write the settings of a new run; refuse to go on with others.

    Raises:
        ConfigError: says what differs.
    """
    if not file.is_file():
        write_json(file, settings)
        return
    there = read_json(file)
    other = [f'{k} is {there.get(k)!r} there, {v!r} now' for k, v in settings.items()
             if there.get(k) != v]  # fmt: skip
    if other:
        raise ConfigError(
            f"'{file.parent}' holds a run of other settings: {'; '.join(other)}. Give the same, "
            'or another --out'
        )


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder, so that one process alone works in it.

    Raises:
        ConfigError: another process does.
    """
    with (folder / '.lock').open('w') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(f"another process works in '{folder}'; wait for it") from error
        yield


def link_episodes(paths: Sequence[Path], folder: Path, card: Path | None = None) -> None:
    """Link episodes, and copy the card of their data set, into a folder of their own.

    Raises:
        ConfigError: the folder has links to other episodes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {path.name: path.resolve() for path in paths}
    there = {path.name: path.resolve() for path in folder.iterdir() if path.is_symlink()}
    if any(wanted.get(name) != place for name, place in there.items()):
        raise ConfigError(f"'{folder}' links to other episodes; remove it, or give another --out")
    for name in wanted.keys() - there.keys():
        (folder / name).symlink_to(wanted[name])
    if card is not None and card.is_file():
        shutil.copyfile(card, folder / card.name)


def add_time(file: Path, name: str, wall_s: float, cpu_s: float) -> None:
    """Add the time of a command [s], CPU time of all threads, to what is stored of it."""
    spent = read_json(file) if file.is_file() else {}
    before = spent.get(name, {'wall_s': 0.0, 'cpu_s': 0.0})
    spent[name] = {
        'wall_s': round(before['wall_s'] + wall_s, 1),
        'cpu_s': round(before['cpu_s'] + cpu_s, 1),
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, spent)


def _is_trained(checkpoint: Path, steps: int) -> bool:
    card = checkpoint / 'world_model.json'
    return card.is_file() and read_card(checkpoint).trained_on.get('steps') == steps


def _has_episodes(dataset: Path, count: int) -> bool:
    card = dataset / CARD_FILE
    return card.is_file() and len(read_json(card)['episodes']) >= count


def commit() -> str:
    """Return the commit of this tree, + with changes on top."""
    words = ['git', '-C', str(ROOT), 'describe', '--always', '--dirty=+', '--exclude=*']
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip() or 'unknown'


def all_tasks() -> list[str]:
    """Return the names of the tasks of the package."""
    return [task.name for task in load_tasks(share_path('config', 'tasks'))]


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options."""
    made = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = made.add_argument
    add('--out', type=Path, required=True, help='goes on with what is there')
    add('--clips', type=int, default=8000, help='training clips a row')
    add('--seeds', type=_numbers, default=[0], help='of trainings, comma-separated')
    add('--rows', type=_names, help=f'of {", ".join(row.name for row in ROWS)}; default: all')
    add('--tasks', type=_names, default=all_tasks(), help='default: the fifteen of the package')
    add('--data', type=Path, help='of collect; default: made in OUT/data')
    add('--episodes', type=int, default=EPISODES_PER_TASK, help='per task, where data are made')
    add('--data-seed', type=int, default=20000, help='of the data that are made')
    add('--test-episodes', type=int, help='spread over the tasks; default: all of the split')
    add('--zero-shot', type=Path, help='of collect --zero-shot; default: made in OUT/zero_shot')
    add(
        '--zero-shot-episodes',
        type=int,
        default=ZERO_SHOT_EPISODES,
        help='where they are made; 0 = no row of zero-shot',
    )
    add('--real', type=Path, help='folder of imported real episodes, for Table 2')
    add('--real-view', help='the view of Table 2')
    add('--real-robot', type=Path, help='default: robot/robot.yaml in REAL')
    add('--real-segmenter', type=Path, help='objects.safetensors of the import')
    add('--preset', default='paper', help='name or YAML file')
    add('--set', action='append', default=[], metavar='SECTION.KEY=VALUE', help='of all rows')
    add('--threads', type=int, default=1, help='CPU threads')
    add('--workers', type=int, default=1, help='processes that make and score episodes')
    add('--fid-weights', type=Path, help='Inception-v3 of 2015-12-05, state dict')
    add('--fvd-weights', type=Path, help='I3D state dict')
    add(
        '--no-lite-features',
        dest='lite_features',
        action='store_false',
        help=f'leave out the distance over features ({LITE})',
    )
    return made


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(',') if name.strip()]


def _numbers(text: str) -> list[int]:
    return [int(name) for name in _names(text)]


def main(argv: Sequence[str] | None = None, run: Runner = mtv_world) -> int:
    """Run the command line; return the exit status."""
    options = parser().parse_args(argv)
    try:
        if options.real is not None and not options.real_view:
            raise ConfigError(
                f"--real '{options.real}' needs --real-view NAME, the view of Table 2"
            )
        PaperTables(options, run).run()
    except StepFailed as error:
        print(f'paper_tables: {error}', file=sys.stderr)
        return error.status
    except (MtvWorldError, OSError) as error:
        again = '; what is finished is kept, run the same command again once there is room'
        more = again if isinstance(error, OSError) else ''
        print(f'paper_tables: {error}{more}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
