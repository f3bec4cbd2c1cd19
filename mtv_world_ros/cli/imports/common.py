"""Parts that the imports share: object masks and boxes, and the exit status."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_options
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.convert import ImportSummary
    from mtv_world_ros.importing.stored_objects import ObjectStage
    from mtv_world_ros.vision.segmenters.examples import ObjectExamples


def add_object_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of object masks and boxes to an import."""
    _add_masks(parser)
    _add_boxes(parser)


def _add_masks(parser: argparse.ArgumentParser) -> None:
    add_options(parser, 'describer')
    parser.add_argument(
        '--segmenter',
        metavar='NAME',
        help="store the objects' masks with the episodes: auto, colour, sam2, sam3 or "
        'module:Class of your own; default: none, or those recorded',
    )
    parser.add_argument('--device', default='cpu', help='PyTorch device of the segmenter')


def _add_boxes(parser: argparse.ArgumentParser) -> None:
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


def write_boxes_page(
    arguments: argparse.Namespace,
    found: Mapping[str, Any],
    read: Callable[[Any], Episode],
    names: Sequence[str],
) -> int:
    """Write the page on which boxes are drawn; nothing is imported."""
    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.importing.boxes_page import boxes_page

    if arguments.objects is not None:
        raise ConfigError('--click writes the page that makes the file for --objects; give one')
    write_whole(arguments.click, boxes_page(found, read, names))
    print(
        f'page: {arguments.click}\nopen it in a browser, draw, save, and give what it saves as '
        '--objects; nothing was imported'
    )
    return 0


def object_stage(
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


def import_status(summary: ImportSummary[Any], name: Callable[[Any], str]) -> int:
    """Print what came of an import, with the names of its recordings; return the exit status."""
    recordings: dict[str, list[str]] = {}  # by warning
    for one, lines in summary.warnings.items():
        for line in lines:
            recordings.setdefault(line, []).append(name(one))
    for line, names in recordings.items():
        print(f'{", ".join(names)}: {line}', file=sys.stderr)
    for note in summary.robot_notes:
        print(f'robot: {note}', file=sys.stderr)
    print(f'{len(summary.made)} made, {len(summary.kept)} kept, {len(summary.failed)} failed')
    failed: dict[str, list[str]] = {}  # by reason
    for one, reason in summary.failed.items():
        failed.setdefault(reason, []).append(name(one))
    for reason, names in failed.items():
        print(f'{", ".join(names)}: {reason}', file=sys.stderr)
    return 1 if summary.failed else 0
