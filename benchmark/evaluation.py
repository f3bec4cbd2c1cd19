"""How long does an evaluation take per episode, and what bounds it?

    mtv-world collect --task place_block_a2b_left,stack_blocks_two --episodes 4 --seed 9000 \
        --out data/speed
    python benchmark/evaluation.py data/speed [--out FOLDER]

Seconds per episode by stage, with the default options of `mtv-world evaluate`, then the same with
several workers: wall time, and whether every score is the same.
"""

from __future__ import annotations

import argparse
from datetime import date
from functools import partial
import os
from pathlib import Path
import statistics
import tempfile
import time

from page import in_turns, machine_line, made_line, table
import torch

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.data.splits import select
from mtv_world_ros.lab.evaluation.evaluate_episodes import evaluate, Parallel
from mtv_world_ros.lab.evaluation.report.evaluation_summary import Summary
from mtv_world_ros.lab.evaluation.settings import EvaluationConfig


def main() -> None:
    """Measures and prints a page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--checkpoint', default='bundled')
    parser.add_argument('--split', default='all')
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--repeats', type=int, default=2, help='turns of one process and several')
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    text = page(options)
    print(text)
    if options.out is not None:
        path = options.out / f'evaluation_{options.machine}_{date.today()}.md'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding='utf-8')
        print(f'written: {path}')


def page(options: argparse.Namespace) -> str:
    """Runs the evaluation with one process and with several; returns the page."""
    selection = select(options.dataset, options.split, options.episodes)
    load = partial(load_pipeline, options.checkpoint, device=options.device, num_threads=1)
    pipeline = load()
    with tempfile.TemporaryDirectory() as folder:
        made: dict[int, list[Summary]] = {1: [], options.workers: []}
        used: list[float] = []

        def run(workers: int) -> None:
            begun, config = time.process_time(), EvaluationConfig(seed=options.seed)
            parallel = Parallel(workers=workers, make_pipeline=load, threads=1)
            out = Path(folder) / f'{workers}_{len(made[workers])}'
            made[workers].append(
                evaluate(pipeline, selection.paths, out, config, parallel=parallel)
            )
            if workers == 1:
                used.append(time.process_time() - begun)

        works = {str(workers): partial(run, workers) for workers in made}
        spent = in_turns(works, options.repeats, warm_up=0)
    alone, shared = (statistics.median(spent[str(n)]) for n in (1, options.workers))
    one, many = made[1][0], made[options.workers][0]
    same = [r.rows for r in one.results] == [r.rows for r in many.results]
    count = len(one.results)
    spec = one.spec
    chunks = sum(len({row.stretch for row in result.rows}) for result in one.results)
    load_line = f'{machine_line()}, torch {torch.__version__}'
    size = f'{len(spec.views)} views x {spec.num_frames} frames of {spec.width}x{spec.height}'
    return f"""# Evaluation: time per episode, {date.today()}

`python benchmark/evaluation.py {options.dataset.name} --seed {options.seed}`,
machine `{options.machine}` ({load_line}),
checkpoint `{options.checkpoint}` on {options.device}, {selection}: n = {count} episodes
of {chunks / count:.1f} chunks each ({size}). Default options: 4 denoising
steps, true and shuffled actions, ceilings, segmenter `{pipeline.segmenter.name}`. One thread a
process.

{_stages(one, count, alone)}

With one process an episode takes {alone / count:.2f} s of wall time and
{statistics.median(used) / count:.2f} s of CPU time; medians of {options.repeats} turns.

{_workers(options.workers, count, alone, shared)}

Scores with {options.workers} workers {'are the same in every row' if same else 'DIFFER'}.

{made_line('evaluation', options.checkpoint)}
"""


def _stages(found: Summary, count: int, alone: float) -> str:
    seconds = found.metrics()['seconds_per_episode']
    rows = [
        [stage, f'{value:.3f}', f'{100 * value * count / alone:.0f} %']
        for stage, value in sorted(seconds.items(), key=lambda item: -item[1])
    ]
    rest = alone / count - sum(seconds.values())
    rows.append(
        ['all else (intervals, files)', f'{rest:.3f}', f'{100 * rest * count / alone:.0f} %']
    )
    return table(['stage', 'wall time per episode [s]', 'share'], rows)


def _workers(workers: int, count: int, alone: float, shared: float) -> str:
    rows = [
        [str(number), f'{wall:.1f}', f'{wall / count:.2f}']
        for number, wall in ((1, alone), (workers, shared))
    ]
    return table(
        ['workers', 'all episodes [s], start of the workers included', 'per episode [s]'], rows
    )


if __name__ == '__main__':
    main()
