"""`mtv-world recover`, `import-bag`, `import-videos`, `import-dataset` and `export-dataset`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_options
from mtv_world_ros.core.errors import ConfigError, EpisodeError

if TYPE_CHECKING:
    from mtv_world_ros.data.bag_mapping import BagMapping
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.convert import ImportSummary
    from mtv_world_ros.importing.lerobot import EpisodeEntry
    from mtv_world_ros.importing.recover import Recovered
    from mtv_world_ros.importing.stored_objects import ObjectStage
    from mtv_world_ros.vision.segmenters.examples import ObjectExamples


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the commands."""
    _add_recover(commands)
    _add_import_bag(commands)
    _add_import_videos(commands)
    _add_import_dataset(commands)
    _add_export_dataset(commands)


def _add_recover(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'recover', help='make whole bags of recordings that were killed or cut off'
    )
    parser.add_argument(
        'bag',
        type=Path,
        help='a damaged bag, the name a recording would have had, or the folder it was made in '
        '(recordings in progress are hidden folders .NAME.*.tmp)',
    )
    parser.add_argument(
        '--out', type=Path, help='bag to make, e.g. on another disk; default: beside the damaged'
    )
    parser.set_defaults(handler=_recover)


def _recover(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.importing.recover import find_damaged, recover

    damaged, lost = find_damaged(arguments.bag), []
    for source in damaged:
        out = arguments.out
        if out is not None and len(damaged) > 1:
            out = out / source.name.strip('.')
        try:
            _print_recovered(recover(source, out))
        except EpisodeError as error:  # of this one; the others may hold something
            lost.append(str(error))
    if lost:
        raise EpisodeError('; '.join(lost))
    return 0


def _print_recovered(bag: Recovered) -> None:
    total = sum(bag.num_messages.values())
    print(f"recovered '{bag.path}': {total} messages over {bag.seconds:.1f} s")
    for topic, count in sorted(bag.num_messages.items()):
        print(f'  {topic} {count}')
    for line in bag.lost:
        print(f'  lost: {line}')
    print(f"  '{bag.source}' is as it was; delete it once you have looked at the new bag")


def _add_objects(parser: argparse.ArgumentParser) -> None:
    add_options(parser, 'describer')
    parser.add_argument(
        '--segmenter',
        choices=('auto', 'colour', 'sam2', 'sam3'),
        help="stores the objects' masks with the episodes; default: none, or those recorded",
    )
    parser.add_argument('--device', default='cpu', help='of the segmenter')


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


def _write_page(
    arguments: argparse.Namespace,
    found: Mapping[str, Any],
    read: Callable[[Any], Episode],
    names: Sequence[str],
) -> int:
    """Writes the page on which boxes are drawn; nothing is imported."""
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


def _boxed_stage(
    arguments: argparse.Namespace, found: Mapping[str, Any], read: Callable[[Any], Episode]
) -> ObjectStage:
    """What names and finds objects, by boxes where there are any."""
    from mtv_world_ros.importing.object_boxes import learn_objects, load_object_boxes
    from mtv_world_ros.importing.stored_objects import ObjectStage
    from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter

    if arguments.objects is None:
        return _object_stage(arguments)
    if arguments.segmenter is not None or arguments.describer is not None:
        raise ConfigError(
            '--objects finds and names the objects; leave --segmenter and --describer out'
        )
    boxed = learn_objects(load_object_boxes(arguments.objects), found, read)
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
    """Keeps the examples that masks of the episodes in a folder were made by."""
    from mtv_world_ros.vision.segmenters.examples import ObjectExamples

    there = [name for name in found if (out / name).exists()]
    if file.is_file() and ObjectExamples.load(file).digest != examples.digest:
        raise ConfigError(
            f"'{file}' was learnt from other --objects, and found what is in the masks there; "
            'choose another --out'
        )
    if there and not file.is_file():
        raise ConfigError(
            f"'{out / there[0]}' was imported without --objects; `mtv-world import-bag {out} "
            '--objects FILE --out NEW` gives such episodes masks, and keeps their cameras'
        )


def _object_stage(arguments: argparse.Namespace) -> ObjectStage:
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


def _add_import_bag(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'import-bag',
        help="convert a robot's own rosbag2 recordings into episodes",
        epilog='config/datasets/bag.yaml describes the mapping file; without one, views are all '
        'image topics. OUT also gets robot/ and mapping.yaml, which --topics takes elsewhere. '
        'Call it again to continue: finished episodes are kept. Exit status: 1 if a bag failed.',
    )
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='or folder of bags')
    parser.add_argument('--topics', type=Path, metavar='FILE', help='mapping: which topic is what')
    parser.add_argument(
        '--robot', help="YAML, or a bundled robot; default: the mapping's, or /robot_description"
    )
    parser.add_argument(
        '--action',
        metavar='TOPIC',
        help="of the commands, or 'state': the measured positions that follow; default: the "
        "mapping's, or joint_trajectory",
    )
    parser.add_argument('--calibration', type=Path, help="default: the bags' TF and CameraInfo")
    parser.add_argument('--out', type=Path, required=True)
    _add_objects(parser)
    _add_boxes(parser)
    parser.set_defaults(handler=_import_bag)


def _import_bag(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm
    import yaml

    from mtv_world_ros.core.files import ROBOT_YAML, write_whole
    from mtv_world_ros.data.bag_mapping import BagMapping, load_bag_mapping
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.importing.bags import (
        episode_name,
        find_bags,
        import_bags,
        summary_line,
        with_guessed_views,
    )

    mapping = BagMapping() if arguments.topics is None else load_bag_mapping(arguments.topics)
    if arguments.action:
        mapping = mapping.replace(action=arguments.action)
    bags = find_bags(arguments.bags)
    mapping = with_guessed_views(mapping, bags[0])

    def frames(bag: Path) -> Episode:
        return read_episode(bag, views=list(mapping.views), mapping=mapping, with_cameras=False)

    found = {episode_name(bag): bag for bag in bags}
    if arguments.click:
        return _write_page(arguments, found, frames, mapping.objects)
    robot = _robot_of_bags(arguments, mapping, bags[0])
    summary = import_bags(
        bags,
        arguments.out,
        mapping,
        robot,
        calibration=arguments.calibration,
        stage=_boxed_stage(arguments, found, frames),
        progress=lambda paths: tqdm(paths, unit='bag', disable=None),
    )
    values = mapping.replace(robot='robot/robot.yaml').model_dump(
        mode='json', exclude_defaults=True
    )
    write_whole(arguments.out / 'mapping.yaml', yaml.safe_dump(values, sort_keys=False))
    for view, row in mapping.views.items():
        print(f'view {view}: {mapping.topic(row.image)}')
    for part in summary.made:
        place = arguments.out / part.name
        print(summary_line(place, objects=bool(arguments.segmenter or arguments.objects)))
    status = _import_status(summary, str)
    print(f'robot: {arguments.out / "robot" / ROBOT_YAML}')
    return status


def _import_status(summary: ImportSummary[Any], name: Callable[[Any], str]) -> int:
    """Prints what came of an import, with the names of its recordings; returns the exit status."""
    recordings: dict[str, list[str]] = {}  # by warning
    for one, lines in summary.warnings.items():
        for line in lines:
            recordings.setdefault(line, []).append(name(one))
    for line, names in recordings.items():
        print(f'{", ".join(names)}: {line}', file=sys.stderr)
    for note in summary.robot_notes:
        print(f'robot: {note}', file=sys.stderr)
    print(f'{len(summary.made)} made, {len(summary.kept)} kept, {len(summary.failed)} failed')
    for one, reason in summary.failed.items():
        print(f'{name(one)}: {reason}', file=sys.stderr)
    return 1 if summary.failed else 0


def _robot_of_bags(arguments: argparse.Namespace, mapping: BagMapping, bag: Path) -> Path:
    """The robot's YAML; that of the first bag's `/robot_description` is written into OUT."""
    from mtv_world_ros.importing.bags import described_robot
    from mtv_world_ros.robot.file import robot_path

    name = arguments.robot or mapping.robot
    if name:
        return robot_path(name)
    folder = arguments.out / 'robot'
    if (folder / 'robot.yaml').is_file():  # confirmed or corrected since the last call
        return folder / 'robot.yaml'
    file, notes = described_robot(bag, mapping, folder)
    for note in notes:
        print(f'guessed: {note}')
    print(f'look at it with: mtv-world robot {file}')
    return file


def _add_import_videos(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'import-videos',
        help='convert video files with tables of joints or tool poses into episodes',
        epilog='config/datasets/videos.yaml describes the mapping file. Call it again to '
        'continue: finished episodes are kept. Exit status: 1 if one failed.',
    )
    parser.add_argument('folder', type=Path, help='of the files that the mapping names')
    parser.add_argument(
        '--mapping', type=Path, required=True, help='which file is which view, which column what'
    )
    parser.add_argument(
        '--calibration', type=Path, help='of the cameras; default: marked as not known'
    )
    parser.add_argument('--out', type=Path, required=True)
    _add_objects(parser)
    _add_boxes(parser)
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
        return _write_page(
            arguments, found, lambda one: read_recording(one, mapping), mapping.objects
        )
    summary = import_videos(
        arguments.folder,
        arguments.out,
        mapping,
        calibration=arguments.calibration,
        stage=_boxed_stage(arguments, found, lambda one: read_recording(one, mapping)),
        progress=lambda recordings: tqdm(recordings, unit='ep', disable=None),
    )
    for one in summary.made:
        looked = bool(arguments.segmenter or arguments.objects)
        print(summary_line(arguments.out / one.name, objects=looked))
    status = _import_status(summary, lambda one: one.name)
    print(f'robot: {arguments.out / "robot" / ROBOT_YAML}')
    return status


def _add_import_dataset(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'import-dataset',
        help='convert a LeRobot dataset (v2.0, v2.1, v3.0) into episodes',
        epilog='config/datasets/example.yaml describes the mapping file. Call it again to '
        'continue: finished episodes are kept. Exit status: 1 if an episode failed.',
    )
    parser.add_argument('dataset', type=Path, help='folder with meta/, data/ and videos/')
    parser.add_argument(
        '--mapping',
        type=Path,
        help='which feature is what; default: made of --robot and --calibration, for columns that '
        "are named like the robot's joints [rad or m]",
    )
    parser.add_argument('--robot', help='without --mapping: YAML, or a bundled robot')
    parser.add_argument(
        '--calibration', type=Path, help="without --mapping: of the cameras, by the views' names"
    )
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--episodes', help="numbers, comma-separated, e.g. '0,4,7'; default: all")
    _add_objects(parser)
    _add_boxes(parser)
    parser.set_defaults(handler=_import_dataset)


def _import_dataset(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.core.files import ROBOT_YAML
    from mtv_world_ros.importing.convert import episode_name, import_dataset, read_frames
    from mtv_world_ros.importing.lerobot import LeRobotDataset
    from mtv_world_ros.importing.mapping import load_mapping

    file = arguments.mapping or _guessed_mapping(arguments)
    source, mapping = LeRobotDataset(arguments.dataset), load_mapping(file)
    found = {episode_name(number): entry for number, entry in sorted(source.episodes.items())}

    def read(entry: EpisodeEntry) -> Episode:
        return read_frames(source, entry, mapping)

    if arguments.click:
        return _write_page(arguments, found, read, mapping.objects)
    summary = import_dataset(
        arguments.dataset,
        file,
        arguments.out,
        episodes=_numbers(arguments.episodes),
        stage=_boxed_stage(arguments, found, read),
        progress=lambda numbers: tqdm(numbers, unit='ep', disable=None),
    )
    status = _import_status(summary, 'episode {}'.format)
    if summary.made or summary.kept:
        print(f'robot: {arguments.out / "robot" / ROBOT_YAML}')
    return status


def _guessed_mapping(arguments: argparse.Namespace) -> Path:
    """Writes OUT/mapping.yaml for columns and views that are named like joints and cameras."""
    import yaml

    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.importing.lerobot import LeRobotDataset
    from mtv_world_ros.importing.mapping import guess_mapping

    if arguments.robot is None or arguments.calibration is None:
        raise ConfigError(
            'give --mapping (config/datasets/example.yaml has all keys), or --robot and '
            "--calibration where the columns are named like the robot's joints"
        )
    values, left_out = guess_mapping(
        LeRobotDataset(arguments.dataset), arguments.robot, arguments.calibration
    )
    file = arguments.out / 'mapping.yaml'
    write_whole(file, yaml.safe_dump(values, sort_keys=False))
    print(f'mapping: {file}')
    if left_out:
        print(f"left out, not in '{arguments.calibration}': {', '.join(left_out)}")
    return file


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(',')]
    except ValueError as error:
        raise ConfigError(f"--episodes is '{text}', must be numbers such as 0,4,7") from error


def _add_export_dataset(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'export-dataset',
        help='write episodes as a LeRobot dataset (v3.0)',
        epilog='OUT/meta/mapping.yaml is the mapping with which import-dataset reads it back.',
    )
    parser.add_argument(
        'episodes', type=Path, nargs='+', help='folder of episodes, or one episode'
    )
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--fps', type=int, default=10, help='rows a second')
    parser.add_argument(
        '--size', default='', metavar='WxH', help='of the images [px]; default: as recorded'
    )
    parser.add_argument(
        '--images',
        action='store_true',
        help='PNG images in the tables in place of MP4: lossless, no video decoder is needed',
    )
    parser.add_argument(
        '--robot', default='yam_bimanual', help="a bundled robot's name, or a robot's YAML"
    )
    parser.set_defaults(handler=_export)


def _export(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.core.files import bundled
    from mtv_world_ros.data.episode_reader import list_episodes
    from mtv_world_ros.importing.lerobot_writer import export_dataset, MAPPING
    from mtv_world_ros.robot.file import load_robot

    if arguments.fps < 1:
        raise ConfigError(f'--fps is {arguments.fps}; it must be at least 1')
    path = bundled('robots', arguments.robot, '--robot')
    named = arguments.robot if path.parent.name == arguments.robot else str(path.resolve())
    count = export_dataset(
        [path for folder in arguments.episodes for path in list_episodes(folder)],
        arguments.out,
        load_robot(path),
        named,
        arguments.fps,
        progress=lambda paths: tqdm(paths, unit='ep', disable=None),
        size=_size(arguments.size),
        as_videos=not arguments.images,
    )
    print(f'{count} episodes; mapping: {arguments.out / MAPPING}')
    return 0


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    width, _, height = text.partition('x')
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError(f"--size is '{text}'; it must be WIDTHxHEIGHT in pixels, e.g. 96x72")
    return int(width), int(height)
