"""Does imagination rank learned policies as the simulator does?

    python benchmark/learned_policies.py --lerobot ENV/bin/python [--data out/learned]
        [--tasks shake_bottle,place_cup_plate,place_bread_plate] [--demos 200] [--steps 4000]
        [--scenes 20] [--workers 1] [--until rank] [--checkpoint bundled]
        [--out benchmark/results]

From an empty folder to a ranking: collects demonstrations of every task, exports them as LeRobot
datasets, trains LeRobot's own ACT by its own command line in an environment of its own
(requirements/lerobot.txt), and ranks the checkpoints, served by LeRobot's own policy server, with
`mtv-world rank`. Every command is printed before it runs. The same command goes on where it was
stopped; what exists is not made again, so checkpoints can be ranked while others are missing.

Every task gets six policies that differ: early, mid and late checkpoints of one run, a tenth of
the demonstrations, one camera, and demonstrations whose grippers close late.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys
from typing import Any

from page import parse_arguments, publish, table
import yaml

#: one arm moves one object, which its shape tells: ACT reads no instruction
TASKS = 'shake_bottle,place_cup_plate,place_bread_plate'
STAGES = ('collect', 'export', 'train', 'rank')
#: of the demonstrations; the ranking has scenes of its own
SEED, SCENE_SEED = 41000, 51000
FPS, WIDTH, HEIGHT = 5, 96, 72
#: actions of an answer: as long as a chunk of the bundled world model, 3.2 s
CHUNK = 16
#: training steps between two saved checkpoints, as a share of a run
SAVED = 8
#: stands for the demonstrations of the expert, and of one whose grippers close late [s]
EXPERT, LATE = 'expert', 'expert-late-0.6'

#: arguments of LeRobot's trainer
TRAINING = {
    'policy.type': 'act',
    'policy.device': 'cpu',
    'policy.push_to_hub': 'false',
    'policy.pretrained_backbone_weights': 'null',  # nothing is downloaded
    'policy.chunk_size': CHUNK,
    'policy.n_action_steps': CHUNK,
    'policy.dim_model': 128,
    'policy.n_heads': 4,
    'policy.dim_feedforward': 512,
    'policy.n_encoder_layers': 2,
    'policy.use_vae': 'false',  # the expert does the same in the same scene
    'batch_size': 16,
    'num_workers': 0,
    'eval_freq': 0,
    'wandb.enable': 'false',
    'use_policy_training_preset': 'false',
    'optimizer.type': 'adamw',
    'optimizer.lr': 3e-4,
    'optimizer.weight_decay': 1e-4,
    'optimizer.grad_clip_norm': 1.0,
    'scheduler.type': 'cosine_decay_with_warmup',
    'scheduler.num_warmup_steps': 100,
    'scheduler.peak_lr': 3e-4,
    'scheduler.decay_lr': 1e-5,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One training run of a task.

    Attributes:
        name: of its folder.
        demos: `EXPERT` or `LATE`.
        demo_share: one of this many demonstrations is used.
        step_share: one of this many of --steps is trained.
        views: that the policy sees.
        ranked: name of a policy -> which eighth of the run it is.
    """

    name: str
    demos: str = EXPERT
    demo_share: int = 1
    step_share: int = 2
    views: tuple[str, ...] = ('low', 'high')
    ranked: tuple[tuple[str, int], ...]


RUNS = (
    Run(name='full', step_share=1, ranked=(('early', 1), ('mid', 4), ('late', 8))),
    Run(name='tenth', demo_share=10, ranked=(('tenth', 8),)),
    Run(name='one_camera', views=('high',), ranked=(('one_camera', 8),)),
    Run(name='late_gripper', demos=LATE, ranked=(('late_gripper', 8),)),
)


def main() -> None:
    """Runs what is missing, up to the stage that is asked for."""
    options = parse_arguments(__doc__, repeats=20, more=_add)
    root, tasks = options.data.resolve(), options.tasks.split(',')
    stages = STAGES[: STAGES.index(options.until) + 1]
    for task in tasks:
        for run in RUNS:
            if run.name not in options.runs.split(','):
                continue
            for stage in stages:
                if stage != 'rank':
                    _STAGES[stage](root, task, run, options)
    if options.until == 'rank':
        _rank(root, tasks, options)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--lerobot', required=True, help="Python of LeRobot's environment")
    parser.add_argument('--data', type=Path, default=Path('out/learned'))
    parser.add_argument('--tasks', default=TASKS)
    parser.add_argument('--runs', default=','.join(run.name for run in RUNS))
    parser.add_argument('--demos', type=int, default=200, help='demonstrations of each task')
    parser.add_argument('--steps', type=int, default=4000, help='training steps of the full run')
    parser.add_argument('--scenes', type=int, default=20, help='of each task, for the ranking')
    parser.add_argument('--max-chunks', type=int, default=3, help='answers of a policy at most')
    parser.add_argument('--workers', type=int, default=1, help='of the ranking; .6 GB a policy')
    parser.add_argument('--until', choices=STAGES, default='rank')
    parser.add_argument('--checkpoint', default='bundled', help='the world model')


def _collect(root: Path, task: str, run: Run, options: argparse.Namespace) -> None:
    kind = ['--failures-of-ten', '0'] if run.demos == EXPERT else ['--policies', run.demos]
    out = _episodes(root, task, run)
    if _dataset(root, task, run).exists():
        return
    size = ['--episodes', str(options.demos), '--fps', str(FPS), '--seed', str(SEED)]
    _mtv_world('collect', '--task', task, *size, *kind, '--out', str(out))


def _export(root: Path, task: str, run: Run, options: argparse.Namespace) -> None:
    out = _dataset(root, task, run)
    if not out.exists():
        kind = ['--fps', str(FPS), '--size', f'{WIDTH}x{HEIGHT}', '--images']
        _mtv_world('export-dataset', str(_episodes(root, task, run)), '--out', str(out), *kind)


def _train(root: Path, task: str, run: Run, options: argparse.Namespace) -> None:
    """Trains to the end; begins at the last saved checkpoint, if there is one."""
    out, steps = _run(root, task, run), options.steps // run.step_share
    if _checkpoint(out, steps).exists():
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    last = out / 'checkpoints/last/pretrained_model/train_config.json'
    if last.exists():
        arguments: dict[str, Any] = {'config_path': last, 'resume': 'true', 'steps': steps}
    else:
        shutil.rmtree(out, ignore_errors=True)
        card = (_dataset(root, task, run) / 'meta/info.json').read_text(encoding='utf-8')
        count = json.loads(card)['total_episodes'] // run.demo_share
        arguments = {
            'dataset.repo_id': f'local/{task}',
            'dataset.root': _dataset(root, task, run),
            'dataset.episodes': list(range(count)),
            'policy.input_features': json.dumps(_features(run)),
            **TRAINING,
            'scheduler.num_decay_steps': steps,
            'output_dir': out,
            'steps': steps,
            'save_freq': steps // SAVED,
            'log_freq': max(1, steps // 48),
            'seed': options.seed,
        }
    words = [f'--{key}={value}' for key, value in arguments.items()]
    log = root / f'runs/{task}_{run.name}.log'
    _call([options.lerobot, '-m', 'lerobot.scripts.lerobot_train', *words], log=log)


_STAGES = {'collect': _collect, 'export': _export, 'train': _train}


def _rank(root: Path, tasks: Sequence[str], options: argparse.Namespace) -> None:
    """Ranks task by task, so that the servers of one task alone are alive, then all together."""
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
            '--out', str(root / 'ranking'),
        )  # fmt: skip
    options.repeats = options.scenes
    ranking = json.loads((root / 'ranking/ranking.json').read_text(encoding='utf-8'))
    body = '\n\n'.join(_body(ranking, root, tasks, options))
    command = 'python benchmark/learned_policies.py --lerobot ENV/bin/python'
    publish('learned_policies', 'Learned policies', command, body, options, _versions(options))


def _policies(root: Path, task: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Entries of the list for `mtv-world rank`, of the checkpoints that exist."""
    serve = 'lerobot.async_inference.policy_server'
    for run in RUNS:
        steps = options.steps // run.step_share
        for name, eighth in run.ranked:
            path = _checkpoint(_run(root, task, run), steps * eighth // SAVED)
            if not path.exists():
                continue
            size = {'width': WIDTH, 'height': HEIGHT}
            yield {
                'name': f'{task}_{name}',
                'policy': 'act_exported',
                'change': {
                    'policy': {'path': str(path)},
                    'images': [{'key': view, 'view': view, **size} for view in run.views],
                },
                'command': [
                    options.lerobot, '-m', serve, '--host=127.0.0.1', '--port={port}',
                    '--inference_latency=0',
                ],
                'tasks': [task],
            }  # fmt: skip


def _body(
    ranking: dict[str, Any], root: Path, tasks: Sequence[str], options: argparse.Namespace
) -> Iterator[str]:
    """Parts of the page."""
    rates = {name: found['rates']['all tasks'] for name, found in ranking['policies'].items()}
    yield (
        f'ACT of LeRobot (ResNet-18 from scratch, {WIDTH} x {HEIGHT} px, {FPS} Hz, answers of '
        f'{CHUNK / FPS:g} s), {options.demos} demonstrations a task, {options.steps} steps of '
        f'{TRAINING["batch_size"]}; half of these for the runs other than `full`.'
    )
    yield table(
        ['policy', 'simulator', 'imagined', "estimator on the simulator's frames"],
        [
            [name, *(_share(found[judge]) for judge in ('simulator', 'imagined', 'seen'))]
            for name, found in rates.items()
        ],
    )
    scores = ranking['agreement']['imagined']['all tasks']
    known = [
        (found['simulator']['rate'], found['imagined']['rate'])
        for found in rates.values()
        if None not in (found['simulator']['rate'], found['imagined']['rate'])
    ]
    apart = [(a, b) for a, b in combinations(known, 2) if abs(a[0] - b[0]) >= 0.25]
    right = sum((a[0] - b[0]) * (a[1] - b[1]) > 0 for a, b in apart)
    yield '\n'.join(
        [
            *(f'- {name}: {found["value"]} {found["interval"]}' for name, found in scores.items()),
            f'- pairs whose true rates differ by >= .25, ranked right: {right} of {len(apart)}',
            f'- rollouts without a result: {len(ranking["failed"])}',
        ]
    )
    yield table(
        ['run', 'steps', 'last loss', 's a step, wall'],
        [row for task in tasks for run in RUNS for row in _trained(root, task, run)],
    )
    speed = [[name, f'{value:.2f}'] for name, value in ranking['speed'].items()]
    yield table(['speed of one process, wall', ''], speed)


def _trained(root: Path, task: str, run: Run) -> Iterator[list[str]]:
    """What the log of a run says of its last steps."""
    log = root / f'runs/{task}_{run.name}.log'
    if not log.exists():
        return
    text = log.read_text(encoding='utf-8', errors='replace')
    found = re.findall(r'step:(\S+) .*?loss:(\S+) .*?updt_s:(\S+) data_s:(\S+)', text)
    if found:
        steps, loss, update, loading = found[-1]
        yield [f'{task}_{run.name}', steps, loss, f'{float(update) + float(loading):.2f}']


def _share(found: dict[str, Any]) -> str:
    if found['rate'] is None:
        return '-'
    low, high = found['interval']
    return f'{found["rate"]:.2f} [{low:.2f}, {high:.2f}] of {found["judged"]}'


def _features(run: Run) -> dict[str, Any]:
    image = {'type': 'VISUAL', 'shape': [3, HEIGHT, WIDTH]}
    return {
        'observation.state': {'type': 'STATE', 'shape': [14]},
        **{f'observation.images.{view}': image for view in run.views},
    }


def _episodes(root: Path, task: str, run: Run) -> Path:
    return root / 'episodes' / f'{task}_{run.demos}'


def _dataset(root: Path, task: str, run: Run) -> Path:
    return root / 'datasets' / f'{task}_{run.demos}'


def _run(root: Path, task: str, run: Run) -> Path:
    return root / 'runs' / f'{task}_{run.name}'


def _checkpoint(run: Path, step: int) -> Path:
    return run / f'checkpoints/{step:06d}/pretrained_model'


def _versions(options: argparse.Namespace) -> str:
    code = 'from importlib.metadata import version as v; print("lerobot", v("lerobot"))'
    done = subprocess.run([options.lerobot, '-c', code], capture_output=True, text=True)
    return done.stdout.strip() or 'lerobot unknown'


def _mtv_world(*words: str) -> None:
    _call([sys.executable, '-m', 'mtv_world_ros.cli', *words])


def _call(words: Sequence[str], log: Path | None = None) -> None:
    """Prints a command and runs it; ends with its status where it fails."""
    print('$', shlex.join(map(str, words)), flush=True)
    # bfloat16 where the processor has it, as `accelerate launch --mixed_precision=bf16` sets it
    more = {'ACCELERATE_MIXED_PRECISION': 'bf16', 'HF_HUB_OFFLINE': '1'}
    environment = os.environ | more
    if log is None:
        status = subprocess.run(words, env=environment).returncode
    else:
        with log.open('ab') as file:
            status = subprocess.run(words, env=environment, stdout=file, stderr=file).returncode
    if status:
        sys.exit(f'the command ended with {status}{f": {log}" if log else ""}')


if __name__ == '__main__':
    main()
