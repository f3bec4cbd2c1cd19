"""Starts the node `world_model`.

ros2 launch mtv_world_ros world_model.launch.py params_file:=/path/to/node.yaml mode:=imagine
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('mtv_world_ros'), 'config'])

#: arguments that override a parameter of the file where they are given
PARAMETERS = {
    'use_sim_time': (bool, 'follow /clock, e.g. of a bag'),
    'checkpoint': (str, "checkpoint folder; 'bundled' and 'bundled-paper' ship with the package"),
    'calibration_file': (str, "YAML with every view's pose"),
    'compressed_input': (bool, '<camera>/image_raw/compressed instead of image_raw'),
    'num_inference_steps': (int, 'denoising steps a chunk'),
    'autostart': (bool, 'false leaves the states to a lifecycle manager'),
    'mode': (str, 'observe or imagine'),
    'pace': (str, 'realtime or burst'),
}


def end_launch(event, context):
    """End the launch with a process; where that failed, with an exit status."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with status {event.returncode}')
    return Shutdown(reason='world_model ended')


def make_node(context):
    """The node, with the parameter file and what was given beside it."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in PARAMETERS.items()
        if LaunchConfiguration(name).perform(context)
    }
    is_required = LaunchConfiguration('required').perform(context) == 'true'
    node = Node(
        package='mtv_world_ros',
        executable='world_model',
        name='world_model',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), given],
        remappings=[('/clock', LaunchConfiguration('clock'))],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
        output='screen',
        emulate_tty=True,
        on_exit=end_launch if is_required else None,
    )
    return [node]


def generate_launch_description():
    """Arguments and the node."""
    arguments = [
        DeclareLaunchArgument(name, default_value='', description=f'{meaning}; empty = the file')
        for name, (_, meaning) in PARAMETERS.items()
    ]
    arguments += [
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([CONFIG, 'node.yaml']),
            description='parameter file of the node',
        ),
        DeclareLaunchArgument('namespace', default_value='', description='of the node'),
        DeclareLaunchArgument(
            'clock',
            default_value='/clock',
            description='topic of the clock; a relative name lies in the namespace',
        ),
        DeclareLaunchArgument('log_level', default_value='info', description='of the node'),
        DeclareLaunchArgument(
            'required', default_value='false', description='end the whole launch with the node'
        ),
        DeclareLaunchArgument(
            'large_images',
            default_value='false',
            description='Fast DDS with 32 MB of shared memory; set it for the cameras too',
        ),
    ]
    set_profile = SetEnvironmentVariable(
        'FASTRTPS_DEFAULT_PROFILES_FILE',
        PathJoinSubstitution([CONFIG, 'fastdds_profile.xml']),
        condition=IfCondition(LaunchConfiguration('large_images')),
    )
    return LaunchDescription([*arguments, set_profile, OpaqueFunction(function=make_node)])
