"""A client of the node `world_model`: cameras, joints and a plan in, frames and a verdict out.

    world_model --ros-args -p place:=simulator/nominal \
        -p calibration_file:=resource/demo_episode/calibration.yaml
    python examples/ros_client.py [EPISODE]

A recorded episode stands for the robot. Texts are kept for subscribers that come later
(transient local); the plan is sent once the node subscribes to it.
"""

from __future__ import annotations

from pathlib import Path
import sys

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros import JointTrajectory as Commands
from mtv_world_ros import read_episode, share_path

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Client(Node):
    """Publishes one moment of a robot at 10 Hz, sends one plan, and prints what comes of it."""

    def __init__(self, path: Path) -> None:
        super().__init__('client')
        self.episode = read_episode(path)
        self.frames, self.is_sent = dict.fromkeys(self.episode.views, 0), False
        self.num_chunks, self.num_published, self.num_frames = -1, 0, 0
        self.images = {v: self.create_publisher(Image, f'{v}/image_raw', 1) for v in self.frames}
        self.infos = {
            v: self.create_publisher(CameraInfo, f'{v}/camera_info', 1) for v in self.frames
        }
        self.joints = self.create_publisher(JointState, 'joint_states', 10)
        self.plans = self.create_publisher(JointTrajectory, 'joint_trajectory', 1)
        self.texts = [
            self.create_publisher(String, t, LATCHED) for t in ('instruction', 'objects')
        ]
        self.texts[0].publish(String(data=self.episode.info.instruction))
        self.texts[1].publish(String(data=', '.join(self.episode.info.objects)))
        for view in self.episode.views:
            topic = f'world_model/{view}/predicted/image_raw'
            self.create_subscription(Image, topic, lambda _, view=view: self.count(view), 100)
        self.create_subscription(DiagnosticArray, 'world_model/report', self.hear, 100)
        self.create_timer(0.1, self.tick)

    def tick(self) -> None:
        """Publish images, camera infos and joints of one stamp; and the plan, once."""
        stamp, states = self.get_clock().now().to_msg(), self.episode.joint_states
        assert states is not None
        for view, camera in self.episode.cameras.items():
            pixels = self.episode.images[view].frames[0]
            size = {'height': pixels.shape[0], 'width': pixels.shape[1]}
            image = Image(**size, encoding='rgb8', step=3 * size['width'], data=pixels.tobytes())
            info = CameraInfo(
                **size, distortion_model='plumb_bob', k=camera.K.ravel(), d=[0.0] * 5
            )
            for publisher, message in ((self.images[view], image), (self.infos[view], info)):
                message.header.stamp, message.header.frame_id = stamp, f'{view}_optical'
                publisher.publish(message)
        joints = JointState(name=states.joint_names, position=states.positions[0].tolist())
        joints.header.stamp = stamp
        self.joints.publish(joints)
        if not self.is_sent and self.plans.get_subscription_count():
            self.is_sent = True
            self.plans.publish(plan(self.episode.trajectories[0][1]))

    @property
    def is_done(self) -> bool:
        """True if the plan has its end, and the frames of all its chunks are here."""
        is_out = self.num_published == self.num_chunks
        return is_out and all(count >= self.num_frames for count in self.frames.values())

    def count(self, view: str) -> None:
        """Count a predicted frame."""
        self.frames[view] += 1

    def hear(self, message: DiagnosticArray) -> None:
        """Print the verdict of the plan and its reasons, or why there is none."""
        said = {pair.key: pair.value for status in message.status for pair in status.values}
        state = said['state']
        if state == 'published':  # a chunk's frames are out
            self.num_published += 1
            self.num_frames += int(said['frames_published'])
        elif state == 'done':
            self.num_chunks = int(said['num_chunks'])
            print(f'success {said["success"]}: {said["success_reasons"]}')
        elif state in ('rejected', 'failed', 'preempted', 'reset'):
            self.num_chunks = self.num_published
            print(f'{state}: {said.get("text", "")}')


def plan(commands: Commands) -> JointTrajectory:
    """Return commands as a message; without a stamp they begin on arrival."""
    points = [
        JointTrajectoryPoint(positions=row, time_from_start=Duration(seconds=time).to_msg())
        for time, row in zip(commands.times.tolist(), commands.positions.tolist(), strict=True)
    ]
    return JointTrajectory(joint_names=commands.joint_names, points=points)


rclpy.init()
client = Client(Path(sys.argv[1]) if sys.argv[1:] else share_path('resource', 'demo_episode'))
while not client.is_done:
    rclpy.spin_once(client)
print(f'frames: {client.frames}')
rclpy.shutdown()
