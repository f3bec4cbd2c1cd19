"""`mtv-world robot`: print a robot, draw it, and make its YAML from a URDF."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.shared_options import add_options
from mtv_world_ros.core.errors import ConfigError, MtvWorldError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.robot.model import RobotModel


#: first lines of the cameras of a workcell
_CAMERAS_HEAD = """\
# Made from workcell.yaml by mtv-world robot ROBOT --workcell: the simulator's cameras before an
# episode moves them a little; a recorded episode carries its own. K in px, pixel centres at
# integers; T_mount_camera: pose of the optical frame (x right, y down, z ahead) in mount_link [m].
"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'robot',
        help='print a robot, draw it, and make its YAML from a URDF',
        epilog='Of a URDF, arms, tools, fingers and base link are guessed and written to a YAML: '
        'look at the picture, correct the YAML where the guess is wrong, and call it again with '
        'the YAML.',
    )
    parser.add_argument('file', help=f'a URDF, {robots()}')
    parser.add_argument(
        '--out', type=Path, help='YAML to write (of a URDF); default: beside the URDF'
    )
    parser.add_argument(
        '--workcell',
        action='store_true',
        help='write cameras.yaml beside the robot YAML: the cameras of its workcell.yaml',
    )
    add_options(parser, 'overwrite')
    parser.add_argument('--picture', type=Path, help='PNG to draw; default: out/robot/<name>.png')
    parser.set_defaults(handler=_robot, default_picture=_default_picture)


def _default_picture(arguments: argparse.Namespace) -> Path:
    return Path('out/robot') / f'{Path(arguments.file).stem}.png'


def _robot(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.robot.shape import load_shape

    path = Path(arguments.file)
    guessed: Path | None = None
    if path.suffix in ('.urdf', '.xml'):
        path = guessed = _write_guess(path, arguments.out or path.with_suffix('.yaml'))
    elif path.suffix == '.xacro':
        raise ConfigError(f"'{path}' is a xacro file; expand it first: xacro {path} > robot.urdf")
    elif arguments.out is not None:
        raise ConfigError('--out is for a URDF; a robot YAML is only read')
    else:
        path = robot_path(arguments.file)
    try:
        robot = load_robot(path)
        shape = load_shape(robot)
    except MtvWorldError:
        if guessed is not None:  # or the next call would find a file that cannot be used
            guessed.unlink()
        raise
    print(describe(robot))
    print(f'shapes: {shape.source}')
    print(*(f'missing: {name}\n' for name in shape.missing), sep='', end='')
    print(*(f'{text}\n' for text in shape.replaced), sep='', end='')
    print(*(f'suspicious: {text}\n' for text in shape.doubts), sep='', end='')
    picture = arguments.picture or Path('out/robot') / f'{robot.name}.png'
    _draw_robot(robot, picture)
    print(f'robot file: {path}\npicture: {picture}')
    if arguments.workcell:
        print(_write_cameras(robot, path.with_name('cameras.yaml'), overwrite=arguments.overwrite))
    return 0


def _write_cameras(robot: RobotModel, path: Path, *, overwrite: bool) -> str:
    """Write the cameras of a robot's workcell; return what was done, in a line."""
    from mtv_world_ros.cameras.calibration_file import calibration_text
    from mtv_world_ros.core.files import check_free, write_whole
    from mtv_world_ros.simulation.scenes.workcell import nominal_cameras

    text = _CAMERAS_HEAD + calibration_text(nominal_cameras(robot))
    if path.is_file() and path.read_text() == text:
        return f'cameras: {path} agrees with the workcell'
    check_free(path, overwrite)
    write_whole(path, text)
    return f'cameras: {path}'


def _write_guess(urdf: Path, out: Path) -> Path:
    import os

    import yaml

    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.importing.robot_guess import guess_robot

    if out.exists():
        raise ConfigError(f"'{out}' exists; look at it with: mtv-world robot {out}")
    guessed = guess_robot(urdf)
    relative = os.path.relpath(urdf.resolve(), out.resolve().parent)
    text = yaml.safe_dump({**guessed.values, 'urdf': relative}, sort_keys=False)
    lines = [f'# {note}' for note in guessed.notes]
    write_whole(out, '\n'.join(['# guessed by mtv-world robot:', *lines, text]))
    print('\n'.join(f'guessed: {note}' for note in guessed.notes))
    return out


def describe(robot: RobotModel) -> str:
    """Return joints with limits, and tools, as text lines."""
    import numpy as np

    lines = [f"robot '{robot.name}', base link '{robot.base_link}'"]
    rows = zip(robot.joint_names, robot.lower, robot.upper, robot.velocity_limits, strict=True)
    for name, lower, upper, speed in rows:
        limits = f'{lower:.4g} .. {upper:.4g}' if np.isfinite(lower) else 'turns without end'
        fastest = f'at most {speed:.3g} a second' if np.isfinite(speed) else 'no speed limit given'
        lines.append(f'  joint {name}: {limits}, {fastest}')
    for tool in robot.tools:
        x, y, z = (float(v) for v in tool.T_link_tool[:3, 3])
        lines.append(f"  tool of '{tool.arm}': ({x:.4g}, {y:.4g}, {z:.4g}) m in '{tool.link}'")
        if tool.gripper_joint:
            lines.append(
                f'    gripper {tool.gripper_joint}: closed at {tool.gripper_closed:.4g}, open at '
                f'{tool.gripper_open:.4g}'
            )
    return '\n'.join(lines)


def _draw_robot(robot: RobotModel, path: Path) -> None:
    from mtv_world_ros.core.images import write_png
    from mtv_world_ros.inspection.image_checks import robot_picture

    write_png(path, robot_picture(robot))
