"""`mtv-world import-weights`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mtv_world_ros.model.wan_import.import_weights import PartReport

#: of the paper, Implementation Details
PROMPT = 'The robotic arm picks up objects from the table and places them'
#: parts that may lie outside PATH
_ELSEWHERE = ('autoencoder', 'text_encoder', 'image_encoder', 'tokenizer')


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'import-weights',
        help='convert public Wan 2.1 weights into a checkpoint',
        description='Makes a checkpoint of Wan2.1-Fun-V1.1-Control: every tensor is loaded, new '
        'and zero, or an error.',
    )
    parser.add_argument(
        'path', type=Path, help="folder in VideoX-Fun's or diffusers' layout, or transformer file"
    )
    parser.add_argument('--out', type=Path, required=True, help='the new checkpoint folder')
    parser.add_argument('--preset', default='wan-1.3b', help='name or YAML file')
    parser.add_argument(
        '--prompt', default=PROMPT, help="the instruction; default: the paper's for all tasks"
    )
    parser.add_argument('--guidance-scale', type=float, default=1.0, help='1 = none')
    parser.add_argument('--negative-prompt', default='', help='negative prompt of guidance')
    for part in _ELSEWHERE:
        option = '--' + part.replace('_', '-')
        parser.add_argument(option, type=Path, help='file or folder; default: in PATH')
    parser.set_defaults(handler=_import_weights)


def _import_weights(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import robot_path
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.training.config import HistoryConfig, load_training_config

    # public weights were trained without history frames
    config = load_training_config(arguments.preset).replace(history=HistoryConfig())
    from mtv_world_ros.model.wan_import.import_weights import import_weights

    robot = load_robot(robot_path(config.video.robot))
    config = config.replace(video=config.video.replace(robot=robot.name))

    text = {
        'prompt': arguments.prompt,
        'negative_prompt': arguments.negative_prompt,
        'guidance_scale': arguments.guidance_scale,
    }
    reports = import_weights(
        arguments.path,
        arguments.out,
        transformer=config.transformer,
        autoencoder=config.autoencoder,
        scheduler=config.scheduler,
        card={**config.card({'imported_from': str(arguments.path)}), **text},
        robot=robot.file,
        elsewhere={part: getattr(arguments, part) for part in _ELSEWHERE},
    )
    for report in reports:
        print(_line(report))
    print(f'checkpoint: {arguments.out}')
    return 0


def _line(report: PartReport) -> str:
    """Summary of the tensors of a part, as text lines."""
    size = f'{report.loaded} tensors, {report.parameters / 1e6:.1f} M parameters'
    lines = [f'{report.part}: {size} ({", ".join(report.dtypes)}) from {report.source}']
    lines += [f'  new, zero: {name}' for name in report.new]
    reasons: dict[str, int] = {}
    for reason in report.unused.values():
        reasons[reason] = reasons.get(reason, 0) + 1
    lines += [f'  left out: {count} ({reason})' for reason, count in reasons.items()]
    return '\n'.join(lines)
