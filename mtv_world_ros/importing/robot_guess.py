"""A robot file guessed from a URDF: arms, tools, fingers and base link, to be confirmed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.bounded_input import read_text
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.transforms import quaternion
from mtv_world_ros.robot.file import read_urdf
from mtv_world_ros.robot.model import check_can_move, Mimic
from mtv_world_ros.robot.shape import link_shapes
from mtv_world_ros.robot.xml_file import parse_xml

#: arms of the largest robot that is guessed
MOST_ARMS = 8
#: joints of the largest hand that is guessed; hands of five fingers have up to 24
MOST_FINGER_JOINTS = 24
#: maximum depth of the fork of a gripper, from the ends of its fingers [joints]
_FINGER_JOINTS = 6
#: the tool point is this far inside the finger tips [m]
_TIP_M = 0.0085
#: finger links that end farther than this behind the others have no tip [m]
_BESIDE_TIP_M = 0.015
#: minimum number of joints of an arm
_ARM_JOINTS = 3
#: minimum number of joints of a short arm: a chain without a longer one, or one that ends in
#: fingers (recognised by their names or by mimic joints)
_SHORT_ARM_JOINTS = 2
#: depth of a fork at the end of a short arm that is a gripper [joints]
_SHORT_ARM_FINGER_JOINTS = 2
#: names of tool frames, the best first
_TOOL_NAMES = ('tcp', 'tool0', 'tool_center_point', 'grasp', 'tool', 'ee_link', 'ee', 'flange')
_FINGER_NAMES = ('finger', 'gripper', 'jaw', 'knuckle', 'hand')


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessedRobot:
    """A robot file's values and how they were found.

    Attributes:
        values: values of the YAML.
        notes: one line a guess, with its grounds, and one a joint that was left out.
    """

    values: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Arm:
    """Joints from the base to the last one before the fingers, and the fingers' joints."""

    chain: tuple[int, ...]
    fingers: tuple[int, ...]


def guess_robot(urdf: Path) -> GuessedRobot:
    """Guess arms, tools and fingers.

    An arm is a chain of joints that ends where no joint follows, or where short finger joints
    fork off: those that slide, mimic each other, or are called fingers. The base link is the last
    link before the first joint that moves. The tool is a link that is called one (`tcp`, `tool0`,
    ...) or the point between the fingers.

    Raises:
        ConfigError, RobotError: the URDF cannot be used, or no arm is in it.
    """
    model, mimics, _ = read_urdf(urdf)
    notes: list[str] = []
    resting = [n for n, j in _named_joints(model) if j.nv != 1]
    if resting:
        notes.append(f'joints of several numbers rest: {", ".join(resting)}')
    arms = _arms(model, {mimic.joint for mimic in mimics})
    if not arms:
        raise RobotError(f"'{urdf}' has no arm: no chain of {_SHORT_ARM_JOINTS} joints that move")
    _check_size(urdf, arms)
    base = _base_link(model, arms)
    notes.append(f"base link '{base}': nothing that moves carries it")
    names = _arm_names(model, arms)
    tools, used = [], []
    for name, arm in zip(names, arms, strict=True):
        tools.append(_tool(model, urdf, arm, name, mimics, notes))
        used += [model.names[joint] for joint in arm.chain]
        gripper = tools[-1].get('gripper_joint')
        used += [gripper] if gripper else []
    followers = {mimic.joint for mimic in mimics}
    leaders = {m.source for m in mimics if m.source not in used and m.source not in followers}
    joints = [
        n
        for n, j in _named_joints(model)
        if (n in used or n in leaders) and n not in followers and j.nv == 1
    ]
    for name, joint in _named_joints(model):
        if name in joints and joint.nq == 1:
            low, high = (
                float(limit[joint.idx_q])
                for limit in (model.lowerPositionLimit, model.upperPositionLimit)
            )
            check_can_move(name, low, high, f"'{urdf}'")
    left_out = [n for n, j in _named_joints(model) if j.nv == 1 and n not in {*joints, *followers}]
    if left_out:
        notes.append(f'joints that rest at zero, add those that are recorded: {left_out}')
    values = {
        'name': model.name or urdf.stem,
        'urdf': urdf.name,
        'base_link': base,
        'joints': joints,
        'tools': tools,
    }
    return GuessedRobot(values=values, notes=tuple(notes))


def _named_joints(model: pin.Model) -> list[tuple[str, Any]]:
    return list(zip(model.names[1:], list(model.joints)[1:], strict=True))


def _check_size(urdf: Path, arms: Sequence[_Arm]) -> None:
    """Raise where a robot has more arms or fingers than one has: the guess would take minutes.

    Raises:
        RobotError: it has.
    """
    num_fingers = max(len(arm.fingers) for arm in arms)
    for count, most, what in (
        (len(arms), MOST_ARMS, 'arms'),
        (num_fingers, MOST_FINGER_JOINTS, 'joints of fingers on one arm'),
    ):
        if count > most:
            raise RobotError(
                f"'{urdf}' has {count} {what}; at most {most} are guessed. Write its YAML by "
                "hand, as 'config/robots/yam_bimanual/robot.yaml' shows"
            )


def _arms(model: pin.Model, followers: set[str]) -> list[_Arm]:
    children: dict[int, list[int]] = {joint: [] for joint in range(model.njoints)}
    for joint in range(1, model.njoints):
        children[model.parents[joint]].append(joint)
    is_finger = {
        joint: _is_finger(model, joint, children, followers) for joint in range(1, model.njoints)
    }
    arms = []
    for joint in range(1, model.njoints):
        beyond = [child for child in children[joint] if not is_finger[child]]
        chain = tuple(j for j in list(model.supports[joint])[1:] if model.joints[j].nv == 1)
        if is_finger[joint] or beyond or len(chain) < _SHORT_ARM_JOINTS:
            continue
        fingers = [c for child in children[joint] for c in _below(child, children)]
        arms.append(_Arm(chain=chain, fingers=tuple(fingers)))
    longest = max((len(arm.chain) for arm in arms), default=0)
    if longest >= _ARM_JOINTS:  # a head that pans and tilts is none
        arms = [arm for arm in arms if len(arm.chain) >= _ARM_JOINTS or arm.fingers]
    return [arm for arm in arms if len(arm.chain) >= min(longest, 5) or arm.fingers]


def _is_finger(
    model: pin.Model, joint: int, children: dict[int, list[int]], followers: set[str]
) -> bool:
    """Return True if a joint and all joints beyond it belong to a gripper.

    It is one of several short chains that fork off beyond an arm, or a last joint that is called
    a finger, or stands beyond such a joint. Beyond two joints, names or mimic joints must say so:
    arms fork off there as well.
    """
    before = len(model.supports[joint]) - 2
    if before < _SHORT_ARM_JOINTS:
        return False
    parent = model.parents[joint]
    siblings = children[parent]
    coupled = followers if len(siblings) > 1 else set[str]()
    looks_so = any(_is_called_finger(model, c, coupled) for c in siblings)
    deepest = max(_depth(c, children) for c in siblings)
    if before < _ARM_JOINTS:
        return looks_so and deepest <= _SHORT_ARM_FINGER_JOINTS
    if len(siblings) > 1 and deepest <= _FINGER_JOINTS:
        return True
    if not children[joint] and _is_called_finger(model, joint, followers):
        return True
    return _is_finger(model, parent, children, followers)


def _is_called_finger(model: pin.Model, joint: int, followers: set[str]) -> bool:
    """Return True if a joint or its link is named like a finger, or if it is a mimic joint."""
    link = next((f.name for f in model.frames if f.parentJoint == joint and _is_body(f)), '')
    names = (model.names[joint].lower(), link.lower())
    return model.names[joint] in followers or any(
        word in name for word in _FINGER_NAMES for name in names
    )


def _depth(joint: int, children: dict[int, list[int]]) -> int:
    return 1 + max((_depth(child, children) for child in children[joint]), default=0)


def _is_body(frame: Any) -> bool:
    return frame.type == pin.FrameType.BODY


def _slides(model: pin.Model, joint: int) -> bool:
    return model.joints[joint].shortname().startswith('JointModelP')


def _below(joint: int, children: dict[int, list[int]]) -> list[int]:
    return [joint, *(c for child in children[joint] for c in _below(child, children))]


def _base_link(model: pin.Model, arms: Sequence[_Arm]) -> str:
    """Return the link that carries the first joint all arms share, or both arms' first joints."""
    roots = {model.parents[arm.chain[0]] for arm in arms}
    joint = roots.pop() if len(roots) == 1 else 0
    frames = [f for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint]
    first = arms[0].chain[0]
    carrier = model.frames[_joint_frame(model, first)].parentFrame
    if model.frames[carrier].type == pin.FrameType.BODY and len(arms) == 1:
        return model.frames[carrier].name
    return frames[0].name


def _joint_frame(model: pin.Model, joint: int) -> int:
    return model.getFrameId(model.names[joint], pin.FrameType.JOINT)


def _arm_names(model: pin.Model, arms: Sequence[_Arm]) -> list[str]:
    names = []
    for number, arm in enumerate(arms):
        text = ' '.join(model.names[j].lower() for j in arm.chain)
        side = next((s for s in ('left', 'right') if s in text), '')
        names.append(side or ('arm' if len(arms) == 1 else f'arm{number + 1}'))
    return names if len(set(names)) == len(names) else [f'arm{n + 1}' for n in range(len(arms))]


def _tool(
    model: pin.Model, urdf: Path, arm: _Arm, name: str, mimics: Sequence[Mimic], notes: list[str]
) -> dict[str, Any]:
    link, link_pose = _tool_link(model, arm)
    tool: dict[str, Any] = {'arm': name, 'link': link}
    if not arm.fingers:
        notes.append(f"arm '{name}': tool at link '{link}', no fingers found")
        return tool
    hand = _Hand(model, urdf, arm, mimics)
    T = link_pose.inverse().homogeneous @ hand.tool_pose()
    tool |= {
        'position': [round(float(x), 5) + 0.0 for x in T[:3, 3]],
        'quaternion_xyzw': [round(float(x), 7) + 0.0 for x in quaternion(T[:3, :3])],
        'gripper_joint': model.names[hand.joint],
        'gripper_closed': round(hand.closed, 6) + 0.0,  # no -0.0
        'gripper_open': round(hand.open, 6) + 0.0,
        'finger_travel_m': hand.travel_m,
    }
    notes.append(
        f"arm '{name}': tool in link '{link}' between the fingers of '{tool['gripper_joint']}': "
        f'open at {hand.open:.4g}, closed at {hand.closed:.4g}, by {hand.source}'
    )
    return tool


class _Hand:
    """Fingers of an arm: where they are when open and when closed, in its last joint [m]."""

    def __init__(self, model: pin.Model, urdf: Path, arm: _Arm, mimics: Sequence[Mimic]) -> None:
        self._model, self._arm = model, arm
        self.joint = _gripper_joint(model, arm, mimics)
        self._followers = {m.joint: m for m in mimics if m.source == model.names[self.joint]}
        self._points = _finger_points(model, urdf, arm)
        self.source = 'their shapes' if self._points else 'the origins of their joints'
        limits = model.lowerPositionLimit, model.upperPositionLimit
        low, high = (float(limit[model.joints[self.joint].idx_q]) for limit in limits)
        spans = {value: self._span(value) for value in (low, high)}
        self.open, self.closed = (high, low) if spans[high] >= spans[low] else (low, high)
        slides = _slides(model, self.joint)
        travel_m = abs(self.open - self.closed) if slides else self._way()
        self.travel_m = round(travel_m, 5)

    def tool_pose(self) -> FloatArray:
        """Return a frame near the finger tips: z away from the arm, y along a finger's motion."""
        shut, opened = self._tips()
        T = np.eye(4)
        middle = np.mean([points.mean(axis=0) for points in shut], axis=0)
        T[:3, 3] = middle
        axes = self._turned_axes(opened, middle) or _slid_axes(shut, opened, middle)
        if axes is None:
            return T
        T[:3, :3] = np.stack(axes, axis=1)
        ends = np.array([[(p @ T[:3, :3]).min(axis=0), (p @ T[:3, :3]).max(axis=0)] for p in shut])
        place = ends.mean(axis=(0, 1))  # of the extents: meshes have more points on one side
        place[2] = max(place[2], float(ends[..., 2].max()) - _TIP_M)
        T[:3, 3] = T[:3, :3] @ place
        return T

    def _way(self) -> float:
        """Return the travel of the finger tips along the tool's y axis [m], without their tilt."""
        y = self.tool_pose()[:3, 1]
        pairs = zip(*self._tips(), strict=True)
        return float(np.mean([abs((wide - shut).mean(axis=0) @ y) for shut, wide in pairs]))

    def _tips(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the points of the finger links that reach farthest, shut and open."""
        shut, opened = self._fingers(self.closed), self._fingers(self.open)
        ahead = np.mean([points.mean(axis=0) for points in opened], axis=0)
        ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
        reach = np.array([float((points @ ahead).max()) for points in opened])
        chosen = np.flatnonzero(reach > reach.max() - _BESIDE_TIP_M)
        if len(chosen) < 2:  # a thumb
            return shut, opened
        return [shut[n] for n in chosen], [opened[n] for n in chosen]

    def _turned_axes(
        self, opened: Sequence[FloatArray], middle: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return the x, y, z of fingers that turn about an axis; None where they slide.

        A tip that turns moves on an arc: the line between the tips is taken in its place.
        """
        if _slides(self._model, self.joint) or len(opened) != 2:
            return None
        x = self._axis()
        y = opened[0].mean(axis=0) - opened[1].mean(axis=0)
        y -= (y @ x) * x
        if np.linalg.norm(y) < 1e-3:
            return None
        y /= np.linalg.norm(y)
        z = np.asarray(np.cross(x, y), np.float64)
        if abs(float(z @ middle)) < 1e-3:
            return None
        x, z = (x, z) if z @ middle > 0 else (-x, -z)
        return x, y, z

    def _axis(self) -> FloatArray:
        """Return the axis (3,) of the gripper's joint, in the frame of the arm's last joint."""
        model, data = self._model, self._model.createData()
        configuration = pin.neutral(model)
        pin.computeJointJacobians(model, data, configuration)
        turns = pin.getJointJacobian(model, data, self.joint, pin.ReferenceFrame.WORLD)
        axis = np.asarray(turns[3:, model.joints[self.joint].idx_v], np.float64)
        last = np.asarray(data.oMi[self._arm.chain[-1]].rotation, np.float64)
        return last.T @ axis

    def _span(self, value: float) -> float:
        centres = np.array([points.mean(axis=0) for points in self._fingers(value)])
        return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())

    def _fingers(self, value: float) -> list[FloatArray]:
        """Return the points (N, 3) of each outermost finger link."""
        model, data = self._model, self._model.createData()
        configuration = pin.neutral(model)
        for joint in self._arm.fingers:
            follower = self._followers.get(model.names[joint])
            place = model.joints[joint].idx_q
            if follower is not None:
                configuration[place] = follower.multiplier * value + follower.offset
            elif joint == self.joint or _slides(model, joint):  # a slide that nothing couples
                configuration[place] = value
        pin.forwardKinematics(model, data, configuration)
        inner = {model.parents[joint] for joint in self._arm.fingers}
        to_last = data.oMi[self._arm.chain[-1]].inverse()
        found = []
        for joint in self._arm.fingers:
            if joint not in inner:
                points = self._points.get(joint, np.zeros((1, 3)))
                T = np.array((to_last * data.oMi[joint]).homogeneous)
                found.append(points @ T[:3, :3].T + T[:3, 3])
        if len(found) == 1:  # the other jaw does not move
            found.append(np.zeros((1, 3)))
        return found


def _slid_axes(
    shut: Sequence[FloatArray], opened: Sequence[FloatArray], middle: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the x, y, z of fingers that slide; None where they do not move."""
    y = opened[0].mean(axis=0) - shut[0].mean(axis=0)
    if np.linalg.norm(y) < 1e-6:
        return None
    y /= np.linalg.norm(y)
    z = middle - (middle @ y) * y
    if np.linalg.norm(z) < 1e-3:
        return None
    z /= np.linalg.norm(z)
    return np.asarray(np.cross(y, z), np.float64), y, z


def _finger_points(model: pin.Model, urdf: Path, arm: _Arm) -> dict[int, FloatArray]:
    """Return the points of the finger links' shapes in their joints' frames.

    Empty where one has none.
    """
    root = parse_xml(read_text(urdf, 'urdf_bytes'))
    links = {link.get('name'): link for link in root.iter('link')}
    found = {}
    for joint in arm.fingers:
        points = []
        for frame in model.frames:
            if frame.parentJoint == joint and _is_body(frame):
                shapes, _ = link_shapes(links[frame.name], urdf)
                T = frame.placement.homogeneous
                points += [s.points @ T[:3, :3].T + T[:3, 3] for s in shapes]
        if not points:
            return {}
        found[joint] = np.concatenate(points)
    return found


def _tool_link(model: pin.Model, arm: _Arm) -> tuple[str, Any]:
    """Return the link that carries the tool and its pose in the last joint.

    A named one if there is.
    """
    last = arm.chain[-1]
    carried = [
        f for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == last
    ]  # fmt: skip
    if not arm.fingers:
        for word in _TOOL_NAMES:
            for frame in carried:
                if word in frame.name.lower().replace('-', '_').split('_') or (
                    len(word) > 4 and word in frame.name.lower()
                ):
                    return frame.name, frame.placement
        return carried[-1].name, carried[-1].placement
    parent = model.parents[arm.fingers[0]]
    frame = model.frames[model.frames[_joint_frame(model, arm.fingers[0])].parentFrame]
    if frame.type != pin.FrameType.BODY or frame.parentJoint != parent:
        frame = carried[-1]
    return frame.name, frame.placement


def _gripper_joint(model: pin.Model, arm: _Arm, mimics: Sequence[Mimic]) -> int:
    """Return the joint that the others follow, or else the first one."""
    sources = [mimic.source for mimic in mimics]
    names = {model.names[j]: j for j in arm.fingers}
    led = max(names, key=sources.count)
    return names[led] if sources.count(led) else arm.fingers[0]
