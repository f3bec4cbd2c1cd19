"""Fuzz of everything that is read from outside: `make fuzz` prints what became of it, by kind.

Every case is made from a seed that is printed: `--seed N --kind K --case C` repeats it. A case is
rejected with an error of the package, or survived (read). Anything else (another error, more time
or memory than the budget) is a failure: it is printed, and the exit status is 1. Each kind runs in
a process of its own, whose memory is limited.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
import multiprocessing
import os
from pathlib import Path
import pickle
import resource
import shutil
import signal
import tempfile
import time
import traceback
from typing import Any, NamedTuple

import cv2
import numpy as np

from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb
from mtv_world_ros.data.bag.messages import deserialize, parse_joint_trajectory, typestore
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.recover import recover
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.success.task import load_task, load_tasks, match_task
from mtv_world_ros.vision.describers.describer import objects_from_instruction

#: a case that takes longer is a hang [s of the process], and a process that takes more memory ends
MOST_S = 2.0
MOST_BYTES = 2 * 2**30
#: what is put into places of a file: numbers at the ends of formats, and words of YAML and JSON
WORDS = (
    b'.inf', b'-.inf', b'.nan', b'NaN', b'1e999', b'-1', b'0', b'null', b'[]', b'{}', b'""',
    b'[[[[', b'*a', b'&a', b'<<: *a', b'!!python/object:os.system', b'!!timestamp x', b'9' * 400,
    b'\0', b'\xff\xfe', b'\xff' * 8, b'\x7f\xff\xff\xff', b'\0' * 8, b'true', b'4294967296',
)  # fmt: skip


class Outcome(NamedTuple):
    """What became of one case: `rejected`, `survived`, or the failure."""

    name: str
    seconds: float
    megabytes: float


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with a few bytes, words or parts changed."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, len(out) + 1))
        word = WORDS[rng.integers(len(WORDS))]
        changes = (
            (at, at + 1, rng.bytes(1)),
            (at, at, word),
            (at, at + int(rng.integers(1, 9)), word),
            (at, at + int(rng.integers(1, 65)), b''),
            (at, at, bytes(out[at : at + int(rng.integers(1, 4096))])),
            (at, at + 8, rng.bytes(8)),
            (at, len(out) if rng.random() < 0.3 else at, b''),
        )
        begin, end, new = changes[rng.integers(len(changes))]
        out[begin:end] = new
    return bytes(out)


class Kind(NamedTuple):
    """What is read: how cases are made, what reads them, and how long that may take [s]."""

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes, Path], Any]
    most_s: float = MOST_S


def _file(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _config(folder: str) -> Callable[[], list[bytes]]:
    return lambda: [file.read_bytes() for file in share_path('config', folder).glob('*.yaml')]


def _read_robot(data: bytes, folder: Path) -> Any:
    """Beside the files that the bundled robots name."""
    if not (folder / 'robots').exists():
        shutil.copytree(share_path('config', 'robots'), folder / 'robots')
    return load_robot(_file(folder / 'robots' / 'mutated.yaml', data))


def _images() -> list[bytes]:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 56, 3), dtype=np.uint8)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 2)
    options = ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])
    jpegs = [cv2.imencode('.jpg', pixels, option)[1].tobytes() for option in options]
    return [*jpegs, cv2.imencode('.png', pixels)[1].tobytes()]


def _read_image(data: bytes, _: Path) -> Any:
    return compressed_to_rgb('jpeg', np.frombuffer(data, np.uint8))


def _bags() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        with BagWriter(Path(folder) / 'bag') as writer:
            for index in range(50):
                data = b'\0\1\0\0\5\0\0\0abcd\0' + bytes(40)
                writer.write_raw('/a', 'std_msgs/msg/String', index, data)
        return [(Path(folder) / 'bag' / 'bag_0.mcap').read_bytes()]


def _read_bag(data: bytes, folder: Path) -> Any:
    reader = BagReader(_file(folder / 'bag.mcap', data))
    for _ in reader.messages():
        pass
    if reader.truncated:
        raise MtvWorldError(reader.truncated)


def _recover(data: bytes, folder: Path) -> Any:
    shutil.rmtree(folder / 'out', ignore_errors=True)
    bag = recover(_file(folder / 'bag.mcap', data), folder / 'out')
    assert sum(bag.num_messages.values()) == len(list(BagReader(folder / 'out').messages()))


def _metadata() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        BagWriter(Path(folder) / 'bag').close()
        return [(Path(folder) / 'bag' / 'metadata.yaml').read_bytes()]


def _read_metadata(data: bytes, folder: Path) -> Any:
    (folder / 'x_0.mcap').write_bytes(b'\x89MCAP0\r\n')
    _file(folder / 'metadata.yaml', data)
    list(BagReader(folder).messages())


def _instructions() -> list[bytes]:
    return [b'stack the red block on the blue block', b'put the red block ' * 400]


def _match(data: bytes, _: Path) -> Any:
    text = data.decode(errors='replace')[:15_000]
    objects_from_instruction(text)
    return match_task(load_tasks(share_path('config', 'tasks')), text)


def _messages() -> list[bytes]:
    """Whole messages of several types, each behind its index."""
    names, empty = [b'a', b'b'], np.zeros(2)
    store = typestore().types
    stamp = store['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    header = store['std_msgs/msg/Header'](stamp=stamp, frame_id='base')
    after = store['builtin_interfaces/msg/Duration'](sec=1, nanosec=2)
    point = store['trajectory_msgs/msg/JointTrajectoryPoint'](
        positions=empty, velocities=empty, accelerations=empty, effort=empty, time_from_start=after
    )
    plan = store[TYPES[0]](
        header=header, joint_names=[name.decode() for name in names], points=[point]
    )
    state = store[TYPES[1]](
        header=header, name=['a', 'b'], position=empty, velocity=empty, effort=empty
    )
    return [
        bytes([index]) + bytes(typestore().serialize_cdr(message, TYPES[index]))
        for index, message in enumerate((plan, state))
    ]


TYPES = ('trajectory_msgs/msg/JointTrajectory', 'sensor_msgs/msg/JointState')


def _read_message(data: bytes, _: Path) -> Any:
    if data:
        message = deserialize(TYPES[data[0] % len(TYPES)], data[1:])
        if data[0] % len(TYPES) == 0:
            parse_joint_trajectory(message)


def _answers() -> list[bytes]:
    """Chunks of actions as the two kinds of servers send them."""
    from mtv_world_ros.policies.openpi_client import pack

    return [pack({'actions': np.ones((8, 7)), 'state': {'a': 1.5, 'b': ['x', 2]}})]


def _read_answer(data: bytes, _: Path) -> Any:
    from mtv_world_ros.policies.openpi_client import unpack

    return unpack(data)


def _pickles() -> list[bytes]:
    """Lists of timed actions as LeRobot's server sends them, made without LeRobot."""
    import torch

    out = b'\x80\x03]('
    for value in range(3):
        tensor = pickle.dumps(torch.full((4,), float(value)), protocol=3)[2:-1]
        out += b'clerobot.async_inference.helpers\nTimedAction\n)\x81}X\x06\0\0\0action' + tensor
        out += b'sb'
    return [out + b'e.']


def _read_pickle(data: bytes, _: Path) -> Any:
    from mtv_world_ros.policies.timed_actions import read_timed_actions

    return read_timed_actions(data)


def _checkpoint_parts() -> list[bytes]:
    """Every JSON file of the bundled checkpoint, behind its name."""
    folder = share_path('resource', 'checkpoint')
    return [
        f'{file.relative_to(folder)}\n'.encode() + file.read_bytes()
        for file in sorted(folder.rglob('*.json'))
    ]


def _load_checkpoint(data: bytes, folder: Path) -> Any:
    from mtv_world_ros.model.checkpoint import load_checkpoint

    name, _, content = data.partition(b'\n')
    source = share_path('resource', 'checkpoint')
    path = name.decode(errors='replace')
    if path not in {str(file.relative_to(source)) for file in source.rglob('*.json')}:
        raise MtvWorldError('the name of the file was changed')
    shutil.rmtree(folder / 'copy', ignore_errors=True)
    shutil.copytree(source, folder / 'copy', copy_function=os.symlink)
    (folder / 'copy' / path).unlink()
    (folder / 'copy' / path).write_bytes(content)
    return load_checkpoint(folder / 'copy')


KINDS = {
    'calibration': Kind(_config('cameras'), lambda d, f: load_calibration(_file(f / 'c.yaml', d))),
    'robot': Kind(_config('robots'), _read_robot),
    'task': Kind(_config('tasks'), lambda d, f: load_task(_file(f / 'task.yaml', d))),
    'image': Kind(_images, _read_image),
    'bag': Kind(_bags, _read_bag),
    'recover': Kind(_bags, _recover),
    'metadata': Kind(_metadata, _read_metadata),
    'message': Kind(_messages, _read_message),
    'instruction': Kind(_instructions, _match),
    'answer, msgpack': Kind(_answers, _read_answer),
    'answer, pickle': Kind(_pickles, _read_pickle),
    'checkpoint': Kind(_checkpoint_parts, _load_checkpoint, 20.0),
}
#: one case of these takes a second or so
SLOW = {'checkpoint': 10, 'recover': 4, 'metadata': 2, 'instruction': 10}


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f'more than {seconds:g} s')

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def attempt(kind: Kind, data: bytes, folder: Path) -> tuple[str, float]:
    """Name of the outcome and the processor's time it took [s]."""
    begin = time.process_time()
    try:
        with _time_limit(30 * MOST_S):  # of the clock: machines may be busy
            kind.read(data, folder)
        name = 'survived'
    except MtvWorldError:
        name = 'rejected'
    except BaseException:
        name = traceback.format_exc()
    seconds = time.process_time() - begin
    return (f'took {seconds:.1f} s' if seconds > kind.most_s else name), seconds


def _run(name: str, seed: int, count: int, only: int | None, results: Any) -> None:
    """Tries the cases of a kind; puts (case, outcome) into the queue, at last None."""
    os.environ['MTV_WORLD_FUZZ'] = '1'
    kind = KINDS[name]
    samples = kind.seeds()
    with tempfile.TemporaryDirectory() as folder:
        attempt(kind, samples[0], Path(folder))  # imports
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
        for case in range(count) if only is None else (only,):
            rng = np.random.default_rng([seed, case])
            data = mutated(samples[rng.integers(len(samples))], rng)
            results.put((case, None))
            outcome, seconds = attempt(kind, data, Path(folder))
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024
            results.put((case, Outcome(outcome, seconds, more)))
    results.put(None)


def fuzz(name: str, seed: int, count: int, only: int | None = None) -> dict[str, Any]:
    """Tries cases of a kind; returns a row of the table and the failures.

    A process that dies costs its case, and another goes on after it.
    """
    spawn = multiprocessing.get_context('spawn')
    results = spawn.Queue()
    row: dict[str, Any] = {'kind': name, 'tried': 0, 'rejected': 0, 'survived': 0}
    row |= {'worst_s': 0.0, 'worst_mb': 0.0, 'failures': {}}
    process = spawn.Process(target=_run, args=(name, seed, count, only, results), daemon=True)
    process.start()
    current = None
    while True:
        try:
            item = results.get(timeout=120 * MOST_S)
        except Exception:  # empty: it hangs so that no signal ends it
            process.kill()
            row['failures'][current] = 'the process hung or died'
            break
        if item is None:
            break
        current, outcome = item
        if outcome is None:
            continue
        row['tried'] += 1
        row['worst_s'] = max(row['worst_s'], outcome.seconds)
        row['worst_mb'] = max(row['worst_mb'], outcome.megabytes)
        if outcome.name in ('rejected', 'survived'):
            row[outcome.name] += 1
        else:
            row['failures'][current] = outcome.name
    process.join(10)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    head = '| kind | tried | rejected | survived | failed | worst time [s] | worst memory [MB] |'
    lines = [head, '|---|---|---|---|---|---|---|']
    for row in rows:
        lines.append(
            f'| {row["kind"]} | {row["tried"]} | {row["rejected"]} | {row["survived"]} | '
            f'{len(row["failures"])} | {row["worst_s"]:.2f} | {row["worst_mb"]:.0f} |'
        )
    return '\n'.join(lines)


def main() -> int:
    """Fuzzes the kinds that are asked for; 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=int(time.time()))
    parser.add_argument('--count', type=int, default=2000, help='cases a kind; fewer of slow ones')
    parser.add_argument('--kind', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--case', type=int, help='try this case alone')
    parser.add_argument('--json', type=Path, help='write the rows here')
    arguments = parser.parse_args()
    print(f'seed {arguments.seed}', flush=True)
    rows = []
    for name in arguments.kind:
        count = max(arguments.count // SLOW.get(name, 1), 1)
        rows.append(fuzz(name, arguments.seed, count, arguments.case))
        for case, text in rows[-1]['failures'].items():
            print(f"--seed {arguments.seed} --kind '{name}' --case {case}\n{text}", flush=True)
    print(table(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return int(any(row['failures'] for row in rows))


if __name__ == '__main__':
    raise SystemExit(main())
