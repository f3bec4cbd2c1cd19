"""`mtv-world import videos`: video files with tables of joints or tool poses become episodes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.imports.common import (
    add_common_options,
    import_parser,
    ImportJob,
    MakeStage,
    Progress,
    run_import,
)

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.importing.convert import ImportSummary


def add(commands: Commands) -> None:
    """Add the command."""
    parser = import_parser(
        commands,
        'videos',
        'convert video files with tables of joints or tool poses into episodes',
        'config/datasets/videos.yaml describes the mapping file.',
        'one',
    )
    parser.add_argument('folder', type=Path, help='folder of the files that the mapping names')
    parser.add_argument(
        '--mapping', type=Path, required=True, help='which file is which view, which column what'
    )
    add_common_options(
        parser,
        _import_videos,
        calibration='calibration of the cameras, also of camera_calibration, OpenCV, kalibr, '
        'easy_handeye or MoveIt, or a folder of such files; default: marked as not known',
    )


def _import_videos(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.importing.videos import (
        find_recordings,
        import_videos,
        load_video_mapping,
        read_recording,
    )

    mapping = load_video_mapping(arguments.mapping)

    def convert(stage: MakeStage, progress: Progress) -> ImportSummary:
        return import_videos(
            arguments.folder,
            arguments.out,
            mapping,
            calibration=arguments.calibration,
            stage=stage(),
            progress=progress,
        )

    job = ImportJob(
        found={one.name: one for one in find_recordings(arguments.folder, mapping)},
        read=lambda one: read_recording(one, mapping),
        objects=mapping.objects,
        convert=convert,
        episode=lambda one: one.name,
        label=lambda one: one.name,
    )
    return run_import(arguments, job)
