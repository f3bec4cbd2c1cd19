"""Policy servers that are slow, huge, nested, in pieces or silent: each question ends in time.

A server of openpi's protocol misbehaves in one of the ways below; the client asks. It must be
answered, or be told within its `timeout_s` (and a margin) why not, and the next question of a
server that has come to its senses must be answered. Prints a table; the exit status is 1 if
something hung, took long, or raised an error that is not ours.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
import json
from pathlib import Path
import sys
import tempfile
import threading
import time
import traceback
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.core.data_types import CameraModel, Observation
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.policies.openpi_client import pack
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import assemble_policy

#: of the client, and by how much the end may be later, on a machine that is not busy [s]
TIMEOUT_S, MARGIN_S = 1.0, 2.0
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)


def _good() -> bytes:
    return pack({'actions': np.zeros((10, 14), np.float32)})


def fine(socket: Any) -> None:
    """Answers."""
    socket.send(_good())


def slow(socket: Any) -> None:
    """Answers a little too late."""
    time.sleep(TIMEOUT_S + 0.5)
    socket.send(_good())


def never(socket: Any) -> None:
    """Do not answer and keep the line."""
    time.sleep(4 * TIMEOUT_S)


def huge(socket: Any) -> None:
    """Answers with more than is read."""
    for _ in range(2):
        socket.send(b'\0' * (80 * 2**20))


def nested(socket: Any) -> None:
    """Maps in maps in maps."""
    socket.send(b'\x81\xa1a' * 100_000 + b'\xc0')


def pieces(socket: Any) -> None:
    """A message that goes on and on, a byte at a time."""

    def drip() -> Any:
        end_s = time.monotonic() + 5 * TIMEOUT_S
        while time.monotonic() < end_s:
            yield b'\0'
            time.sleep(0.05)

    socket.send(drip())


def gone(socket: Any) -> None:
    """Close in mid-answer."""
    socket.socket.sendall(b'\x82\x7e\xff\xff' + b'\0' * 100)
    socket.socket.close()


def garbage(socket: Any) -> None:
    """Bytes that are no message."""
    socket.send(np.random.default_rng(0).bytes(2000))


def wild(socket: Any) -> None:
    """Numbers that are none."""
    socket.send(pack({'actions': np.full((10, 14), np.nan, np.float32)}))


def vast(socket: Any) -> None:
    """Far more actions than any robot takes."""
    socket.send(pack({'actions': np.zeros((400_000, 14), np.float32)}))


def words(socket: Any) -> None:
    """A traceback of a megabyte."""
    socket.send('Traceback: ' + 'x' * 2**20)


WAYS: dict[str, Callable[[Any], None]] = {
    way.__name__: way
    for way in (fine, slow, never, huge, nested, pieces, gone, garbage, wild, vast, words)
}


class Server:
    """A server in a thread that does what `way` says."""

    def __init__(self) -> None:
        from websockets.sync.server import serve

        self.way = 'fine'
        self._server = serve(self._serve, '127.0.0.1', 0, compression=None, max_size=None)
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _serve(self, socket: Any) -> None:
        socket.send(pack({'model': 'wild'}))
        with suppress(Exception):  # the client may have hung up
            while True:
                socket.recv()
                WAYS[self.way](socket)


def _policy(folder: Path, port: int) -> Any:
    values = yaml.safe_load(share_path('config', 'policies', 'openpi.yaml').read_text())
    values |= {'server': f'ws://127.0.0.1:{port}', 'timeout_s': TIMEOUT_S}
    path = folder / 'policy.yaml'
    path.write_text(yaml.safe_dump(values))
    return assemble_policy(path, load_robot(robot_path('yam_bimanual')))(EpisodeOrigin())


def _observation() -> Observation:
    cameras = tuple(
        CameraModel(view=view, width=96, height=72, K=np.diag([90.0, 90.0, 1.0]),
                    mount_link='base', T_mount_camera=np.eye(4))
        for view in ('low', 'high')
    )  # fmt: skip
    frames = np.zeros((2, 72, 96, 3), np.uint8)
    return Observation(cameras=cameras, frames=frames, positions=HOME, stamp_ns=10**9)


def ask(policy: Any, observation: Observation) -> tuple[str, float]:
    """Ask once: `answered`, `refused`, or what went wrong; and how long it took [s]."""
    begin_s = time.monotonic()
    try:
        answer = policy.act(observation, 'stack')
        name = 'answered' if np.isfinite(answer.positions).all() else 'believed what is no number'
    except MtvWorldError:
        name = 'refused'
    except Exception:
        name = traceback.format_exc()
    return name, time.monotonic() - begin_s


def run(count: int, margin_s: float = MARGIN_S) -> list[dict[str, Any]]:
    """Ask each kind of server so often; a row a kind."""
    rows, observation = [], _observation()
    with tempfile.TemporaryDirectory() as folder:
        for name in WAYS:
            server = Server()
            policy = _policy(Path(folder), server.port)
            row: dict[str, Any] = {'server': name, 'tried': 0, 'answered': 0, 'refused': 0}
            row |= {'recovered': 0, 'worst_s': 0.0, 'failures': []}
            for _ in range(count):
                server.way = name
                outcome, seconds = ask(policy, observation)
                row['tried'] += 1
                row['worst_s'] = max(row['worst_s'], seconds)
                if outcome in ('answered', 'refused'):
                    row[outcome] += 1
                else:
                    row['failures'].append(outcome)
                if seconds > TIMEOUT_S + margin_s:
                    row['failures'].append(f'took {seconds:.1f} s')
                server.way = 'fine'
                policy.close()
                row['recovered'] += ask(policy, observation)[0] == 'answered'
            policy.close()
            rows.append(row)
    return rows


def main() -> int:
    """Ask; 1 if something hung, or was not refused as it should."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=20, help='questions to each kind of server')
    parser.add_argument('--margin', type=float, default=MARGIN_S, help='[s]')
    parser.add_argument('--json', type=Path, help='keep the rows here')
    arguments = parser.parse_args()
    rows = run(arguments.cases, arguments.margin)
    for row in rows:
        sys.stdout.write(json.dumps(row) + '\n')
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return int(any(row['failures'] or row['recovered'] < row['tried'] for row in rows))


if __name__ == '__main__':
    raise SystemExit(main())
