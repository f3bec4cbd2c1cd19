"""`mtv-world imagine --image FILES --joints TABLE`: a picture and a table of joints to a video."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import names, open_checkpoints, pipeline_of
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import CommandParser
    from mtv_world_ros.core.data_types import ByteArray

#: video where `--out` names none
DEFAULT_OUT = Path('out/imagined.mp4')


def add_options_of_tables(parser: CommandParser) -> None:
    """Add the options for a start that is no recording."""
    parser.add_argument(
        '--image',
        type=names,
        metavar='FILES',
        help='images of the views to start from, comma-separated: VIEW=FILE, or files in order of '
        "the checkpoint's views; with --joints, --out is an MP4",
    )
    parser.add_argument(
        '--joints',
        type=Path,
        metavar='TABLE',
        help='CSV or JSON with a column for each joint, and time [s] if it has any, else a row is '
        'a frame; its first row is where the robot stands, the others are commanded',
    )
    parser.add_argument(
        '--calibration',
        type=Path,
        metavar='FILE',
        help="calibration of the cameras of --image; default: the checkpoint's",
    )


def is_asked_for(arguments: argparse.Namespace) -> bool:
    """Return whether a table is to be imagined.

    Raises:
        ConfigError: images without a table, or the other way round, or with recordings.
    """
    given = [bool(arguments.image), arguments.joints is not None]
    if any(given) and (not all(given) or arguments.episodes or arguments.live):
        raise ConfigError(
            '--image and --joints go together, and without --episodes and --live, e.g. '
            'mtv-world imagine --image low.png,high.png --joints plan.csv --out imagined.mp4'
        )
    return all(given)


def imagine_table(arguments: argparse.Namespace) -> int:
    """Imagine a table of joints from still images, and write an MP4."""
    from mtv_world_ros.core.estimate_words import estimate_lines
    from mtv_world_ros.core.images import read_rgb
    from mtv_world_ros.importing.number_tables import read_table
    from mtv_world_ros.rollout.table_start import read_view_cameras, table_start, view_images

    (checkpoint,) = open_checkpoints(arguments.device, arguments.checkpoint)
    arguments.checkpoint, spec = checkpoint, checkpoint.spec
    is_default = arguments.out.suffix != '.mp4'
    out = DEFAULT_OUT if is_default else arguments.out
    check_free(out, arguments.overwrite)
    files = _by_view(arguments.image, spec.views)
    frames = view_images(spec, {view: read_rgb(file) for view, file in files.items()})
    table = read_table(arguments.joints, ())
    robot = checkpoint.load_robot(arguments.robot)
    wanted = [index for index, name in enumerate(table.names) if name]
    table.check_numbers(wanted)
    cameras = read_view_cameras(spec, arguments.calibration or checkpoint.cameras_file)
    start, commands = table_start(robot, spec, frames, cameras, table.names, table.values)

    from dataclasses import replace

    import numpy as np

    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.rollout.options import RolloutOptions
    from mtv_world_ros.viewing.video import write_video

    pipeline = replace(pipeline_of(arguments), describer=asked_describer(arguments.describer))
    rollout = pipeline.begin(
        replace(start, place=arguments.place or ''),
        RolloutOptions(
            instruction=arguments.instruction,
            seed=arguments.seed,
            num_inference_steps=arguments.steps,
        ),
    )
    chunks = list(rollout.extend(commands))
    imagined = np.concatenate([chunk.video.frames for chunk in chunks], axis=1)
    write_video(out, _row(imagined), spec.fps)
    print(f'{imagined.shape[1]} frames of {", ".join(spec.views)} at {spec.fps:g} Hz')
    print(
        *estimate_lines(
            'success after each chunk',
            [chunk.success.probability for chunk in chunks],
            [chunk.success.reasons for chunk in chunks],
        ),
        sep='\n',
    )
    print(f'written: {out}')
    return 0


def _by_view(given: Sequence[str], views: Sequence[str]) -> Mapping[str, Path]:
    """Return the image file of each view."""
    pairs = [text.partition('=') for text in given]
    if all(mark for _, mark, _ in pairs):
        return {view: Path(file) for view, _, file in pairs}
    if len(given) != len(views):
        raise ConfigError(
            f'--image has {len(given)} files; the checkpoint has {len(views)} views: '
            f'{", ".join(views)}; give a file for each, in this order'
        )
    return dict(zip(views, map(Path, given), strict=True))


def _row(frames: ByteArray) -> ByteArray:
    """Return the views (V, T, H, W, 3) side by side, of even size."""
    import numpy as np

    row = np.concatenate(list(frames), axis=2)
    return row[:, : row.shape[1] // 2 * 2, : row.shape[2] // 2 * 2]
