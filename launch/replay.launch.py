"""Plays a recorded episode through the node; ends when the episode is over.

ros2 launch mtv_world_ros replay.launch.py episode:=/path/to/episode

With `namespace:=` the node, the episode's topics and its clock lie in that namespace.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('mtv_world_ros')


def end_launch(event, context):
    """End the launch with a process; where that failed, with an exit status."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with status {event.returncode}')
    return Shutdown(reason='the episode is over')


def generate_launch_description():
    """Arguments, the node on the episode's clock, and the player in lock-step with it."""
    episode = LaunchConfiguration('episode')
    arguments = [
        DeclareLaunchArgument(
            'episode',
            default_value=PathJoinSubstitution([SHARE, 'resource', 'demo_episode']),
            description='rosbag2 MCAP folder with JPEG images and a calibration.yaml',
        ),
        DeclareLaunchArgument(
            'calibration_file',
            default_value=PathJoinSubstitution([episode, 'calibration.yaml']),
            description="every view's pose",
        ),
        DeclareLaunchArgument('compressed_input', default_value='true', description='JPEG images'),
        DeclareLaunchArgument('rate', default_value='1.0', description='of playing'),
        DeclareLaunchArgument('pace', default_value='realtime', description='or burst'),
        DeclareLaunchArgument(
            'wait_timeout', default_value='600', description='for the node to be loaded [s]'
        ),
        DeclareLaunchArgument('namespace', default_value='', description='of node and player'),
        DeclareLaunchArgument('checkpoint', default_value='', description='empty = bundled'),
        DeclareLaunchArgument(
            'num_inference_steps', default_value='', description="empty = the checkpoint's"
        ),
    ]
    node = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([SHARE, 'launch', 'world_model.launch.py'])
        ),
        launch_arguments={
            'use_sim_time': 'true',
            'calibration_file': LaunchConfiguration('calibration_file'),
            'compressed_input': LaunchConfiguration('compressed_input'),
            'pace': LaunchConfiguration('pace'),
            'checkpoint': LaunchConfiguration('checkpoint'),
            'num_inference_steps': LaunchConfiguration('num_inference_steps'),
            'namespace': LaunchConfiguration('namespace'),
            'clock': 'clock',
            'required': 'true',
        }.items(),
    )
    player = Node(
        package='mtv_world_ros',
        executable='mtv-world',
        name='player',
        namespace=LaunchConfiguration('namespace'),
        arguments=['replay', episode, '--', '--clock', '--lock-step',
                   '--rate', LaunchConfiguration('rate'),
                   '--wait-timeout', LaunchConfiguration('wait_timeout')],
        output='screen',
        on_exit=end_launch,
    )  # fmt: skip
    return LaunchDescription([*arguments, node, player])
