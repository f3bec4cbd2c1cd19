"""The launch files, read by the real `ros2 launch`."""

from importlib import metadata
import os
import signal
import subprocess
import time

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from mtv_world_ros.core.files import share_path
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.policy.loop import PolicySettings
from test.support.launch_stand_in import LaunchStandIn


@pytest.mark.native_ros
@pytest.mark.parametrize(
    ('name', 'arguments'),
    [
        ('world_model.launch.py', ('params_file', 'mode', 'calibration_file', 'large_images')),
        ('policy_in_the_loop.launch.py', ('policy', 'mode', 'max_chunks', 'checkpoint')),
        ('replay.launch.py', ('episode', 'calibration_file', 'rate', 'pace')),
    ],
)
def test_launch_file_shows_its_arguments(name, arguments):
    command = ['ros2', 'launch', str(share_path('launch', name)), '--show-args']
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    for argument in arguments:
        assert f"'{argument}'" in shown


@pytest.fixture
def launch(tmp_path):
    """Start `ros2 launch` on the package as colcon installed it."""
    found = subprocess.run(['ros2', 'pkg', 'prefix', 'mtv_world_ros'], capture_output=True)
    if found.returncode != 0:
        pytest.skip('mtv_world_ros is not built by colcon and sourced')
    environment = dict(os.environ)

    started = []

    def launch(name, *arguments):
        started.append(subprocess.Popen(
            ['ros2', 'launch', 'mtv_world_ros', name, *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
            env=environment,
        ))  # fmt: skip
        return started[-1]

    launch.environment = environment
    yield launch
    for process in started:
        if process.poll() is None:  # the test failed
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)


def read_until(process, text):
    """Read what a launch says up to a text."""
    said = []
    for line in process.stdout:
        said.append(line)
        if text in line:
            return
    raise AssertionError(''.join(said))


@pytest.fixture
def ros2(launch):
    """Run the command line beside a launch; return what it said."""

    def ros2(*arguments, until=''):
        """With `until` again and again, for a minute: discovery takes its time."""
        end = time.monotonic() + 60
        while True:
            ran = subprocess.run(
                ['ros2', *arguments], env=launch.environment, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, text=True, timeout=180, check=False,
            )  # fmt: skip
            if ran.returncode == 0 and until in ran.stdout:
                return ran.stdout
            assert until and time.monotonic() < end, (arguments, ran.stdout)

    yield ros2
    ros2('daemon', 'stop')


def check_end(process):
    """The launch ends by itself and well; returns what was said."""
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    assert 'process has died' not in said, said  # `ros2 launch` returns 0 for these too
    return said


@pytest.mark.native_ros
def test_node_starts_and_ends_on_ctrl_c(launch):
    process = launch('world_model.launch.py', 'mode:=imagine')
    read_until(process, 'ready: low, high')
    process.send_signal(signal.SIGINT)
    check_end(process)


@pytest.mark.native_ros
def test_lifecycle_node_answers_the_command_line(launch, ros2):
    process = launch('world_model.launch.py', 'autostart:=false')
    read_until(process, 'waits for a lifecycle manager')
    ros2('lifecycle', 'nodes', until='/world_model')
    assert 'unconfigured' in ros2('lifecycle', 'get', '/world_model')
    for transition, state in (('configure', 'inactive'), ('activate', 'active')):
        assert 'successful' in ros2('lifecycle', 'set', '/world_model', transition)
        assert state in ros2('lifecycle', 'get', '/world_model')
    process.send_signal(signal.SIGINT)
    check_end(process)


@pytest.mark.native_ros
def test_parameters_topics_and_services_answer_the_command_line(launch, ros2):
    process = launch('world_model.launch.py', 'pace:=burst', 'namespace:=robot1')
    read_until(process, 'ready: low, high')
    node = '/robot1/world_model'
    ros2('node', 'list', until=node)
    assert 'String value is: burst' in ros2('param', 'get', node, 'pace')
    assert 'successful' in ros2('param', 'set', node, 'pace', 'realtime')
    assert 'failed' in ros2('param', 'set', node, 'calibration_file', '/nowhere')
    said = ros2('param', 'describe', node, 'max_image_age_s')
    assert 'Type: double' in said and 'Description: ' in said
    kinds = ros2('topic', 'list', '-t')
    assert f'{node}/success [std_msgs/msg/Float64]' in kinds
    assert '/robot1/low/image_raw [sensor_msgs/msg/Image]' in kinds
    health = ros2('topic', 'echo', '--once', '/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    assert 'name: robot1/world_model' in health and 'hardware_id: robot1/' in health
    assert 'nobody publishes /robot1/low/camera_info' in health
    said = ros2('service', 'call', f'{node}/reset', 'std_srvs/srv/Trigger')
    assert 'success=True' in said
    process.send_signal(signal.SIGINT)
    check_end(process)


@pytest.mark.native_ros
def test_a_second_subscriber_hears_every_verdict(launch):
    """Three plans of one chunk each; `ros2 topic echo` is there before the node is."""
    command = ['ros2', 'topic', 'echo', '/world_model/success', 'std_msgs/msg/Float64']
    echo = subprocess.Popen(
        command, env=launch.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip
    try:
        check_end(launch('replay.launch.py', 'pace:=realtime'))
    finally:
        echo.send_signal(signal.SIGINT)
        said, _ = echo.communicate(timeout=60)
    assert said.count('data: ') == 3, said


@pytest.mark.native_ros
@pytest.mark.control_msgs
def test_action_answers_the_command_line(launch, ros2):
    process = launch('world_model.launch.py')
    read_until(process, 'ready: low, high')
    name = '/world_model/follow_joint_trajectory'
    kind = 'control_msgs/action/FollowJointTrajectory'
    ros2('action', 'list', '-t', until=f'{name} [{kind}]')
    points = '[{positions: [0.0], time_from_start: {sec: 1}}]'
    goal = f'{{trajectory: {{joint_names: [elbow], points: {points}}}}}'
    said = ros2('action', 'send_goal', name, kind, goal)
    assert 'Goal accepted' in said
    assert 'it has no [' in said and 'status: ABORTED' in said
    process.send_signal(signal.SIGINT)
    check_end(process)


@pytest.mark.native_ros
def test_replays_in_two_namespaces_at_once(launch):
    processes = [
        launch('replay.launch.py', f'namespace:={name}', 'rate:=4.0', 'pace:=burst')
        for name in ('one', 'two')
    ]
    for process in processes:
        said = check_end(process)
        assert 'ready: low, high' in said
        assert '3 trajectories, 3 done' in said, said  # six, were they to hear each other


@pytest.mark.native_ros
@pytest.mark.parametrize(
    ('name', 'argument', 'said'),
    [
        ('replay.launch.py', 'checkpoint:=/nowhere', 'world_model'),
        ('replay.launch.py', 'episode:=/nowhere', 'nowhere'),
        ('policy_in_the_loop.launch.py', 'checkpoint:=/nowhere', 'world_model'),
    ],
)
def test_a_process_that_fails_is_the_status_of_the_launch(launch, name, argument, said):
    process = launch(name, argument)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 1, output
    assert said in output and 'ended with status 1' in output


@pytest.mark.native_ros
def test_policy_and_world_model_start_and_end_on_ctrl_c(launch, ros2):
    policy = share_path('config', 'policies', 'openpi.yaml')
    process = launch('policy_in_the_loop.launch.py', f'policy:={policy}', 'mode:=observe')
    read_until(process, 'ready: policy')
    assert 'success=True' in ros2('service', 'call', '/policy/start', 'std_srvs/srv/Trigger')
    process.send_signal(signal.SIGINT)
    check_end(process)


SCHEMAS = {'world_model': Settings, 'policy_node': PolicySettings}


@pytest.mark.parametrize(
    ('name', 'arguments', 'started'),
    [
        ('world_model.launch.py', {}, ['world_model']),
        ('world_model.launch.py', {'mode': 'imagine', 'pace': 'burst'}, ['world_model']),
        ('replay.launch.py', {'episode': '/bag'}, ['world_model', 'mtv-world']),
        ('policy_in_the_loop.launch.py', {}, ['world_model', 'policy_node']),
        (
            'policy_in_the_loop.launch.py',
            {'mode': 'observe', 'policy': 'a.yaml', 'max_chunks': '3', 'instruction': 'stack'},
            ['world_model', 'policy_node'],
        ),
    ],
)
def test_launch_files_start_what_is_installed_with_parameters_that_exist(name, arguments, started):
    """The files run on stand-ins of `launch`, which has no wheel."""
    nodes = LaunchStandIn(share_path('launch')).nodes(name, arguments)
    assert [node['executable'] for node in nodes] == started
    installed = {e.name for e in metadata.entry_points(group='console_scripts')}
    for node in nodes:
        assert node['executable'] in installed
        if node['executable'] in SCHEMAS:
            schema, given = SCHEMAS[node['executable']], node['parameters']
            known = {'use_sim_time', *schema.model_fields}
            assert {*given} <= known
            read = schema(**{key: v for key, v in given.items() if key != 'use_sim_time'})
            for key in {*arguments} & {*given}:
                assert str(getattr(read, key)) == arguments[key]


def test_both_nodes_of_a_policy_agree():
    nodes = LaunchStandIn(share_path('launch')).nodes(
        'policy_in_the_loop.launch.py', {'mode': 'observe', 'calibration_file': '/c.yaml'}
    )
    world_model, policy = (node['parameters'] for node in nodes)
    for key in ('mode', 'checkpoint', 'calibration_file', 'compressed_input', 'use_sim_time'):
        assert world_model[key] == policy[key]


def test_a_mode_that_does_not_exist_is_refused():
    with pytest.raises(RuntimeError, match="mode is 'watch'; it must be one of imagine, observe"):
        LaunchStandIn(share_path('launch')).nodes(
            'policy_in_the_loop.launch.py', {'mode': 'watch'}
        )


@pytest.mark.parametrize('old', [{'live': 'true'}, {'episodes': '/data', 'out': 'out'}])
def test_arguments_of_before_say_what_does_their_work_now(old):
    said = f'{", ".join(old)}: no longer an argument.*mtv-world imagine'
    with pytest.raises(RuntimeError, match=said):
        LaunchStandIn(share_path('launch')).nodes('policy_in_the_loop.launch.py', old)
