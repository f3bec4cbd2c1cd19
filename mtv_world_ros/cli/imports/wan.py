"""`mtv-world import wan`."""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import presets
from mtv_world_ros.core.errors import CheckpointError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.model.wan_weights import PartReport

#: of the paper, Implementation Details
PROMPT = 'The robotic arm picks up objects from the table and places them'
#: parts that may lie outside PATH
_ELSEWHERE = ('autoencoder', 'text_encoder', 'image_encoder', 'tokenizer')


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'wan',
        help='convert public Wan 2.1 weights into a checkpoint',
        description='Make a checkpoint of Wan2.1-Fun-V1.1-Control: every tensor is loaded, new '
        'and zero, or an error.',
    )
    parser.add_argument(
        'path', type=Path, help="folder in VideoX-Fun's or diffusers' layout, or transformer file"
    )
    parser.add_argument('--out', type=Path, required=True, help='the new checkpoint folder')
    parser.add_argument('--preset', default='wan-1.3b', help=f'training preset: {presets()}')
    parser.add_argument(
        '--prompt', default=PROMPT, help="the instruction; default: the paper's for all tasks"
    )
    for part in _ELSEWHERE:
        option = '--' + part.replace('_', '-')
        parser.add_argument(option, type=Path, help='file or folder; default: in PATH')
    parser.set_defaults(handler=_import_weights)


def _import_weights(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.training.training_config import load_training_config

    if not arguments.path.exists():
        raise CheckpointError(
            f"'{arguments.path}' does not exist; name a checkpoint's folder or file"
        )
    config = load_training_config(arguments.preset)
    from mtv_world_ros.model.wan_weights import import_weights

    robot = load_robot(robot_path(config.video.robot))
    config = config.replace(video=config.video.replace(robot=robot.name))

    text = {
        'prompt': arguments.prompt,
        'negative_prompt': config.sampling.negative_prompt,
        'guidance_scale': config.sampling.guidance_scale,
    }
    reports = import_weights(
        arguments.path,
        arguments.out,
        transformer=config.transformer,
        autoencoder=config.autoencoder,
        scheduler=config.scheduler,
        card=config.card({'imported_from': str(arguments.path)}, **text),
        robot=robot.file,
        elsewhere={part: getattr(arguments, part) for part in _ELSEWHERE},
    )
    for report in reports:
        print(_line(report))
    preset, out = shlex.quote(arguments.preset), shlex.quote(str(arguments.out))
    print(
        f'checkpoint: {out}\ntrain it with: mtv-world train DATASET --preset {preset} '
        f'--init {out} --out DIR'
    )
    return 0


def _line(report: PartReport) -> str:
    """Return the summary of the tensors of a part, as text lines."""
    size = f'{report.loaded} tensors, {report.parameters / 1e6:.1f} M parameters'
    lines = [f'{report.part}: {size} ({", ".join(report.dtypes)}) from {report.source}']
    lines += [f'  new, zero: {name}' for name in report.new]
    reasons: dict[str, int] = {}
    for reason in report.unused.values():
        reasons[reason] = reasons.get(reason, 0) + 1
    lines += [f'  left out: {count} ({reason})' for reason, count in reasons.items()]
    return '\n'.join(lines)
