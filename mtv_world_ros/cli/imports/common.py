"""Parts that the imports share: their parsers, and the way from recordings to episodes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import sys
import textwrap
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import segmenters
from mtv_world_ros.cli.shared_options import add_options
from mtv_world_ros.core.bounded_input import require_regular
from mtv_world_ros.core.errors import ConfigError

#: folder of the robot in OUT
ROBOT_FOLDER = 'robot'
#: width from which names of recordings are printed as a list [characters]
_LIST_WIDTH = 95
#: stands for a space at which a list is not wrapped
_NO_BREAK = '\N{NO-BREAK SPACE}'
#: wraps recordings in a progress bar
Progress = Callable[[Iterable[Any]], Iterable[Any]]
#: makes the stage that names and segments the objects of recordings
MakeStage = Callable[[], 'ObjectStage']

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import CommandParser, Commands
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.convert import ImportSummary
    from mtv_world_ros.importing.stored_objects import ObjectStage
    from mtv_world_ros.vision.segmenters.examples import ObjectExamples


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportJob:
    """An import, from its recordings to the lines about its episodes.

    Attributes:
        found: recordings by the names of their episodes.
        read: reads the frames of a recording, to draw and find objects in.
        objects: names of the objects, for the page on which boxes are drawn.
        convert: converts the recordings; gets what makes the stage that names and segments
            objects, and what wraps the recordings in a progress bar.
        unit: a recording in the progress bar.
        episode: returns the folder of a converted recording, in OUT.
        label: returns the name of a recording in messages.
        recording: returns the recording that an episode is a part of; None = it is a whole one.
    """

    found: Mapping[str, Any]
    read: Callable[[Any], Episode]
    objects: Sequence[str]
    convert: Callable[[MakeStage, Progress], ImportSummary[Any]]
    episode: Callable[[Any], str]
    label: Callable[[Any], str] = str
    recording: Callable[[Any], str] | None = None
    unit: str = 'episode'


def import_parser(
    commands: Commands, name: str, purpose: str, mapping: str, one: str
) -> CommandParser:
    """Return the parser of an import.

    Args:
        commands: commands of `mtv-world import`.
        name: word of the import after `mtv-world import`.
        purpose: sentence of the help: what the import does.
        mapping: sentences of the help about the mapping file.
        one: a recording, e.g. `a bag`.
    """
    return commands.add_parser(
        name,
        help=purpose,
        epilog=f'{mapping} Call it again to continue: finished episodes are kept. Exit status: 1 '
        f'if {one} failed.',
    )


def add_common_options(
    parser: CommandParser,
    run: Callable[[argparse.Namespace], int],
    *,
    calibration: str,
) -> None:
    """Add the options that all imports have, and the handler.

    Args:
        parser: parser of the import.
        run: runs the import and returns the exit status.
        calibration: help of `--calibration`.
    """
    parser.add_argument('--calibration', type=Path, help=calibration)
    parser.add_argument('--out', type=Path, required=True, help='folder of the episodes')
    parser.add_argument(
        '--split',
        metavar='TRAIN:TEST',
        help="shares of the recordings to train and to test on, or 'off'; OUT/dataset.json gets "
        'the names. Default: 75:25 where there are four recordings or more',
    )
    _add_masks(parser)
    _add_boxes(parser)
    parser.set_defaults(handler=run)


def run_import(arguments: argparse.Namespace, job: ImportJob) -> int:
    """Convert the recordings, or write the page of `--click`; return the exit status."""
    from mtv_world_ros.core.files import ROBOT_YAML
    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.importing.bags import summary_line
    from mtv_world_ros.importing.split import parse_split, write_split

    percent = None if arguments.split is None else parse_split(arguments.split)
    if arguments.click:
        return _write_boxes_page(arguments, job)
    summary = job.convert(
        lambda: _object_stage(arguments, job.found, job.read),
        lambda recordings: Progress(recordings, unit=job.unit),
    )
    has_objects = bool(arguments.segmenter or arguments.objects)
    for one in summary.made:
        print(summary_line(arguments.out / job.episode(one), objects=has_objects))
    status = _import_status(summary, job.label)
    recording = job.recording or job.episode
    there = [*summary.made, *summary.kept]
    split = write_split(
        arguments.out, {job.episode(one): recording(one) for one in there}, percent
    )
    if split:
        print(split)
    robot = arguments.out / ROBOT_FOLDER / ROBOT_YAML
    if robot.is_file():
        print(f'robot: {robot}')
    return status


def _add_masks(parser: CommandParser) -> None:
    add_options(parser, 'describer')
    parser.add_argument(
        '--segmenter',
        metavar='NAME',
        help=f"store the objects' masks with the episodes: {segmenters()}, or module:Class of "
        'your own; default: none, or those recorded',
    )
    parser.add_argument('--device', default='cpu', help='PyTorch device of the segmenter')


def _add_boxes(parser: CommandParser) -> None:
    parser.add_argument(
        '--objects',
        type=Path,
        metavar='FILE',
        help='boxes around objects in a few frames; their masks are stored with the episodes, and '
        'OUT/objects.safetensors, for --segmenter of other commands, with what was learnt',
    )
    parser.add_argument(
        '--click',
        type=Path,
        metavar='PAGE',
        help='only write an HTML page on which to draw these boxes; it saves the file for '
        '--objects',
    )


def _write_boxes_page(arguments: argparse.Namespace, job: ImportJob) -> int:
    """Write the page on which boxes are drawn; nothing is imported."""
    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.importing.boxes_page import boxes_page

    if arguments.objects is not None:
        raise ConfigError('--click writes the page that makes the file for --objects; give one')
    write_whole(arguments.click, boxes_page(job.found, job.read, job.objects))
    print(
        f'page: {arguments.click}\nopen it in a browser, draw, save, and give what it saves as '
        '--objects; nothing was imported'
    )
    return 0


def _object_stage(
    arguments: argparse.Namespace, found: Mapping[str, Any], read: Callable[[Any], Episode]
) -> ObjectStage:
    """Return the stage that names and segments objects, by boxes where there are any."""
    from mtv_world_ros.importing.object_boxes import learn_objects, load_object_boxes
    from mtv_world_ros.importing.stored_objects import ObjectStage
    from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter

    if arguments.objects is None:
        return _stage_without_boxes(arguments)
    if arguments.segmenter is not None or arguments.describer is not None:
        raise ConfigError(
            '--objects finds and names the objects; leave --segmenter and --describer out'
        )
    boxed = learn_objects(load_object_boxes(arguments.objects), found, read)
    if boxed.note:
        print(boxed.note, file=sys.stderr)
    file = arguments.out / 'objects.safetensors'
    _refuse_others(arguments.out, file, boxed.examples, found)
    boxed.examples.save(file)
    segmenter = ExampleSegmenter(boxed.examples)
    for name, stands_out in segmenter.stands_out.items():
        how = 'its colours' if stands_out else 'its picture: its colours are around it, too'
        print(f'object {name}: found by {how}')
    print(f'objects: {file}')
    require_regular(arguments.objects)
    return ObjectStage(segmenter=segmenter, boxed=boxed, key=arguments.objects.read_bytes())


def _refuse_others(
    out: Path, file: Path, examples: ObjectExamples, found: Mapping[str, Any]
) -> None:
    """Keep the examples that masks of the episodes in a folder were made by."""
    from mtv_world_ros.vision.segmenters.examples import ObjectExamples

    there = [name for name in found if (out / name).exists()]
    if file.is_file() and ObjectExamples.load(file).digest != examples.digest:
        raise ConfigError(
            f"'{file}' was learnt from other --objects, and found what is in the masks there; "
            'choose another --out'
        )
    if there and not file.is_file():
        raise ConfigError(
            f"'{out / there[0]}' was imported without --objects; `mtv-world import bag {out} "
            '--objects FILE --out NEW` gives such episodes masks, and keeps their cameras'
        )


def _stage_without_boxes(arguments: argparse.Namespace) -> ObjectStage:
    from mtv_world_ros.importing.stored_objects import ObjectStage, stage_key
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.vision.segmenters.choose import choose_segmenter

    segmenter = arguments.segmenter and choose_segmenter(
        arguments.segmenter, device=arguments.device
    )
    return ObjectStage(
        describer=asked_describer(arguments.describer),
        segmenter=segmenter or None,
        key=stage_key(arguments.describer, segmenter.name if segmenter else ''),
    )


def _import_status(summary: ImportSummary[Any], name: Callable[[Any], str]) -> int:
    """Print what came of an import, with the names of its recordings; return the exit status."""
    _print_each((name(one), line) for one, lines in summary.warnings.items() for line in lines)
    for note in summary.notes:
        print(note, file=sys.stderr)
    for note in summary.robot_notes:
        print(f'robot: {note}', file=sys.stderr)
    print(f'{len(summary.made)} made, {len(summary.kept)} kept, {len(summary.failed)} failed')
    _print_each((name(one), reason) for one, reason in summary.failed.items())
    return 1 if summary.failed else 0


def _print_each(told: Iterable[tuple[str, str]]) -> None:
    """Print pairs of a recording and a text to standard error, each text once.

    Names of many recordings follow their text as a list.
    """
    recordings: dict[str, list[str]] = {}
    for name, text in told:
        recordings.setdefault(text, []).append(name)
    for text, names in recordings.items():
        listed = ', '.join(names)
        if len(listed) > _LIST_WIDTH:
            whole = [name.replace(' ', _NO_BREAK) for name in names]
            lines = textwrap.wrap(
                ', '.join(whole), _LIST_WIDTH, break_long_words=False, break_on_hyphens=False
            )
            text = '\n    '.join([text, *lines]).replace(_NO_BREAK, ' ')
            listed = f'{len(names)} recordings'
        print(f'{listed}: {text}', file=sys.stderr)
