"""Lets a policy live whole episodes in the world model, from recorded or live frames.

ros2 launch mtv_world_ros policy_in_the_loop.launch.py policy:=expert episodes:=/path/to/episode
ros2 launch mtv_world_ros policy_in_the_loop.launch.py policy:=/path/to/policy.yaml live:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.substitutions import ExecutableInPackage

#: arguments that become an option of `mtv-world imagine`, with default and meaning
OPTIONS = {
    'policy': ('scripted', 'YAML, name of one in config/policies, or a scripted policy'),
    'checkpoint': ('bundled', 'checkpoint folder'),
    'count': ('0', 'number of episodes; 0 = each recorded one once'),
    'max-chunks': ('0', 'chunks of an episode; 0 = until the policy is done'),
    'seed': ('0', 'of the noise'),
    'device': ('cpu', 'cpu, cuda'),
    'steps': ('4', 'denoising steps'),
    'out': ('out/imagine', 'folder for the bags'),
}


def end_launch(event, context):
    """End the launch with a process; where that failed, with an exit status."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with status {event.returncode}')
    return Shutdown(reason='all episodes are over')


def generate_launch_description():
    """Arguments, and the command that starts world model, policy, runner and recorder."""
    arguments = [
        DeclareLaunchArgument(name.replace('-', '_'), default_value=default, description=text)
        for name, (default, text) in OPTIONS.items()
    ]
    arguments += [
        DeclareLaunchArgument('episodes', default_value='', description='recorded episode(s)'),
        DeclareLaunchArgument('live', default_value='false', description='from the cameras'),
    ]
    options = [
        part
        for name in OPTIONS
        for part in (f'--{name}', LaunchConfiguration(name.replace('-', '_')))
    ]
    # colcon installs it into lib/mtv_world_ros, which is on no PATH
    command = ExecutableInPackage(package='mtv_world_ros', executable='mtv-world')
    live = LaunchConfiguration('live')
    runs = {
        PythonExpression(["'", live, "' == 'true'"]): ['--live'],
        PythonExpression(["'", live, "' != 'true'"]): [
            '--episodes',
            LaunchConfiguration('episodes'),
        ],
    }
    processes = [
        ExecuteProcess(
            cmd=[command, 'imagine', *start, *options],
            output='screen',
            condition=IfCondition(condition),
            on_exit=end_launch,
        )
        for condition, start in runs.items()
    ]
    return LaunchDescription([*arguments, *processes])
