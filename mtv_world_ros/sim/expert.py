"""The scripted expert: top-down pick and place as one joint trajectory, and misses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.sim.arm import FINGER_WIDTH_M
from mtv_world_ros.sim.kinematics import ArmSolver, top_down
from mtv_world_ros.sim.randomize import arm_of, goal_position
from mtv_world_ros.sim.scene import Scene, SceneObject
from mtv_world_ros.sim.tasks import PickPlace, Task

#: the tools' rest poses in the base frame [m], pointing down, in view of both cameras
HOME_TOOL = {'left': (-0.2, 0.17, 0.13), 'right': (0.2, 0.17, 0.13)}
_HOME_SEED = np.array([0.0, 1.5, 1.5, -1.4, 0.0, 0.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpertConfig:
    """Heights, speeds and timing of the expert.

    Attributes:
        rate_hz: samples of the trajectory per second.
        above_grasp: height of the pre-grasp over the grasp, range [m].
        lift: height of the lift, range [m].
        above_place: height of the pre-place over the place [m].
        retreat: rise after opening [m].
        close_s: time to close the gripper.
        open_s: time to open it.
        speed: mean speed of the tool between way points [m/s], before scaling.
        least_s: shortest move between way points, before scaling.
        motion_s: time from first to last motion per move, range; the plan is scaled to it.
        miss_margin: gap between the fingers and an object that is missed, range [m].
    """

    rate_hz: float = 50.0
    above_grasp: tuple[float, float] = (0.09, 0.10)
    lift: tuple[float, float] = (0.07, 0.10)
    above_place: float = 0.05
    retreat: float = 0.07
    close_s: float = 0.4
    open_s: float = 0.3
    speed: float = 0.22
    least_s: float = 0.4
    motion_s: tuple[float, float] = (6.0, 6.5)
    miss_margin: tuple[float, float] = (0.004, 0.01)


@dataclass(frozen=True, slots=True)
class _WayPoint:
    """Where one arm's tool is at the end of a segment: position, yaw, opening, duration."""

    position: FloatArray
    yaw: float
    opening: float
    seconds: float


def home_positions(robot: RobotModel) -> FloatArray:
    """Returns the joint positions (J,) of both arms at rest, grippers open."""
    positions = np.zeros(len(robot.joint_names))
    for tool in robot.tools:
        solver = ArmSolver(robot, tool)
        pose = top_down(np.asarray(HOME_TOOL[tool.arm]), 0.0)
        positions[solver.indices] = solver.solve(pose, _HOME_SEED)
        if tool.gripper_joint is not None:
            positions[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions


def _nearest_turn(yaw: float) -> float:
    """A square object looks the same every quarter turn: the yaw nearest to none."""
    return float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def miss_offset(
    subject: SceneObject, others: list[SceneObject], yaw: float, margin: float
) -> FloatArray:
    """Returns the sideways shift (3,) [m] with which the closing fingers miss the subject.

    The shift is 2-4 cm across the fingers' travel, to the side with more room.
    """
    distance = min(subject.size[1] / 2 + FINGER_WIDTH_M / 2 + margin, 0.04)
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    position = np.asarray(subject.position)

    def room(shift: FloatArray) -> float:
        gaps = [np.linalg.norm((position + shift - item.position)[:2]) for item in others]
        return float(min(gaps, default=1.0))

    return max((distance * across, -distance * across), key=room)


class Expert:
    """Plans a task's moves for a scene, from the objects' true start poses."""

    def __init__(self, robot: RobotModel, config: ExpertConfig | None = None) -> None:
        self.robot = robot
        self.home = home_positions(robot)
        self._config = config or ExpertConfig()
        self._solvers = {tool.arm: ArmSolver(robot, tool) for tool in robot.tools}
        self._tools = {tool.arm: tool for tool in robot.tools}

    def plan(
        self, task: Task, scene: Scene, rng: np.random.Generator, *, miss: bool
    ) -> JointTrajectory:
        """Returns the trajectory (T, J) with velocities that carries out the task's moves.

        Args:
            task: what to do.
            scene: where everything is at the start.
            rng: draws heights, tempo and the size of a miss.
            miss: displace the first grasp so that the gripper closes on nothing.

        Raises:
            SimulatorError: a way point is out of the arm's reach.
        """
        items = {item.role: item for item in scene.objects}
        pieces = [self.home[None]]
        for number, move in enumerate(task.moves):
            arm = arm_of(items[move.subject])
            points = self._way_points(move, items, arm, rng, miss=miss and number == 0)
            pieces.append(self._follow(arm, points, rng))
        positions = np.concatenate(pieces)
        rate = self._config.rate_hz
        return JointTrajectory(
            joint_names=self.robot.joint_names,
            times=np.arange(len(positions)) / rate,
            positions=positions,
            velocities=np.gradient(positions, 1 / rate, axis=0),
        )

    def _way_points(
        self,
        move: PickPlace,
        items: dict[str, SceneObject],
        arm: str,
        rng: np.random.Generator,
        *,
        miss: bool,
    ) -> list[_WayPoint]:
        config, subject, reference = self._config, items[move.subject], items[move.reference]
        yaw = _nearest_turn(subject.yaw)
        turned = _nearest_turn(reference.yaw) if move.on_top else yaw
        grasp = np.asarray(subject.position)
        if miss:
            others = [item for item in items.values() if item is not subject]
            margin = float(rng.uniform(*config.miss_margin))
            grasp = grasp + miss_offset(subject, others, yaw, margin)
        goal = np.asarray(goal_position(move, subject, reference)) + np.array([0, 0, 0.002])
        home = np.asarray(HOME_TOOL[arm])
        above, lift = (
            np.array([0, 0, rng.uniform(*r)]) for r in (config.above_grasp, config.lift)
        )
        pre_place = goal + np.array([0, 0, config.above_place])
        lifted = np.array([*grasp[:2], max(grasp[2] + lift[2], pre_place[2])])
        stops = [
            (grasp + above, yaw, 1.0, None),
            (grasp, yaw, 1.0, None),
            (grasp, yaw, 0.0, config.close_s),
            (lifted, yaw, 0.0, None),
            (pre_place, turned, 0.0, None),
            (goal, turned, 0.0, None),
            (goal, turned, 1.0, config.open_s),
            (goal + np.array([0, 0, config.retreat]), turned, 1.0, None),
            (home, 0.0, 1.0, None),
        ]
        return self._timed(home, stops)

    def _timed(
        self, home: FloatArray, stops: list[tuple[FloatArray, float, float, float | None]]
    ) -> list[_WayPoint]:
        points = [_WayPoint(home, 0.0, 1.0, 0.0)]
        for position, yaw, opening, seconds in stops:
            travel = float(np.linalg.norm(position - points[-1].position))
            moving = max(travel / self._config.speed, self._config.least_s)
            points.append(_WayPoint(position, yaw, opening, seconds or moving))
        return points

    def _follow(self, arm: str, points: list[_WayPoint], rng: np.random.Generator) -> FloatArray:
        """Minimum-jerk blends between way points, scaled to the drawn motion time."""
        config = self._config
        scale = rng.uniform(*config.motion_s) / sum(point.seconds for point in points)
        ends = np.cumsum([point.seconds * scale for point in points])
        solver, tool = self._solvers[arm], self._tools[arm]
        rows, joints = [], self.home[solver.indices]
        for time in np.arange(1, round(ends[-1] * config.rate_hz) + 1) / config.rate_hz:
            k = min(int(np.searchsorted(ends[1:], time)), len(points) - 2)
            share = np.clip((time - ends[k]) / (ends[k + 1] - ends[k]), 0.0, 1.0)
            blend = share**3 * (10 - 15 * share + 6 * share**2)
            a, b = points[k], points[k + 1]
            pose = top_down(
                a.position + blend * (b.position - a.position), a.yaw + blend * (b.yaw - a.yaw)
            )
            joints = solver.solve(pose, joints)
            row = self.home.copy()
            row[solver.indices] = joints
            opening = a.opening + blend * (b.opening - a.opening)
            if tool.gripper_joint is not None:
                row[self.robot.joint_names.index(tool.gripper_joint)] = (
                    tool.gripper_closed + opening * (tool.gripper_open - tool.gripper_closed)
                )
            rows.append(row)
        return np.asarray(rows)
