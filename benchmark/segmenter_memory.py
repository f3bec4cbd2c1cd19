"""Does a SAM tracker stream at constant memory?

    python benchmark/segmenter_memory.py [--weights FOLDER] [--frames 1000] [--out FOLDER]

Follows two objects through a long video that is never held as a whole, and prints what the
session stores and how large the process is. Without weights of SAM 2, a tiny random one of the
true architecture does it: what is stored per frame is the same, only smaller.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import importlib
import os
from pathlib import Path
import sys
import tempfile
import time

import numpy as np
import page

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.vision.segmenters.prompted import (
    drop_old,
    reach,
    start_session,
    stored_entries,
)
from mtv_world_ros.vision.segmenters.sam import Sam2Video
from mtv_world_ros.vision.segmenters.weights import find_weights

HEIGHT, WIDTH = 288, 384
REPORTED = (100, 200, 500, 1000, 2000, 5000)


def frames(count: int, seed: int) -> Iterator[ByteArray]:
    """Noise with a red square that circles."""
    rng = np.random.default_rng(seed)
    for index in range(count):
        frame = rng.integers(60, 120, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        x = round(150 + 100 * np.cos(index / 30))
        frame[100:140, x : x + 40] = (220, 40, 30)
        yield frame


def follow(video: Sam2Video, count: int, seed: int, *, bounded: bool) -> list[list[str]]:
    """Rows: frame, stored entries, resident memory, time per frame since the row before."""
    masks = np.zeros((2, HEIGHT, WIDTH), np.bool_)
    masks[0, 100:140, 250:290] = True
    masks[1, 10:50, 10:50] = True
    source = frames(count + 1, seed)
    session = start_session(video, next(source), masks)
    rows, last = [], 0
    begun = time.process_time()
    for index, frame in enumerate(source, start=1):
        video.advance(session, frame, index)
        if bounded:
            drop_old(session, index, reach(video.tracker.config))
        if index in REPORTED or index == count:
            spent = (time.process_time() - begun) / (index - last)
            rows.append(
                [
                    'dropped' if bounded else 'kept',
                    str(index),
                    str(stored_entries(session)),
                    f'{_resident_mib():.0f}',
                    f'{1e3 * spent:.1f}',
                ]
            )
            begun, last = time.process_time(), index
    return rows


def _resident_mib() -> float:
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


def _tiny(folder: Path) -> Sam2Video:
    """The one that the tests use."""
    sys.path.insert(0, str(Path(__file__).parent.parent / 'test' / 'vision'))
    return Sam2Video(importlib.import_module('tiny_vision').save_sam2(folder))


def main() -> None:
    """Reads the arguments, follows, prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--weights', type=Path, help='folder with a SAM 2; default: tiny, random')
    parser.add_argument('--frames', type=int, default=1000)
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    options.repeats = options.frames
    import torch
    import transformers

    torch.set_num_threads(1)
    if options.weights:
        video = Sam2Video(find_weights(options.weights)['sam2_video'], device=options.device)
    else:
        with tempfile.TemporaryDirectory() as folder:
            video = _tiny(Path(folder))
    rows = follow(video, options.frames, options.seed, bounded=True)
    rows += follow(video, options.frames, options.seed, bounded=False)
    size = sum(parameter.numel() for parameter in video.tracker.parameters()) / 1e6
    body = (
        f'SAM 2 of {size:.1f} M parameters at {video.tracker.image_size} px'
        f'{"" if options.weights else " (random weights)"}, 2 objects, frames of '
        f'{WIDTH} x {HEIGHT}. Entries: frames, mask memories and pointers in the session.\n\n'
    )
    header = ('what is out of reach is', 'frame', 'entries', 'resident [MiB]', 'ms / frame')
    page.publish(
        'segmenter_memory',
        'A SAM tracker over a long video',
        f'python benchmark/segmenter_memory.py --frames {options.frames}',
        body + page.table(header, rows),
        options,
        f'transformers {transformers.__version__}, torch {torch.__version__}',
    )


if __name__ == '__main__':
    main()
