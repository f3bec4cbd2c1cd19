"""The scripted expert: top-down pick and place as one joint trajectory, and misses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import SimulatorError, TrajectoryError
from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.robot.arm_solver import ArmSolver
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.faults.variant_faults import WayPointFaults
from mtv_world_ros.simulation.physics import physics_named
from mtv_world_ros.simulation.scenes.placement import side_of
from mtv_world_ros.simulation.scenes.scene import Place, Scene, SceneObject
from mtv_world_ros.simulation.scenes.shapes import Grasp, SHAPES
from mtv_world_ros.simulation.scenes.tasks import Move, PickPlace, Shake, Task
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.way_points import ring, UP, Visit, WayPoint

#: step in the search for the longest reachable part of a path [fraction of the path]
_SHORTENING_STEP = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class PickingConfig:
    """Gaps between fingers and objects.

    Attributes:
        release: gap on either side of the object when the fingers release it; they open fully
            above it [m].
        miss_margin: range of the gap between the fingers and an object that they miss [m].
        max_miss: largest shift past an object, across the fingers' travel [m].
    """

    release: float = 0.008
    miss_margin: tuple[float, float] = (0.004, 0.01)
    max_miss: float = 0.045


@dataclass(frozen=True, slots=True)
class Pick:
    """Grasp of one object by one arm.

    Attributes:
        arm: name of the arm.
        position: position of the tool at the grasp (3,) [m].
        yaw: yaw of the tool [rad].
        opening: opening of the gripper on the way down, 0..1.
        released: opening of the gripper when the object is let go, 0..1.
    """

    arm: str
    position: FloatArray
    yaw: float
    opening: float
    released: float


def grasp_of(subject: SceneObject) -> Grasp:
    """Return the grasp of the object's shape."""
    grasp = SHAPES[subject.shape].grasp
    assert grasp is not None, f'{subject.shape} cannot be grasped'
    return grasp


def tool_yaw(item: SceneObject) -> float:
    """Return the yaw nearest to none under which the object looks the same to a gripper."""
    step = SHAPES[item.shape].step
    return float((item.yaw + step / 2) % step - step / 2)


def tool_offset(subject: SceneObject, yaw: float) -> FloatArray:
    """Return the way (3,) from an object's centre, turned by `yaw`, to the tool that holds it."""
    grasp = grasp_of(subject)
    out = grasp.offset(subject.size, side_of(subject))
    height = (grasp.height - 0.5) * subject.size[2]
    return np.array([out * np.cos(yaw), out * np.sin(yaw), height])


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpertConfig:
    """Heights, speeds and timing of the expert.

    Attributes:
        rate_hz: samples of the trajectory per second.
        above_grasp: height of the pre-grasp over the grasp, range [m].
        lift: height of the lift, range [m].
        above_place: height of the pre-place over the place [m].
        above_drop: height of the pre-place over a container, where the object is let go higher up
            [m].
        drop: height of the lowest point over a container's wall, where it is let go [m].
        retreat: rise after opening [m].
        close_s: time to close the gripper [s].
        open_s: time to open the gripper [s].
        shake_lift: height at which an object is shaken, over where it stood, range [m].
        shake_lean: angles that it leans by in turn, positive towards the table's middle [rad]; the
            wrist has less room the other way.
        num_swings: number of swings of a shake from one side to the other.
        swing_s: time of one swing of a shake [s].
        speed: mean speed of the tool between way points [m/s], before scaling.
        least_s: shortest move between way points, before scaling [s].
        motion_s: range of the time from first to last motion in a task of one move, to which the
            plan is scaled [s].
        motions_s: range of this time for each move in a task of several [s].
        overlap_s: time before the end of a move at which the other arm may start [s].
        picking: gaps between fingers and objects.
    """

    rate_hz: float = 50.0
    above_grasp: tuple[float, float] = (0.09, 0.10)
    lift: tuple[float, float] = (0.07, 0.10)
    above_place: float = 0.05
    above_drop: float = 0.025
    drop: float = 0.008
    retreat: float = 0.07
    close_s: float = 0.4
    open_s: float = 0.3
    shake_lift: tuple[float, float] = (0.074, 0.082)
    shake_lean: tuple[float, float] = (0.45, -0.1)
    num_swings: int = 4
    swing_s: float = 0.45
    speed: float = 0.22
    least_s: float = 0.4
    motion_s: tuple[float, float] = (6.0, 6.5)
    motions_s: tuple[float, float] = (4.8, 5.2)
    overlap_s: float = 2.2
    picking: PickingConfig = PickingConfig()


def top_down(position: FloatArray, yaw: float, lean: float = 0.0) -> FloatArray:
    """Return base_T_tool (4, 4) of a tool that points down; the fingers close along `yaw`.

    The tool's frame has z along the fingers and y along their travel; at yaw 0 the fingers move
    along the base's x. `lean` [rad] swings the tool about its own x, in the plane of the travel.
    """
    cos, sin = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    down = np.array([[sin, -cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, -1.0]])
    pose[:3, :3] = down @ rotation((np.sin(lean / 2), 0.0, 0.0, np.cos(lean / 2)))
    pose[:3, 3] = position
    return pose


def home_positions(robot: RobotModel) -> FloatArray:
    """Return the joint positions (J,) of all arms at rest, grippers open."""
    positions, workcell = np.zeros(len(robot.joint_names)), workcell_of(robot)
    for tool in robot.tools:
        solver, near = ArmSolver(robot, tool), workcell.home_joints[tool.arm]
        pose = top_down(workcell.home_tools[tool.arm], 0.0)
        positions[solver.indices] = solver.solve(pose, near)
        if tool.gripper_joint is not None:
            positions[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions


def _missed_move(task: Task, rng: np.random.Generator) -> int:
    return int(rng.integers(len(task.moves)))


class Expert:
    """Plans a task's moves for a scene, from the objects' true start poses."""

    def __init__(
        self,
        robot: RobotModel,
        config: ExpertConfig | None = None,
        physics: str = NOMINAL,
    ) -> None:
        self.robot = robot
        self.workcell = physics_named(physics).workcell(workcell_of(robot))
        self.home = home_positions(robot)
        self._config = config or ExpertConfig()
        self._solvers = {}
        for tool in robot.tools:
            rest = self.home[ArmSolver(robot, tool).indices]
            self._solvers[tool.arm] = ArmSolver(robot, tool, rest)
        self._tools = {tool.arm: tool for tool in robot.tools}
        self._max_gap = {
            tool.arm: abs(tool.gripper_open - tool.gripper_closed) for tool in robot.tools
        }

    def plan(
        self,
        task: Task,
        scene: Scene,
        rng: np.random.Generator,
        *,
        miss: bool,
        faults: WayPointFaults | None = None,
    ) -> JointTrajectory:
        """Return the trajectory (T, J) with velocities that carries out the task's moves.

        Two moves of different arms overlap: one arm reaches out while the other goes home.

        Args:
            task: the task to carry out.
            scene: start poses of all objects, and the goals.
            rng: draws heights, tempo and the size of a miss.
            miss: displace one grasp so that the gripper closes on nothing.
            faults: faults of the way points of one move.

        Raises:
            SimulatorError: a way point is out of the arm's reach.
        """
        now = {item.role: item for item in scene.objects}
        missed = _missed_move(task, rng) if miss else None
        rate = self._config.rate_hz
        positions, busy, last_arm = self.home[None], 1, ''
        free: dict[str, int] = {}
        for number, (move, goal) in enumerate(zip(task.moves, scene.goals, strict=True)):
            pick = self._pick(now, move, rng, miss=number == missed)
            stops = fault_free = self._stops(pick, move, now, goal, rng)
            other = next((arm for arm in self._tools if arm != pick.arm), '')
            draws = None
            if faults is not None and number == faults.move_of(len(task.moves)):
                rests = self.workcell.home_tools[other] if other else None
                objects = [np.asarray(item.position) for item in now.values()]
                draws = faults.draws(pick.yaw, objects, rests)
                stops = faults.applied(stops, draws)
            timed = fault_free if faults is not None and faults.keeps_tempo else stops
            pace = self._pace(pick.arm, timed, rng, alone=len(task.moves) == 1)
            second_arm: list[tuple[FloatArray, int]] = []
            if faults is not None and draws is not None and other:
                times = self._timed(stops, self.workcell.home_tools[pick.arm])
                visits = faults.visits(stops, draws, self._rests(other), times)
                waits, second_arm = self._visits(other, visits, pace)
                stops = [replace(stops[0], seconds=times[0] + waits), *stops[1:]]
            rows = self._follow(pick.arm, stops, pace)
            overlap = round(self._config.overlap_s * rate) if pick.arm != last_arm else 0
            start = max(1, busy - overlap, free.get(pick.arm, 1))
            busy = free[pick.arm] = start + len(rows)
            last_arm = pick.arm
            positions = self._lay(positions, rows, start, pick.arm)
            for rows, before in second_arm:
                first = max(start + before, free.get(other, 1))
                free[other] = first + len(rows)
                positions = self._lay(positions, rows, first, other)
            now[move.subject] = replace(now[move.subject], position=goal)
        return JointTrajectory(
            joint_names=self.robot.joint_names,
            times=np.arange(len(positions)) / rate,
            positions=positions,
            velocities=np.gradient(positions, 1 / rate, axis=0),
        )

    @staticmethod
    def missed_object(task: Task, rng: np.random.Generator) -> str:
        """Return the role that `plan` with the same generator misses."""
        return task.moves[_missed_move(task, rng)].subject

    def _lay(self, whole: FloatArray, rows: FloatArray, start: int, arm: str) -> FloatArray:
        """Put one arm's rows into the whole plan from `start` on; the arms rest at home."""
        num = max(len(whole), start + len(rows))
        longer = np.concatenate([whole, np.repeat(self.home[None], num - len(whole), axis=0)])
        columns = self._columns(arm)
        longer[start : start + len(rows), columns] = rows[:, columns]
        return longer

    def _columns(self, arm: str) -> list[int]:
        gripper = self._tools[arm].gripper_joint
        more = [] if gripper is None else [self.robot.joint_names.index(gripper)]
        return [*self._solvers[arm].indices, *more]

    def _pick(
        self, now: dict[str, SceneObject], move: Move, rng: np.random.Generator, *, miss: bool
    ) -> Pick:
        subject, config = now[move.subject], self._config.picking
        arm, yaw, grasp = (
            self.workcell.arm_at(subject.position[0]),
            tool_yaw(subject),
            grasp_of(subject),
        )
        position = np.asarray(subject.position) + tool_offset(subject, yaw)
        if miss:
            others = [item for item in now.values() if item is not subject]
            position = position + self._miss_shift(subject, others, self._max_gap[arm], rng)
        gap = grasp.width(subject.size) / 2 + config.release
        return Pick(
            arm=arm,
            position=position,
            yaw=yaw,
            opening=grasp.opening,
            released=min(1.0, gap / self._max_gap[arm]),
        )

    def _miss_shift(
        self,
        subject: SceneObject,
        others: Sequence[SceneObject],
        max_gap: float,
        rng: np.random.Generator,
    ) -> FloatArray:
        """Return a sideways shift (3,) [m] that makes the closing fingers miss the subject.

        Past a rim it goes outwards, past anything else across the fingers' travel, to the side
        with more room.
        """
        yaw, grasp, config = tool_yaw(subject), grasp_of(subject), self._config.picking
        margin = float(rng.uniform(*config.miss_margin))
        if grasp.rim_m is not None:
            side = np.sign(grasp.offset(subject.size, side_of(subject)))
            inner = grasp.opening * max_gap + self.workcell.finger_thickness_m
            return side * (grasp.rim_m / 2 + inner + margin) * ring(yaw)
        distance = subject.size[1] / 2 + self.workcell.finger_width_m / 2 + margin
        across = min(distance, config.max_miss) * ring(yaw + np.pi / 2)
        place = np.asarray(subject.position)

        def room(shift: FloatArray) -> float:
            gaps = [np.linalg.norm((place + shift - item.position)[:2]) for item in others]
            return float(min(gaps, default=1.0))

        return max((across, -across), key=room)

    def _stops(
        self,
        pick: Pick,
        move: Move,
        now: dict[str, SceneObject],
        goal: Place,
        rng: np.random.Generator,
    ) -> list[WayPoint]:
        config, place, yaw, wide = self._config, pick.position, pick.yaw, pick.opening
        heights = config.lift if isinstance(move, PickPlace) else config.shake_lift
        above, lift = (rng.uniform(*r) * UP for r in (config.above_grasp, heights))
        start = [
            WayPoint('above', place + above, yaw, wide),
            WayPoint('grasp', place, yaw, wide),
            WayPoint('close', place, yaw, 0.0, config.close_s),
        ]
        if isinstance(move, Shake):
            middle = self._swings(pick, place + lift, -side_of(now[move.subject]))
            down, turned = place + 0.002 * UP, yaw
        else:
            down, turned = self._place(pick, move, now, goal)
            above_goal = config.above_place if move.rest != 'in' else config.above_drop
            pre_place = down + above_goal * UP
            lifted = np.array([*place[:2], max(place[2] + lift[2], pre_place[2])])
            middle = [
                WayPoint('lift', lifted, yaw, 0.0),
                WayPoint('carry', pre_place, turned, 0.0),
            ]
        home = self.workcell.home_tools[pick.arm]
        return [
            *start,
            *middle,
            WayPoint('lower', down, turned, 0.0),
            WayPoint('open', down, turned, pick.released, config.open_s),
            WayPoint('retreat', down + config.retreat * UP, turned, 1.0),
            WayPoint('home', home, 0.0, 1.0),
        ]

    def _swings(self, pick: Pick, lifted: FloatArray, inwards: float) -> list[WayPoint]:
        upright = WayPoint('lift', lifted, pick.yaw, 0.0)
        swings = [
            replace(
                upright,
                phase='carry',
                lean=inwards * self._config.shake_lean[k % 2],
                seconds=self._config.swing_s,
            )
            for k in range(self._config.num_swings)
        ]
        return [upright, *swings, replace(upright, phase='carry')]

    def _place(
        self, pick: Pick, move: PickPlace, now: dict[str, SceneObject], goal: Place
    ) -> tuple[FloatArray, float]:
        """Return the tool position and yaw at which the subject is let go."""
        subject, turned, rest = now[move.subject], pick.yaw, np.asarray(goal)
        if move.rest != 'table':
            reference = now[move.reference]
            turned = tool_yaw(reference)
            if move.rest == 'in':
                top = reference.position[2] + reference.size[2] / 2
                rest = np.array([*goal[:2], top + self._config.drop + subject.size[2] / 2])
        return rest + tool_offset(subject, turned) + 0.002 * UP, turned

    def _timed(self, stops: list[WayPoint], home: FloatArray) -> list[float]:
        """Time of each segment before scaling [s]."""
        seconds, before = [], home
        for point in stops:
            travel = float(np.linalg.norm(point.position - before))
            seconds.append(point.seconds or max(travel / self._config.speed, self._config.least_s))
            before = point.position
        return seconds

    def _pace(
        self, arm: str, usual: list[WayPoint], rng: np.random.Generator, *, alone: bool
    ) -> tuple[float, float]:
        """Return the drawn motion time, and what the usual way points take before scaling [s]."""
        wanted = rng.uniform(*(self._config.motion_s if alone else self._config.motions_s))
        return wanted, sum(self._timed(usual, self.workcell.home_tools[arm]))

    def _visits(
        self, other: str, visits: Sequence[Visit], pace: tuple[float, float]
    ) -> tuple[float, list[tuple[FloatArray, int]]]:
        """Seconds that the first arm waits, and the second arm's rows with their first row."""
        waits, rows_of_visits = 0.0, list[tuple[FloatArray, int]]()
        for visit in visits:
            rows, done = self._as_far_as_it_reaches(other, visit.ways, visit.share, pace)
            takes = sum(self._timed(done[: visit.done], self.workcell.home_tools[other]))
            late = visit.meets - takes + visit.is_timed * waits
            waits = max(waits, -late) if visit.waits else waits
            rows_of_visits.append((rows, self._late(late, pace)))
        return waits, rows_of_visits

    def _late(self, seconds: float, pace: tuple[float, float]) -> int:
        """Return the rows until an unscaled time [s]; 0 if it is negative."""
        return max(round(seconds * pace[0] / pace[1] * self._config.rate_hz), 0)

    def _rests(self, arm: str) -> WayPoint:
        return WayPoint('home', self.workcell.home_tools[arm], 0.0, 1.0)

    def _as_far_as_it_reaches(
        self,
        arm: str,
        ways: Callable[[float], list[WayPoint]],
        share: float,
        pace: tuple[float, float],
    ) -> tuple[FloatArray, list[WayPoint]]:
        """Rows and way points of an arm that goes a share of a way, less if out of reach."""
        while True:
            way = ways(share)
            try:
                return self._follow(arm, way, pace), way
            except SimulatorError:
                if not share:
                    raise
                share = max(share - _SHORTENING_STEP, 0.0)

    def _follow(self, arm: str, stops: list[WayPoint], pace: tuple[float, float]) -> FloatArray:
        """Return the minimum-jerk blends between way points, at a pace."""
        config = self._config
        home = self._rests(arm)
        seconds, (wanted, unscaled) = self._timed(stops, home.position), pace
        ends = np.cumsum([0.0, *seconds]) * wanted / unscaled
        points, solver = [home, *stops], self._solvers[arm]
        rows, joints = [], self.home[solver.indices]
        for time in np.arange(1, round(ends[-1] * config.rate_hz) + 1) / config.rate_hz:
            k = min(int(np.searchsorted(ends[1:], time)), len(points) - 2)
            share = np.clip((time - ends[k]) / (ends[k + 1] - ends[k]), 0.0, 1.0)
            blend = share**3 * (10 - 15 * share + 6 * share**2)
            a, b = points[k], points[k + 1]
            pose = top_down(
                a.position + blend * (b.position - a.position),
                a.yaw + blend * (b.yaw - a.yaw),
                a.lean + blend * (b.lean - a.lean),
            )
            try:
                joints = solver.solve(pose, joints)
            except TrajectoryError as error:
                raise SimulatorError(str(error)) from error
            row = self.home.copy()
            row[solver.indices] = joints
            self._set_gripper(row, arm, a.opening + blend * (b.opening - a.opening))
            rows.append(row)
        return np.asarray(rows)

    def _set_gripper(self, row: FloatArray, arm: str, opening: float) -> None:
        tool = self._tools[arm]
        if tool.gripper_joint is not None:
            row[self.robot.joint_names.index(tool.gripper_joint)] = (
                tool.gripper_closed + opening * (tool.gripper_open - tool.gripper_closed)
            )
