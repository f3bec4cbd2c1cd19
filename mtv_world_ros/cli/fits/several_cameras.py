"""`mtv-world fit camera` of several recordings: moved cameras, focal length, points."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.core.data_types import CameraModel, FloatArray
    from mtv_world_ros.data.bag_mapping import EpisodeSource
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.inspection.cameras.shared_estimate import SharedEstimate
    from mtv_world_ros.robot.model import RobotModel
    from mtv_world_ros.robot.shape import LinkShape

#: recordings that confirm a place and are named at most
_MAX_NAMES = 3


def is_shared(arguments: argparse.Namespace) -> bool:
    """Return whether the options need the search over several recordings."""
    asked = arguments.points or arguments.focal == 'estimate' or arguments.apply
    asked = asked or arguments.click or len(arguments.views) > 1
    return bool(asked) or len(recordings(arguments.episodes)) > 1


def recordings(paths: Sequence[Path]) -> list[Path]:
    """Return recordings, and those in folders.

    Raises:
        ConfigError: there is none.
    """
    from mtv_world_ros.data.episode_reader import list_episodes

    found: list[Path] = []
    for path in paths:
        inside = (
            [] if (path / 'metadata.yaml').is_file() or path.is_file() else list_episodes(path)
        )
        found += inside or [path]
    if not found:
        raise ConfigError('name at least one recording')
    return found


def calibrate_shared(arguments: argparse.Namespace) -> int:
    """Run the command on all recordings."""
    from mtv_world_ros.inspection.cameras.seen_points import load_points
    from mtv_world_ros.robot.file import load_robot

    if arguments.mount_link or arguments.between:
        raise ConfigError('--mount-link and --between are for one recording')
    files = [path for path in recordings(arguments.episodes) if path.is_file()]
    if arguments.apply and files:
        raise ConfigError(
            f"--apply writes into folders of episodes, and '{files[0]}' is a file: import it "
            '(mtv-world import bag), or leave --apply out'
        )
    views = arguments.views
    episodes, file = _read_all(arguments)
    robot = load_robot(file)
    arms = [tool.arm for tool in robot.tools]
    given = arguments.points
    points = given and {view: load_points(given, view, arms) for view in views}
    if arguments.click:
        return _write_page(arguments, episodes, robot)
    if _has_all_poses(arguments, episodes):
        print(
            'the recordings have the poses of all views already, and nothing is estimated; '
            '--overwrite estimates them anew and replaces them'
        )
        return _apply(arguments, episodes, {})
    parts = known_shapes(robot)
    groups = [views] if arguments.same_focal else [[view] for view in views]
    status = 0
    for group in groups:
        found = _estimate(arguments, group, points, episodes, robot, parts)
        if arguments.apply:
            by_view = {one.cameras[0].view: one for one in found}
            status = max(status, _apply(arguments, episodes, by_view))
    return status


def _has_all_poses(arguments: argparse.Namespace, episodes: Sequence[Episode]) -> bool:
    """Return whether `--apply` has nothing to estimate, and nothing is asked for otherwise."""
    from mtv_world_ros.data.episode_cameras import calibrated_views

    asked = arguments.overwrite or arguments.points or arguments.focal or arguments.out
    if not arguments.apply or asked or arguments.calibration:
        return False
    wanted = set(arguments.views)
    return all(wanted <= calibrated_views(episode.info.path).keys() for episode in episodes)


def _write_page(
    arguments: argparse.Namespace, episodes: Sequence[Episode], robot: RobotModel
) -> int:
    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.inspection.cameras.finger_tips import num_tips
    from mtv_world_ros.inspection.cameras.points_page import points_page
    from mtv_world_ros.robot.shape import load_shape

    parts = load_shape(robot).parts
    tips = [num_tips(robot, parts, arm) for arm in range(len(robot.tools))]
    write_whole(arguments.click, points_page(episodes, arguments.views, robot, tips))
    print(
        f'page: {arguments.click}\nopen it in a browser, click, save, and give what it saves as '
        '--points'
    )
    return 0


def _estimate(
    arguments: argparse.Namespace,
    views: Sequence[str],
    points: dict[str, dict[str, list[FloatArray]]] | None,
    episodes: Sequence[Episode],
    robot: RobotModel,
    parts: Sequence[LinkShape],
) -> Sequence[SharedEstimate]:
    """Estimate views that share their focal length; print them and write their files."""
    from mtv_world_ros.inspection.cameras.shared_camera import estimate_shared

    unknown = [episode.unknown.get(view, '') for episode in episodes for view in views]
    if arguments.guess and any(unknown) and points is None:
        print('a pose is not known: searched from all sides; --points gives a start')
    known = arguments.focal == 'known' or (
        arguments.focal is None and not any('intrinsics' in what for what in unknown)
    )
    found = estimate_shared(
        episodes,
        views,
        robot,
        parts,
        guess=arguments.guess and not any(unknown) and points is None,
        points=points,
        focal_known=known,
        seed=arguments.seed,
    )
    for estimate in found:
        print(describe(estimate, episodes, focal_known=known))
        _write(arguments, estimate, episodes, robot, parts)
    return found


def recorded_robot(episode: Path, name: str) -> Path:
    """Return the YAML of the robot that an episode shows.

    Args:
        episode: folder of the episode; an imported data set has its robot in `../robot/`.
        name: name of the robot in the episode's metadata.

    Raises:
        ConfigError: there is no file of that name.
    """
    from mtv_world_ros.core.files import ROBOT_YAML
    from mtv_world_ros.model.card import ROBOT_FOLDER
    from mtv_world_ros.robot.file import load_robot, robot_path

    for folder in (episode, *list(episode.resolve().parents)[:2]):
        file = folder / ROBOT_FOLDER / ROBOT_YAML
        if file.is_file() and load_robot(file).name == name:
            return file
    if not name:
        raise ConfigError(f"'{episode}' does not say which robot it shows; name it with --robot")
    return robot_path(name)


def robot_file(arguments: argparse.Namespace, path: Path) -> tuple[Path, EpisodeSource]:
    """Return the robot's YAML (`--robot`, the mapping's, the episode's), and the source."""
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.data.episode_reader import read_info
    from mtv_world_ros.robot.file import robot_path

    source = load_source(arguments.topics, arguments.calibration)
    name = arguments.robot or (source.mapping.robot if source.mapping else '')
    return robot_path(name) if name else recorded_robot(path, read_info(path).robot), source


def read_for_checks(
    path: Path,
    views: Sequence[str] | None,
    source: EpisodeSource,
    robot: RobotModel,
    unknown_mount: str = '',
    *,
    with_masks: bool = False,
) -> Episode:
    """Return a recording; with `unknown_mount` its cameras may be unknown."""
    from mtv_world_ros.data.episode_reader import read_episode

    return read_episode(
        path,
        views=views,
        calibration=source.calibration,
        with_masks=with_masks,
        mapping=source.mapping,
        robot=robot,
        unknown_mount=unknown_mount,
    )


def _read_all(arguments: argparse.Namespace) -> tuple[list[Episode], Path]:
    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.robot.file import load_robot

    paths = recordings(arguments.episodes)
    file, source = robot_file(arguments, paths[0])
    robot = load_robot(file)
    episodes = [
        read_for_checks(path, arguments.views, source, robot, robot.base_link)
        for path in Progress(paths, desc='reading', unit='episode')
    ]
    return episodes, file


def describe(estimate: SharedEstimate, episodes: Sequence[Episode], *, focal_known: bool) -> str:
    """Return the table: a line a recording, with its place, the measures of `check` and doubts."""
    import numpy as np

    view, width = estimate.cameras[0].view, estimate.cameras[0].width
    how = 'as given' if focal_known or estimate.kept_guess else 'estimated'
    count = len(set(estimate.places.place.tolist()))
    focal = f'focal length {estimate.focal_px:.1f} px of {width} ({how}'
    focal += ')' if focal_known or estimate.kept_guess else f', {_lens(estimate)})'
    lines = [f"view '{view}': {focal}; {count} places in {len(episodes)} recordings"]
    if len(estimate.apart_px):
        lines.append(
            f'{len(estimate.apart_px)} seen points that were left out: '
            f'{np.median(estimate.apart_px):.1f} px beside where they are drawn in the median; '
            f'95 % of tool points are expected within {estimate.within_px:.1f} px'
        )
    else:
        lines.append(
            'no error is stated: of three or more --points of a recording each third is left out '
            'of a first fit, and tells it'
        )
    if estimate.strays:
        names = [episode.info.path.name for episode in episodes]
        lines.append(
            'look again at seen points that contradict the others, correct them or leave them out '
            'where a finger is hidden: '
            + ', '.join(
                f'{names[point.recording]} at {point.seconds:g} s ({apart:.1f} px)'
                for point, apart in estimate.strays
            )
        )
    if estimate.kept_guess:
        lines.append('the guess fits better by the measure of `check` and is kept')
    for number, episode in enumerate(episodes):
        x, y, z = estimate.cameras[number].T_mount_camera[:3, 3]
        measure = estimate.measures[number]
        parts = [f'place {estimate.places.place[number]}', f'at ({x:.3f}, {y:.3f}, {z:.3f}) m']
        parts.append(f'fit {estimate.fits[number]:.2f}, match {measure.match_here:.2f}')
        if estimate.guess_measures:
            parts.append(f'guess {estimate.guess_measures[number].match_here:.2f}')
        doubt = estimate.doubts(number)
        parts += [f'doubted: {doubt}'] if doubt else []
        others = estimate.confirming(number) if doubt else ()
        names = ', '.join(episodes[other].info.path.name for other in others[:_MAX_NAMES])
        parts += [f'taken, as its place is confirmed by {names}'] if others else []
        lines.append(f'{episode.info.path.name}: {"; ".join(parts)}')
    return '\n'.join(lines)


def _lens(estimate: SharedEstimate) -> str:
    """Return the estimated lens parameters in words, or why there are none."""
    camera = estimate.cameras[0]
    stretch = f'fy is {camera.K[1, 1] / camera.K[0, 0]:.3f} fx'
    if not estimate.bent:
        return (
            f'{stretch}; distortion is not: that takes 8 --points, some of them a quarter of the '
            'width from the middle of the image'
        )
    k1 = camera.distortion[0] if len(camera.distortion) else 0.0
    return f'{stretch}, k1 is {k1:.3f}'


def _write(
    arguments: argparse.Namespace,
    estimate: SharedEstimate,
    episodes: Sequence[Episode],
    robot: RobotModel,
    parts: Sequence[LinkShape],
) -> None:
    """Write a calibration file and a picture a place."""
    view = estimate.cameras[0].view
    out = arguments.out or Path('out/camera') / f'{view}.yaml'
    numbers = estimate.places.place.tolist()
    several = len(set(numbers)) > 1
    stem = f'{out.stem}_{view}' if len(arguments.views) > 1 and arguments.out else out.stem
    for place in dict.fromkeys(numbers):
        file = out.with_stem(f'{stem}_{place}' if several else stem)
        known = other_views(file, view, arguments)
        first = numbers.index(place)
        save_camera(file, known, estimate.cameras[first], episodes[first], robot, parts)


def known_shapes(robot: RobotModel) -> Sequence[LinkShape]:
    """Return the shapes of a robot's links.

    Raises:
        ConfigError: they are not known.
    """
    from mtv_world_ros.robot.shape import load_shape

    shape = load_shape(robot)
    if not shape.is_known:
        raise ConfigError(
            f'a fixed camera is found by how the robot looks, but it has {shape.source}; give it '
            'the meshes of its URDF'
        )
    return shape.parts


def other_views(file: Path, view: str, arguments: argparse.Namespace) -> dict[str, CameraModel]:
    """Return the cameras that a calibration file has; empty without a file.

    Raises:
        ConfigError: the user named the file, and it has the view already.
    """
    from mtv_world_ros.cameras.calibration_file import load_calibration

    known = load_calibration(file) if file.is_file() else {}
    if view in known and arguments.out is not None and not arguments.overwrite:
        raise ConfigError(
            f"'{file}' has view '{view}' already; name another --out, or --overwrite to replace it"
        )
    return known


def save_camera(
    file: Path,
    known: dict[str, CameraModel],
    camera: CameraModel,
    episode: Episode,
    robot: RobotModel,
    parts: Sequence[LinkShape],
) -> None:
    """Write a camera into a calibration file, and a picture of the robot drawn with it."""
    from dataclasses import replace

    from mtv_world_ros.cameras.calibration_file import save_calibration
    from mtv_world_ros.core.images import write_png
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.inspection.inspect import overlay_picture

    assert episode.joint_states is not None
    shown = replace(episode, cameras={camera.view: camera})
    joints = JointTrack(episode.joint_states, robot)
    write_png(file.with_suffix('.png'), overlay_picture(shown, camera.view, robot, parts, joints))
    save_calibration(file, {**known, camera.view: camera})
    print(f'calibration: {file}\nlook at it: {file.with_suffix(".png")}')


def _apply(
    arguments: argparse.Namespace,
    episodes: Sequence[Episode],
    found: dict[str, SharedEstimate],
) -> int:
    """Write cameras into the episodes: `found`, where they have none or are to be replaced.

    Cameras that an episode has already get their CameraInfo, where the bag lacks it. Doubted poses
    are not written without `--apply-doubted`.

    Returns:
        The exit status: 1 if an episode could not be written or a pose was not, which is said on
        stderr.
    """
    from mtv_world_ros.core.errors import MtvWorldError

    status, num_doubted, num_all = 0, 0, 0
    for number, episode in enumerate(episodes):
        try:
            cameras, doubted = _relied_on(arguments, episode, found, number)
            num_doubted, num_all = num_doubted + len(doubted), num_all + len(cameras | doubted)
            words = [f'{view} not written, as it is doubted' for view in doubted]
            if cameras or not found:
                line = _write_into(
                    episode, cameras, arguments.views, overwrite=arguments.overwrite
                )
                print('; '.join([line, *words]))
            else:
                print(f'{episode.info.path.name}: {"; ".join(words)}')
        except MtvWorldError as error:
            sys.stderr.write(f'mtv-world: {error}\n')
            status = 1
    if num_doubted:
        sys.stderr.write(
            f'mtv-world: {num_doubted} of {num_all} poses of {", ".join(found)} are doubted (the '
            'reasons stand above) and were not written. Look at the pictures; give seen points '
            '(--click, then --points), or record the arm while every joint moves over most of its '
            'range. --apply-doubted writes these poses all the same.\n'
        )
        status = 1
    return status


def _relied_on(
    arguments: argparse.Namespace,
    episode: Episode,
    found: dict[str, SharedEstimate],
    number: int,
) -> tuple[dict[str, CameraModel], dict[str, str]]:
    """Return the cameras to write into an episode, and the views whose doubts forbid it.

    Cameras that the episode keeps anyway are among the first.
    """
    from mtv_world_ros.data.episode_cameras import calibrated_views

    kept = set() if arguments.overwrite else calibrated_views(episode.info.path).keys()
    doubts = {
        view: objection
        for view, one in found.items()
        if view not in kept and (objection := one.objection(number))
    }
    if arguments.apply_doubted:
        doubts = {}
    cameras = {view: one.cameras[number] for view, one in found.items() if view not in doubts}
    return cameras, doubts


def _write_into(
    episode: Episode, found: dict[str, CameraModel], views: Sequence[str], *, overwrite: bool
) -> str:
    """Write cameras into an episode; returns what was done, in a line."""
    from mtv_world_ros.cameras.calibration_file import save_calibration
    from mtv_world_ros.data.episode import CALIBRATION_FILE
    from mtv_world_ros.data.episode_cameras import calibrated_views, is_imported, write_cameras

    path = episode.info.path
    filed = calibrated_views(path)
    kept = [view for view in views if view in filed and not (overwrite and view in found)]
    new = {view: camera for view, camera in found.items() if view not in kept}
    known = {view: episode.cameras[view] for view in kept if not found or view in found}
    words = [f'{", ".join(new)} written'] if new else []
    words += [f'{", ".join(known)} left as in {CALIBRATION_FILE}'] if known else []
    if not is_imported(path):
        if new:
            save_calibration(path / CALIBRATION_FILE, {**filed, **new})
        words.append(
            'its bag, a recording of your own, stays as it is: mtv-world import bag makes an '
            'episode for the node and ROS tools of it'
        )
    elif write_cameras(path, new, known):
        words.append('its bag has their CameraInfo now')
    return f'{path.name}: {"; ".join(words)}'
