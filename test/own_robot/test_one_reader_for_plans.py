"""What the live node accepts as a plan the importer accepts, and the reverse."""

from dataclasses import dataclass

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.bags import BagPart, convert_bag
from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.sensing.observations import ObservationBuffer, SensedScene
from mtv_world_ros.ros.world_model.request_maker import RequestMaker
from test.support.bags import bag_cameras, grey_frames, record
from test.support.crane import FPS, JOINTS, make_positions, render, START_NS

NUM = 25
TOPIC = '/cell/joint_trajectory'
ARM = JOINTS[:5]
HOME = {'yaw': 0.1, 'shoulder': 0.2, 'elbow': 0.3, 'roll': 0.4, 'nod': 0.5, 'jaw_left': 0.02}


@pytest.fixture(scope='module')
def scene(robot):
    """Cameras, positions whose gripper closes, and what the cameras see."""
    cameras, positions = bag_cameras(), make_positions(NUM / FPS)
    positions[:, 5] = np.linspace(0.04, 0.0, len(positions))
    return cameras, positions, {v: render(robot, c, positions) for v, c in cameras.items()}


@dataclass(frozen=True)
class Case:
    """A plan message.

    Attributes:
        says: what an error names; empty = it is accepted.
        names: joints.
        rows: positions; None = those of `HOME` at two points.
        velocities: one list a point; None = none.
        times: of the points [s].
    """

    says: str = ''
    names: tuple[str, ...] = JOINTS
    rows: tuple[tuple[float, ...], ...] | None = None
    velocities: tuple[tuple[float, ...], ...] | None = None
    times: tuple[float, ...] = (0.5, 1.0)

    def message(self, stamp_ns):
        """trajectory_msgs/JointTrajectory of rosbags' class."""
        rows = self.rows or tuple(tuple(HOME.get(n, 0.0) for n in self.names) for _ in self.times)
        rates = self.velocities or tuple(() for _ in rows)
        points = [
            messages.make(
                'trajectory_msgs/msg/JointTrajectoryPoint',
                positions=np.array(row, np.float64),
                velocities=np.array(rate, np.float64),
                accelerations=np.empty(0),
                effort=np.empty(0),
                time_from_start=messages.make(
                    'builtin_interfaces/msg/Duration',
                    sec=int(seconds // 1),
                    nanosec=round(seconds % 1 * 1e9),
                ),
            )
            for seconds, row, rate in zip(self.times, rows, rates, strict=False)
        ]
        header = messages.make_header(stamp_ns, '')
        return messages.make(
            messages.JOINT_TRAJECTORY, header=header, joint_names=list(self.names), points=points
        )


def changed(value):
    """Positions of all joints with another last row of the first one."""
    row = tuple(HOME.values())
    return (row, (value, *row[1:]))


CASES = {
    'all joints': Case(),
    'in another order': Case(names=JOINTS[::-1]),
    'more joints than the robot has': Case(names=(*JOINTS, 'lift')),
    'the arm without its gripper': Case(names=ARM),
    'one joint': Case(names=('elbow',)),
    'with velocities': Case(velocities=((0.0,) * 6, (0.1,) * 6)),
    'velocities in some points': Case(velocities=((0.0,) * 6, ())),
    'velocities of some joints in some points': Case(velocities=((0.0,) * 2, ())),
    'the first point at time 0': Case(times=(0.0, 1.0)),
    'one point': Case(times=(0.5,)),
    'a joint that is not there': Case('wrist', names=(*ARM[:4], 'wrist')),
    'a joint of another robot beside the arm': Case('ur_elbow', names=(*ARM, 'ur_elbow')),
    'no joints': Case('0 joint names', names=()),
    'a name twice': Case('more than once', names=(*JOINTS, 'yaw')),
    'not a number': Case('must be finite', rows=changed(float('nan'))),
    'infinite velocity': Case('must be finite', velocities=((0.0,) * 6, (float('inf'),) * 6)),
    'too few positions': Case('5 positions for 6 joints', rows=((0.1,) * 5, (0.1,) * 5)),
    'velocities alone': Case('has no positions', rows=((), ()), velocities=((0.1,) * 6,) * 2),
    'times that go back': Case('not increasing', times=(0.5, 0.4)),
    'a time twice': Case('not increasing', times=(0.5, 0.5)),
    'beyond the limits': Case('its limits are', rows=changed(3.5)),
}  # fmt: skip


def ask_node(case, robot):
    """Why the live node refuses the message; empty = it does not."""
    settings = Settings(mode='imagine', limit_tolerance=BagMapping().limit_tolerance)
    seen = Observation(
        cameras=(), frames=np.zeros((0, 1, 1, 3), np.uint8),
        positions=np.array(list(HOME.values())), stamp_ns=START_NS,
    )  # fmt: skip
    start = SensedScene(observation=seen, camera_infos=(), source_stamp_ns=START_NS)
    buffer = ObservationBuffer(
        cameras=(), robot=robot, width=96, height=72, limits=lambda: settings
    )
    maker = RequestMaker(robot, buffer, lambda: settings, lambda: start)
    data = messages.serialize(messages.JOINT_TRAJECTORY, case.message(START_NS))
    try:
        maker.make(deserialize_message(data, JointTrajectoryMsg), START_NS, 0.0)
    except Rejection as error:
        return str(error)
    return ''


def converted(folder, robot, scene, plans):
    """What is said of a bag of the scene with these plans, imported to `folder/episode`."""
    cameras, positions, frames = scene

    def write(bag):
        for stamp, message in plans:
            bag.write(TOPIC, messages.JOINT_TRAJECTORY, stamp, message)

    bag = record(folder / 'bag', robot, cameras, positions, frames=frames, prefix='', more=write)
    views = {view: f'/cell/{view}/color/image_raw' for view in cameras}
    mapping = BagMapping.model_validate({'namespace': 'cell', 'views': views})
    return convert_bag(BagPart(bag), folder / 'episode', mapping, robot, None)


def ask_importer(case, robot, scene, folder):
    """Why the importer refuses the message, or leaves it out; empty = it does not."""
    try:
        converted(folder, robot, scene, [(START_NS, case.message(START_NS))])
    except MtvWorldError as error:
        return str(error)
    return ''


@pytest.mark.parametrize('name', CASES)
def test_node_and_importer_take_and_refuse_the_same_plans(name, robot, scene, tmp_path):
    case = CASES[name]
    live, imported = ask_node(case, robot), ask_importer(case, robot, scene, tmp_path)
    for said in (live, imported):
        assert case.says in said if case.says else not said, (live, imported)


def test_joints_that_a_plan_leaves_out_have_the_measured_positions(robot, scene, tmp_path):
    _, positions, _ = scene
    cases = {0: Case(names=ARM, times=(0.2, 1.0)), 2: Case(names=ARM, times=(0.1, 0.3))}
    stamps = {START_NS + seconds * 10**9: case for seconds, case in cases.items()}
    plans = [(stamp, case.message(stamp)) for stamp, case in stamps.items()]
    said = converted(tmp_path, robot, scene, plans)
    assert any('leave out joints jaw_left; their measured positions' in text for text in said)
    episode = read_episode(tmp_path / 'episode')
    measured = np.arange(len(positions)) / FPS
    arm = [HOME[name] for name in ARM]
    whole = [(s, t) for s, t in episode.trajectories if s < START_NS + 2e9]
    assert len(whole) == 2  # the plan, and what the gripper does until the next one
    for stamp, trajectory in whole:
        assert trajectory.joint_names == robot.joint_names
        at = (stamp - START_NS) / 1e9 + trajectory.times
        np.testing.assert_allclose(
            trajectory.positions[:, 5], np.interp(at, measured, positions[:, 5]), atol=1e-9
        )
    np.testing.assert_allclose(whole[0][1].positions[-1, :5], arm)
    np.testing.assert_allclose(whole[1][1].positions[:, :5], [arm] * len(whole[1][1].times))
    assert (whole[1][0] - START_NS) / 1e9 == pytest.approx(1.0)
    assert (whole[1][0] - START_NS) / 1e9 + whole[1][1].times[-1] == pytest.approx(2.0)


def test_a_stream_of_one_point_plans_becomes_plans_of_the_chunks_length(robot, tmp_path):
    """6 s of MoveIt Servo at 30 Hz: each target is reached a period after its message."""
    cameras, positions = bag_cameras(), make_positions(6.5)
    frames = grey_frames(len(positions))
    period = 1 / 30
    targets = np.stack([np.linspace(0.0, 0.3, 180)] * 6, axis=1) * [1, 1, 1, 1, 1, 0.1]

    servo = []
    for k, row in enumerate(targets):
        stamp = START_NS + round(k * period * 1e9)
        servo.append((stamp, Case(rows=(tuple(row),), times=(period,)).message(stamp)))
    said = converted(tmp_path, robot, (cameras, positions, frames), servo)
    assert any('180 trajectories of one point are a stream' in text for text in said)
    plans = read_episode(tmp_path / 'episode').trajectories
    assert [(s - START_NS) / 1e9 for s, _ in plans] == pytest.approx([0.0, 3.2], abs=period)
    at = np.concatenate([(s - START_NS) / 1e9 + t.times for s, t in plans])
    np.testing.assert_allclose(at, period * np.arange(1, 181), atol=1e-6)
    np.testing.assert_allclose(np.concatenate([t.positions for _, t in plans]), targets)
