"""Two processes train together, one is killed; what the other one says goes into OUT/said.

python train_lost.py OUT EPISODES PRESET
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import socket
import sys
import time

from mtv_world_ros.core.errors import MtvWorldError
from test.support.sources import run_training


def start(number: int, port: int, out: Path, episodes: Path, preset: Path) -> int:
    """Start process `number` of two, as a launcher does, and return its id."""
    child = os.fork()
    if child:
        return child
    os.environ |= {
        'RANK': str(number),
        'LOCAL_RANK': str(number),
        'WORLD_SIZE': '2',
        'LOCAL_WORLD_SIZE': '2',
        'MASTER_ADDR': '127.0.0.1',
        'MASTER_PORT': str(port),
    }
    try:
        run_training(out, episodes, preset, save_every=5)
    except MtvWorldError as error:
        (out / 'said').write_text(f'{type(error).__name__}: {error}')
    finally:
        os._exit(1)


def held_port() -> socket.socket:
    """Return a socket whose port no other program is given, and torch can listen on."""
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind(('127.0.0.1', 0))
    return held


if __name__ == '__main__':
    folder, bags, file = (Path(argument) for argument in sys.argv[1:])
    held = held_port()
    chosen = held.getsockname()[1]
    main, other = (start(number, chosen, folder, bags, file) for number in (0, 1))
    while not (folder / 'state' / 'state.json').exists():
        time.sleep(0.01)
        assert os.waitpid(main, os.WNOHANG) == (0, 0)
    os.kill(other, signal.SIGKILL)
    os.waitpid(other, 0)
    os.waitpid(main, 0)
