"""Starts the nodes `world_model` and `policy`; the service `policy/start` begins an episode.

ros2 launch mtv_world_ros policy_in_the_loop.launch.py policy:=/path/to/policy.yaml mode:=observe
ros2 service call /policy/start std_srvs/srv/Trigger
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('mtv_world_ros')

#: arguments that are parameters of both nodes: they must agree
SHARED = {
    'use_sim_time': (bool, 'false', 'follow /clock, e.g. of a bag'),
    'checkpoint': (str, 'bundled', "checkpoint folder; 'bundled' ships with the package"),
    'calibration_file': (str, '', "YAML with every view's pose; empty = the checkpoint's"),
    'compressed_input': (bool, 'false', '<camera>/image_raw/compressed instead of image_raw'),
    'mode': (
        str,
        'imagine',
        'later observations of the policy: imagine = predictions, observe = cameras',
    ),
}
#: arguments that are parameters of the node `policy`
POLICY = {
    'policy': (str, 'scripted', 'YAML, or name of one in config/policies'),
    'instruction': (str, '', 'text for the robot'),
    'seed': (int, '0', "of the policy's own randomness"),
    'max_chunks': (int, '0', 'chunks of an episode; 0 = until the policy is done'),
}
#: arguments of version 0.1.0, whose work `mtv-world imagine` does now
REPLACED = ('episodes', 'live', 'count', 'device', 'steps', 'out')
#: pace of the world model's images by mode: in imagination the policy waits for them
PACES = {'imagine': 'burst', 'observe': 'realtime'}


def end_launch(event, context):
    """End the launch with a process; where that failed, with an exit status."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with status {event.returncode}')
    return Shutdown(reason='policy ended')


def make_nodes(context):
    """The world model, at the pace of its mode, and the policy."""
    old = [name for name in REPLACED if LaunchConfiguration(name).perform(context)]
    if old:
        raise RuntimeError(
            f'{", ".join(old)}: no longer an argument of this launch file, which starts the nodes '
            'of the policy and the world model alone. Whole episodes, from recordings or from the '
            'cameras, are run by: mtv-world imagine --episodes EPISODES, or --live (device and '
            'steps of the nodes: params_file)'
        )
    mode = LaunchConfiguration('mode').perform(context)
    if mode not in PACES:
        raise RuntimeError(f"mode is '{mode}'; it must be one of {', '.join(PACES)}")
    namespace = LaunchConfiguration('namespace')
    world_model = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([SHARE, 'launch', 'world_model.launch.py'])
        ),
        launch_arguments={
            **{name: LaunchConfiguration(name) for name in SHARED},
            'pace': PACES[mode],
            'params_file': LaunchConfiguration('params_file'),
            'namespace': namespace,
            'required': 'true',
        }.items(),
    )
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _, _) in {**SHARED, **POLICY}.items()
        if LaunchConfiguration(name).perform(context)
    }
    policy = Node(
        package='mtv_world_ros',
        executable='policy_node',
        name='policy',
        namespace=namespace,
        parameters=[{**given, 'world_model': 'world_model'}],
        output='screen',
        emulate_tty=True,
        on_exit=end_launch,
    )
    return [world_model, policy]


def generate_launch_description():
    """Arguments and both nodes."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (_, default, meaning) in {**SHARED, **POLICY}.items()
    ]
    arguments += [
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([SHARE, 'config', 'node.yaml']),
            description='parameter file of the world model',
        ),
        DeclareLaunchArgument('namespace', default_value='', description='of both nodes'),
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value='', description='see mtv-world imagine --help')
        for name in REPLACED
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=make_nodes)])
