"""The paper's tables by one command: data, trainings, evaluations, Tables 1, 2 and 3.

    python experiments/paper_tables.py --out runs/paper_tables --clips 500,1000,2000,4000,8000

makes the data of the fifteen tasks (half of the episodes for training, half for testing) and the
395 zero-shot episodes, trains every row with the same number of clips, evaluates it with its own
commands and with those of another episode, and writes `tables.md` after each row. `--clips` names
the stages: all rows are trained and evaluated with one number before any goes on to the next.
The same command goes on where it was stopped. Stages, rows, seeds and weights for FID and FVD may
be added later: `--seeds 0,1 --rows ee_mlp,mtv_world` trains these two rows a second time, and the
tables then have both. Several processes may share a folder: each takes the rows that no other
works on.

Rows are tested on whole episodes from their first frame, as in the paper, and also chunk by chunk
from recorded frames, which is named so. `--rates` trains each row with several learning rates for
`--rate-clips` clips first, with the first seed, and goes on with the best: the one with the lowest
loss at the end, in less than one pass of the clips, so that few of these were seen before.

Tables 1 to 3 are those of the last stage that all rows have; a learning curve shows all stages.
The learning rate is constant after a short warm-up, so that a stage does not depend on those after
it; the checkpoints hold moving averages of the weights.

Table 2 needs real recordings as `mtv-world import videos`, `import bag` or `import lerobot` makes
them: `--real data/lab --real-view ext1 --real-segmenter data/lab/objects.safetensors`. With
`--real-init 2000` the full method is also trained on them from its weights of that stage of the
simulated episodes; the controls made of a robot's numbers do not fit another robot.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import fcntl
from itertools import pairwise
import json
from math import ceil, isfinite, nan
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
from mtv_world_ros.cli.parser import CommandParser
from mtv_world_ros.cli.shared_options import add_options, machine
from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.control.registry import control_class, TRAJECTORY_VIDEO
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.documents import DASH, Table
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import share_path, whole_folder, write_json, write_whole
from mtv_world_ros.data.splits import CARD_FILE, EVERY, select, spread
from mtv_world_ros.evaluation.evaluation_summary import (
    EvaluationSummary,
    Group,
    NOT_MEASURED,
)
from mtv_world_ros.evaluation.metrics.frechet_features import clip_features, frame_features
from mtv_world_ros.evaluation.metrics.grasp_outcomes import Dreams
from mtv_world_ros.evaluation.metrics.statistics import Estimate, mean_interval, t_quantile
from mtv_world_ros.model.card import read_card
from mtv_world_ros.model.runtime import check_device
from mtv_world_ros.reports.read_back import read_evaluations
from mtv_world_ros.success.task import load_tasks
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig

ROOT = Path(__file__).resolve().parents[1]
#: views of the simulated episodes: the paper's View 1 and View 2
VIEWS = ('low', 'high')
CHECKPOINT_CARD = 'world_model.json'
SETTINGS, TIMES, TABLES = 'settings.json', 'times.json', 'tables.md'
#: default stages: training clips a row
STAGES = (500, 1000, 2000, 4000, 8000)
#: steps of the learning rate's warm-up, the same for all stages of 250 clips or more
WARMUP_STEPS = 25
#: pause before rows that another process works on are looked at again [s]
WAIT_S = 20.0
#: episodes of a task, half of them for training; the paper has 1,492 of 15 tasks
EPISODES_PER_TASK = 100
ZERO_SHOT_EPISODES = 395
ZERO_SHOT_KINDS = 'view,task,object'
#: of four real episodes three train and one tests
REAL_TEST_SHARE = 4
#: small models of real recordings: frames of 16:9, chunks of 1.6 s, colours as they are
REAL_SETTINGS = (
    'video.num_frames=8', 'video.width=160', 'video.height=96', 'augment.colour_permutation=0',
)  # fmt: skip
ONE_VIEW = 'transformer.num_views=1'
#: tests of a row: whole episodes as in the paper, and the same chunk by chunk
WHOLE, CHUNKS = 'test', 'test_chunks'
#: how each test imagines (`evaluate --mode`)
MODES = {WHOLE: 'imagine', CHUNKS: 'observe', 'zero_shot': 'imagine'}
#: what a row is made and tested by; rows of another version are not mixed with it
METHODS = {
    'policy2vec': 'version 2: three layers of 1,280; scale .1 at first; tested on whole episodes',
    'ee_mlp': 'version 2: 1,024 wide, Kaiming, rotation columns, eight history frames, guidance '
    'on the control; tested on whole episodes',
    'fast_tokens': 'version 2: tested on whole episodes',
    TRAJECTORY_VIDEO: 'version 2: tested on whole episodes',
}
METHOD, RATES = 'method.json', 'rates.json'
#: settings of a method beyond the preset, as its authors have it: Ctrl-World's history and
#: guidance. It has six history frames; eight are the next number of whole tokens of four frames
METHOD_SETTINGS = {
    'ee_mlp': (
        'history.num_frames=8', 'history.reference=first_frame', 'sampling.guidance_scale=2.0',
    ),
}  # fmt: skip
#: lines of the training log whose mean loss a learning rate is judged by
RATE_LINES = 5


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
        starts_from: row of the simulated episodes whose weights it starts from; empty = new ones.
    """

    name: str
    title: str
    control: str = TRAJECTORY_VIDEO
    views: tuple[str, ...] = ()
    object_mask: bool = True
    is_real: bool = False
    starts_from: str = ''


_SIMULATED = (
    # World-Eval supports one view, the paper's View 2
    Row(name='policy2vec', title='World-Eval (policy2vec)', control='policy2vec', views=('high',)),
    Row(name='ee_mlp', title='Ctrl-World (ee_mlp)', control='ee_mlp'),
    Row(name='fast_tokens', title='Fast-Token (fast_tokens)', control='fast_tokens'),
    Row(name='single_view_low', title='Single-View', views=('low',)),
    Row(name='single_view_high', title='Single-View', views=('high',)),
    Row(name='without_mask', title='w/o Mask', object_mask=False),
    Row(name='mtv_world', title='MTV-World (trajectory_video)'),
)
#: rows of Table 2 from worst to best by the paper
_REAL = ('ee_mlp', 'fast_tokens', 'mtv_world')
ROWS = (
    *_SIMULATED,
    *(
        replace(row, name=f'real_{row.name}', is_real=True)
        for row in _SIMULATED
        if row.name in _REAL
    ),
    # numbers of one robot's joints mean nothing for another: drawn trajectories alone can start
    # another robot's training
    Row(
        name='real_mtv_world_after_simulation',
        title='MTV-World after the simulated episodes',
        is_real=True,
        starts_from='mtv_world',
    ),
)
ROWS_SIMULATED = tuple(row.name for row in _SIMULATED)
#: the row whose model is tested on the zero-shot episodes, and the title of that row
FULL, ZERO_SHOT = 'mtv_world', 'Zero-Shot'
HELD = 'First frame held'
#: rows from worst to best by the paper's Table 3, with J x 100 averaged over its tasks, by view
PAPER_ORDER: tuple[tuple[Mapping[str, str], Mapping[str, float]], ...] = (
    ({'high': 'policy2vec'}, {'high': 18.3}),
    (dict.fromkeys(VIEWS, 'ee_mlp'), {'low': 35.3, 'high': 22.2}),
    (dict.fromkeys(VIEWS, 'fast_tokens'), {'low': 36.7, 'high': 26.3}),
    (
        {'low': 'single_view_low', 'high': 'single_view_high'},
        {'low': 51.3, 'high': 38.0},
    ),
    (dict.fromkeys(VIEWS, 'without_mask'), {'low': 54.8, 'high': 42.6}),
    (dict.fromkeys(VIEWS, 'mtv_world'), {'low': 54.9, 'high': 45.0}),
)
#: rows of Table 2 from worst to best by the paper, and all of them
REAL_ORDER = tuple(f'real_{name}' for name in _REAL)
TABLE_2 = (*REAL_ORDER, 'real_mtv_world_after_simulation')
#: rows of Table 1 (without the ablations), and of Table 3 in the paper's order
TABLE_1 = ('policy2vec', 'ee_mlp', 'fast_tokens', 'mtv_world')
_ABOUT = (
    'J: of the union of all objects, mean over frames and episodes, in whole episodes from their '
    'first frame. Chunk by chunk: each 3.2 s from recorded frames. Task Averaged: mean over '
    'tasks. J moving: of the objects that '
    "really move. Other commands: J moving where the commands are another episode's; a method "
    'reacts to its actions where the interval of the difference is above 0. Brackets: 95 % t '
    'intervals over episodes of one seed, of Frechet distances jackknife; with several seeds the '
    'least and the greatest value of a seed. A dash: not measured so far, or a view that the '
    'model does not have. n: episodes that are tested.'
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
        self._did_something = False
        self.rows = chosen_rows(
            options.rows,
            has_real=options.real is not None,
            has_start=options.real_init is not None,
        )
        self.seeds: list[int] = options.seeds

    @property
    def data(self) -> Path:
        """Folder of the episodes of the tasks."""
        return self.options.data or self.out / 'data'

    @property
    def zero_shot(self) -> Path:
        """Folder of the zero-shot episodes."""
        return self.options.zero_shot or self.out / 'zero_shot'

    @property
    def stages(self) -> list[int]:
        """Training clips a row of all stages, in order."""
        return self.options.clips

    def run(self) -> None:
        """Do everything that is left, and write the tables after each row.

        Raises:
            StepFailed: a command failed or was stopped.
            ConfigError: options that do not fit together or to what is there.
        """
        self._check_before()
        for row in ROWS:  # the tables read rows that were not asked for, too
            for folder in sorted((self.out / 'rows' / row.name).glob('seed_*')):
                check_method(folder, row)
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out, wait=True):
            check_settings(self.out / SETTINGS, self._settings())
            for stage in self.stages:
                check_settings(self.out / 'stages' / f'{stage}.json', self._tested(stage))
            self._make_data()
        left = [(s, seed, row) for s in self.stages for seed in self.seeds for row in self.rows]
        while left:
            left = self._try(left)
            if left:  # of other processes, which may be stopped
                print(f'waiting for {len(left)} stages of rows of other processes', flush=True)
                time.sleep(WAIT_S)
        print(self.write_tables())

    def _try(self, left: Sequence[tuple[int, int, Row]]) -> list[tuple[int, int, Row]]:
        """Do what no other process works on; return the rest."""
        busy = []
        for stage, seed, row in left:
            if self._waits(row, seed):
                busy.append((stage, seed, row))
                continue
            folder = self.folder(row, seed)
            folder.mkdir(parents=True, exist_ok=True)
            try:
                with locked(folder):
                    # an earlier stage that another process left unfinished comes first
                    for earlier in self.stages[: self.stages.index(stage) + 1]:
                        self._do_stage(row, seed, earlier)
            except FolderInUse:
                busy.append((stage, seed, row))
            if self._did_something:
                self.write_tables()
                self._did_something = False
        return busy

    def _check_before(self) -> None:
        """Refuse what would fail after hours: weights of another network, missing packages."""
        options = self.options
        if options.ray is None:  # else other machines test
            check_device(options.device)
        self._check_adapters()
        for row in self.rows:
            control_class(row.control)
            for seed in self.seeds:
                if row.starts_from and not self._waits(row, seed):
                    self._start(row, seed)
        if options.fid_weights is not None:
            frame_features(options.fid_weights)
        if options.fvd_weights is not None:
            clip_features(options.fvd_weights)
        if options.lite_features:
            lite_features()
        if self.stages != sorted(set(self.stages)) or self.stages[0] < 1:
            given = ','.join(map(str, self.stages))
            raise ConfigError(f'--clips is {given}; give numbers that rise, from 1 on')

    def _check_adapters(self) -> None:
        """Refuse adapters without a checkpoint to train on, or to start from."""
        options = self.options
        if self.product == 'adapter' and options.init is None:
            raise ConfigError(
                f"preset '{options.preset}' trains a LoRA adapter: give --init, the checkpoint "
                "that 'mtv-world import wan' made"
            )
        started = next((row.name for row in self.rows if row.starts_from), '')
        if started and options.init is not None:
            raise ConfigError(
                f"row '{started}' starts from the weights of another row, and all rows from "
                f"--init '{options.init}'; leave one of them out (--rows)"
            )

    def _settings(self) -> dict[str, Any]:
        """Settings that all rows and stages share; others would mix two experiments."""
        options = self.options
        return {
            'tasks': sorted(options.tasks),
            # what is made in OUT moves with it
            'data': options.data and str(options.data.resolve()),
            'zero_shot': options.zero_shot and str(options.zero_shot.resolve()),
            'zero_shot_episodes': options.zero_shot_episodes,
            'preset': str(options.preset),
            'set': sorted(options.set),
            # absent by default, so that earlier runs can be continued
            **({} if options.init is None else {'init': str(options.init.resolve())}),
            **({} if options.fps is None else {'fps': options.fps}),
            'rates': options.rates,
            'rate_clips': options.rate_clips if options.rates else None,
        }

    def _tested(self, stage: int) -> dict[str, int | None]:
        """Return how many episodes the rows of a stage are tested on; None = all."""
        options, index = self.options, self.stages.index(stage)
        return {
            name: numbers and numbers[min(index, len(numbers) - 1)]
            for name, numbers in (
                ('test_episodes', options.test_episodes),
                ('zero_shot_tested', options.zero_shot_tested),
            )
        }

    def _make_data(self) -> None:
        options = self.options
        if options.data is None:
            self._command(
                'data', ['collect', '--task', ','.join(options.tasks), '--episodes',
                         str(options.episodes), '--seed', str(options.data_seed), '--out',
                         str(self.data), *self._workers, *self._rate_of_frames],
                done=_has_episodes(self.data, options.episodes * len(options.tasks)),
            )  # fmt: skip
        check_tasks(self.data, options.tasks)
        if options.real is not None:
            self._split_real()

    @property
    def _workers(self) -> list[str]:
        """Options of commands that run many jobs."""
        options, words = self.options, ['--workers', str(self.options.workers)]
        if options.ray is not None:
            words += ['--ray', options.ray] if options.ray else ['--ray']
        for name in ('gpus', 'cpus'):
            value = getattr(options, f'{name}_per_worker')
            words += [] if value is None else [f'--{name}-per-worker', f'{value:g}']
        return words

    @property
    def _rate_of_frames(self) -> list[str]:
        return [] if self.options.fps is None else ['--fps', f'{self.options.fps:g}']

    def _make_zero_shot(self) -> None:
        """Make the zero-shot episodes, which the last row of the simulation is tested on."""
        options = self.options
        with locked(self.out, wait=True):
            self._command(
                'zero-shot data', ['collect', '--zero-shot', ZERO_SHOT_KINDS, '--episodes',
                                   str(options.zero_shot_episodes), '--seed',
                                   str(options.data_seed + 1), '--out', str(self.zero_shot),
                                   *self._workers, *self._rate_of_frames],
                done=options.zero_shot is not None
                or _has_episodes(self.zero_shot, options.zero_shot_episodes),
            )  # fmt: skip

    @property
    def _wants_zero_shot(self) -> bool:
        return self.options.zero_shot is not None or self.options.zero_shot_episodes > 0

    def _linked(self, source: Path, split: str, name: str, count: int | None) -> Path:
        """Return a folder with links to a number of episodes of a split, spread over its tasks."""
        folder = self.out / 'tests' / (name if count is None else f'{name}_{count}')
        paths = spread(select(source, split).paths, count)
        link_episodes(paths, folder, source / CARD_FILE)
        return folder

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

    def _do_stage(self, row: Row, seed: int, stage: int) -> None:
        """Train a row to the clips of a stage, keep its checkpoint and test it."""
        label = f'{row.name}, seed {seed}, {stage} clips'
        folder, training = self.folder(row, seed), self.folder(row, seed) / 'training'
        held = self.stage_folder(row, seed, stage)
        checkpoint, steps = held / self.product, self.steps(stage)
        check_method(folder, row)
        rate = self._find_rate(row, seed, label)
        if trained_steps(checkpoint) != steps:
            if (trained_steps(training / self.product) or 0) > steps:
                print(f'{label}: left out, the row was trained further before', flush=True)
                return
            self._command(
                f'{label}: training', self._training(row, seed, stage, rate),
                done=trained_steps(training / self.product) == steps, times=folder,
            )  # fmt: skip
            with whole_folder(checkpoint) as new:
                shutil.copytree(training / self.product, new, dirs_exist_ok=True)
        for name, dataset in self._tests(row, stage):
            out = held / name
            self._command(
                f'{label}: {name}', self._evaluation(row, seed, checkpoint, dataset, out, name),
                done=self._is_evaluated(out), times=folder,
            )  # fmt: skip
            file = held / f'{name}_features.npz'
            if self.options.lite_features and name != CHUNKS and not file.is_file():
                print(f'{label}: {name}: features of {LITE}', flush=True)
                write_features(read_evaluations(out)[0], lite_features(), file)

    def _tests(self, row: Row, stage: int) -> Iterator[tuple[str, Path]]:
        """Yield name and episodes of the tests of a row; the zero-shot episodes are made last."""
        counts = self._tested(stage)
        if row.is_real:
            yield WHOLE, self.out / 'real_test'
            yield CHUNKS, self.out / 'real_test'
            return
        tested = self._linked(self.data, 'test', 'test', counts['test_episodes'])
        yield WHOLE, tested
        yield CHUNKS, tested
        if row.name == FULL and self._wants_zero_shot:
            self._make_zero_shot()
            count = counts['zero_shot_tested']
            yield 'zero_shot', self._linked(self.zero_shot, EVERY, 'zero_shot', count)

    def folder(self, row: Row, seed: int) -> Path:
        """Return the folder of a row's training and stages."""
        return self.out / 'rows' / row.name / f'seed_{seed}'

    def stage_folder(self, row: Row, seed: int, stage: int) -> Path:
        """Return the folder of a stage: the row's checkpoint and evaluations."""
        return self.folder(row, seed) / f'clips_{stage:06d}'

    def _overrides(self, row: Row) -> list[str]:
        """Settings of the preset that a row changes, the user's last."""
        options = self.options
        found: list[str] = []
        if row.is_real:
            robot = options.real_robot or options.real / 'robot' / 'robot.yaml'
            found += [] if options.init else REAL_SETTINGS
            found += [f'video.robot={robot}', f'video.views=[{options.real_view}]']
            # weights of two views know the first
            found += [] if row.starts_from or options.init else [ONE_VIEW]
        elif row.views:
            found += [
                f'video.views=[{",".join(row.views)}]',
                *([] if options.init else [ONE_VIEW]),
            ]
        if row.control != TRAJECTORY_VIDEO:
            found.append(f'video.control={row.control}')
        found += METHOD_SETTINGS.get(row.control, ())
        return [*found, f'video.object_mask={str(row.object_mask).lower()}', *options.set]

    @property
    def _config(self) -> TrainingConfig:
        return load_training_config(self.options.preset, set_overrides(self.options.set))

    @property
    def product(self) -> str:
        """Name of the folder that a training writes: an adapter where the preset trains LoRA."""
        return 'adapter' if self._config.lora.rank else 'checkpoint'

    @property
    def batch_size(self) -> int:
        """Clips of a training step, the same for all rows."""
        return self._config.optimizer.batch_size

    def steps(self, stage: int) -> int:
        """Return the training steps of a number of clips."""
        return ceil(stage / self.batch_size)

    def _find_rate(self, row: Row, seed: int, label: str) -> float | None:
        """Return the learning rate of a row; None = the preset's. Trains with each where asked."""
        rates, first = self.options.rates, self.folder(row, self.seeds[0])
        if not rates or row.starts_from:
            return None
        if seed != self.seeds[0]:
            first.mkdir(parents=True, exist_ok=True)
            with locked(first):  # another process may try them
                return self._tried_rate(row, label)
        rate, training = self._tried_rate(row, label), first / 'training'
        if (best := first / f'rate_{rate:g}').is_dir() and not training.is_dir():
            best.rename(training)  # the rate is constant, so these are the first clips of the row
        return rate

    def _tried_rate(self, row: Row, label: str) -> float:
        """Return the rate of `--rates` with the lowest loss; train with those not tried so far."""
        seed, clips = self.seeds[0], self.options.rate_clips
        folder = self.folder(row, seed)
        if (file := folder / RATES).is_file():
            return float(read_json(file)['rate'])
        losses = {}
        for rate in self.options.rates:
            out = folder / f'rate_{rate:g}'
            self._command(
                f'{label}: training', self._training(row, seed, clips, rate, out),
                done=trained_steps(out / self.product) == self.steps(clips), times=folder,
            )  # fmt: skip
            losses[rate] = last_loss(out)
        best = min(losses, key=lambda rate: losses[rate])
        write_json(file, {'losses': losses, 'rate': best})
        return best

    def _training(
        self,
        row: Row,
        seed: int,
        stage: int,
        rate: float | None = None,
        out: Path | None = None,
    ) -> list[str]:
        dataset = self.out / 'real_train' if row.is_real else self.data
        words = [
            'train', str(dataset), '--out', str(out or self.folder(row, seed) / 'training'),
            '--preset', str(self.options.preset), '--seed', str(seed),
            '--cache', str(self.out / 'cache'),
            '--device', self.options.device, '--threads', str(self.options.threads),
            '--split', EVERY if row.is_real else 'train',
        ]  # fmt: skip
        if row.is_real:
            words += self._real_segmenter()
        if row.starts_from:
            words += ['--init', str(self._start(row, seed))]
        elif self.options.init is not None:
            words += ['--init', str(self._base(row))]
        if self.options.latent_cache is not None:
            words += ['--latent-cache', str(self.options.latent_cache / row.name)]
        # the learning rate of a step must not depend on how many more there are
        schedule = [f'optimizer.warmup_steps={WARMUP_STEPS}', 'optimizer.decay_share=0.0']
        schedule += [] if rate is None else [f'optimizer.learning_rate={rate:g}']
        sets = [*schedule, *self._overrides(row), f'optimizer.steps={self.steps(stage)}']
        return [*words, *(f'--set={text}' for text in sets)]

    def _base(self, row: Row) -> Path:
        """Return the checkpoint that a row trains on top of: that of `--init` for its views."""
        views = (self.options.real_view,) if row.is_real else row.views
        if not views:
            return self.options.init
        folder, card = self.out / 'bases' / '_'.join(views), CHECKPOINT_CARD
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with whole_folder(folder) as new:
                for part in self.options.init.iterdir():
                    if part.name != card:
                        (new / part.name).symlink_to(part.resolve())
                values = read_json(self.options.init / card)
                write_json(new / card, {**values, 'views': list(views)})
        return folder

    def _waits(self, row: Row, seed: int) -> bool:
        """Whether a row starts from weights that this run has still to train."""
        will_be = any(one.name == row.starts_from for one in self.rows)
        if not will_be or self.options.real_init not in self.stages:
            return False
        return trained_steps(self._source(row, seed)) is None

    def _source(self, row: Row, seed: int) -> Path:
        """Return where the checkpoint that a row starts from is, or will be."""
        source = next(one for one in ROWS if one.name == row.starts_from)
        return self.stage_folder(source, seed, self.options.real_init) / self.product

    def _start(self, row: Row, seed: int) -> Path:
        """Return the checkpoint that a row starts from.

        Raises:
            ConfigError: the row of the simulated episodes has no such stage so far.
        """
        checkpoint = self._source(row, seed)
        if trained_steps(checkpoint) is None:
            raise ConfigError(
                f"row '{row.name}' starts from row '{row.starts_from}' with "
                f'{self.options.real_init} clips (--real-init), which is not trained so far; '
                'name that stage in --clips, and run the same command again'
            )
        return checkpoint

    def _evaluation(
        self, row: Row, seed: int, checkpoint: Path, dataset: Path, out: Path, test: str
    ) -> list[str]:
        options = self.options
        is_adapter = self.product == 'adapter'
        tested = self._base(row) if is_adapter else checkpoint
        words = [
            'evaluate', f'{row.name}={tested}', str(dataset), '--split', EVERY, '--actions',
            'true,shuffled', '--no-ceiling', '--no-report', '--seed', str(seed),
            '--mode', MODES[test],
            '--device', options.device, '--threads', str(options.threads),
            *self._workers, '--out', str(out),
        ]  # fmt: skip
        words += ['--adapter', str(checkpoint)] if is_adapter else []
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
        self._did_something = True
        print(f'{label}: {shlex.join(["mtv-world", *words])}', flush=True)
        begun, cpu = time.monotonic(), time.process_time()
        try:
            is_launched = self.options.launcher is not None and words[0] == 'train'
            status = self._launch(words) if is_launched else self._run(words)
        finally:
            if times is not None:
                spent = time.monotonic() - begun, time.process_time() - cpu
                add_time(times / TIMES, label.rpartition(': ')[2], *spent)
        if status:
            raise StepFailed(label, words, status)

    def _launch(self, words: list[str]) -> int:
        """Run a training in the processes of the launcher; return its exit status."""
        launcher = shlex.split(self.options.launcher)
        return subprocess.run(
            [*launcher, '-m', 'mtv_world_ros.cli', *words], check=False
        ).returncode

    def write_tables(self) -> str:
        """Write the tables of what is finished, and return them."""
        text = '\n\n'.join(Sections(self).all()) + '\n'
        write_whole(self.out / TABLES, text)
        return text


class Sections:
    """Sections of the page of tables.

    Args:
        run: whose rows are read.
    """

    def __init__(self, run: PaperTables) -> None:
        self._run = run
        self._stages = sorted(
            int(path.stem) for path in (run.out / 'stages').glob('*.json') if path.stem.isdigit()
        )
        self._results = {stage: Results(run, stage) for stage in self._stages}

    def all(self) -> Iterator[str]:
        """Yield headings, tables and what they mean."""
        options = self._run.options
        seeds = ', '.join(map(str, self._run.seeds))
        yield (
            f'# Tables of the paper\n\nStages of clips a row, seeds {seeds}, preset '
            f'{options.preset}, learning rate constant after {WARMUP_STEPS} steps, averaged '
            f'weights; commit {commit()}; {machine()}.\n\n{_ABOUT}'
        )
        found, which = self._last(ROWS_SIMULATED)
        yield f'## Table 1: methods by view, {which}\n\n{found.methods(TABLE_1, VIEWS).markdown()}'
        chunks = found.chunk_by_chunk(ROWS_SIMULATED, VIEWS).markdown()
        yield f'## Chunk by chunk from recorded frames, {which}\n\n{chunks}'
        reactions = found.reactions(ROWS_SIMULATED).markdown()
        yield f'## Do they react to their actions? {which}\n\n{reactions}'
        yield f"## The paper's order, {which}\n\n{_ORDER}\n\n{found.order().markdown()}"
        yield from self._further(found)
        for key, words in (('j_union', 'J x 100'), ('j_moving', 'J moving x 100')):
            table = found.by_task(key).markdown()
            yield f'## Table 3: {words} by task and view, {which}\n\n{table}'
        if self._rows(TABLE_2):
            found, which = self._last(TABLE_2)
            yield (
                f'## Table 2: real recordings, one view, {which}\n\n'
                f'{found.methods(TABLE_2, found.real_views).markdown()}\n\n'
                f'{found.reactions(TABLE_2).markdown()}\n\n'
                f'{found.real_order().markdown()}\n\n'
                f'{found.real_by_task().markdown()}'
            )
        yield f'## Learning curve\n\n{self._curve().markdown()}'
        yield f'## Clips and time\n\n{self._times().text()}'

    def _rows(self, names: Sequence[str]) -> list[Row]:
        """Return the rows of these names that are asked for or there."""
        return [
            row
            for row in ROWS
            if row.name in names
            and (
                row in self._run.rows
                or any(r.evaluations(row.name) for r in self._results.values())
            )
        ]

    def _last(self, names: Sequence[str]) -> tuple[Results, str]:
        """Return the last stage that all rows have, else the first, and words for a heading."""
        rows = self._rows(names)
        finished = [s for s in self._stages if rows and all(map(self._results[s].has, rows))]
        stage = finished[-1] if finished else self._stages[0]
        results = self._results[stage]
        there = sum(map(results.has, rows))
        part = '' if there == len(rows) else f', {there} of {len(rows)} rows so far'
        return results, f'{stage} clips a row{part}'

    def _further(self, complete: Results) -> Iterator[str]:
        """Yield methods and order of the last stage that some rows have, if it is a later one."""
        for stage in reversed(self._stages):
            found = self._results[stage]
            if found is complete:
                return
            ready = [name for name in ROWS_SIMULATED if found.evaluations(name)]
            if len(ready) > 1:
                heading = f'{stage} clips a row, {len(ready)} of {len(ROWS_SIMULATED)} rows so far'
                yield f'## Table 1: {heading}\n\n{found.methods(TABLE_1, VIEWS).markdown()}'
                order = found.order()
                rows = [
                    row
                    for row in order.rows
                    if all(found.evaluations(str(name)) for name in row[:2])
                ]
                yield f"## The paper's order: {heading}\n\n{replace(order, rows=rows).markdown()}"
                return

    def _curve(self) -> Table:
        """Return J of moving objects of all rows and stages, with true and other commands."""
        head = ['Row', 'clips', *REACTION_HEAD, HELD]
        rows = [
            [row.name, str(stage), *found.reaction(row.name), found.cell(row.name, None, HELD_KEY)]
            for row in ROWS
            for stage, found in self._results.items()
            if found.evaluations(row.name)
        ]
        return Table(head=head, rows=rows)

    def _times(self) -> Table:
        head = ['Row', 'seed', 'clips', 'training CPU [h]', 'testing CPU [h]']
        rows = []
        for row in ROWS:
            for seed in self._run.seeds:
                folder = self._run.folder(row, seed)
                steps = trained_steps(folder / 'training' / self._run.product)
                if steps is None:
                    continue
                spent = read_json(folder / TIMES) if (folder / TIMES).is_file() else {}
                hours = [
                    f'{sum(spent.get(n, {}).get("cpu_s", 0) for n in names) / 3600:.2f}'
                    for names in (('training',), tuple(MODES))
                ]
                rows.append([row.name, str(seed), str(steps * self._run.batch_size), *hours])
        return Table(head=head, rows=rows)


#: columns of what tells whether a method reacts to its actions
REACTION_HEAD = [
    'n', 'J moving', 'other commands', 'difference', 'reacts', 'pictures less other commands [dB]',
    'missed grasps dreamt', 'grasps missed',
]  # fmt: skip
REACTION_KEYS = ('j_moving', 'j_shuffled_moving', 'margin_over_shuffled')
HELD_KEY = 'j_copy_moving'
#: columns of the difference of two rows
_DIFFERENCES = ['n', 'J x 100', 'J moving x 100', "paper's order"]
_ORDER = (
    'Differences of J x 100, paired by episode, of rows in the order of the paper\'s "Task '
    'Averaged". Confirmed: the interval of the difference of J is above 0; contradicted: below 0. '
    'Where neither row reacts to its actions the order says nothing about the methods.'
)


class Results:
    """Finished evaluations of a stage as tables.

    Args:
        run: whose rows are read.
        stage: its number of clips.
    """

    def __init__(self, run: PaperTables, stage: int) -> None:
        self._run, self._stage, self._seeds = run, stage, run.seeds
        self._rows = {row.name: row for row in ROWS}
        self._read = {
            (row.name, seed, name): read_evaluations(folder)[0]
            for row in ROWS
            for seed in self._seeds
            for name in MODES
            if ((folder := run.stage_folder(row, seed, stage) / name) / 'metrics.json').is_file()
        }

    def has(self, row: Row) -> bool:
        """Return True if a row is tested with the first seed; others may have fewer rows."""
        return (row.name, self._seeds[0], WHOLE) in self._read

    def evaluations(self, name: str, test: str = 'test') -> list[EvaluationSummary]:
        """Return the evaluations of a row, one a seed."""
        keys = [(name, seed, test) for seed in self._seeds]
        return [self._read[key] for key in keys if key in self._read]

    def cell(
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
        """Return a number of a row: with its interval, or mean and range of several seeds."""
        found = [
            evaluated.estimates(view, Group(task=task))[key]
            for evaluated in self.evaluations(name, test)
            if (view is None or view in evaluated.spec.views)
            and evaluated.chosen(Group(task=task))
            and key in evaluated.estimates(view, Group(task=task))
        ]
        return joined(found, digits, factor)

    def methods(self, names: Sequence[str], views: Sequence[str]) -> Table:
        """Return Table 1 or 2: FID, FVD, the distance of Lite0, J and J of what moves by view."""
        columns = ('FID', 'FVD', LITE, 'J', 'J moving')
        head = ['Method', 'n', *(f'{view} {what}' for view in views for what in columns)]
        rows = []
        for name in names:
            cells = [self._rows[name].title, self.count(name)]
            for view in views:
                cells += [self._distance(name, view, key) for key in ('fid', 'fvd')]
                cells.append(self._lite(name, view))
                cells += [self.cell(name, view, key) for key in ('j_union', 'j_moving')]
            rows.append(cells)
        first = next((n for n in reversed(names) if self.evaluations(n)), names[-1])
        held = [HELD, self.count(first)]
        for view in views:
            copies = [self.cell(first, view, k) for k in ('j_copy_union', 'j_copy_moving')]
            held += [DASH, DASH, self._lite(first, view, 'held'), *copies]
        return Table(head=head, rows=[*rows, held])

    def _distance(self, name: str, view: str, key: str) -> str:
        if getattr(self._run.options, f'{key}_weights') is None:
            return 'no weights' if self._has_view(name, view) else DASH
        return self.cell(name, view, key, digits=1)

    def _has_view(self, name: str, view: str) -> bool:
        return any(view in evaluated.spec.views for evaluated in self.evaluations(name))

    def _lite(self, name: str, view: str, side: str = 'predicted') -> str:
        row = self._rows[name]
        folders = (self._run.stage_folder(row, seed, self._stage) for seed in self._seeds)
        found = [distance(folder / f'{WHOLE}_features.npz', view, side) for folder in folders]
        return joined([one for one in found if one is not None], 1)

    def reactions(self, names: Sequence[str]) -> Table:
        """Return J of moving objects with true and other commands, and whether they differ."""
        rows = [
            [f'{self._rows[name].title} ({name})', *self.reaction(name)]
            for name in names
            if self.evaluations(name)
        ]
        return Table(head=['Method', *REACTION_HEAD], rows=rows)

    def reaction(self, name: str) -> list[str]:
        """Return the cells of a row under `REACTION_HEAD`."""
        cells = [self.cell(name, None, key) for key in REACTION_KEYS]
        return [self.count(name), *cells, self.reacts(name), *self._pictures(name)]

    def _pictures(self, name: str) -> list[str]:
        """Return the margin in dB where the picture changes, and the shares of grasps."""
        found = self.evaluations(name)
        margins = [e.pictures[None].get('margin_over_shuffled', NOT_MEASURED) for e in found]
        dreams = Dreams.of([g for e in found for r in e.results for g in r.grasps], [])
        return [joined(margins, 2), dreams.dreamt.text, dreams.missed.text]

    def chunk_by_chunk(self, names: Sequence[str], views: Sequence[str]) -> Table:
        """Return J of all objects and of what moves, each chunk from recorded frames."""
        head = ['Method', 'n', *(f'{view} {what}' for view in views for what in ('J', 'J moving'))]
        keys = ('j_union', 'j_moving')
        rows = [
            [
                f'{self._rows[name].title} ({name})',
                self.count(name, CHUNKS),
                *(self.cell(name, view, key, test=CHUNKS) for view in views for key in keys),
            ]
            for name in names
        ]
        held = next((n for n in reversed(names) if self.evaluations(n, CHUNKS)), names[-1])
        copies = [
            self.cell(held, view, key, test=CHUNKS)
            for view in views
            for key in ('j_copy_union', 'j_copy_moving')
        ]
        return Table(head=head, rows=[*rows, [HELD, self.count(held, CHUNKS), *copies]])

    def reacts(self, name: str) -> str:
        """Return whether true commands beat other ones by all seeds of a row."""
        lows = [
            evaluated.estimates(None)['margin_over_shuffled'].interval[0]
            for evaluated in self.evaluations(name)
        ]
        known = [low for low in lows if isfinite(low)]
        return 'cannot tell' if not known else 'yes' if min(known) > 0 else 'not shown'

    @property
    def real_views(self) -> tuple[str, ...]:
        """The view of the real recordings."""
        found = [e for name in TABLE_2 for e in self.evaluations(name)]
        return found[0].spec.views if found else (self._run.options.real_view,)

    def order(self) -> Table:
        """Return differences of rows that the paper has in another order, paired by episode."""
        neighbours = list(pairwise(PAPER_ORDER))
        best = PAPER_ORDER[-1]
        lines = []
        for (worse, theirs), (better, mine) in [
            *neighbours,
            *((o, best) for o in PAPER_ORDER[:-2]),
        ]:
            for view in VIEWS:
                if view in worse:
                    pair = better[view], worse[view]
                    lines.append([*pair, view, f'{mine[view] - theirs[view]:.1f}',
                                  *self._differences(*pair, view)])  # fmt: skip
        return Table(head=['Better', 'than', 'view', 'in the paper', *_DIFFERENCES], rows=lines)

    def real_order(self) -> Table:
        """Return differences of neighbours of the paper's Table 2, paired by episode."""
        (view,) = self.real_views
        lines = [
            [better, worse, view, *self._differences(better, worse, view)]
            for worse, better in pairwise(REAL_ORDER)
        ]
        return Table(head=['Better', 'than', 'view', *_DIFFERENCES], rows=lines)

    def _differences(self, better: str, worse: str, view: str) -> list[str]:
        """Return the cells of a pair of rows under `_DIFFERENCES`."""
        whole, moving = (self.difference(better, worse, view, k) for k in ('j_union', 'j_moving'))
        low, high = whole.interval
        says = 'confirmed' if low > 0 else 'contradicted' if high < 0 else 'cannot be told'
        if self.reacts(better) != 'yes' and self.reacts(worse) != 'yes':
            says = 'neither reacts'
        cells = [joined([one], 1, 100.0) for one in (whole, moving)]
        return [str(whole.num_episodes or DASH), *cells, says if isfinite(whole.value) else DASH]

    def difference(self, better: str, worse: str, view: str, key: str) -> Estimate:
        """Return the mean difference of two rows over the episodes that both have.

        Of a row with several seeds an episode has the mean over its seeds.
        """
        held: list[dict[str, float]] = []
        for name in (better, worse):
            by_episode: dict[str, list[float]] = {}
            for evaluated in self.evaluations(name):
                for r in evaluated.results:
                    by_episode.setdefault(r.episode, []).append(r.means(view).get(key, nan))
            held.append({episode: float(np.mean(of)) for episode, of in by_episode.items()})
        both = [held[0][k] - held[1][k] for k in held[0] if k in held[1]]
        values = np.array([value for value in both if isfinite(value)])[:, None]
        if not len(values):
            return NOT_MEASURED
        means, ends = mean_interval(values, np.ones_like(values), low=-1.0)
        return Estimate(
            value=float(means[0]),
            interval=(float(ends[0, 0]), float(ends[1, 0])),
            num_episodes=len(values),
        )

    def count(self, name: str, test: str = 'test') -> str:
        """Return how many episodes a row is tested on, of all seeds."""
        return str(sum(len(e.results) for e in self.evaluations(name, test)) or DASH)

    def real_by_task(self) -> Table:
        """Return J and J of what moves of the real recordings by task, times 100."""
        (view,) = self.real_views
        found = [e for name in TABLE_2 for e in self.evaluations(name)]
        tasks = sorted({task for evaluated in found for task in evaluated.tasks})
        rows = [
            [
                task or 'no task',
                words,
                *(self.cell(n, view, key, task, digits=1, factor=100.0) for n in TABLE_2),
            ]
            for task in tasks
            for words, key in (('J', 'j_union'), ('J moving', 'j_moving'))
        ]
        head = ['Task', 'x 100', *(self._rows[name].title for name in TABLE_2)]
        return Table(head=head, rows=rows, num_labels=2)

    def task_mean(self, name: str, view: str, key: str, test: str) -> str:
        """Return the mean over tasks of a row, times 100, with its 95 % interval."""
        means = []
        for evaluated in self.evaluations(name, test):
            if view in evaluated.spec.views:
                by_task = [
                    [r.means(view)[key] for r in evaluated.chosen(Group(task=task))]
                    for task in evaluated.tasks
                ]
                means.append(mean_over_groups(by_task))
        return joined(means, 1, 100.0)

    def by_task(self, key: str) -> Table:
        """Return Table 3 turned: a line a task and view, a column a method, J times 100."""
        tasks = sorted(self._run.options.tasks)
        lines = [(task, view) for task in tasks for view in VIEWS]
        lines += [(None, view) for view in VIEWS]
        columns: list[tuple[str, dict[str, str], str, str]] = [
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
        columns += [
            (ZERO_SHOT, dict.fromkeys(VIEWS, FULL), 'zero_shot', key),
            ('Single-View', single, 'test', key),
            ('w/o Mask', dict.fromkeys(VIEWS, 'without_mask'), 'test', key),
            (self._rows[FULL].title, dict.fromkeys(VIEWS, FULL), 'test', key),
            (HELD, any_row, 'test', key.replace('j_', 'j_copy_')),
        ]
        head = ['Task', 'view', *(title for title, *_ in columns)]
        counts = [
            ' + '.join(dict.fromkeys(self.count(name, test) for name in names.values()))
            for _, names, test, _ in columns
        ]
        rows = [
            [
                task or 'Task Averaged',
                view,
                *(
                    self.cell(names[view], view, k, task, test=test, digits=1, factor=100.0)
                    if task
                    else self.task_mean(names[view], view, k, test)
                    for _, names, test, k in columns
                ),
            ]
            for task, view in lines
        ]
        return Table(head=head, rows=[*rows, ['n', '', *counts]])


def mean_over_groups(groups: Sequence[Sequence[float]]) -> Estimate:
    """Return the mean of the groups' means, each group of the same weight, and its interval.

    The groups are the tasks of the paper, no sample of tasks: the interval is that of the episodes
    within them. It is not known where a group has one value.
    """
    known = [np.array([v for v in group if isfinite(v)]) for group in groups]
    known = [group for group in known if len(group)]
    if not known:
        return NOT_MEASURED
    value, count = float(np.mean([group.mean() for group in known])), sum(map(len, known))
    if min(map(len, known)) < 2:
        return Estimate(value=value, interval=(nan, nan), num_episodes=count)
    variances = [group.var(ddof=1) / len(group) for group in known]
    half = float(t_quantile(count - len(known)) * np.sqrt(sum(variances)) / len(known))
    low, high = max(value - half, 0.0), min(value + half, 1.0)
    return Estimate(value=value, interval=(low, high), num_episodes=count)


def check_method(folder: Path, row: Row) -> None:
    """Write how a row that is begun or begins is made; refuse one that was made otherwise.

    Raises:
        ConfigError: names the row, both methods and what to do.
    """
    file, method = folder / METHOD, METHODS[row.control]
    if file.is_file():
        there = str(read_json(file)['method'])
    else:
        there = 'version 1' if (folder / 'training').is_dir() else method
    if there != method:
        raise ConfigError(
            f"row '{row.name}' in '{folder}' was made by {there}; today's method is {method}. "
            'Move that folder away, or give another --out'
        )
    write_json(file, {'method': method})


def last_loss(training: Path) -> float:
    """Return the mean loss of the last lines of a training's log."""
    lines = (training / 'log.jsonl').read_text(encoding='utf-8').splitlines()[-RATE_LINES:]
    return float(np.mean([json.loads(line)['loss'] for line in lines]))


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


def chosen_rows(
    names: Sequence[str] | None, *, has_real: bool, has_start: bool = False
) -> list[Row]:
    """Return the rows to train: those named, else all that there are data for.

    Args:
        names: of rows; None = all.
        has_real: whether there are real recordings.
        has_start: whether it is said from which stage rows start that start from others.

    Raises:
        ConfigError: no such row, or a real one without recordings or without a start.
    """
    known = {row.name: row for row in ROWS}
    if names is None:
        real = [row for row in ROWS if row.is_real and (has_start or not row.starts_from)]
        return [*_SIMULATED, *(real if has_real else [])]
    for name in names:
        if name not in known:
            raise ConfigError.unknown(
                '--rows', name, known, is_not=' is no row', listed='; rows are'
            )
        if known[name].is_real and not has_real:
            raise ConfigError(
                f"row '{name}' is trained on real recordings: give --real FOLDER and --real-view"
            )
        if known[name].starts_from and not has_start:
            raise ConfigError(
                f"row '{name}' starts from the weights of '{known[name].starts_from}': give "
                '--real-init CLIPS, the stage to take them from'
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
        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, settings)
        return
    there = read_json(file)
    other = [f'{k} is {there.get(k)!r} there, {v!r} now' for k, v in settings.items()
             if there.get(k) != v]  # fmt: skip
    if other:
        raise ConfigError(
            f"'{file}' is of a run of other settings: {'; '.join(other)}. Give the same, "
            'or another --out'
        )


class FolderInUse(ConfigError):
    """Another process works in a folder."""


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder, so that one process alone works in it.

    Args:
        folder: to hold.
        wait: for another process to release the folder.

    Raises:
        FolderInUse: another process holds the folder, and `wait` is off.
    """
    with (folder / '.lock').open('w') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise FolderInUse(f"another process works in '{folder}'; wait for it") from error
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


def trained_steps(checkpoint: Path) -> int | None:
    """Return the steps that a checkpoint was trained for; None if there is none."""
    card = checkpoint / 'world_model.json'
    return read_card(checkpoint).trained_on.get('steps') if card.is_file() else None


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


def parser() -> CommandParser:
    """Return the parser of the options."""
    made = CommandParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add('--out', type=Path, required=True, help='goes on with what is there')
    add(
        '--clips',
        type=_numbers,
        default=list(STAGES),
        metavar='N,N,...',
        help='training clips a row of each stage; default: ' + ','.join(map(str, STAGES)),
    )
    add('--seeds', type=_numbers, default=[0], help='of trainings, comma-separated')
    add('--rows', type=_names, help=f'of {", ".join(row.name for row in ROWS)}; default: all')
    add('--tasks', type=_names, default=all_tasks(), help='default: the fifteen of the package')
    add('--data', type=Path, help='of collect; default: made in OUT/data')
    add('--episodes', type=int, default=EPISODES_PER_TASK, help='per task, where data are made')
    add('--data-seed', type=int, default=20000, help='of the data that are made')
    add(
        '--test-episodes',
        type=_numbers,
        metavar='N,N,...',
        help='tested in each stage, the last number in all further ones, spread over the tasks; '
        'default: all of the split',
    )
    add('--zero-shot', type=Path, help='of collect --zero-shot; default: made in OUT/zero_shot')
    add(
        '--zero-shot-episodes',
        type=int,
        default=ZERO_SHOT_EPISODES,
        help='where they are made; 0 = no row of zero-shot',
    )
    add(
        '--zero-shot-tested',
        type=_numbers,
        metavar='N,N,...',
        help='tested in each stage, the last number in all further ones; default: all',
    )
    add('--real', type=Path, help='folder of imported real episodes, for Table 2')
    add('--real-view', help='the view of Table 2')
    add('--real-robot', type=Path, help='default: robot/robot.yaml in REAL')
    add('--real-segmenter', type=Path, help='objects.safetensors of the import')
    add(
        '--real-init',
        type=int,
        metavar='CLIPS',
        help='stage of the simulated row whose weights the last row of Table 2 starts from',
    )
    add(
        '--rates',
        type=_rates,
        default=[],
        metavar='R,R,...',
        help="learning rates that each row is first tried with; default: the preset's alone",
    )
    add('--rate-clips', type=int, default=500, help='training clips of each of --rates')
    add('--preset', default='paper', help='name or YAML file')
    add('--set', action='append', default=[], metavar='SECTION.KEY=VALUE', help='of all rows')
    add('--device', default='cpu', help='of trainings and tests, e.g. cuda')
    add('--threads', type=int, default=1, help='CPU threads')
    add(
        '--init',
        type=Path,
        help="checkpoint that all rows train on top of, e.g. of 'mtv-world import wan'; a preset "
        'with LoRA needs it, and its rows are tested as adapters of it',
    )
    add('--latent-cache', type=Path, help='of trainings: latents go to a folder a row in it')
    add('--fps', type=float, help='frames a second of episodes that are made; 16 for Wan')
    add(
        '--launcher',
        metavar='COMMAND',
        help="of trainings on several GPUs, e.g. 'torchrun --nproc-per-node 8'",
    )
    add_options(made, 'workers')
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


def _rates(text: str) -> list[float]:
    return [float(name) for name in _names(text)]


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
