"""Where the viewer listens, and what it says where it cannot."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import socket
import time

import pytest

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.viewing import viewer_process
from mtv_world_ros.viewing.viewer_process import check_ports, PageAddress
from robustness import listeners

PACKAGE = Path(viewer_process.__file__).parents[1]


@pytest.fixture
def stream():
    pytest.importorskip('rerun')
    from mtv_world_ros.viewing import rerun_log

    return rerun_log.recording('test')


@pytest.mark.parametrize(
    ('text', 'host', 'port', 'is_local'),
    [
        ('9090', '127.0.0.1', 9090, True),
        ('localhost:2000', '127.0.0.1', 2000, True),
        ('127.0.0.2:2000', '127.0.0.2', 2000, True),
        ('0.0.0.0:9000', '0.0.0.0', 9000, False),
        ('192.0.2.7:9000', '192.0.2.7', 9000, False),
        ('[::1]:9000', '::1', 9000, True),
        ('[::]:9000', '::', 9000, False),
    ],
)
def test_a_port_alone_is_on_this_machine_only(text, host, port, is_local):
    address = PageAddress.parse(text)
    assert (address.host, address.port, address.is_local) == (host, port, is_local)
    assert PageAddress.parse(str(address)) == address


@pytest.mark.parametrize('text', ['', 'x', '80', '65535', '-1', '1.5', ':9090', 'me:9090', '٩٠٩٠'])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match='port from 1024|an IP address'):
        PageAddress.parse(text)


def test_the_address_of_a_page_names_its_data():
    assert PageAddress.parse('9090').url == (
        'http://127.0.0.1:9090/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9091%2Fproxy'
    )
    assert PageAddress.parse('0.0.0.0:9090').url.startswith(f'http://{socket.gethostname()}:9090/')


def test_ports_are_looked_at_where_the_page_will_listen():
    with socket.socket() as taken:
        taken.bind(('127.0.0.2', 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f'port {port} cannot be used on 127.0.0.2 .*--port'):
            check_ports(PageAddress('127.0.0.2', port))
        with pytest.raises(ConfigError, match=f'port {port} cannot be used on 0.0.0.0'):
            check_ports(PageAddress('0.0.0.0', port - 1))
        check_ports(PageAddress('127.0.0.1', port))
    with pytest.raises(ConfigError, match="does not have the address '192.0.2.77'"):
        check_ports(PageAddress('192.0.2.77', port))


def test_page_and_data_listen_on_the_loopback_address_alone(stream):
    port = listeners.free_ports()
    before = listeners.listening(listeners.process_tree(os.getpid()))
    viewer_process.serve(stream, None, PageAddress(port=port))
    after = listeners.listening(listeners.process_tree(os.getpid())) - before
    assert after == {('127.0.0.1', port), ('127.0.0.1', port + 1)}
    assert not listeners.beyond_loopback(after)


def test_what_is_asked_for_is_seen_as_open_to_others():
    """The check of the tests above can fail."""
    with socket.socket() as everywhere:
        everywhere.bind(('', 0))
        everywhere.listen()
        found = listeners.listening({os.getpid()})
        assert ('0.0.0.0', everywhere.getsockname()[1]) in listeners.beyond_loopback(found)


def test_a_program_that_ends_is_told_with_its_last_line(stream, monkeypatch):
    shown = ['sh', '-c', 'echo no display >&2; exit 3']
    monkeypatch.setattr(viewer_process, 'command_line', lambda _: shown)
    begin_s = time.monotonic()
    with pytest.raises(MtvWorldError, match='ended with status 3: no display'):
        viewer_process.serve(stream, None, PageAddress(port=listeners.free_ports()))
    assert time.monotonic() - begin_s < viewer_process._START_TIMEOUT_S / 2  # it is not waited for


def test_a_missing_program_is_told(stream, monkeypatch):
    monkeypatch.setattr(viewer_process, 'find_spec', lambda _: None)
    monkeypatch.setenv('PATH', '/nowhere')
    with pytest.raises(ConfigError, match='pip install --force-reinstall rerun-sdk'):
        viewer_process.serve(stream, None, PageAddress(port=listeners.free_ports()))


def test_servers_of_the_library_are_not_used_as_they_listen_everywhere():
    """rerun-sdk 0.41: serve_grpc, serve_web_viewer and spawn listen on 0.0.0.0."""
    words = ('serve_grpc', 'serve_web_viewer', 'stream.spawn(', 'HTTPServer(')
    used = [
        f'{path.relative_to(PACKAGE)}: {word}'
        for path in PACKAGE.rglob('*.py')
        for word in words
        if word in path.read_text(encoding='utf-8')
    ]
    assert not used
