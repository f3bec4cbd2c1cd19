"""Does a distilled student do in a few steps what its teacher does in many?

    python benchmark/distillation.py TRAIN HELD_OUT --work runs/distillation \
        --training-steps 2000 --batch-size 8 --device cuda --out benchmark/results

Distils `--checkpoint` into one student for each number of `--student-steps`, scores the teacher in
`--teacher-steps` and each student in its own number of steps on held-out episodes, every chunk
from its recorded start frame, and prints one table. The models are timed in turns. Running it
again goes on where it was stopped.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
import sys

from model_scores import add_options, cells, chunk_seconds, COLUMNS, overrides, run_of, score
from page import publish, table
import torch

from mtv_world_ros.assembly import assemble_segmenter, checkpoint_path, checkpoint_robot
from mtv_world_ros.lab.training.distillation import distill, DistillConfig


def student(steps: int, options: argparse.Namespace) -> Path:
    """Trains a student, or goes on; returns its checkpoint."""
    teacher = checkpoint_path(options.checkpoint)
    return distill(
        teacher,
        run_of(options, f'student{steps}', overrides(options)),
        DistillConfig(num_steps=steps, teacher_steps=options.path_steps),
        robot=checkpoint_robot(teacher),
        segmenter=assemble_segmenter('colour'),
    )


def row(
    title: str, checkpoint: str | Path, steps: int, seconds: float, options: argparse.Namespace
) -> list[str]:
    """A line of the table."""
    summary = score(
        checkpoint, options.work / 'scores' / title.replace(' ', '_'), options,
        mode='observe', steps=steps,
    )  # fmt: skip
    return [title, str(steps), *cells(summary), f'{seconds:.3f}', str(len(summary.results))]


def main() -> None:
    """Trains, scores, prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_options(parser)
    parser.add_argument('--student-steps', default='1,4')
    parser.add_argument('--teacher-steps', default='1,4,8,32')
    parser.add_argument('--path-steps', type=int, default=32, help='that the student learns from')
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    students = {
        int(steps): student(int(steps), options) for steps in options.student_steps.split(',')
    }
    models: dict[str, tuple[str | Path, int]] = {
        f'teacher {steps}': (options.checkpoint, int(steps))
        for steps in options.teacher_steps.split(',')
    }
    models |= {f'student {steps}': (path, steps) for steps, path in students.items()}
    seconds = chunk_seconds(models, options)
    rows = [row(name, *model, seconds[name], options) for name, model in models.items()]
    options.repeats = int(rows[0][-1])
    publish(
        'distillation',
        'Few-step distillation',
        f'python {shlex.join(sys.argv)}',
        table(['model', 'steps', *COLUMNS, 'model [s a chunk]', 'episodes'], rows)
        + f'\n\nStudents: {options.training_steps} training steps of batch {options.batch_size} '
        f'along {options.path_steps}-step paths of the teacher. Brackets: 95 % t intervals over '
        'episodes.',
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    main()
