"""Robot YAML files: a URDF or Denavit-Hartenberg tables become one `RobotModel`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from mtv_world_ros.config import check_keys, number, read_yaml, word
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import ConfigError, RobotError
from mtv_world_ros.geometry.robot import Mimic, RobotModel, Tool
from mtv_world_ros.geometry.transforms import denavit_hartenberg, pose

_KEYS = ('name', 'urdf', 'dh', 'base_link', 'joints', 'mimic', 'tools')
_MIMIC_KEYS = ('joint', 'source', 'multiplier', 'offset')
_TOOL_KEYS = ('arm', 'link', 'position', 'quaternion_xyzw', 'gripper_joint', 'gripper_closed',
              'gripper_open', 'finger_travel_m')  # fmt: skip
_ARM_KEYS = ('arm', 'convention', 'position', 'quaternion_xyzw', 'joints', 'gripper')
_ROW_KEYS = ('joint', 'a', 'alpha', 'd', 'theta', 'lower', 'upper', 'type')
_GRIPPER_KEYS = ('joint', 'lower', 'upper')
_CONVENTIONS = ('standard', 'modified')
_ROW_TYPES = ('revolute', 'prismatic')


def load_robot(path: Path | str) -> RobotModel:
    """Reads a robot YAML.

    Keys: `name`; `urdf` (file, relative to the YAML) or `dh` (a list of arms); `base_link`
    (default: the URDF's root, or `base`); `joints` (order of all position vectors; default: all
    that move by themselves); `mimic` (a list of `joint, source, multiplier, offset`, added to
    the URDF's own); `tools` (a list of `arm, link, position, quaternion_xyzw, gripper_joint,
    gripper_closed, gripper_open`).

    An arm of `dh` has `arm`; the pose of its frame 0 in the base, `position` and
    `quaternion_xyzw`; `convention`, `standard` or `modified` (Craig); `joints`, rows of `joint,
    a, alpha, d, theta, lower, upper, type` [m, rad] whose link is named `<joint>_link`; and
    optionally `gripper` with `joint, lower, upper`, a slide along the last frame's z.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown, missing or wrong values.
        RobotError: the description cannot be used.
    """
    path = Path(path)
    values = check_keys(
        read_yaml(path, 'robot file', 'robot_file'), _KEYS, ('name', 'tools'), str(path)
    )
    if ('urdf' in values) == ('dh' in values):
        raise ConfigError(f"'{path}': give either 'urdf' or 'dh'")
    mimics = [_mimic(row, f'{path}: mimic') for row in _rows(values, 'mimic', str(path))]
    if 'urdf' in values:
        model, own_mimics, base = _from_urdf(path.parent / str(values['urdf']))
        mimics += own_mimics
        base = str(values.get('base_link', base))
    else:
        base = str(values.get('base_link', 'base'))
        model = _from_dh(values, base, str(path))
    followers = {mimic.joint for mimic in mimics}
    return RobotModel(
        name=str(values['name']),
        model=model,
        joint_names=values.get('joints') or [n for n in model.names[1:] if n not in followers],
        tools=[_tool(row, f'{path}: tools') for row in _rows(values, 'tools', str(path))],
        base_link=base,
        mimics=mimics,
    )


def _rows(values: Mapping[str, Any], key: str, where: str) -> list[Any]:
    rows = values.get(key, [])
    if not isinstance(rows, list):
        raise ConfigError(f"{where}: '{key}' must be a list, got {rows!r}")
    return rows


def _pose(row: Mapping[str, Any], where: str) -> FloatArray:
    try:
        return pose(row.get('position', (0, 0, 0)), row.get('quaternion_xyzw', (0, 0, 0, 1)))
    except (ValueError, TypeError) as error:
        raise ConfigError(f'{where}: {error}') from error


def _mimic(row: Any, where: str) -> Mimic:
    check_keys(row, _MIMIC_KEYS, ('joint', 'source'), where)
    return Mimic(
        joint=str(row['joint']),
        source=str(row['source']),
        multiplier=number(row, 'multiplier', 1.0, where),
        offset=number(row, 'offset', 0.0, where),
    )


def _tool(row: Any, where: str) -> Tool:
    check_keys(row, _TOOL_KEYS, ('arm', 'link'), where)
    where = f"{where}: arm '{row['arm']}'"
    return Tool(
        arm=str(row['arm']),
        link=str(row['link']),
        T_link_tool=_pose(row, where),
        gripper_joint=row.get('gripper_joint'),
        gripper_closed=number(row, 'gripper_closed', 0.0, where),
        gripper_open=number(row, 'gripper_open', 1.0, where),
        finger_travel_m=(
            number(row, 'finger_travel_m', 0.0, where) if 'finger_travel_m' in row else None
        ),
    )


def _from_urdf(path: Path) -> tuple[pin.Model, list[Mimic], str]:
    """The model, its mimic joints (kept as joints of their own), and the root link."""
    if not path.is_file():
        raise ConfigError(f"URDF file '{path}' does not exist; 'urdf' is relative to the YAML")
    try:
        root = ElementTree.fromstring(path.read_text(encoding='utf-8'))
        # Pinocchio must see mimic joints as ordinary ones: RobotModel moves them itself.
        mimics = [mimic for joint in root.iter('joint') for mimic in _take_mimics(joint)]
        model = pin.buildModelFromXML(ElementTree.tostring(root, encoding='unicode'))
    except (ElementTree.ParseError, ValueError, KeyError, RuntimeError) as error:
        raise RobotError(
            f"URDF '{path}' cannot be used: {error} (a .xacro file must be expanded first)"
        ) from error
    children = {child.get('link') for child in root.iter('child')}
    base = next(link.attrib['name'] for link in root.iter('link')
                if link.get('name') not in children)  # fmt: skip
    return model, mimics, base


def _take_mimics(joint: ElementTree.Element) -> list[Mimic]:
    mimics = []
    for tag in joint.findall('mimic'):
        joint.remove(tag)
        mimics.append(
            Mimic(
                joint=joint.attrib['name'],
                source=tag.attrib['joint'],
                multiplier=float(tag.get('multiplier', 1.0)),
                offset=float(tag.get('offset', 0.0)),
            )
        )
    return mimics


def _from_dh(values: Mapping[str, Any], base: str, where: str) -> pin.Model:
    arms = _rows(values, 'dh', where)
    if not arms:
        raise ConfigError(f"{where}: 'dh' must be a list of arms")
    model = pin.Model()
    model.name = str(values['name'])
    model.addFrame(pin.Frame(base, 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    for arm in arms:
        check_keys(arm, _ARM_KEYS, ('arm', 'joints'), f'{where}: dh')
        _add_dh_arm(model, arm, f"{where}: dh arm '{arm['arm']}'")
    return model


def _add_dh_arm(model: pin.Model, arm: Mapping[str, Any], where: str) -> None:
    modified = word(arm, 'convention', _CONVENTIONS, where) == 'modified'
    parent, placement = 0, pin.SE3(_pose(arm, where))
    for row in _rows(arm, 'joints', where):
        check_keys(row, _ROW_KEYS, ('joint', 'a', 'alpha', 'd', 'lower', 'upper'), where)
        turns = word(row, 'type', _ROW_TYPES, where) == 'revolute'
        joint = pin.JointModelRZ() if turns else pin.JointModelPZ()
        before, after = _around_joint(row, modified, where)
        parent = _add_joint(model, parent, joint, placement * before, row, where)
        link = f'{row["joint"]}_link'
        model.addFrame(pin.Frame(link, parent, 0, after, pin.FrameType.BODY))
        placement = after
    if 'gripper' in arm:
        check_keys(arm['gripper'], _GRIPPER_KEYS, _GRIPPER_KEYS, f'{where}: gripper')
        _add_joint(model, parent, pin.JointModelPZ(), placement, arm['gripper'], where)


def _around_joint(row: Mapping[str, Any], modified: bool, where: str) -> tuple[pin.SE3, pin.SE3]:
    """What stands before and after the joint's own motion along or about its z.

    The standard row is Rz(theta) Tz(d) Tx(a) Rx(alpha), the modified one (J. Craig, Introduction
    to Robotics, 3.4) Rx(alpha) Tx(a) Rz(theta) Tz(d); motions along and about one axis commute.
    """
    a, alpha, d, theta = (number(row, key, 0.0, where) for key in ('a', 'alpha', 'd', 'theta'))
    turn = pin.SE3(denavit_hartenberg(0.0, 0.0, d, theta))
    twist = pin.SE3(denavit_hartenberg(a, alpha, 0.0, 0.0))
    return (twist * turn, pin.SE3.Identity()) if modified else (turn, twist)


def _add_joint(
    model: pin.Model, parent: int, joint: Any, placement: pin.SE3, row: Mapping[str, Any],
    where: str,
) -> int:  # fmt: skip
    lower, upper = (number(row, key, 0.0, where) for key in ('lower', 'upper'))
    if lower >= upper:
        raise ConfigError(f"{where}: joint '{row['joint']}': lower {lower} is not below {upper}")
    free = np.full(1, np.inf)
    limits = np.array([lower]), np.array([upper])
    return model.addJoint(parent, joint, placement, str(row['joint']), free, free, *limits)
