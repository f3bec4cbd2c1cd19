"""`mtv-world import videos`: video files with tables of joints or tool poses become episodes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.imports.common import (
    add_object_options,
    import_status,
    object_stage,
    write_boxes_page,
)

if TYPE_CHECKING:
    pass


def add(commands: argparse._SubParsersAction) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'videos',
        help='convert video files with tables of joints or tool poses into episodes',
        epilog='config/datasets/videos.yaml describes the mapping file. Call it again to '
        'continue: finished episodes are kept. Exit status: 1 if one failed.',
    )
    parser.add_argument('folder', type=Path, help='folder of the files that the mapping names')
    parser.add_argument(
        '--mapping', type=Path, required=True, help='which file is which view, which column what'
    )
    parser.add_argument(
        '--calibration', type=Path, help='calibration of the cameras; default: marked as not known'
    )
    parser.add_argument('--out', type=Path, required=True, help='folder of the episodes')
    add_object_options(parser)
    parser.set_defaults(handler=_import_videos)


def _import_videos(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.core.files import ROBOT_YAML
    from mtv_world_ros.importing.bags import summary_line
    from mtv_world_ros.importing.videos import (
        find_recordings,
        import_videos,
        load_video_mapping,
        read_recording,
    )

    mapping = load_video_mapping(arguments.mapping)
    found = {one.name: one for one in find_recordings(arguments.folder, mapping)}
    if arguments.click:
        return write_boxes_page(
            arguments, found, lambda one: read_recording(one, mapping), mapping.objects
        )
    summary = import_videos(
        arguments.folder,
        arguments.out,
        mapping,
        calibration=arguments.calibration,
        stage=object_stage(arguments, found, lambda one: read_recording(one, mapping)),
        progress=lambda recordings: tqdm(recordings, unit='ep', disable=None),
    )
    for one in summary.made:
        looked = bool(arguments.segmenter or arguments.objects)
        print(summary_line(arguments.out / one.name, objects=looked))
    status = import_status(summary, lambda one: one.name)
    print(f'robot: {arguments.out / "robot" / ROBOT_YAML}')
    return status
