"""A client of the node `world_model`: cameras, joints and a plan in, frames and a verdict out.

    world_model --ros-args -p place:=simulator/nominal \
        -p calibration_file:=resource/demo_episode/calibration.yaml
    python examples/ros_client.py [EPISODE]

A recorded episode stands for the robot.
"""

import sys

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros import read_episode, share_path

episode = read_episode(sys.argv[1] if sys.argv[1:] else share_path('resource', 'demo_episode'))
frames, sent, said = dict.fromkeys(episode.views, 0), [], {}
rclpy.init()
node = rclpy.create_node('client')
publishers, plans = {}, node.create_publisher(JointTrajectory, 'joint_trajectory', 10)


def send(topic, message, quality: QoSProfile | int = 10):
    """Publish a message."""
    if topic not in publishers:
        publishers[topic] = node.create_publisher(type(message), topic, quality)
    publishers[topic].publish(message)


def send_moment():
    """Publish images, camera infos and joints of one stamp."""
    stamp, states = node.get_clock().now().to_msg(), episode.joint_states
    assert states is not None
    for view, camera in episode.cameras.items():
        pixels, header = episode.images[view].frames[0], Header(stamp=stamp, frame_id=view)
        size = {'header': header, 'height': pixels.shape[0], 'width': pixels.shape[1]}
        data = {'encoding': 'rgb8', 'step': 3 * pixels.shape[1], 'data': pixels.tobytes()}
        send(f'{view}/image_raw', Image(**size, **data))
        send(f'{view}/camera_info', CameraInfo(**size, k=camera.K.ravel()))
    header, position = Header(stamp=stamp), states.positions[0].tolist()
    send('joint_states', JointState(header=header, name=states.joint_names, position=position))


def send_plan():
    """Publish the episode's first plan; without a stamp it begins when it arrives."""
    commands = episode.trajectories[0][1]
    points = [
        JointTrajectoryPoint(positions=row, time_from_start=Duration(seconds=time).to_msg())
        for time, row in zip(commands.times.tolist(), commands.positions.tolist(), strict=True)
    ]
    plans.publish(JointTrajectory(joint_names=commands.joint_names, points=points))


def count(view):
    """Count a predicted frame."""
    frames[view] += 1


def hear(message):
    """Keep the report on the plan, and how many frames of each chunk are out."""
    report = {pair.key: pair.value for status in message.status for pair in status.values}
    if report['state'] == 'published':
        sent.append(int(report['frames_published']))
    elif report['state'] in ('done', 'rejected', 'failed', 'preempted', 'reset'):
        said.update(report)


def is_over():
    """Return True if the plan has its end, and all its frames are here."""
    all_sent = len(sent) == int(said.get('num_chunks', 0))
    return bool(said) and all_sent and min(frames.values()) >= sum(sent)


for name in episode.views:
    topic = f'world_model/{name}/predicted/image_raw'
    node.create_subscription(Image, topic, lambda _, view=name: count(view), 100)
node.create_subscription(DiagnosticArray, 'world_model/report', hear, 100)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # for who comes later
send('instruction', String(data=episode.info.instruction), latched)
send('objects', String(data=', '.join(episode.info.objects)), latched)
node.create_timer(0.1, send_moment)
while not plans.get_subscription_count():  # the node is not there yet
    rclpy.spin_once(node)
send_plan()
while not is_over():
    rclpy.spin_once(node)
print(f'success {said["success"]}: {said["success_reasons"]}' if 'success' in said else said)
print(f'frames: {frames}')
rclpy.shutdown()
