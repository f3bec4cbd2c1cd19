"""Does imagination rank learned policies as the simulator does?

    python experiments/learned_policies.py --lerobot ENV/bin/python [--data out/learned]
        [--tasks shake_bottle,place_cup_plate,place_bread_plate] [--demos 150] [--starts 1000]
        [--steps 800] [--scenes 20] [--workers 1] [--until rank] [--checkpoint bundled]
        [--out experiments/results]

From an empty folder to a ranking: collects demonstrations of every task, exports them as LeRobot
datasets, and renders the first frames of more scenes, whose commands are the expert's plan; trains
LeRobot's ACT on each task (act_training.py, in LeRobot's environment, see
requirements/lerobot.txt); and ranks the checkpoints, served by LeRobot's own policy server, with
`mtv-world rank`, each in its task. Every command is printed before it runs. The same command
goes on where it was stopped; what exists is not made again, so checkpoints can be ranked while
others are missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import io
from itertools import combinations
import json
import os
from pathlib import Path
import shlex
import subprocess
import sys
from typing import Any

import numpy as np
from page import parse_arguments, publish, table
from PIL import Image
import pyarrow.parquet as parquet
from scipy.stats import spearmanr
import yaml

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.ranking.jobs import Result
from mtv_world_ros.ranking.run_jobs import read_results
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.simulation.collect.record import expert_generator
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.simulator import SimEpisode

#: one arm moves one object: ACT reads no instruction
TASKS = 'shake_bottle,place_cup_plate,place_bread_plate'
STAGES = ('collect', 'pack', 'train', 'rank')
#: of the demonstrations, and of further first frames; the ranking has scenes of its own
SEED, STARTS_SEED, SCENE_SEED = 41000, 42000, 51000
#: of the frames on disk; the policy sees `SEEN` of them, at `SEEN_SIZE`
FPS, WIDTH, HEIGHT, VIEWS = 5, 96, 72, ('low', 'high')
SEEN, SEEN_SIZE = ('high',), '64x48'
#: actions of an answer: as long as a chunk of the bundled world model, 3.2 s
CHUNK = 16
TRAINER = Path(__file__).parent / 'act_training.py'


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One training run, of which every task has its own.

    Attributes:
        name: of its folder.
        begin: run and sixteenth of the checkpoint that it goes on from; None = random weights.
        sixteenths: of --steps; length of the learning rate's schedule.
        rate: largest learning rate.
        asked: share of the later frames that are drawn where an answer ends.
        share: one of this many scenes is used.
        late: actions by which the grippers of the demonstrations are late, each 0.2 s.
        ranked: name of a policy -> which sixteenth of --steps it is; training ends at the last.
    """

    name: str
    begin: tuple[str, int] | None = None
    sixteenths: int = 16
    rate: float = 6e-4
    asked: float = 0.0
    share: int = 1
    late: int = 0
    ranked: tuple[tuple[str, int], ...]


#: the first run sees all frames alike, the second those that a policy is asked at
RUNS = (
    Run(name='full', ranked=(('sixteenth', 1), ('eighth', 2), ('quarter', 4), ('half', 8))),
    Run(
        name='asked', begin=('full', 8), sixteenths=6, rate=4e-4, asked=0.75,
        ranked=(('asked_eighth', 2), ('asked_quarter', 4), ('asked_end', 6)),
    ),
    Run(
        name='late', begin=('asked', 6), sixteenths=2, rate=2e-4, asked=0.75, late=2,
        ranked=(('late_grippers', 2),),
    ),
    Run(
        name='few', begin=('full', 4), sixteenths=2, rate=2e-4, asked=0.75, share=50,
        ranked=(('few_scenes', 2),),
    ),
)  # fmt: skip


def main() -> None:
    """Make what is missing, up to the stage that is asked for."""
    options = parse_arguments(__doc__, repeats=20, more=_add)
    root, tasks = options.data.resolve(), options.tasks.split(',')
    stages = STAGES[: STAGES.index(options.until) + 1]
    for stage in stages[:2]:
        for task in tasks:
            _STAGES[stage](root, task, options)
    if 'train' in stages:
        for run in RUNS:
            if run.name in options.runs.split(','):
                for task in tasks:
                    _train(root, task, run, options)
    if 'rank' in stages:
        _rank(root, tasks, options)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--lerobot', required=True, help="Python of LeRobot's environment")
    parser.add_argument('--data', type=Path, default=Path('out/learned'))
    parser.add_argument('--tasks', default=TASKS)
    parser.add_argument('--runs', default=','.join(run.name for run in RUNS))
    parser.add_argument('--demos', type=int, default=150, help='demonstrations of each task')
    parser.add_argument('--starts', type=int, default=1000, help='more first frames of each task')
    parser.add_argument('--steps', type=int, default=800, help='training steps of the full run')
    parser.add_argument('--scenes', type=int, default=20, help='of each task, for the ranking')
    parser.add_argument('--max-chunks', type=int, default=2, help='answers of a policy at most')
    parser.add_argument('--workers', type=int, default=1, help='of the ranking; .6 GB a policy')
    parser.add_argument('--no-clips', dest='clips', action='store_false', help='as in rank')
    parser.add_argument('--until', choices=STAGES, default='rank')
    parser.add_argument('--checkpoint', default='bundled', help='the world model')


def _collect(root: Path, task: str, options: argparse.Namespace) -> None:
    """Demonstrations as a LeRobot dataset, and first frames of more scenes."""
    demos, out = root / 'episodes' / f'{task}_expert', _dataset(root, task)
    if not out.exists():
        size = ['--episodes', str(options.demos), '--fps', str(FPS), '--seed', str(SEED)]
        kind = ['--task', task, '--failures-of-ten', '0']
        _mtv_world('collect', *kind, *size, '--out', str(demos))
        kind = ['--fps', str(FPS), '--size', f'{WIDTH}x{HEIGHT}', '--images']
        _mtv_world('export', 'lerobot', str(demos), '--out', str(out), *kind)
    starts = _starts(root, task)
    if not starts.exists():
        print(f'$ {options.starts} first frames of {task}', flush=True)
        np.savez(starts, **_first_frames(task, options.starts))


def _first_frames(task: str, num: int) -> dict[str, Any]:
    """First frames of scenes, and what the expert would command in the 3.2 s after them."""
    robot = load_robot(bundled('robots', 'yam_bimanual', '--robot'))
    expert, times = Expert(robot), np.arange(1, CHUNK + 1) / FPS
    sim = SimEpisode(robot, expert.home)
    seeds = np.random.default_rng([STARTS_SEED, *task.encode()]).integers(2**32, size=2 * num)
    images, actions = [], []
    for seed in map(int, seeds):
        try:
            seen = sim.reset(seed, task)
            plan = expert.plan(sim.task, sim.scene, expert_generator(seed), miss=False)
        except SimulatorError:
            continue
        images.append([resize_frames(seen.images[v][None], WIDTH, HEIGHT)[0] for v in VIEWS])
        actions.append(resample(plan, expert.home, times))
        if len(images) == num:
            break
    sim.close()
    state = np.repeat(expert.home[None], num, axis=0)
    return {
        'images': np.array(images, np.uint8),
        'state': state.astype(np.float32),
        'actions': np.array(actions, np.float32),
    }


def _pack(root: Path, task: str, _options: argparse.Namespace) -> None:
    """Demonstrations and first frames as one file, which the trainer holds in memory."""
    out = _samples(root, task)
    if out.exists():
        return
    parts = _demonstrated(_dataset(root, task))
    with np.load(_starts(root, task)) as file:
        more = dict(file)
    num = len(more['state'])
    # scenes of their own, after those of the demonstrations
    more |= {'start': np.ones(num, bool), 'scene': parts['scene'].max() + 1 + np.arange(num)}
    out.parent.mkdir(parents=True, exist_ok=True)
    whole: dict[str, Any] = {
        key: np.concatenate([values, more[key]]) for key, values in parts.items()
    }
    np.savez(out, views=np.array(VIEWS), **whole)


def _demonstrated(dataset: Path) -> dict[str, Any]:
    """Every row of a LeRobot dataset with the actions that follow; an episode ends at rest."""
    parts: dict[str, list[Any]] = {
        key: [] for key in ('images', 'state', 'actions', 'start', 'scene')
    }
    for path in sorted(dataset.glob('data/*/*.parquet')):
        rows = parquet.read_table(path).to_pydict()
        episodes, actions = np.array(rows['episode_index']), np.array(rows['action'], np.float32)
        for episode in np.unique(episodes):
            (mine,) = np.nonzero(episodes == episode)
            for k, row in enumerate(mine):
                cells = (rows[f'observation.images.{view}'][row] for view in VIEWS)
                frames = [np.asarray(Image.open(io.BytesIO(cell['bytes']))) for cell in cells]
                after = mine[np.minimum(k + np.arange(CHUNK), len(mine) - 1)]
                values = (frames, rows['observation.state'][row], actions[after], k == 0, episode)
                for found, value in zip(parts.values(), values, strict=True):
                    found.append(value)
    kinds = {'images': np.uint8, 'start': bool, 'scene': np.int64}
    return {key: np.array(found, kinds.get(key, np.float32)) for key, found in parts.items()}


_STAGES = {'collect': _collect, 'pack': _pack}


def _train(root: Path, task: str, run: Run, options: argparse.Namespace) -> None:
    """Train to the end; go on where it was stopped."""
    steps = [_step(at, options) for _, at in run.ranked]
    if _checkpoint(root, task, run.name, steps[-1]).exists():
        return
    words = [options.lerobot, str(TRAINER), '--out', str(root / 'runs' / task / run.name)]
    words += ['--data', str(_samples(root, task))]
    words += ['--views', ','.join(SEEN), '--size', SEEN_SIZE, '--rate', f'{run.rate:g}']
    words += ['--steps', str(_step(run.sixteenths, options))]
    words += ['--save-at', ','.join(map(str, steps)), '--asked', f'{run.asked:g}']
    words += ['--share', str(run.share), '--late', str(run.late), '--seed', str(options.seed)]
    if run.begin:
        name, at = run.begin
        words += ['--begin', str(_checkpoint(root, task, name, _step(at, options)))]
    (root / 'runs' / task).mkdir(parents=True, exist_ok=True)
    _call(words, log=root / f'runs/{task}/{run.name}.log')


def _rank(root: Path, tasks: Sequence[str], options: argparse.Namespace) -> None:
    """Rank task by task, so that the servers of one task alone are alive, then all together."""
    found = {task: list(_policies(root, task, options)) for task in tasks}
    lists = {f'policies_{task}.yaml': entries for task, entries in found.items() if entries}
    if not lists:
        sys.exit('there is no checkpoint yet')
    lists['policies.yaml'] = [entry for entries in found.values() for entry in entries]
    for name, entries in lists.items():
        text = yaml.safe_dump({'policies': entries}, sort_keys=False)
        (root / name).write_text(text, encoding='utf-8')
        _mtv_world(
            'rank', '--policies', str(root / name), '--episodes', str(options.scenes),
            '--max-chunks', str(options.max_chunks), '--seed', str(SCENE_SEED),
            '--workers', str(options.workers), '--checkpoint', options.checkpoint,
            '--threads', '1',
            *([] if options.clips else ['--no-clips']), '--out', str(root / 'ranking'),
        )  # fmt: skip
    options.repeats = options.scenes
    ranking = json.loads((root / 'ranking/ranking.json').read_text(encoding='utf-8'))
    body = '\n\n'.join(_body(ranking, root, options))
    given = ('tasks', 'demos', 'starts', 'steps', 'scenes', 'max_chunks')
    words = (f'--{name.replace("_", "-")} {getattr(options, name)}' for name in given)
    command = f'python experiments/learned_policies.py --lerobot ENV/bin/python {" ".join(words)}'
    publish('learned_policies', 'Learned policies', command, body, options, _versions(options))


def _policies(root: Path, task: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Entries of the list for `mtv-world rank`, of the checkpoints that exist."""
    serve = 'lerobot.async_inference.policy_server'
    size = {'width': WIDTH, 'height': HEIGHT}
    for run in RUNS:
        for name, sixteenth in run.ranked:
            path = _checkpoint(root, task, run.name, _step(sixteenth, options))
            if not path.exists():
                continue
            yield {
                'name': f'{task}_{name}',
                'policy': 'act_exported',
                'change': {
                    'policy': {'path': str(path)},
                    'images': [{'key': view, 'view': view, **size} for view in SEEN],
                },
                'command': [
                    options.lerobot, '-m', serve, '--host=127.0.0.1', '--port={port}',
                    '--inference_latency=0',
                ],
                'start_timeout_s': 600.0,  # a busy machine
                'tasks': [task],
            }  # fmt: skip


def _body(ranking: dict[str, Any], root: Path, options: argparse.Namespace) -> Iterator[str]:
    """Parts of the page."""
    rates = {name: found['rates']['all tasks'] for name, found in ranking['policies'].items()}
    yield (
        f"LeRobot's ACT (ResNet-18 from random weights, view {' and '.join(SEEN)} at {SEEN_SIZE} "
        f'px, {FPS} Hz, answers of {CHUNK / FPS:g} s), runs of its own for every task: '
        f'{options.demos} demonstrations and the first frames of {options.starts} more scenes, '
        f'schedule of {options.steps} steps of 64. {options.scenes} scenes of each task (seed '
        f'{SCENE_SEED}; the demonstrations have '
        f'{SEED}), {options.max_chunks} answers an episode.'
    )
    yield table(
        ['policy', 'simulator', 'imagined', "estimator on the simulator's frames"],
        [
            [name, *(_share(found[judge]) for judge in ('simulator', 'imagined', 'seen'))]
            for name, found in rates.items()
        ],
    )
    yield '## Agreement with the simulator, over the policies'
    yield from _agreement(ranking, rates)
    yield '## Rollouts'
    results = [
        result
        for result in read_results(root / 'ranking')
        if result.policy in ranking['policies'] and result.index < options.scenes
    ]
    yield from _rollouts(results)
    yield '## Prediction-powered success rates'
    yield (
        f'The first {ranking["num_true_for_powered"]} true episodes of each policy, at most, and '
        'all imagined ones. An interval over so few true episodes is wide.'
    )
    yield table(
        ['policy', 'estimate', 'weight of imagination', 'all true ones'],
        [
            [name, _estimate(found['powered']), f'{found["powered"]["weight"]:.2f}', _share(
                found['rates']['all tasks']['simulator'])]
            for name, found in ranking['policies'].items()
        ],
    )  # fmt: skip
    yield _saved(results)
    yield '## Training'
    yield (
        'Explained: share of the variance of commands, in scenes kept from training, 1.2 s after '
        'the first frame (the grasp) and 1.6 s after later ones.'
    )
    header = ['checkpoint', 'steps of its run', 'CPU min', 'loss', 'explained, grasp']
    trained = [row for task in options.tasks.split(',') for row in _trained(root, task, options)]
    yield table([*header, 'explained, later'], trained)
    speed = [[name, f'{value:.2f}'] for name, value in ranking['speed'].items()]
    yield table(['speed of one process, wall', ''], speed)


def _agreement(ranking: dict[str, Any], rates: dict[str, Any]) -> Iterator[str]:
    rows = []
    for judge, said in (('imagined', 'imagination'), ('seen', "simulator's frames")):
        for task, scores in ranking['agreement'][judge].items():
            values = [_score(scores[name]) for name in ('pearson', 'mmrv')]
            chosen = [
                found['rates'][task]
                for found in ranking['policies'].values()
                if found['rates'].get(task, {}).get('simulator', {}).get('rate') is not None
            ]
            pairs = [(found['simulator']['rate'], found[judge]['rate']) for found in chosen]
            pairs = [pair for pair in pairs if None not in pair]
            apart = [(a, b) for a, b in combinations(pairs, 2) if abs(a[0] - b[0]) >= 0.25]
            right = sum((a[0] - b[0]) * (a[1] - b[1]) > 0 for a, b in apart)
            ranked = [said, task, *values, _rank_correlation(pairs), f'{right} of {len(apart)}']
            rows.append([*ranked, f'{len(pairs)}'])
    yield table(
        ['judged on', 'task', "Pearson's r", 'MMRV', "Spearman's rho",
         'pairs >= .25 apart ranked right', 'policies'], rows,
    )  # fmt: skip
    confusion = ranking['confusion']['imagined']
    yield (
        'As `mtv-world rank` gives them: value; without the noise of few scenes, with a 95 % '
        'interval. Rollouts, imagined / true: '
        + ', '.join(f'{key.replace("_", " / ")} {count}' for key, count in confusion.items())
        + f'; abstained {ranking["abstained"]["imagined"]["hits"]}; without a result '
        f'{len(ranking["failed"])}.'
    )


def _rollouts(results: Sequence[Result]) -> Iterator[str]:
    """What looking adds, when the two worlds part, and the rollouts that are judged worst."""

    def right(judged: str) -> str:
        said = [(getattr(result, judged).probability, result.final) for result in results]
        known = [(probability >= 0.5) == final for probability, final in said if probability >= 0]
        return f'{np.mean(known):.2f} of {len(known)}'

    yield (
        f'Right in how many of the {len(results)} rollouts that it judges: imagination '
        f"{right('imagined')}, the estimator on the simulator's frames {right('seen')}, the "
        f'no-picture rule {right("no_picture")}. That rule is given the commands of the simulated '
        'rollout, which these policies choose by what they see: before the robot moves nobody '
        'has more of them than the first answer, so the rule cannot be asked in the place of '
        'imagination.'
    )
    parts = [
        [course.commands_part_s, course.objects_part_s]
        for course in (result.course for result in results)
        if course is not None
    ]
    shares = [f'{np.isfinite(values).mean():.2f}' for values in np.transpose(parts)]
    medians = [
        f'{np.median(values[np.isfinite(values)]):.1f} s' if np.isfinite(values).any() else '-'
        for values in np.transpose(parts)
    ]
    yield (
        f'The commands of the two worlds part in {shares[0]} of the rollouts (median of those at '
        f'{medians[0]}), the objects in {shares[1]} (at {medians[1]}).'
    )
    judged = [found for found in results if np.isfinite(found.imagined.probability)]
    worst = sorted(judged, key=lambda found: -abs(found.imagined.probability - found.final))
    yield table(
        ['worst cases', 'scene', 'simulator', 'imagined', "simulator's frames", 'objects part'],
        [
            [
                found.policy, f'{found.task} {found.index}', str(int(found.final)),
                f'{found.imagined.probability:.2f}', f'{found.seen.probability:.2f}',
                '-' if found.course is None or not np.isfinite(found.course.objects_part_s)
                else f'{found.course.objects_part_s:.1f} s',
            ]
            for found in worst[:6]
        ],
    )  # fmt: skip


def _saved(results: Sequence[Result]) -> str:
    """How many real trials imagined ones stand for."""
    pairs: dict[str, list[tuple[float, float]]] = {}
    for result in results:
        if np.isfinite(result.imagined.probability):
            pair = (result.imagined.probability, float(result.final))
            pairs.setdefault(result.policy, []).append(pair)
    within = np.concatenate([np.array(found) - np.mean(found, 0) for found in pairs.values()])
    share = float(np.corrcoef(within.T)[0, 1] ** 2)
    return (
        f'Within a policy, the imagined probability explains {share:.2f} of the variance of the '
        f'true outcome (squared correlation, {len(within)} rollouts). With many imagined episodes '
        f'for each true one an interval as narrow therefore takes {share:.0%} fewer true trials.'
    )


def _score(found: dict[str, Any]) -> str:
    def shown(value: float | None) -> str:
        return '-' if value is None else f'{value:.3f}'

    low, high = map(shown, found['interval'])
    return f'{shown(found["value"])}; {shown(found["noise_free"])} [{low}, {high}]'


def _estimate(found: dict[str, Any]) -> str:
    low, high = found['interval']
    interval = '[n too small]' if low is None else f'[{low:.2f}, {high:.2f}]'
    return f'{found["value"]:.2f} {interval} of {found["num_true"]} + {found["num_more"]}'


def _rank_correlation(pairs: Sequence[tuple[float, float]]) -> str:
    if len(pairs) < 3 or any(len({pair[k] for pair in pairs}) < 2 for k in (0, 1)):
        return '-'
    found: Any = spearmanr([true for true, _ in pairs], [said for _, said in pairs])
    return f'{found.statistic:.3f}'


def _trained(root: Path, task: str, options: argparse.Namespace) -> Iterator[list[str]]:
    """What the cards of the checkpoints say."""
    for run in RUNS:
        for name, sixteenth in run.ranked:
            card = _checkpoint(root, task, run.name, _step(sixteenth, options)) / 'training.json'
            if card.exists():
                values: Mapping[str, float] = json.loads(card.read_text(encoding='utf-8'))
                shares = (f'{values[key]:.3f}' for key in ('grasp', 'later'))
                minutes = f'{values["cpu_s"] / 60:.1f}'
                steps, loss = f'{values["step"]}', f'{values["loss"]:.3f}'
                yield [f'{task}_{name}', steps, minutes, loss, *shares]


def _share(found: dict[str, Any]) -> str:
    if found['rate'] is None:
        return '-'
    low, high = found['interval']
    return f'{found["rate"]:.2f} [{low:.2f}, {high:.2f}] of {found["judged"]}'


def _dataset(root: Path, task: str) -> Path:
    return root / 'datasets' / f'{task}_expert'


def _starts(root: Path, task: str) -> Path:
    return root / 'datasets' / f'{task}_starts.npz'


def _samples(root: Path, task: str) -> Path:
    return root / 'samples' / f'{task}.npz'


def _step(sixteenths: int, options: argparse.Namespace) -> int:
    return options.steps * sixteenths // 16


def _checkpoint(root: Path, task: str, run: str, step: int) -> Path:
    return root / 'runs' / task / run / f'{step:06d}'


def _versions(options: argparse.Namespace) -> str:
    code = 'from importlib.metadata import version as v; print("lerobot", v("lerobot"))'
    done = subprocess.run([options.lerobot, '-c', code], capture_output=True, text=True)
    return done.stdout.strip() or 'lerobot unknown'


def _mtv_world(*words: str) -> None:
    _call([sys.executable, '-m', 'mtv_world_ros.cli', *words])


def _call(words: Sequence[str], log: Path | None = None) -> None:
    """Print a command and run it; end with its status where it fails."""
    print('$', shlex.join(map(str, words)), flush=True)
    environment = os.environ | {'HF_HUB_OFFLINE': '1'}
    if log is None:
        status = subprocess.run(words, env=environment).returncode
    else:
        with log.open('ab') as file:
            status = subprocess.run(words, env=environment, stdout=file, stderr=file).returncode
    if status:
        sys.exit(f'the command ended with {status}{f": {log}" if log else ""}')


if __name__ == '__main__':
    main()
