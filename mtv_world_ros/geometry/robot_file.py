"""Robot YAML files: a URDF or Denavit-Hartenberg tables become one `RobotModel`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import yaml

from mtv_world_ros.errors import ConfigError, RobotError, nearest
from mtv_world_ros.geometry.robot import Mimic, RobotModel, Tool
from mtv_world_ros.geometry.transforms import denavit_hartenberg, pose

_KEYS = ('name', 'urdf', 'dh', 'base_link', 'joints', 'tools')
_TOOL_KEYS = ('arm', 'link', 'position', 'quaternion_xyzw', 'gripper_joint', 'gripper_closed',
              'gripper_open')  # fmt: skip
_ARM_KEYS = ('arm', 'position', 'quaternion_xyzw', 'joints', 'gripper')
_ROW_KEYS = ('joint', 'a', 'alpha', 'd', 'theta', 'lower', 'upper', 'type')
_GRIPPER_KEYS = ('joint', 'lower', 'upper')


def load_robot(path: Path) -> RobotModel:
    """Reads a robot YAML.

    Keys: `name`; `urdf` (file, relative to the YAML) or `dh` (a list of arms: `arm`, base
    `position` and `quaternion_xyzw`, `joints` rows of `joint, a, alpha, d, theta, lower, upper,
    type`, optional `gripper` with `joint, lower, upper`); `base_link`; `joints` (order of all
    position vectors); `tools` (`arm, link, position, quaternion_xyzw, gripper_joint,
    gripper_closed, gripper_open`). The link after a DH row is named `<joint>_link`.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown or missing keys.
        RobotError: the description cannot be used.
    """
    path = Path(path)
    values = _read_yaml(path)
    _check_keys(values, _KEYS, ('name', 'tools'), str(path))
    if ('urdf' in values) == ('dh' in values):
        raise ConfigError(f"'{path}': give either 'urdf' or 'dh'")
    if 'urdf' in values:
        model, mimics, commanded = _from_urdf(path.parent / values['urdf'])
    else:
        model, commanded = _from_dh(values['dh'], str(path))
        mimics = []
    return RobotModel(
        name=values['name'],
        model=model,
        joint_names=values.get('joints', commanded),
        tools=[_tool(row, f'{path}: tools') for row in values['tools']],
        base_link=values.get('base_link', 'base'),
        mimics=mimics,
    )


def _read_yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ConfigError(f"robot file '{path}' does not exist; set 'robot_file' to one")
    try:
        values = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ConfigError(f"'{path}' is not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"'{path}' must hold keys and values, got {type(values).__name__}")
    return values


def _check_keys(values: Any, known: tuple[str, ...], required: tuple[str, ...], where: str) -> None:
    if not isinstance(values, Mapping):
        raise ConfigError(f'{where}: expected keys and values, got {values!r}')
    for key in values:
        if key not in known:
            raise ConfigError(f"{where}: unknown key '{key}'{nearest(str(key), known)}")
    for key in required:
        if key not in values:
            raise ConfigError(f"{where}: key '{key}' is missing")


def _tool(row: Any, where: str) -> Tool:
    _check_keys(row, _TOOL_KEYS, ('arm', 'link'), where)
    offset = pose(row.get('position', (0, 0, 0)), row.get('quaternion_xyzw', (0, 0, 0, 1)))
    return Tool(
        arm=row['arm'],
        link=row['link'],
        T_link_tool=offset,
        gripper_joint=row.get('gripper_joint'),
        gripper_closed=float(row.get('gripper_closed', 0.0)),
        gripper_open=float(row.get('gripper_open', 1.0)),
    )


def _from_urdf(path: Path) -> tuple[pin.Model, list[Mimic], list[str]]:
    """The model, its mimic joints (kept as joints of their own), and the other joints' names."""
    if not path.is_file():
        raise ConfigError(f"URDF file '{path}' does not exist; 'urdf' is relative to the YAML")
    try:
        root = ElementTree.parse(path).getroot()
        # Pinocchio must see mimic joints as ordinary ones: RobotModel moves them itself.
        mimics = []
        for joint in root.iter('joint'):
            for tag in joint.findall('mimic'):
                mimics.append(
                    Mimic(
                        joint=joint.attrib['name'],
                        source=tag.attrib['joint'],
                        multiplier=float(tag.get('multiplier', 1.0)),
                        offset=float(tag.get('offset', 0.0)),
                    )
                )
                joint.remove(tag)
        model = pin.buildModelFromXML(ElementTree.tostring(root, encoding='unicode'))
    except (ElementTree.ParseError, ValueError, KeyError) as error:
        raise RobotError(f"URDF '{path}' cannot be used: {error}") from error
    followers = {mimic.joint for mimic in mimics}
    return model, mimics, [n for n in list(model.names)[1:] if n not in followers]


def _from_dh(arms: Any, where: str) -> tuple[pin.Model, list[str]]:
    if not isinstance(arms, list) or not arms:
        raise ConfigError(f"{where}: 'dh' must be a list of arms")
    model, names = pin.Model(), []
    base = pin.Frame('base', 0, 0, pin.SE3.Identity(), pin.FrameType.BODY)
    model.addFrame(base)
    for arm in arms:
        _check_keys(arm, _ARM_KEYS, ('arm', 'joints'), f'{where}: dh')
        names += _add_dh_arm(model, arm, f"{where}: dh arm '{arm['arm']}'")
    return model, names


def _add_dh_arm(model: pin.Model, arm: Mapping[str, Any], where: str) -> list[str]:
    """A DH row turns about z first; its fixed remainder places the next joint."""
    mount = pose(arm.get('position', (0, 0, 0)), arm.get('quaternion_xyzw', (0, 0, 0, 1)))
    parent, placement, names = 0, pin.SE3(mount), []
    for row in arm['joints']:
        _check_keys(row, _ROW_KEYS, ('joint', 'a', 'alpha', 'd', 'lower', 'upper'), where)
        kind = row.get('type', 'revolute')
        if kind not in ('revolute', 'prismatic'):
            raise ConfigError(f"{where}: type '{kind}' is not revolute or prismatic")
        joint = pin.JointModelRZ() if kind == 'revolute' else pin.JointModelPZ()
        # theta is the joint's zero offset for revolute rows, d the offset for prismatic ones
        offset = denavit_hartenberg(0.0, 0.0, 0.0, float(row.get('theta', 0.0)))
        parent = _add_joint(model, parent, joint, placement * pin.SE3(offset), row)
        rest = denavit_hartenberg(float(row['a']), float(row['alpha']), float(row['d']), 0.0)
        placement = pin.SE3(rest)
        link = pin.Frame(f'{row["joint"]}_link', parent, 0, placement, pin.FrameType.BODY)
        model.addFrame(link)
        names.append(row['joint'])
    if 'gripper' in arm:
        _check_keys(arm['gripper'], _GRIPPER_KEYS, _GRIPPER_KEYS, f'{where}: gripper')
        _add_joint(model, parent, pin.JointModelPZ(), placement, arm['gripper'])
        names.append(arm['gripper']['joint'])
    return names


def _add_joint(
    model: pin.Model, parent: int, joint: Any, placement: pin.SE3, row: Mapping[str, Any]
) -> int:
    limits = [np.array([float(row[key])]) for key in ('lower', 'upper')]
    if limits[0] >= limits[1]:
        raise ConfigError(f"joint '{row['joint']}': lower {row['lower']} is not below upper")
    wide = np.full(1, 1e3)
    return model.addJoint(parent, joint, placement, row['joint'], wide, wide, *limits)
