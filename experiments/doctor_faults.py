"""Which faults of a recording does `mtv-world check` find, and which right ones does it pass?

    python experiments/doctor_faults.py DATASET [DATASET ...] [--repeats 20] [--minutes 60]

Views of cameras that stand still are judged as they are and with one thing wrong at a time: the
camera turned about each axis, moved, with a scaled K or another view's calibration, or its clock
late or early. With --folders a recording is judged in a folder of others, as `doctor FOLDER` does:
as it is, and with one thing wrong with the recording itself. The episodes' own calibration is
taken to be right. The sign of each fault is drawn. Data sets take turns, a view or a recording
each; --minutes ends a run early, with the n it got to; --kept keeps what was judged for the next
run. --right-only judges views as they are alone, which takes a tenth of the time.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import json
from pathlib import Path
import re
import tempfile
import time
from typing import Any
from xml.etree import ElementTree
from zlib import crc32

import cv2
import numpy as np
from page import parse_arguments, publish, table
import yaml

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.cli.fits.several_cameras import recorded_robot
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.data.episode import Episode, Track
from mtv_world_ros.data.episode_reader import list_episodes, read_episode, read_info
from mtv_world_ros.inspection.folder import inspect_folder
from mtv_world_ros.inspection.inspect import Inspector, load_inspector
from mtv_world_ros.inspection.inspection_report import Inspection
from mtv_world_ros.inspection.places import background
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape, moving_links, RobotShape

#: (episode, view, sign) -> the same with something wrong
Fault = Callable[[Episode, str, float], Episode]


def turned(axis: int, degrees: float) -> Fault:
    """The camera turned about an axis of its own (0 right, 1 down, 2 ahead)."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        turn = np.eye(4)
        a, b = [k for k in range(3) if k != axis]
        angle = sign * np.radians(degrees)
        c, s = np.cos(angle), np.sin(angle)
        turn[[a, b, a, b], [a, b, b, a]] = c, c, -s, s
        camera = episode.cameras[view]
        return with_camera(episode, replace(camera, T_mount_camera=camera.T_mount_camera @ turn))

    return change


def moved(metres: float) -> Fault:
    """The camera moved sideways."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        camera = episode.cameras[view]
        T = camera.T_mount_camera.copy()
        T[:3, 3] += sign * metres * T[:3, 0]
        return with_camera(episode, replace(camera, T_mount_camera=T))

    return change


def zoomed(factor: float) -> Fault:
    """K for images of another size."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        camera = episode.cameras[view]
        by = factor**sign
        scale = np.diag([by, by, 1.0])
        return with_camera(episode, replace(camera, K=scale @ camera.K))

    return change


def swapped(episode: Episode, view: str, sign: float) -> Episode:
    """The next view's calibration."""
    del sign
    names = list(episode.views)
    other = episode.cameras[names[(names.index(view) + 1) % len(names)]]
    return with_camera(episode, replace(other, view=view))


def late(seconds: float) -> Fault:
    """The images' clock late against the joint states'."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        track = episode.images[view]
        stamps = track.stamps_ns + round(sign * seconds * 1e9)
        return replace(episode, images={**episode.images, view: track._replace(stamps_ns=stamps)})

    return change


def with_camera(episode: Episode, camera: CameraModel) -> Episode:
    """The episode with another camera of a view."""
    return replace(episode, cameras={**episode.cameras, camera.view: camera})


FAULTS: dict[str, Fault | None] = {
    'as it is': None,
    'rolled by 10 degrees': turned(2, 10),
    'rolled by 40 degrees': turned(2, 40),
    'turned sideways by 3 degrees': turned(1, 3),
    'tilted by 3 degrees': turned(0, 3),
    'moved by 5 cm': moved(0.05),
    'K scaled by 1.15 or its inverse': zoomed(1.15),
    'K scaled by 2 or 0.5': zoomed(2),
    'views swapped': swapped,
    'images 0.2 s late or early': late(0.2),
    'images 1 s late or early': late(1.0),
}


def with_states(episode: Episode, positions: FloatArray) -> Episode:
    """The episode with other joint states."""
    assert episode.joint_states is not None
    return replace(episode, joint_states=replace(episode.joint_states, positions=positions))


def in_degrees(episode: Episode, robot: RobotModel) -> Episode:
    """Joints in degrees."""
    assert episode.joint_states is not None
    return with_states(episode, np.degrees(episode.joint_states.positions))


def gripper_swapped(episode: Episode, robot: RobotModel) -> Episode:
    """Open and closed swapped, of all grippers."""
    assert episode.joint_states is not None
    names, positions = list(episode.joint_states.joint_names), episode.joint_states.positions
    positions = positions.copy()
    for tool in robot.tools:
        if tool.gripper_joint is not None:
            column = names.index(tool.gripper_joint)
            positions[:, column] = tool.gripper_open + tool.gripper_closed - positions[:, column]
    return with_states(episode, positions)


def with_images(episode: Episode, change: Callable[[Track], Track]) -> Episode:
    """The episode with other images of all views."""
    return replace(episode, images={v: change(track) for v, track in episode.images.items()})


def _pixels(track: Track) -> Any:
    return np.asarray(track.frames)


def shorter(track: Track) -> Track:
    """The first 60 %: what went on after that has joint states alone."""
    count = round(0.6 * len(track.stamps_ns))
    return Track(track.stamps_ns[:count], _pixels(track)[:count])


def frozen(track: Track) -> Track:
    """From a third on the same frame."""
    frames = np.array(track.frames)
    frames[len(frames) // 3 :] = frames[len(frames) // 3]
    return track._replace(frames=frames)


def sparse(track: Track) -> Track:
    """A frame a second."""
    step = max(1, round(1e9 / float(np.median(np.diff(track.stamps_ns)))))
    return Track(track.stamps_ns[::step], _pixels(track)[::step])


def flipped(track: Track) -> Track:
    """Mirrored frames."""
    return track._replace(frames=np.ascontiguousarray(_pixels(track)[:, :, ::-1]))


def without_arm(track: Track) -> Track:
    """What stays of the scene, with a camera's noise: the arm is elsewhere."""
    noise = np.random.default_rng(0).normal(0, 3, (len(track.stamps_ns), *track.frames[0].shape))
    frames = np.clip(background(track) + noise, 0, 255).astype(np.uint8)
    return track._replace(frames=frames)


def other_scene(episode: Episode, robot: RobotModel) -> Episode:
    """The views' images of each other, by name: other cameras than in the other episodes."""
    views = list(episode.views)
    images = {v: episode.images[views[n - 1]] for n, v in enumerate(views)}
    return replace(episode, images=images)


def of_images(change: Callable[[Track], Track]) -> RecordingFault:
    """A fault of all images."""
    return lambda episode, robot: with_images(episode, change)


#: (episode, robot) -> the same with something wrong
RecordingFault = Callable[[Episode, RobotModel], Episode]
#: a fault, and a word of the finding that names it
RECORDINGS: dict[str, tuple[RecordingFault | None, str]] = {
    'as it is': (None, ''),
    'joints in degrees': (in_degrees, 'outside its limits'),
    'gripper: open and closed swapped': (gripper_swapped, 'swapped'),
    'video ends at 60 % of the joint states': (of_images(shorter), 'after the last frame'),
    'frames frozen from a third on': (of_images(frozen), 'the same as the one before'),
    'a frame a second': (of_images(sparse), 'frames a second'),
    'mirrored images': (of_images(flipped), 'mirror'),
    'a view that never sees the arm': (of_images(without_arm), 'not move like the drawn robot'),
    "another view's images (mixed cameras)": (other_scene, 'shares no background'),
    'a URDF 10 % too long': (None, 'beside the moving pixels|not move like|fits the moving'),
}


class Remembering(Inspector):
    """An inspector that looks at each right episode once."""

    def __init__(self, robot: RobotModel, shape: RobotShape, right: Iterable[Episode]) -> None:
        super().__init__(robot, shape)
        self._right = [(episode, list[Inspection]()) for episode in right]

    def inspect(
        self, episode: Episode, progress: Callable[[Sequence[str]], Iterable[str]] = iter
    ) -> Inspection:
        """See `Inspector.inspect`."""
        for one, found in self._right:
            if one is episode:
                found[:] = found or [super().inspect(episode, progress)]
                return found[0]
        return super().inspect(episode, progress)

    def picture(self, episode: Episode, view: str) -> ByteArray:
        """None is looked at."""
        return np.zeros((2, 2, 3), np.uint8)


def longer(robot_file: Path, place: Path) -> RobotModel:
    """The same robot, with its joints 10 % farther apart."""
    values = yaml.safe_load(robot_file.read_text(encoding='utf-8'))
    urdf = robot_file.parent / values['urdf']
    tree = ElementTree.parse(urdf)
    for origin in tree.iterfind('joint/origin'):
        xyz = [1.1 * float(word) for word in origin.get('xyz', '0 0 0').split()]
        origin.set('xyz', ' '.join(map(str, xyz)))
    for mesh in tree.iterfind('.//mesh'):
        name = mesh.get('filename', '')
        if '://' not in name:
            mesh.set('filename', str((urdf.parent / name).resolve()))
    tree.write(place / 'longer.urdf')
    file = place / 'longer.yaml'
    file.write_text(yaml.safe_dump({**values, 'urdf': 'longer.urdf'}), encoding='utf-8')
    return load_robot(file)


class Kept:
    """Verdicts of cases, in a file or in memory.

    Args:
        file: of lines of JSON; None = they are kept in memory alone.
    """

    def __init__(self, file: Path | None) -> None:
        self._file, self.rows = file, []
        if file is not None and file.is_file():
            self.rows = [json.loads(line) for line in file.read_text().splitlines()]
        self._done = {tuple(row[:4]) for row in self.rows}

    def verdict(self, case: tuple[str, str, str, str], judge: Callable[[], list[str]]) -> None:
        """Judge a case (robot, episode, view, fault) unless it was judged."""
        if case in self._done:
            return
        row = [*case, *judge()]
        self.rows.append(row)
        if self._file is not None:
            with self._file.open('a', encoding='utf-8') as file:
                file.write(json.dumps(row) + '\n')
        print(row, flush=True)

    def counts(self, faults: Iterable[str]) -> dict[str, dict[str, Counter[str]]]:
        """Verdicts by robot and fault; of those named, `named` is counted, too."""
        found: dict[str, dict[str, Counter[str]]] = {}
        for robot, _, _, fault, *words in self.rows:
            if fault in (known := list(faults)):
                each = found.setdefault(robot, {name: Counter() for name in known})
                each[fault].update(words[:2])
        return found


def fixed_views(inspector: Inspector, path: Path, width: int) -> Episode:
    """Return an episode with the views that stand still, decoded and shrunk to a width [px]."""
    base = inspector.robot.base_link
    episode = read_episode(path, with_masks=False, robot=inspector.robot, unknown_mount=base)
    moving = moving_links(inspector.robot)
    views = tuple(
        view
        for view in episode.views
        if view not in episode.unknown and episode.cameras[view].mount_link not in moving
    )
    cameras = {v: episode.cameras[v] for v in views}
    small = {v: scaled(c, width, round(width * c.height / c.width)) for v, c in cameras.items()}
    images = {
        v: episode.images[v]._replace(
            frames=np.stack(
                [
                    cv2.resize(frame, (c.width, c.height), interpolation=cv2.INTER_AREA)
                    for frame in np.asarray(episode.images[v].frames)
                ]
            )
        )
        for v, c in small.items()
    }
    return replace(episode, views=views, images=images, cameras=small, unknown={})


def judge_views(dataset: Path, options: argparse.Namespace, kept: Kept) -> Iterator[None]:
    """Judge all faults of a view before each step."""
    paths = shuffled(dataset, options.seed)
    file = recorded_robot(paths[0], read_info(paths[0]).robot)
    inspector = load_inspector(file)
    faults = {name: f for name, f in FAULTS.items() if f is None or not options.right_only}
    left = options.repeats
    for path in paths:
        episode = fixed_views(inspector, path, options.width)
        for view in episode.views:
            for name, fault in faults.items():
                case = (inspector.robot.name, path.name, view, name)
                kept.verdict(case, lambda f=fault, at=(episode, view), case=case: _view(
                    inspector, f, *at, case, options.seed))  # fmt: skip
            yield
            left -= 1
            if not left:
                return


def _view(
    inspector: Inspector, fault: Fault | None, episode: Episode, view: str,
    case: tuple[str, ...], seed: int,
) -> list[str]:  # fmt: skip
    rng = np.random.default_rng([seed, crc32(' '.join(case).encode())])
    judged = fault(episode, view, float(rng.choice((-1.0, 1.0)))) if fault else episode
    section = inspector.inspect(replace(judged, views=(view,))).views[0]
    texts = [finding.text for finding in section.findings] if fault is None else []
    return [section.verdict, '', *texts]


def judge_folder(dataset: Path, options: argparse.Namespace, kept: Kept) -> Iterator[None]:
    """Judge all faults of a recording, in a folder with the others, before each step."""
    paths = shuffled(dataset, options.seed)[: options.repeats]
    file = recorded_robot(paths[0], read_info(paths[0]).robot)
    robot = load_robot(file)
    inspector = load_inspector(file)
    whole = {path: fixed_views(inspector, path, options.width) for path in paths}

    def seen(episode: Episode) -> Episode:
        return replace(episode, views=episode.views[: options.views])

    episodes = {path: seen(episode) for path, episode in whole.items()}
    inspector = Remembering(robot, load_shape(robot), episodes.values())
    with tempfile.TemporaryDirectory() as place:
        wrong = longer(file, Path(place))
        other = Remembering(wrong, load_shape(wrong), ())
    for path in paths:
        for name, (fault, word) in RECORDINGS.items():
            by = other if 'URDF' in name else inspector
            shown = {path: episodes[path]} if 'URDF' in name else dict(episodes)
            if fault is not None:
                shown[path] = seen(fault(whole[path], robot))
            kept.verdict(
                (robot.name, path.name, 'folder', name),
                lambda shown=shown, at=path, by=by, word=word: _in_folder(by, shown, at, word),
            )
        yield


def _in_folder(
    inspector: Inspector, episodes: Mapping[Path, Episode], path: Path, word: str
) -> list[str]:
    found, _ = inspect_folder(episodes, inspector, lambda one: episodes[one])
    if path.name in found.failed:
        return ['broken', 'named' if re.search(word, found.failed[path.name]) else '']
    inspection = found.episodes[path.name]
    texts = [
        f'{section.name}: {finding.text}'
        for section in inspection.sections
        for finding in section.findings
        if finding.verdict != 'not checked'
    ]
    named = bool(word) and any(re.search(word, text) for text in texts)
    return [inspection.verdict, 'named' if named else '', *([] if word else texts)]


def shuffled(dataset: Path, seed: int) -> list[Path]:
    """The episodes of a data set in an order that the seed draws."""
    paths = np.array(list_episodes(dataset), dtype=object)
    return list(np.random.default_rng(seed).permutation(paths))


def main() -> None:
    """Publish a row a fault and a column a robot."""

    def more(parser: argparse.ArgumentParser) -> None:
        parser.add_argument('datasets', type=Path, nargs='+')
        parser.add_argument('--width', type=int, default=384, help='of the images [px]')
        parser.add_argument('--minutes', type=float, default=1e9, help='stop starting after that')
        parser.add_argument('--right-only', action='store_true')

        parser.add_argument('--folders', action='store_true')
        parser.add_argument('--views', type=int, default=1, help='of each recording in a folder')
        parser.add_argument('--kept', type=Path, help='file of verdicts; is continued')

    options = parse_arguments(__doc__, 20, more)
    kept, ends = Kept(options.kept), time.monotonic() + 60 * options.minutes
    judge = judge_folder if options.folders else judge_views
    left = [judge(dataset, options, kept) for dataset in options.datasets]
    while left and time.monotonic() < ends:
        left = [one for one in left if next(one, 0) is None]
    found = kept.counts(RECORDINGS if options.folders else FAULTS)
    rows = [
        [name, *(_cell(name, counts[name]) for counts in found.values())]
        for name in next(iter(found.values()))
    ]
    if options.folders:
        said = (
            'Recordings as they are that passed (`ok` or `not checked`), and recordings with a '
            'fault that were found (`suspicious` or `broken`) and whose finding names it, each '
            'in a folder with the others.'
        )
        what = 'the recording'
    else:
        said = (
            'Views as they are that passed (`ok`), and views with a fault that were found '
            '(`suspicious` or `broken`); each sign of a fault is as likely.'
        )
        what = 'the view'
    body = f'{said} Images are {options.width} px wide.\n\n' + table(
        [what, *(f'`{name}`' for name in found)], rows
    )
    title = 'Which faults does the doctor find, and which right ones does it pass?'
    names = ' '.join(p.name for p in options.datasets)
    folders = ' --folders' if options.folders else ''
    publish('doctor_faults', title, f'python experiments/doctor_faults.py {names}{folders}', body,
            options, 'recorded or simulated episodes')  # fmt: skip


def _cell(name: str, verdicts: Counter[str]) -> str:
    count = sum(verdicts[one] for one in ('ok', 'not checked', 'suspicious', 'broken'))
    if name == 'as it is':
        return f'{verdicts["ok"] + verdicts["not checked"]} of {count} pass'
    found = verdicts['suspicious'] + verdicts['broken']
    named = f', {verdicts["named"]} named' if name in RECORDINGS else ''
    return f'{found} of {count}{named}'


if __name__ == '__main__':
    main()
