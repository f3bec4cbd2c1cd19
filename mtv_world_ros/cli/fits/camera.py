"""`mtv-world fit camera`: the pose of a camera, from recordings in which the arm moves."""

from __future__ import annotations

import argparse
from math import isfinite
from pathlib import Path
import re
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.fits.several_cameras import (
    calibrate_shared,
    is_shared,
    known_shapes,
    other_views,
    read_for_checks,
    robot_file,
    save_camera,
)
from mtv_world_ros.cli.shared_options import add_options, names
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.core.data_types import CameraModel, FloatArray
    from mtv_world_ros.data.episode import Episode, JointStates, Track
    from mtv_world_ros.inspection.camera_pose import CameraEstimate
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.robot.model import RobotModel


#: standard error beyond which another recording is recommended [mm]
_ROUGH_MM = 50.0


#: correlation of drawn and seen motion below which a pose may be a wrong one: of five recorded
#: tasks, those with .67, .76 and .82 ended 130 to 350 mm off, those with .86 and .91 10 and 21 mm
GOOD_MATCH = 0.85


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'camera',
        help='estimate where a camera is, fixed or on the arm, from a recording in which the arm '
        'moves',
        epilog='Intrinsics come from the recording; the pose there is the guess to start from. '
        'Of several recordings, moved cameras are told apart, and the focal length is estimated '
        'where it is not known. '
        'The success estimate is calibrated by mtv-world fit success.',
    )
    parser.add_argument(
        'episodes', type=Path, nargs='+', metavar='EPISODE', help='recordings, or folders of them'
    )
    parser.add_argument(
        '--view',
        dest='views',
        type=names,
        required=True,
        help='name of the view; or several, comma-separated, of cameras that stand still',
    )
    parser.add_argument(
        '--same-focal',
        action='store_true',
        help='the views are of the same make of camera: one focal length is estimated for all',
    )
    parser.add_argument(
        '--points',
        type=Path,
        metavar='FILE',
        help='where the middle between the finger tips is seen, to start from: '
        '{VIEW: {EPISODE: [[seconds, x, y], ...]}} in YAML [s, px], four points or more',
    )
    parser.add_argument(
        '--click',
        type=Path,
        metavar='PAGE',
        help='only write an HTML page on which to click these points; it saves the file for '
        '--points',
    )
    parser.add_argument(
        '--focal',
        choices=('known', 'estimate'),
        help='whether the focal length is right; default: estimate where nothing gives one',
    )
    parser.add_argument(
        '--apply',
        action='store_true',
        help='write the cameras into the imported recordings, where they have none: poses into '
        'calibration.yaml, CameraInfo into the bag; doubted poses are not written',
    )
    parser.add_argument(
        '--apply-doubted',
        action='store_true',
        help='as --apply, and doubted poses are written as well',
    )
    add_options(parser, 'overwrite')
    parser.add_argument(
        '--no-guess',
        dest='guess',
        action='store_false',
        help='search from all sides instead of starting from the pose in the recording, which '
        'need not have one',
    )
    parser.add_argument(
        '--mount-link',
        help='link that carries the camera; `find` = the link of the arm whose motion fits; '
        'default: as recorded',
    )
    parser.add_argument('--robot', help=f"{robots()}; default: the episode's")
    add_options(parser, 'source')
    parser.add_advanced(
        '--between',
        type=_interval,
        metavar='FROM,TO',
        help='only that part of the recording [s], e.g. before the hand takes something: 0,4',
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of the search')
    parser.add_argument(
        '--out', type=Path, help='calibration file to write; default: out/camera/<view>.yaml'
    )
    parser.set_defaults(handler=_calibrate_camera, default_out=_default_out)


def _default_out(arguments: argparse.Namespace) -> Path:
    return Path('out/camera') / f'{"_".join(arguments.views)}.yaml'


def _interval(text: str) -> tuple[float, float]:
    words = re.fullmatch(r'(\d+\.?\d*),(\d+\.?\d*)', text)
    if words is None or not float(words[1]) < float(words[2]):
        raise argparse.ArgumentTypeError(f"'{text}'; it must be FROM,TO in seconds, FROM < TO")
    return float(words[1]), float(words[2])


def _calibrate_camera(arguments: argparse.Namespace) -> int:
    if not arguments.views or arguments.same_focal and len(arguments.views) < 2:
        least = 'two views, e.g. --view front,side' if arguments.same_focal else 'a view'
        raise ConfigError(f"--view '{','.join(arguments.views)}': name at least {least}")
    arguments.apply |= arguments.apply_doubted
    if is_shared(arguments):
        return calibrate_shared(arguments)
    arguments.episode, arguments.view = arguments.episodes[0], arguments.views[0]
    return _calibrate_one(arguments)


def _calibrate_one(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.inspection.camera_pose import difference
    from mtv_world_ros.robot.file import load_robot
    from mtv_world_ros.robot.shape import load_shape

    out = arguments.out or Path('out/camera') / f'{arguments.view}.yaml'
    known = other_views(out, arguments.view, arguments)
    file, source = robot_file(arguments, arguments.episode)
    robot = load_robot(file)
    episode = read_for_checks(
        arguments.episode,
        [arguments.view],
        source,
        robot,
        '' if arguments.guess else robot.base_link,
    )
    guess = episode.cameras[arguments.view]
    estimate = estimate_camera(episode, robot, arguments)
    camera = estimate.camera
    print(_estimate_text(estimate))
    if arguments.guess and guess.mount_link == camera.mount_link:
        mm, degrees = difference(guess.T_mount_camera, camera.T_mount_camera)
        print(f'the guess was {mm:.0f} mm and {degrees:.1f} degrees away')
    save_camera(out, known, camera, episode, robot, load_shape(robot).parts)
    return 0


def estimate_camera(
    episode: Episode, robot: RobotModel, arguments: argparse.Namespace
) -> CameraEstimate:
    """Return the estimate for a view, on its mount link.

    Raises:
        CalibrationError: the recording does not determine it.
        ConfigError: a guess is wanted for another link than the recorded one.
    """
    from dataclasses import replace

    from mtv_world_ros.core.errors import CalibrationError, EpisodeError
    from mtv_world_ros.inspection.cameras.scene_tracks import follow_scene
    from mtv_world_ros.inspection.cameras.wrist_camera import find_mount, WristCamera
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.robot.shape import moving_links

    if episode.joint_states is None:
        raise EpisodeError(f"'{episode.info.path}' has no joint_states")
    if arguments.view in episode.camera_tracks:
        raise CalibrationError(
            f"'{episode.info.path}': the camera of view '{arguments.view}' moves by itself, with "
            'the poses of /tf; one that stands still or is on the arm can be estimated'
        )
    if 'intrinsics' in episode.unknown.get(arguments.view, ''):
        raise CalibrationError(
            f"'{episode.info.path}': the intrinsics of view '{arguments.view}' are not known, and "
            'one recording does not tell them: give a calibration file with K (--calibration), '
            'or, for a camera that stands still, the folder of the recordings'
        )
    states = episode.joint_states
    if arguments.between is not None:
        start, end = arguments.between
        states = _part(states, start, end, str(episode.info.path))
    joints = JointTrack(states, robot)
    track, camera = episode.images[arguments.view], episode.cameras[arguments.view]
    link = arguments.mount_link or camera.mount_link
    on_arm = link in (*moving_links(robot), 'find')
    if arguments.guess and link != camera.mount_link and on_arm:
        raise ConfigError(
            f"the pose in the recording is one in link '{camera.mount_link}' and no guess for "
            f"'{link}'; give --no-guess"
        )
    if link == 'find':
        return find_mount(follow_scene(track, camera, robot, joints), camera, robot)
    if on_arm:
        tracks = follow_scene(track, camera, robot, joints)
        on_link = replace(camera, mount_link=link)
        return WristCamera(tracks, on_link, robot).estimate(guess=arguments.guess)
    return _estimate_fixed(track, camera, link, robot, joints, arguments)


def _part(states: JointStates, start: float, end: float, path: str) -> JointStates:
    """Return the joint states between two times of the recording.

    Frames outside are not used then.
    """
    from dataclasses import replace

    import numpy as np

    times = (states.stamps_ns - states.stamps_ns[0]) * 1e-9
    chosen = np.flatnonzero((times >= start) & (times <= end))
    if len(chosen) < 2:
        raise ConfigError(
            f"'{path}' has no joint states between {start:g} and {end:g} s: it is "
            f'{times[-1]:.1f} s long'
        )
    return replace(states, stamps_ns=states.stamps_ns[chosen], positions=states.positions[chosen])


def _estimate_fixed(
    track: Track,
    camera: CameraModel,
    link: str,
    robot: RobotModel,
    joints: JointTrack,
    arguments: argparse.Namespace,
) -> CameraEstimate:
    from dataclasses import replace
    from functools import partial

    import numpy as np

    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.core.transforms import inverse
    from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera

    def rest(name: str) -> FloatArray:
        return robot.link_poses(name, np.zeros((1, len(robot.joint_names))))[0]

    on_base = replace(
        camera,
        mount_link=robot.base_link,
        T_mount_camera=rest(camera.mount_link) @ camera.T_mount_camera,
    )
    fixed = FixedCamera(track, on_base, robot, known_shapes(robot), joints)
    found = fixed.estimate(
        guess=arguments.guess,
        seed=arguments.seed,
        progress=partial(Progress, desc='aligning', unit='pose'),
    )
    pose = inverse(rest(link)) @ found.camera.T_mount_camera
    return replace(found, camera=replace(found.camera, mount_link=link, T_mount_camera=pose))


def _estimate_text(estimate: CameraEstimate) -> str:
    camera = estimate.camera
    x, y, z = (float(v) for v in camera.T_mount_camera[:3, 3])
    meant = '95 % of errors are within twice that'
    if isfinite(estimate.match):  # of a fixed camera: not measured often enough
        meant = 'most errors are within twice that'
    if is_doubtful(estimate):
        meant = 'of the right pose, if this is one'
    return (
        f"view '{camera.view}' on link '{camera.mount_link}': at ({x:.3f}, {y:.3f}, {z:.3f}) m, "
        f'standard error {estimate.std_mm:.1f} mm and {estimate.std_deg:.2f} degrees ({meant})\n'
        f'{estimate.evidence}{_advice(estimate)}'
    )


def is_doubtful(estimate: CameraEstimate) -> bool:
    """Return whether an estimate may be a wrong pose at which the robot moves alike."""
    return estimate.match < GOOD_MATCH


def _advice(estimate: CameraEstimate) -> str:
    doubts = []
    if is_doubtful(estimate):
        doubts.append(
            f'drawn and seen motion should correlate by {GOOD_MATCH:g} or more: this may be a '
            'wrong pose, and its error larger than said'
        )
    elif estimate.std_mm > _ROUGH_MM:
        doubts.append('this is rough')
    if not doubts:
        return ''
    return (
        f'\n{doubts[0]}. Look at the picture, or record 20 s in which every joint moves slowly '
        'over most of its range, the arm towards the camera and away from it and into the '
        "image's corners, nothing in its hand and nobody in view"
    )
