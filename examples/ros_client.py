"""A client of the node `world_model`: cameras, joints and a plan in, frames and a verdict out.

Start `world_model --ros-args -p place:=simulator/nominal -p calibration_file:=FILE`, with FILE
resource/demo_episode/calibration.yaml; then `python examples/ros_client.py [EPISODE]`.
"""

from functools import partial
import sys

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros import read_episode, share_path

ENDS = 'done', 'rejected', 'failed', 'preempted', 'reset'
episode = read_episode(sys.argv[1] if sys.argv[1:] else share_path('resource', 'demo_episode'))
states, commands = episode.joint_states, episode.trajectories[0][1]
assert states is not None
names, position = states.joint_names, states.positions[0].tolist()
frames, reports, ends, sent = dict.fromkeys(episode.views, 0), [], [], []
rclpy.init()
node = rclpy.create_node('client')
make, latched = node.create_publisher, QoSProfile(depth=1)
latched.durability = DurabilityPolicy.TRANSIENT_LOCAL  # for a node that starts later
make(String, 'instruction', latched).publish(String(data=episode.info.instruction))
make(String, 'objects', latched).publish(String(data=', '.join(episode.info.objects)))
images = {view: make(Image, f'{view}/image_raw', 10) for view in frames}
infos = {view: make(CameraInfo, f'{view}/camera_info', 10) for view in frames}
joints, plans = make(JointState, 'joint_states', 10), make(JointTrajectory, 'joint_trajectory', 10)


def send_moment():
    """Publish images, camera infos and joints of one stamp."""
    stamp = node.get_clock().now().to_msg()
    for view, camera in episode.cameras.items():
        pixels, header = episode.images[view].frames[0], Header(stamp=stamp, frame_id=view)
        size = {'header': header, 'height': pixels.shape[0], 'width': pixels.shape[1]}
        data = {'encoding': 'rgb8', 'step': 3 * pixels.shape[1], 'data': pixels.tobytes()}
        images[view].publish(Image(**size, **data))
        lens = {'distortion_model': camera.distortion_model, 'd': camera.distortion}
        infos[view].publish(CameraInfo(**size, **lens, k=camera.K.ravel()))
    joints.publish(JointState(header=Header(stamp=stamp), name=names, position=position))


def count(view, _):
    """Count a predicted frame."""
    frames[view] += 1


for view in frames:
    topic = f'world_model/{view}/predicted/image_raw'
    node.create_subscription(Image, topic, partial(count, view), 100)
node.create_subscription(DiagnosticArray, 'world_model/report', reports.append, 100)
node.create_timer(0.1, send_moment)
while not plans.get_subscription_count():  # the node is not there yet
    rclpy.spin_once(node)
points = [
    JointTrajectoryPoint(positions=row, time_from_start=Duration(seconds=time).to_msg())
    for time, row in zip(commands.times.tolist(), commands.positions.tolist(), strict=True)
]  # without a stamp the plan begins when it arrives
plans.publish(JointTrajectory(joint_names=commands.joint_names, points=points))
while not ends or len(sent) < int(ends[0]['num_chunks']) or min(frames.values()) < sum(sent):
    rclpy.spin_once(node)
    said = [{pair.key: pair.value for pair in report.status[0].values} for report in reports]
    sent = [int(one['frames_published']) for one in said if one['state'] == 'published']
    ends = [one for one in said if one['state'] in ENDS]
end = ends[0]
print(f'success {end["success"]}: {end["success_reasons"]}' if 'success' in end else end)
print(f'frames: {frames}')
rclpy.shutdown()
