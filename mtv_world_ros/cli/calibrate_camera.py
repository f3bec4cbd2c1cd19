"""`mtv-world calibrate-camera`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_source
from mtv_world_ros.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.geometry.robot import RobotModel
    from mtv_world_ros.inspection.camera_pose import CameraEstimate


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'calibrate-camera',
        help='estimate where a fixed camera is, from a recording in which the arm moves',
        epilog='Intrinsics come from the recording; the pose there is the guess to start from. '
        'This is the calibration of a camera: that of the success estimate is `calibrate`.',
    )
    parser.add_argument('episode', type=Path)
    parser.add_argument('--view', required=True)
    parser.add_argument(
        '--no-guess',
        dest='guess',
        action='store_false',
        help='search from all sides instead of starting from the pose in the recording',
    )
    parser.add_argument('--mount-link', help='link that carries it; default: as recorded')
    parser.add_argument('--robot', help="YAML, or a bundled robot; default: the episode's")
    add_source(parser)
    parser.add_argument('--seed', type=int, default=0, help='of the search')
    parser.add_argument(
        '--out', type=Path, help='calibration file to write; default: out/camera/<view>.yaml'
    )
    parser.set_defaults(handler=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import recorded_robot, robot_path
    from mtv_world_ros.data.bag.messages import encode_png
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.data.episode_reader import read_episode, read_info
    from mtv_world_ros.files import write_whole
    from mtv_world_ros.geometry.calibration_file import load_calibration, save_calibration
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.geometry.robot_shape import load_shape
    from mtv_world_ros.inspection.camera_pose import difference
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.inspection.inspect import overlay_picture

    out = arguments.out or Path('out/camera') / f'{arguments.view}.yaml'
    known = load_calibration(out) if out.is_file() else {}
    if arguments.view in known and arguments.out is not None:
        raise ConfigError(f"'{out}' has view '{arguments.view}' already; name another --out")
    source = load_source(arguments.topics, arguments.calibration)
    name = arguments.robot or (source.mapping.robot if source.mapping else '')
    path = arguments.episode
    robot = load_robot(robot_path(name) if name else recorded_robot(path, read_info(path).robot))
    episode = read_episode(
        path,
        views=[arguments.view],
        calibration=source.calibration,
        with_masks=False,
        mapping=source.mapping,
        robot=robot,
    )
    guess = episode.cameras[arguments.view]
    estimate = estimate_camera(episode, robot, arguments)
    camera = estimate.camera
    print(_words(estimate))
    if arguments.guess:
        mm, degrees = difference(guess.T_mount_camera, camera.T_mount_camera)
        print(f'the guess was {mm:.0f} mm and {degrees:.1f} degrees away')
    save_calibration(out, {**known, arguments.view: camera})
    assert episode.joint_states is not None
    picture = overlay_picture(
        _with_camera(episode, camera),
        arguments.view,
        robot,
        load_shape(robot).parts,
        JointTrack(episode.joint_states, robot),
    )
    write_whole(out.with_suffix('.png'), encode_png(picture))
    print(f'calibration: {out}\nlook at it: {out.with_suffix(".png")}')
    return 0


def estimate_camera(
    episode: Episode, robot: RobotModel, arguments: argparse.Namespace
) -> CameraEstimate:
    """Returns the estimate for a view, on its mount link."""
    from dataclasses import replace

    import numpy as np

    from mtv_world_ros.errors import EpisodeError
    from mtv_world_ros.geometry.robot_shape import load_shape, moving_links
    from mtv_world_ros.geometry.transforms import inverse
    from mtv_world_ros.inspection.clocks import JointTrack
    from mtv_world_ros.inspection.fixed_camera import FixedCamera

    if episode.joint_states is None:
        raise EpisodeError(f"'{episode.info.path}' has no joint_states")
    joints = JointTrack(episode.joint_states, robot)
    track, camera = episode.images[arguments.view], episode.cameras[arguments.view]
    link = arguments.mount_link or camera.mount_link
    rest = robot.link_poses(link, np.zeros((1, len(robot.joint_names))))[0]
    if link in moving_links(robot):
        raise ConfigError(
            f"view '{arguments.view}' moves with '{link}'; only cameras that stand still can be "
            'estimated (--mount-link names the link that carries it)'
        )
    on_base = replace(
        camera, mount_link=robot.base_link, T_mount_camera=rest @ camera.T_mount_camera
    )
    shape = load_shape(robot)
    if not shape.is_known:
        raise ConfigError(
            f'a fixed camera is found by how the robot looks, but it has {shape.source}; give it '
            'the meshes of its URDF'
        )
    fixed = FixedCamera(track, on_base, robot, shape.parts, joints)
    found = fixed.estimate(guess=arguments.guess, seed=arguments.seed)
    pose = inverse(rest) @ found.camera.T_mount_camera
    return replace(found, camera=replace(found.camera, mount_link=link, T_mount_camera=pose))


def _with_camera(episode: Episode, camera: object) -> Episode:
    from dataclasses import replace

    return replace(episode, cameras={episode.views[0]: camera})  # type: ignore[dict-item]


def _words(estimate: CameraEstimate) -> str:
    camera = estimate.camera
    x, y, z = (float(v) for v in camera.T_mount_camera[:3, 3])
    lines = []
    lines.append(
        f"view '{camera.view}' on link '{camera.mount_link}': at ({x:.3f}, {y:.3f}, {z:.3f}) m, "
        f'standard error {estimate.std_mm:.1f} mm and {estimate.std_deg:.2f} degrees'
    )
    lines.append(
        f'correlation of drawn and seen motion {estimate.fit:.2f} over {estimate.num_pairs} pairs '
        'of frames'
    )
    return '\n'.join(lines)
