"""Sockets that processes listen on: none is reachable from another machine unless asked for.

    python -m robustness.listeners

starts every command that opens a TCP port, prints where it listens, and fails on an address that
is not the machine's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import ipaddress
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import tempfile
import time

#: TCP state LISTEN in /proc/net/tcp (include/net/tcp_states.h of Linux)
_LISTEN = '0A'
_START_S = 90.0
_ENVIRONMENT = {'ROS_DOMAIN_ID': '86', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
ROOT = Path(__file__).resolve().parents[1]


def process_tree(pid: int) -> set[int]:
    """Return a process and everything that it started."""
    parents = {}
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            parents[int(folder.name)] = int(
                (folder / 'stat').read_text().rpartition(')')[2].split()[1]
            )
        except OSError:  # it ended
            continue
    tree = {pid}
    while more := {child for child, parent in parents.items() if parent in tree} - tree:
        tree |= more
    return tree


def listening(pids: set[int]) -> set[tuple[str, int]]:
    """Return the addresses (IP, port) on which processes listen for TCP connections."""
    inodes = set()
    for pid in pids:
        for entry in Path(f'/proc/{pid}/fd').glob('*'):
            try:
                inodes.add(os.readlink(entry))
            except OSError:  # it was closed
                continue
    found = set()
    for table in ('tcp', 'tcp6'):
        path = Path('/proc/net') / table
        for line in path.read_text().splitlines()[1:] if path.exists() else ():
            fields = line.split()
            if fields[3] == _LISTEN and f'socket:[{fields[9]}]' in inodes:
                host, _, port = fields[1].partition(':')
                found.add((_address(host), int(port, 16)))
    return found


def beyond_loopback(addresses: set[tuple[str, int]]) -> set[tuple[str, int]]:
    """Return the addresses that other machines may reach."""
    return {one for one in addresses if not _is_loopback(one[0])}


def _is_loopback(host: str) -> bool:
    address = ipaddress.ip_address(host)
    return (getattr(address, 'ipv4_mapped', None) or address).is_loopback


def free_ports() -> int:
    """Return a port that is free, as the one above it is."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(('127.0.0.1', 0))
            port = first.getsockname()[1]
            try:
                second.bind(('127.0.0.1', port + 1))
            except OSError:
                continue
            return port


def _address(text: str) -> str:
    """An address of /proc/net/tcp: words of 32 bits in the machine's order, as hexadecimals."""
    words = [int(text[k : k + 8], 16).to_bytes(4, sys.byteorder) for k in range(0, len(text), 8)]
    return str(ipaddress.ip_address(b''.join(words)))


@contextmanager
def running(command: Sequence[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of `mtv-world`; Ctrl-C ends it."""
    with log.open('wb') as out:
        process = subprocess.Popen(
            [sys.executable, '-m', 'mtv_world_ros.cli', *command],
            cwd=ROOT,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={
                **os.environ,
                'ROS_DOMAIN_ID': '86',
                'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            },
        )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def commands(port: int, out: Path) -> dict[str, list[str]]:
    """Return the commands that listen, by name; each on ports of its own."""
    episode = 'resource/demo_episode'
    imagine = ['imagine', '--policy', 'expert', '--episodes', episode, '--max-chunks', '2']
    rank = ['rank', '--policies', 'expert', '--tasks', 'stack_blocks_two', '--episodes', '1']
    rank += ['--max-chunks', '1', '--out', str(out / 'rank')]
    return {
        'view': ['view', episode, '--port', str(port)],
        'view --live': ['view', '--live', '--port', str(port)],
        'imagine --watch': [*imagine, '--out', str(out / 'imagine'), '--watch', str(port)],
        'rank --watch': [*rank, '--watch', str(port)],
    }


def main() -> int:
    """Print where every command listens; return 1 where another machine may reach it."""
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in commands(0, Path(folder)):
            port = free_ports()
            log = Path(folder) / 'log'
            with running(commands(port, Path(folder))[name], log) as process:
                found = set[tuple[str, int]]()
                end_s = time.monotonic() + _START_S
                while time.monotonic() < end_s and process.poll() is None:
                    found |= listening(process_tree(process.pid))
                    if {port, port + 1} <= {number for _, number in found}:
                        break
                    time.sleep(0.2)
            wrong = beyond_loopback(found)
            is_served = {port, port + 1} <= {number for _, number in found}
            failed |= bool(wrong) or not is_served
            said = ', '.join(f'{host}:{number}' for host, number in sorted(found)) or 'nothing'
            print(f'{name:16} {said}{"  WRONG" if wrong or not is_served else ""}', flush=True)
            if not is_served:
                print(log.read_text()[-500:])
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
