"""The Rerun viewer as a process of its own: a page for browsers, or a window.

It listens on the loopback address unless the user names another one: whoever reaches its ports can
copy the recording and write to it. The servers inside of Rerun's library listen on every address
(0.0.0.0), so its program is started instead, which takes an address.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
import errno
from importlib.util import find_spec
import ipaddress
import os
from pathlib import Path
import shutil
import socket
import subprocess
import tempfile
import time
from typing import Any
from urllib.parse import quote
import weakref

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.processes import ending_with_this_process, last_line

#: address of the machine itself
LOOPBACK = '127.0.0.1'
#: port on which Rerun's window takes data
_WINDOW_PORT = 9876
#: timeout of the start [s]; a first start reads 300 MB from a slow disk
_START_TIMEOUT_S = 30.0
_STOP_S = 2.0
_POLL_S = 0.05
#: environment of Rerun's program, so that it asks no questions at its first start
_ENVIRONMENT = {'RERUN_APP_ONLY': 'true'}


@dataclass(frozen=True, slots=True)
class PageAddress:
    """Address of a page for browsers.

    Attributes:
        host: IP address to listen on; 0.0.0.0 or :: = every one of this machine.
        port: TCP port of the page; the data take the one above it.
    """

    host: str = LOOPBACK
    port: int = 9090

    @classmethod
    def parse(cls, text: str) -> PageAddress:
        """Return the value of an option: `PORT` or `ADDRESS:PORT`, e.g. `0.0.0.0:9090`.

        Raises:
            argparse.ArgumentTypeError: it is neither.
        """
        host, colon, port = text.rpartition(':')
        host = host.removeprefix('[').removesuffix(']') if colon else LOOPBACK
        try:
            host = str(ipaddress.ip_address('127.0.0.1' if host == 'localhost' else host))
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f"'{text}' does not begin with an IP address; expected PORT, or ADDRESS:PORT such "
                'as 0.0.0.0:9090 for every address of this machine'
            ) from error
        if not (port.isascii() and port.isdecimal()) or not 1024 <= int(port) < 65535:
            raise argparse.ArgumentTypeError(f"'{text}' does not end in a port from 1024 to 65534")
        return cls(host, int(port))

    @property
    def is_local(self) -> bool:
        """True if only this machine reaches the page."""
        return ipaddress.ip_address(self.host).is_loopback

    @property
    def url(self) -> str:
        """Address for a browser, with that of the data."""
        host = self.host
        if ipaddress.ip_address(host).is_unspecified:
            host = socket.gethostname()
        host = f'[{host}]' if ':' in host else host
        data = quote(f'rerun+http://{host}:{self.port + 1}/proxy', safe='')
        return f'http://{host}:{self.port}/?url={data}'

    def __str__(self) -> str:
        host = f'[{self.host}]' if ':' in self.host else self.host
        return str(self.port) if self.host == LOOPBACK else f'{host}:{self.port}'


def check_ports(address: PageAddress, option: str = '--port') -> None:
    """Check that the ports of the page and of its data are free on the address to listen on.

    Args:
        address: address of the page.
        option: option of the command, which sets it.

    Raises:
        ConfigError: a port is taken, or this machine does not have the address.
    """
    for port in (address.port, address.port + 1):
        _check_port(address.host, port, option)


def _check_port(host: str, port: int, option: str) -> None:
    family = socket.AF_INET6 if ':' in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            where = '' if host == LOOPBACK else f' on {host}'
            if error.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                raise ConfigError(
                    f"this machine does not have the address '{host}' ({error.strerror}); give "
                    f'one that it has: {option} [ADDRESS:]PORT'
                ) from error
            raise ConfigError(
                f'port {port} cannot be used{where} ({error.strerror}): another viewer may still '
                f'be served there; give another {option} (the data take the one above it)'
            ) from error


def serve(stream: Any, blueprint: Any, address: PageAddress) -> str:
    """Serve a recording to browsers until the recording is deleted; return the page's address.

    Args:
        stream: recording of Rerun; data logged after this call is shown.
        blueprint: first layout; None = the viewer's own.
        address: address to listen on.

    Raises:
        ConfigError: a port is taken, or Rerun's program is missing.
        MtvWorldError: the program ended.
    """
    check_ports(address)
    data_port = address.port + 1
    command = ['--serve-web', '--bind', address.host]
    command += ['--port', str(data_port), '--web-viewer-port', str(address.port)]
    if not address.is_local:  # Rerun's server refuses pages that come from elsewhere
        command += ['--cors-allow-origin', f'http://*:{address.port}']
    folder = Path(tempfile.mkdtemp(prefix='mtv_world_viewer_'))
    weakref.finalize(stream, shutil.rmtree, folder, ignore_errors=True)
    process = _start(ending_with_this_process(command_line(command)), folder)
    weakref.finalize(stream, _end, process)
    reached = _reached(address.host)
    for port in (data_port, address.port):
        _wait(process, reached, port, folder)
    _connect(stream, blueprint, reached, data_port)
    return address.url


def open_window(stream: Any, blueprint: Any) -> None:
    """Show a recording in Rerun's window, which stays when this process ends.

    A window that is already there on the usual port is used.

    Raises:
        ConfigError: Rerun's program is missing.
        MtvWorldError: the program ended, as it does without a display.
    """
    if not _listens(LOOPBACK, _WINDOW_PORT):
        command = ['--bind', LOOPBACK, '--port', str(_WINDOW_PORT), '--expect-data-soon']
        with tempfile.TemporaryDirectory(prefix='mtv_world_viewer_') as folder:
            process = _start(command_line(command), Path(folder))
            _wait(process, LOOPBACK, _WINDOW_PORT, Path(folder))
    _connect(stream, blueprint, LOOPBACK, _WINDOW_PORT)


def command_line(arguments: Sequence[str]) -> list[str]:
    """Return a command of Rerun's program, which comes with its Python package.

    Raises:
        ConfigError: there is none.
    """
    package = find_spec('rerun_cli')
    bundled = Path(package.origin).with_name('rerun') if package and package.origin else None
    program = str(bundled) if bundled and bundled.is_file() else shutil.which('rerun')
    if program is None:
        raise ConfigError(
            "the program 'rerun' of the viewer is missing: pip install --force-reinstall rerun-sdk"
        )
    return [program, *arguments]


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start the program in a session of its own: Ctrl-C ends the command, then the command it."""
    with (folder / 'log').open('wb') as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **_ENVIRONMENT},
            start_new_session=True,
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the program; it holds nothing that must be written."""
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _wait(process: subprocess.Popen[bytes], host: str, port: int, folder: Path) -> None:
    """Wait until the program listens.

    Raises:
        MtvWorldError: it ended, or does not listen in time.
    """
    end_s = time.monotonic() + _START_TIMEOUT_S
    while not _listens(host, port):
        if process.poll() is not None:
            text = last_line(folder / 'log', 'it printed nothing')
            raise MtvWorldError(f'the viewer ended with status {process.returncode}: {text}')
        if time.monotonic() > end_s:
            _end(process)
            raise MtvWorldError(
                f'the viewer does not listen on port {port} after {_START_TIMEOUT_S:g} s; see '
                f"'{folder / 'log'}'"
            )
        time.sleep(_POLL_S)


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _reached(host: str) -> str:
    """Return the address under which this process reaches what listens on `host`."""
    address = ipaddress.ip_address(host)
    if not address.is_unspecified:
        return host
    return LOOPBACK if address.version == 4 else '::1'


def _connect(stream: Any, blueprint: Any, host: str, port: int) -> None:
    name = f'[{host}]' if ':' in host else host
    stream.connect_grpc(f'rerun+http://{name}:{port}/proxy', default_blueprint=blueprint)
