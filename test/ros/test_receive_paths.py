"""Plans and joint states come in through ports of their own."""

import json
from pathlib import Path
import subprocess
import sys
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from mtv_world_ros.core.files import share_path
from mtv_world_ros.ros import receive_paths as module
from mtv_world_ros.ros.receive_paths import receive_paths, ReceivePaths, resolved_topics, SERVICES

NAMES = ('joint_trajectory', '~/plan', '/joint_states', SERVICES)
#: command lines and what rclpy makes of the names; the last of each is no topic
RULES = {
    '': ('/joint_trajectory', '/world_model/plan', '/joint_states'),
    '-r __ns:=/robot1': ('/robot1/joint_trajectory', '/robot1/world_model/plan', '/joint_states'),
    '-r joint_trajectory:=/arm/cmd': ('/arm/cmd', '/world_model/plan', '/joint_states'),
    '-r /joint_states:=states -r __ns:=/r': (
        '/r/joint_trajectory', '/r/world_model/plan', '/r/states',
    ),
    '--remap world_model:joint_trajectory:=a -r other:joint_states:=b': (
        '/a', '/world_model/plan', '/joint_states',
    ),
    '-r __node:=m -r m:joint_trajectory:=~/cmd': ('/m/cmd', '/m/plan', '/joint_states'),
    '-p joint_states:=1 -r joint_trajectory:=x -- joint_states:=y': (
        '/x', '/world_model/plan', '/y',
    ),
}  # fmt: skip


@pytest.mark.parametrize('rules', RULES)
def test_names_are_resolved_before_the_node_exists(rules):
    words = ['program', *(['--ros-args', *rules.split()] if rules else [])]
    assert resolved_topics(words, 'world_model', NAMES) == [*RULES[rules], SERVICES]


@pytest.mark.slow
def test_names_are_those_that_rclpy_resolves(ros):
    """Independent source: a real node with the same command lines, all in one process."""
    code = (
        'import json, sys, rclpy\n'
        'for rules in json.load(sys.stdin):\n'
        '    context = rclpy.Context()\n'
        '    rclpy.init(args=["n", *(["--ros-args", *rules.split()] if rules else [])],'
        ' context=context)\n'
        '    node = rclpy.create_node("world_model", context=context)\n'
        f'    print(*[node.resolve_topic_name(n) for n in {NAMES[:-1]!r}])\n'
        '    node.destroy_node(); rclpy.shutdown(context=context)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], input=json.dumps(list(RULES)), text=True,
        env=ros.ENVIRONMENT, capture_output=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [tuple(line.split()) for line in done.stdout.splitlines()]
    assert found == list(RULES.values())


@pytest.fixture
def own_paths(monkeypatch):
    """The state of a process that has made no node yet."""
    paths = ReceivePaths()
    monkeypatch.setattr(module, 'PATHS', paths)
    for name in (module.PROFILES_VARIABLE, module.TRANSPORTS_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    yield paths
    for lock in paths._locks:
        lock.close()


def read_profile():
    tree = ElementTree.parse(module.os.environ[module.PROFILES_VARIABLE])
    space = {'d': 'http://www.eprosima.com'}
    ports = {
        reader.get('profile_name'): int(reader.find('.//d:udpv4/d:port', space).text)
        for reader in tree.findall('d:data_reader', space)
    }
    return tree, space, ports


@pytest.mark.parametrize('given', [None, 'fastdds_heartbeat.xml', 'fastdds_profile.xml'])
def test_each_group_has_a_port_and_the_rest_of_the_profile_stays(given, own_paths, monkeypatch):
    if given:
        monkeypatch.setenv(module.PROFILES_VARIABLE, str(share_path('config', given)))
    with receive_paths([('/a', SERVICES), ('/b',)]):
        tree, space, ports = read_profile()
        path = Path(module.os.environ[module.PROFILES_VARIABLE])
    assert ports['/a'] == ports[SERVICES] != ports['/b'] and ports == own_paths.ports
    assert tree.find('.//d:heartbeatPeriod/d:nanosec', space).text == '100000000'
    (buffer,) = tree.findall('.//d:rtps/d:listenSocketBufferSize', space)
    assert 0 < int(buffer.text) <= module.WANTED_BUFFER_BYTES
    has_segment = tree.find('.//d:segment_size', space) is not None
    assert has_segment == (given == 'fastdds_profile.xml')
    assert not path.exists()
    now = module.os.environ.get(module.PROFILES_VARIABLE)
    assert now == (str(share_path('config', given)) if given else None)


def test_two_nodes_never_reserve_one_port(own_paths, monkeypatch):
    monkeypatch.setattr(module, '_PORTS', range(61_000, 61_006))
    monkeypatch.setattr(module, '_NUM_TRIES', 6)
    other = ReceivePaths()
    for paths in (own_paths, other):
        paths.reserve(['/a'])
        paths.reserve(['/b'])
    assert len({*own_paths.ports.values(), *other.ports.values()}) == 4
    for lock in other._locks:
        lock.close()


@pytest.mark.parametrize(
    ('variable', 'value'),
    [(module.PROFILES_VARIABLE, '/etc/mine.xml'), (module.TRANSPORTS_VARIABLE, 'SHM')],
)
def test_settings_of_the_user_are_left_alone_and_the_limit_is_said(
    variable, value, own_paths, monkeypatch
):
    monkeypatch.setenv(variable, value)
    with receive_paths([('/a',)]):
        assert module.os.environ[variable] == value
    assert not own_paths.ports and own_paths.of('/a') == 'shared'
    (note,) = own_paths.notes
    assert variable in note and value in note and 'seconds late' in note


def test_other_middlewares_get_no_profile(own_paths, monkeypatch):
    monkeypatch.setattr(module.rclpy, 'get_rmw_implementation_identifier', lambda: 'rmw_zenoh_cpp')
    with receive_paths([('/a',)]):
        assert module.PROFILES_VARIABLE not in module.os.environ
    assert not own_paths.ports and not own_paths.notes


def test_a_kernel_with_small_buffers_is_named(own_paths, monkeypatch, tmp_path):
    limit = tmp_path / 'rmem_max'
    limit.write_text('212992\n')
    monkeypatch.setattr(module, '_BUFFER_LIMIT', limit)
    with receive_paths([('/a',)]):
        tree, space, _ = read_profile()
    assert tree.find('.//d:listenSocketBufferSize', space).text == '212992'
    (note,) = own_paths.notes
    assert '212992' in note and 'net.core.rmem_max=4194304' in note


def test_a_port_that_another_program_took_is_an_error_not_silence(own_paths):
    """A subscription whose port belongs to somebody else would receive nothing."""
    code = (
        'import socket, sys\ns = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n'
        's.bind(("", 0)); print(s.getsockname()[1], flush=True); sys.stdin.read()'
    )
    with subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        own_paths.ports['/a'] = int(other.stdout.readline())
        with pytest.raises(module.ConfigError, match="'/a', was taken by another program"):
            own_paths.of('/a')
        other.stdin.close()
    assert own_paths.of('/a') == 'shared'  # nobody has it: the profile came too late


def test_a_machine_without_ipv4_is_told_the_cause(monkeypatch):
    from mtv_world_ros.core.errors import ConfigError
    from mtv_world_ros.ros import receive_paths as module

    def refuse(*_):
        raise OSError(99, 'Cannot assign requested address')

    class Socket(module.socket.socket):
        bind = refuse

    monkeypatch.setattr(module.socket, 'socket', Socket)
    with pytest.raises(ConfigError, match=r'no IPv4 loopback address \(127\.0\.0\.1\)'):
        module._free_port()
