"""Robots: joints, limits, tools and forward kinematics on one Pinocchio model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import RobotError, TrajectoryError
from mtv_world_ros.core.transforms import inverse, is_rigid

#: how far outside the limits a position is still accepted: recorded states overshoot [rad or m]
LIMIT_TOLERANCE = 1e-3


#: of a joint, link or tool from what carries it [m]
FARTHEST_M = 100.0
#: travel of a finger where the robot's file does not say it [m]
_TRAVEL_M = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class Tool:
    """Tool of an arm: its tool centre point and gripper.

    Attributes:
        arm: name of the arm.
        link: link that carries the tool.
        T_link_tool: (4, 4) pose of the tool centre point in the link [m].
        gripper_joint: joint that opens the gripper, or None.
        gripper_closed: position of the gripper joint when closed [rad or m].
        gripper_open: position of the gripper joint when open [rad or m].
        finger_travel_m: distance of each finger from the tool point along the tool's y axis when
            the gripper is open [m]; None = fingers are not drawn, and taken to be 40 mm away.
    """

    arm: str
    link: str
    T_link_tool: FloatArray
    gripper_joint: str | None = None
    gripper_closed: float = 0.0
    gripper_open: float = 1.0
    finger_travel_m: float | None = None

    def __post_init__(self) -> None:
        offset = np.array(self.T_link_tool, dtype=float)
        if offset.shape != (4, 4) or not is_rigid(offset):
            raise RobotError(
                f"arm '{self.arm}': {offset.tolist()} is not a rigid tool pose (4, 4)"
            )
        offset.flags.writeable = False
        object.__setattr__(self, 'T_link_tool', offset)
        if self.gripper_open == self.gripper_closed:
            raise RobotError(
                f"arm '{self.arm}': gripper_open and gripper_closed are both {self.gripper_open}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Mimic:
    """A joint that follows another: `value = multiplier * source + offset`."""

    joint: str
    source: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinematics:
    """Poses of a robot in its base link, for T positions of its joints.

    Attributes:
        links: T_base_link (T, 4, 4) by name [m].
        tools: (A, T, 4, 4) T_base_tool of the tool centre points [m].
        arm_points: (N, T, 3) points along each arm [m]: the origins of the joints that carry its
            tool, from the base on, and the tool centre point; lines between them are a skeleton of
            the arm.
    """

    links: Mapping[str, FloatArray]
    tools: FloatArray
    arm_points: tuple[FloatArray, ...]


class RobotModel:
    """A robot with any number of arms. Nothing changes after construction: threads may share it.

    Args:
        name: name of the robot.
        model: Pinocchio model of the robot; joints that are neither commanded nor mimics rest at
            zero.
        joint_names: J commanded joints, in the order of all position vectors.
        tools: tools of the robot, one per arm, in the order of all A axes.
        base_link: link in which all poses are given.
        mimics: joints that follow commanded ones.
        speed_limits: largest speeds by joint, in place of those of the model [rad/s or m/s].
        file: the YAML that it was read from; None = made in code.

    Attributes:
        joint_names: J names.
        lower: (J,) smallest positions [rad or m]; -inf for joints that turn without end.
        upper: (J,) largest positions [rad or m].
        velocity_limits: (J,) largest speeds [rad/s or m/s]; inf where not given, which a URDF
            may also write as 0.
        tools: tools of the robot, one per arm, in the order of all A axes.
        mimics: joints that follow commanded ones.
        speed_limits: speeds that were given in place of those of the model.
        pinocchio_model: the model, with every joint of the description.

    Raises:
        RobotError: a joint or link is not in the model.
    """

    def __init__(
        self,
        *,
        name: str,
        model: pin.Model,
        joint_names: Sequence[str],
        tools: Sequence[Tool],
        base_link: str,
        mimics: Sequence[Mimic] = (),
        speed_limits: Mapping[str, float] | None = None,
        file: Path | None = None,
    ) -> None:
        self.name = name
        self.file = file
        self.pinocchio_model = model
        self.joint_names = tuple(joint_names)
        self.tools = tuple(tools)
        self.base_link = base_link
        self.mimics = tuple(mimics)
        _check_places(name, model)
        # links by name; joints have frames too, maybe of the same name
        frames = enumerate(model.frames)
        self._frames = {f.name: i for i, f in frames if f.type == pin.FrameType.BODY}
        self._setters = [
            _Setter.of(self._joint(joint), column) for column, joint in enumerate(self.joint_names)
        ]
        self.speed_limits = dict(speed_limits or {})
        self.lower, self.upper, self.velocity_limits = self._limits()
        self._check_names(mimics)
        self._setters += [
            _Setter.of(
                self._joint(m.joint), self.joint_names.index(m.source), m.multiplier, m.offset
            )
            for m in mimics
        ]
        for link in (base_link, *(tool.link for tool in self.tools)):
            self._frame(link)

    @property
    def is_endless(self) -> BoolArray:
        """(J,) True for commanded joints without limits (continuous)."""
        return np.isinf(self.lower) & ~self.slides

    @property
    def slides(self) -> BoolArray:
        """(J,) True for prismatic joints among the commanded ones."""
        joints = (self._joint(name).shortname() for name in self.joint_names)
        return np.array([name.startswith('JointModelP') for name in joints], np.bool_)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links."""
        return tuple(self._frames)

    @property
    def posed_links(self) -> tuple[str, ...]:
        """Names of the links whose pose in the base link the commanded joints determine."""
        return tuple(link for link in self._frames if not self.unknown_joints(link))

    def unknown_joints(self, link: str) -> tuple[str, ...]:
        """Return the joints between a link and the base link that no commanded joint moves."""
        model = self.pinocchio_model
        ends = [model.frames[self._frame(name)].parentJoint for name in (link, self.base_link)]
        between = set(model.supports[ends[0]]) ^ set(model.supports[ends[1]])
        known = {setter.joint for setter in self._setters}
        return tuple(model.names[joint] for joint in sorted(between - known))

    def forward_kinematics(self, positions: FloatArray) -> dict[str, FloatArray]:
        """Return base_T_link (T, 4, 4) of every link for positions (T, J)."""
        return self._placements(positions, self.link_names)[0]

    def link_poses(self, link: str, positions: FloatArray) -> FloatArray:
        """Return base_T_link (T, 4, 4) of one link for positions (T, J)."""
        return self._placements(positions, (link,))[0][link]

    def tool_poses(self, positions: FloatArray) -> FloatArray:
        """Return base_T_tool (A, T, 4, 4) of the tool centre points for positions (T, J)."""
        links = [tool.link for tool in self.tools]
        return self._tool_poses(self._placements(positions, links)[0])

    def kinematics(self, positions: FloatArray, links: Sequence[str] = ()) -> Kinematics:
        """Return the poses of tools and links and the points along each arm, in one pass.

        Args:
            positions: (T, J) [rad or m].
            links: names of the links.

        Raises:
            RobotError: there is no such link, or the positions have another shape.
        """
        wanted = (*links, *(tool.link for tool in self.tools))
        chains = self._chains()
        joints = sorted({joint for chain in chains for joint in chain})
        poses, origins = self._placements(positions, wanted, joints)
        tools = self._tool_poses(poses)
        arm_points = (
            np.stack([*(origins[joint] for joint in chain), tool[:, :3, 3]])
            for chain, tool in zip(chains, tools, strict=True)
        )
        return Kinematics(
            links={name: poses[name] for name in links},
            tools=tools,
            arm_points=tuple(arm_points),
        )

    def gripper_openings(self, positions: FloatArray) -> FloatArray:
        """Return (A, T) openings in [0, 1] for positions (T, J); 1 where there is no gripper."""
        openings = np.ones((len(self.tools), len(positions)))
        for arm, tool in enumerate(self.tools):
            if tool.gripper_joint is not None:
                values = positions[:, self.joint_names.index(tool.gripper_joint)]
                travel = tool.gripper_open - tool.gripper_closed
                openings[arm] = (values - tool.gripper_closed) / travel
        return openings.clip(0.0, 1.0)

    def finger_gaps(self, positions: FloatArray) -> FloatArray:
        """Return (T, A) how far each finger is from its tool at positions (T, J) [m]."""
        travels = [
            _TRAVEL_M if tool.finger_travel_m is None else tool.finger_travel_m
            for tool in self.tools
        ]
        return self.gripper_openings(positions).T * np.array(travels)

    @property
    def joint_motions(self) -> FloatArray:
        """Matrix (nv, J) from joint velocities to Pinocchio's velocities."""
        follows = np.zeros((self.pinocchio_model.nv, len(self.joint_names)))
        for setter in self._setters:
            follows[setter.velocity, setter.column] = setter.multiplier
        return follows

    def _tool_poses(self, links: Mapping[str, FloatArray]) -> FloatArray:
        """Return (A, T, 4, 4) T_base_tool from the poses of the tools' links."""
        return np.stack([links[tool.link] @ tool.T_link_tool for tool in self.tools])

    def _chains(self) -> list[list[int]]:
        """Return the numbers of the joints that carry each tool, from the base on."""
        model = self.pinocchio_model
        parents = [model.frames[self._frame(tool.link)].parentJoint for tool in self.tools]
        return [list(model.supports[parent])[1:] for parent in parents]

    def _placements(
        self, positions: FloatArray, links: Sequence[str], joints: Sequence[int] = ()
    ) -> tuple[dict[str, FloatArray], dict[int, FloatArray]]:
        """Return T_base_link (T, 4, 4) by link, origins (T, 3) by joint, for positions (T, J)."""
        model, data = self.pinocchio_model, self.pinocchio_model.createData()
        names = tuple(dict.fromkeys((*links, self.base_link)))
        frames = [self._frame(link) for link in names]
        configurations = self.configurations(positions)
        poses = np.empty((len(frames), len(configurations), 4, 4))
        origins = np.empty((len(joints), len(configurations), 3))
        for t, configuration in enumerate(configurations):
            pin.forwardKinematics(model, data, configuration)
            for f, frame in enumerate(frames):
                # .homogeneous is a copy; .translation would alias Pinocchio's buffer
                poses[f, t] = pin.updateFramePlacement(model, data, frame).homogeneous
            for j, joint in enumerate(joints):
                origins[j, t] = data.oMi[joint].translation
        to_base = inverse(poses[names.index(self.base_link)])
        turned = (to_base[:, :3, :3] @ origins[..., None])[..., 0] + to_base[:, :3, 3]
        return (
            dict(zip(names, to_base @ poses, strict=True)),
            dict(zip(joints, turned, strict=True)),
        )

    def configurations(self, positions: FloatArray) -> FloatArray:
        """Return Pinocchio's (T, nq) for positions (T, J); endless joints as cos, sin."""
        positions = np.asarray(positions, dtype=float)
        if positions.ndim != 2 or positions.shape[1] != len(self.joint_names):
            raise RobotError(
                f"positions have shape {positions.shape}, robot '{self.name}' needs "
                f'(T, {len(self.joint_names)})'
            )
        configurations = np.repeat(pin.neutral(self.pinocchio_model)[None], len(positions), axis=0)
        for setter in self._setters:
            values = setter.multiplier * positions[:, setter.column] + setter.offset
            if not setter.endless:
                configurations[:, setter.first] = values
            else:
                configurations[:, setter.first] = np.cos(values)
                configurations[:, setter.first + 1] = np.sin(values)
        return configurations

    def _limits(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        model, joints = self.pinocchio_model, self._setters
        rows = [
            (-np.inf, np.inf)
            if joint.endless
            else (model.lowerPositionLimit[joint.first], model.upperPositionLimit[joint.first])
            for joint in joints
        ]
        lower, upper = np.array(rows, dtype=float).reshape(-1, 2).T.copy()
        if (lower > upper).any():
            joint = int(np.argmax(lower > upper))
            raise RobotError(
                f"joint '{self.joint_names[joint]}' of robot '{self.name}' has its lower limit "
                f'{lower[joint]} above the upper one {upper[joint]}'
            )
        for name, low, high in zip(self.joint_names, lower, upper, strict=True):
            check_can_move(name, low, high, f"robot '{self.name}'")
        speeds = np.array([model.velocityLimit[joint.velocity] for joint in joints])
        speeds = np.where(speeds > 0, speeds, np.inf)
        for name, speed in self.speed_limits.items():
            if name not in self.joint_names:
                raise RobotError.unknown(
                    f"'speed_limits' of robot '{self.name}' names",
                    name,
                    self.joint_names,
                    is_not=', which is not among its joints',
                )
            speeds[self.joint_names.index(name)] = speed
        for array in (lower, upper, speeds):
            array.flags.writeable = False
        return lower, upper, speeds

    def _joint(self, name: str) -> pin.JointModel:
        model = self.pinocchio_model
        if not model.existJointName(name):
            known = list(model.names)[1:]
            raise RobotError.unknown(
                f"robot '{self.name}' has no joint", name, known, listed='; it has'
            )
        joint = model.joints[model.getJointId(name)]
        if joint.nv != 1:
            raise RobotError(
                f"joint '{name}' of robot '{self.name}' is of type {joint.shortname()}; only "
                'joints of one number (revolute, continuous, prismatic) can be commanded'
            )
        return joint

    def _frame(self, link: str) -> int:
        if link not in self._frames:
            raise RobotError.unknown(
                f"robot '{self.name}' has no link", link, self._frames, listed='; it has'
            )
        return self._frames[link]

    def _check_names(self, mimics: Sequence[Mimic]) -> None:
        names = self.joint_names
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise RobotError(f"robot '{self.name}' lists joints {doubled} more than once")
        for mimic in mimics:
            if mimic.joint in names:
                raise RobotError(
                    f"joint '{mimic.joint}' of robot '{self.name}' follows '{mimic.source}'; "
                    "take it out of 'joints'"
                )
            self._check_commanded(mimic.source, f"joint '{mimic.joint}' follows")
        for tool in self.tools:
            if tool.gripper_joint is not None:
                self._check_commanded(tool.gripper_joint, f"arm '{tool.arm}' opens by")

    def _check_commanded(self, joint: str, why: str) -> None:
        if joint not in self.joint_names:
            raise RobotError.unknown(
                f"robot '{self.name}': {why}",
                joint,
                self.joint_names,
                is_not=', which is not among the joints',
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Setter:
    """Place of a joint in Pinocchio's configuration, and the robot's joint it follows.

    Attributes:
        joint: number of the joint in Pinocchio's model.
        first: index of its first entry in a configuration vector.
        velocity: index of its entry in a velocity vector.
        endless: whether the joint turns without limits; its position is then cosine and sine.
        column: column of the robot's joint that it follows.
        multiplier: factor of that joint's position.
        offset: added to it [rad or m].
    """

    joint: int
    first: int
    velocity: int
    endless: bool
    column: int
    multiplier: float
    offset: float

    @classmethod
    def of(
        cls, joint: pin.JointModel, column: int, multiplier: float = 1.0, offset: float = 0.0
    ) -> _Setter:
        return cls(
            joint=joint.id,
            first=joint.idx_q,
            velocity=joint.idx_v,
            endless=joint.nq > 1,
            column=column,
            multiplier=multiplier,
            offset=offset,
        )


def _check_places(name: str, model: pin.Model) -> None:
    """Refuse a description in which something is nowhere, or out of all reach."""
    joints = zip(list(model.names)[1:], list(model.jointPlacements)[1:], strict=True)
    frames = ((frame.name, frame.placement) for frame in model.frames)
    for part, place in [*joints, *frames]:
        if not (np.abs(place.translation) <= FARTHEST_M).all():
            raise RobotError(
                f"'{part}' of robot '{name}' is at {place.translation.tolist()} m from what "
                f'carries it; at most {FARTHEST_M:g} m are accepted'
            )


def check_can_move(joint: str, lower: float, upper: float, where: str) -> None:
    """Refuse a joint whose limits are equal; a URDF without stops has 0 and 0.

    Raises:
        RobotError: names the entry and what to write instead.
    """
    if lower == upper:
        raise RobotError(
            f"joint '{joint}' of {where} cannot move: its limits are {lower:g} and {upper:g}; a "
            "URDF whose <limit> has no 'lower' and 'upper' means 0 and 0. Give both there, make "
            "the joint type 'continuous' if it turns without stops, or leave it out of 'joints' "
            "in the robot's YAML if it rests"
        )


def check_positions(
    robot: RobotModel, positions: FloatArray, *, tolerance: float = LIMIT_TOLERANCE
) -> None:
    """Check positions (T, J) against the joint limits, with a tolerance [rad or m].

    Raises:
        TrajectoryError: names the first joint outside or not finite, its value and the limits.
    """
    inside = (positions >= robot.lower - tolerance) & (positions <= robot.upper + tolerance)
    bad = ~(inside & np.isfinite(positions))
    if bad.any():
        point, joint = np.argwhere(bad)[0]
        raise TrajectoryError(
            f"joint '{robot.joint_names[joint]}' is {positions[point, joint]:.5g} at point "
            f'{point}, its limits are {robot.lower[joint]:.5g} .. {robot.upper[joint]:.5g} '
            f"(set in the description of robot '{robot.name}')"
        )
