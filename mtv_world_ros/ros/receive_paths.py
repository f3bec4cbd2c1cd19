"""Sockets of their own for small, urgent topics, so that plans do not wait behind pictures.

A Fast DDS participant receives all unicast data through one UDP port and one shared-memory port.
A burst of images overflows their buffers. The datagram of a plan that is lost there comes again
after the sender's heartbeat period, by default 3 s. Readers with a UDP port of their own do not
share these buffers, whatever the settings of the sender are.

Fast DDS reads ports from an XML profile that has the name of the topic, once a process, when its
first node is made. Therefore the file is written before that, for the remapped names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
import errno
import os
from pathlib import Path
import random
import socket
import tempfile
from xml.etree import ElementTree

import rclpy
from rclpy.expand_topic_name import expand_topic_name

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path

PROFILES_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
TRANSPORTS_VARIABLE = 'FASTDDS_BUILTIN_TRANSPORTS'
#: name of the profile that rmw_fastrtps gives the request readers of all services
SERVICES = 'service'
#: receive buffer of a socket, four raw images of 640x480 [bytes]
WANTED_BUFFER_BYTES = 4 * 1024 * 1024
#: the kernel's limit of it
_BUFFER_LIMIT = Path('/proc/sys/net/core/rmem_max')
#: ports above Linux' ephemeral ones; Fast DDS itself takes them for domains above 214 only
_PORTS = range(61_000, 65_536)
_NUM_TRIES = 200
#: errors of a machine without IPv4
_NO_IPV4 = (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)
#: built-in transports of Fast DDS that can receive over UDPv4
_UDP_TRANSPORTS = ('DEFAULT', 'UDPV4', 'LARGE_DATA')
_SPACE = 'http://www.eprosima.com'
_OWN_PROFILES = ('fastdds_heartbeat.xml', 'fastdds_profile.xml')
_SHARED = 'plans share their receive buffer with images and may come seconds late'


@dataclass(slots=True)
class ReceivePaths:
    """UDP ports of a process by topic.

    Attributes:
        ports: port by fully qualified topic name, or `SERVICES`.
        notes: limits that the user should know of, for the log.
    """

    ports: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _locks: list[socket.socket] = field(default_factory=list)

    def reserve(self, topics: Sequence[str]) -> None:
        """Reserve a free UDP port that these topics share."""
        port, lock = _free_port()
        self._locks.append(lock)
        self.ports.update(dict.fromkeys(topics, port))

    def of(self, topic: str) -> str:
        """Return the receive path of a subscribed topic in words, for `/diagnostics`.

        Raises:
            ConfigError: another process has taken the port: nothing would be received.
        """
        port = self.ports.get(topic)
        if port is None:
            return 'shared'
        if _is_open_here(port):
            return f'UDP port {port}'
        if _is_free(port):
            return 'shared'  # the process had a node before this profile was written
        raise ConfigError(
            f"UDP port {port}, chosen for '{topic}', was taken by another program meanwhile; "
            'start the node again, it will choose another one'
        )


#: of this process: Fast DDS reads its profiles once
PATHS = ReceivePaths()


@contextmanager
def receive_paths(groups: Sequence[Sequence[str]]) -> Iterator[ReceivePaths]:
    """Make nodes created in this context receive topics through UDP ports of their own.

    Other middlewares than Fast DDS, and profiles of the user's own, are left alone. What this
    package publishes is sent again after .1 s where it was lost.

    Args:
        groups: fully qualified topic names, or `SERVICES`; those of a group share a port.
    """
    if not rclpy.get_rmw_implementation_identifier().startswith('rmw_fastrtps'):
        yield PATHS
        return
    before = os.environ.get(PROFILES_VARIABLE)
    with tempfile.TemporaryDirectory(prefix='mtv_world_ros_') as folder:
        base = _base_profile(before)
        if base is not None:
            os.environ[PROFILES_VARIABLE] = str(base)
            if groups and not PATHS.ports and _can_receive_udp():
                os.environ[PROFILES_VARIABLE] = _write(base, groups, Path(folder))
        elif groups:
            PATHS.notes.append(
                f"{PROFILES_VARIABLE} names '{before}', which is used as it is: {_SHARED}; see "
                "'Plans arrive late' in docs/troubleshooting.md"
            )
        try:
            yield PATHS
        finally:
            if before is None:
                os.environ.pop(PROFILES_VARIABLE, None)
            else:
                os.environ[PROFILES_VARIABLE] = before


def resolved_topics(arguments: Sequence[str], node: str, topics: Sequence[str]) -> list[str]:
    """Return the fully qualified names that a node's topics will have.

    rclpy resolves names for nodes that exist; Fast DDS needs them before.

    Args:
        arguments: command line with `--ros-args -r FROM:=TO`.
        node: name of the node.
        topics: names of topics in the program; `SERVICES` stays.
    """
    rules = _remap_rules(arguments)
    name = next((to for scope, source, to in rules if _renames(scope, source, node)), node)
    spaces = [to for scope, source, to in rules if source == '__ns' and scope in ('', name)]
    space = spaces[0] if spaces else '/'
    space = space if space.startswith('/') else f'/{space}'

    def resolve(topic: str) -> str:
        if topic == SERVICES:
            return topic
        full = expand_topic_name(topic, name, space)
        for scope, source, to in rules:
            if scope in ('', name) and not source.startswith('__'):
                with suppress(ValueError):  # rclpy says what is wrong with a rule
                    if expand_topic_name(source, name, space) == full:
                        return expand_topic_name(to, name, space)
        return full

    return [resolve(topic) for topic in topics]


def _renames(scope: str, source: str, node: str) -> bool:
    return source in ('__node', '__name') and scope in ('', node)


def _remap_rules(arguments: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return the remapping rules of a command line: node name, or '' for all, from, to."""
    rules: list[tuple[str, str, str]] = []
    is_ros, is_rule = False, False
    for word in arguments:
        if word in ('--ros-args', '--'):
            is_ros, is_rule = word == '--ros-args', False
        elif is_ros and word in ('-r', '--remap'):
            is_rule = True
        else:
            # outside of --ros-args, rcl still takes FROM:=TO, with a warning
            left, mark, to = word.partition(':=')
            if mark and (is_rule or not is_ros):
                scope, colon, source = left.removeprefix('rostopic://').partition(':')
                rules.append((scope, source, to) if colon else ('', scope, to))
            is_rule = False
    return rules


def _base_profile(given: str | None) -> Path | None:
    """Return the package's profile to extend; None = the user has one of their own."""
    own = [share_path('config', name) for name in _OWN_PROFILES]
    if not given:
        return own[0]
    with suppress(OSError):
        return next((path for path in own if Path(given).samefile(path)), None)
    return None


def _can_receive_udp() -> bool:
    transports = os.environ.get(TRANSPORTS_VARIABLE, '') or 'DEFAULT'
    if transports.partition('?')[0].upper() in _UDP_TRANSPORTS:
        return True
    PATHS.notes.append(
        f"{TRANSPORTS_VARIABLE} is '{transports}', which has no UDPv4: {_SHARED}; leave it unset, "
        "or set it to 'UDPv4'"
    )
    return False


def _write(base: Path, groups: Sequence[Sequence[str]], folder: Path) -> str:
    """Write the profile with the ports of this process; return its path."""
    ElementTree.register_namespace('', _SPACE)
    tree = ElementTree.parse(base)
    root = tree.getroot()
    for group in groups:
        PATHS.reserve(group)
    for topic, port in PATHS.ports.items():
        root.append(_reader(topic, port))
    _add_buffer(root, _buffer_bytes())
    path = folder / 'fastdds.xml'
    tree.write(path, encoding='utf-8', xml_declaration=True)
    return str(path)


def _reader(topic: str, port: int) -> ElementTree.Element:
    """Return the profile of a topic's reader: a UDP port on all interfaces of this machine."""
    reader = ElementTree.Element(_tag('data_reader'), profile_name=topic)
    _add(reader, 'unicastLocatorList', 'locator', 'udpv4', 'port').text = str(port)
    return reader


def _add_buffer(root: ElementTree.Element, size: int) -> None:
    """Set the receive buffer of the default participant's sockets."""
    participant = root.find(_tag('participant'))
    if participant is None:
        participant = ElementTree.SubElement(
            root,
            _tag('participant'),
            {'profile_name': 'receive_buffer', 'is_default_profile': 'true'},
        )
    rtps = participant.find(_tag('rtps'))
    rtps = _add(participant, 'rtps') if rtps is None else rtps
    _add(rtps, 'listenSocketBufferSize').text = str(size)


def _add(element: ElementTree.Element, *names: str) -> ElementTree.Element:
    for name in names:
        element = ElementTree.SubElement(element, _tag(name))
    return element


def _tag(name: str) -> str:
    return f'{{{_SPACE}}}{name}'


def _buffer_bytes() -> int:
    """Return the receive buffer to ask for: what is wanted, or what the kernel allows."""
    try:
        allowed = int(_BUFFER_LIMIT.read_text())
    except (OSError, ValueError):
        return WANTED_BUFFER_BYTES
    if allowed < WANTED_BUFFER_BYTES:
        PATHS.notes.append(
            f'the kernel allows receive buffers of {allowed} bytes; large images over UDP need '
            f'{WANTED_BUFFER_BYTES}: sysctl -w net.core.rmem_max={WANTED_BUFFER_BYTES}'
        )
    return min(allowed, WANTED_BUFFER_BYTES)


def _free_port() -> tuple[int, socket.socket]:
    """Return a free UDP port, and a TCP socket of the same number that reserves it.

    Fast DDS opens the UDP port itself, later. The TCP port, on which nobody listens, keeps other
    nodes of this package from choosing the same number meanwhile.
    """
    for port in random.sample(_PORTS, _NUM_TRIES):
        lock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            lock.bind(('127.0.0.1', port))
        except OSError as error:
            lock.close()
            if error.errno in _NO_IPV4:
                raise ConfigError(
                    'this machine has no IPv4 loopback address (127.0.0.1), over which nodes '
                    f'receive plans: {error.strerror}; bring it up (ip link set lo up; ip address '
                    'add 127.0.0.1/8 dev lo)'
                ) from error
            continue
        if _is_free(port):
            return port, lock
        lock.close()
    raise ConfigError(
        f'{_NUM_TRIES} UDP ports from {_PORTS.start} to {_PORTS.stop - 1} were tried and none is '
        'free; is another program holding them?'
    )


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True


def _is_open_here(port: int) -> bool:
    """Return whether this process (without /proc: any process) has the UDP port open."""
    try:
        rows = [line.split() for line in Path('/proc/self/net/udp').read_text().splitlines()[1:]]
        open_here = {os.readlink(link.path) for link in os.scandir('/proc/self/fd')}
    except OSError:
        return not _is_free(port)
    nodes = {row[9] for row in rows if int(row[1].rpartition(':')[2], 16) == port}
    return any(f'socket:[{node}]' in open_here for node in nodes)
