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

import torch

from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.lab.training.training_config import load_training_config, TrainingRun
from mtv_world_ros.lab.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def start(number: int, port: int, out: Path, episodes: Path, preset: Path) -> int:
    """Starts process `number` of two, as a launcher does, and returns its id."""
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
        torch.set_num_threads(1)
        robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
        config = load_training_config(preset)
        run = TrainingRun(config=config, dataset=episodes, out=out, save_every=5)
        train(run, robot=robot, segmenter=ColourSegmenter())
    except MtvWorldError as error:
        (out / 'said').write_text(f'{type(error).__name__}: {error}')
    finally:
        os._exit(1)


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


if __name__ == '__main__':
    folder, bags, file = (Path(argument) for argument in sys.argv[1:])
    chosen = free_port()
    main, other = (start(number, chosen, folder, bags, file) for number in (0, 1))
    while not (folder / 'state' / 'state.json').exists():
        time.sleep(0.01)
        assert os.waitpid(main, os.WNOHANG) == (0, 0)
    os.kill(other, signal.SIGKILL)
    os.waitpid(other, 0)
    os.waitpid(main, 0)
