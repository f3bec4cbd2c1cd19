"""Interruption (SIGINT, Ctrl-C in a terminal, SIGTERM) of every long command, at random moments.

Each command runs once undisturbed: how long that takes, and which files it writes. Then it is
interrupted at moments drawn from that time. It must end soon, with the signal's status and one
line, or be done; what bears its final name must be whole; no process may be left; and the same
command, run again, must end with status 0 and the same files. Prints a row for each command; the
exit status is 1 if one did not. Goes on where it was stopped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import cv2
import numpy as np

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag.reader import BagReader
from robustness.node_messages import commit, ROOT

#: an end that comes later than this after the signal is late; what is not over then is killed [s]
LATE_S, FROZEN_S = 15.0, 120.0
#: processes of a command may outlive it by this long [s]: they look at their parent now and then
LINGER_S = 10.0
#: an undisturbed run may take this long [s]
PATIENCE_S = 900.0
#: name -> signal, and whether all processes of the command's group get it, as from a terminal
WAYS = {
    'SIGINT': (signal.SIGINT, False),
    'Ctrl-C': (signal.SIGINT, True),
    'SIGTERM': (signal.SIGTERM, False),
}
#: by which processes of a command are known, whoever their parent is
MARK = 'MTV_WORLD_INTERRUPTED'
#: names of logs and locks
LOGS, LOG_FOLDERS = ('.lock', 'log.jsonl'), {'logs', 'tensorboard'}
TASK = 'stack_blocks_two'
#: of each episode: a calibration wants eight with an outcome
COPIES = 4
TINY = (
    'transformer.num_attention_heads=2 transformer.attention_head_dim=12 transformer.ffn_dim=32 '
    'transformer.num_layers=1 transformer.stem_widths=[8,16,16] transformer.frames_per_token=2 '
    'transformer.freq_dim=16 video.num_frames=2 video.width=48 video.height=40 '
    'optimizer.batch_size=1 optimizer.warmup_steps=1'
)
ONE_STEP = ['--steps', '1', '--threads', '1']
SIZE = ['--width', '96', '--height', '72', '--fps', '5']


def settings(steps: int) -> list[str]:
    """Options of `train` for a tiny model and a number of steps."""
    values = [*TINY.split(), f'optimizer.steps={steps}']
    return [word for value in values for word in ('--set', value)]


#: command -> its words, of the folder with the inputs and that of the results
COMMANDS: dict[str, Callable[[Path, Path], list[str]]] = {
    'collect': lambda given, out: [
        'collect', '--task', TASK, '--episodes', '2', '--workers', '2', *SIZE,
        '--out', str(out / 'set')],
    'import-bag': lambda given, out: [
        'import', 'bag', str(given / 'set'), '--robot', 'yam_bimanual', '--out', str(out / 'set')],
    'export-dataset': lambda given, out: [
        'export', 'lerobot', str(given / 'set'), '--out', str(out / 'dataset')],
    'train': lambda given, out: [
        'train', str(given / 'set'), '--out', str(out / 'run'), '--dtype', 'float32',
        '--threads', '1', '--save-every', '5',
        *settings(12)],
    'evaluate': lambda given, out: [
        'evaluate', 'bundled', str(given / 'set'), '--split', 'all', '--actions', 'true',
        '--no-ceiling', '--out', str(out / 'evaluation'), *ONE_STEP],
    'calibrate': lambda given, out: [
        'fit', 'success', str(out / 'checkpoint'), str(given / 'copies'), '--split', 'all',
        '--out', str(out / 'calibration'), *ONE_STEP],
    'rank': lambda given, out: [
        'rank', '--policies', 'expert,expert-miss-0.5', '--tasks', TASK, '--episodes', '1',
        '--max-chunks', '1', '--out', str(out / 'ranking'), *ONE_STEP],
    'fit-contact': lambda given, out: [
        'fit', 'contact', str(given / 'set'), '--episodes', '2', '--motions', '2',
        '--threads', '1', '--out', str(out / 'contact')],
    'imagine': lambda given, out: [
        'imagine', '--policy', 'recorded', '--episodes', str(next((given / 'set').glob('*_0*'))),
        '--max-chunks', '2', '--out', str(out / 'imagined'), *ONE_STEP],
}  # fmt: skip
#: what is refused since an interrupted run left finished results; said with the option that helps
REPLACES = {'imagine': '--overwrite', 'calibrate': '--overwrite'}
#: what nodes publish by the clock is recorded: no two runs have as many messages
BY_THE_CLOCK = ('imagine',)


def prepare(given: Path) -> Path:
    """Make the inputs of all commands, once: two episodes, one of them a failure."""
    if not (given / 'ready').is_file():
        shutil.rmtree(given, ignore_errors=True)
        words = ['collect', '--task', TASK, '--episodes', '2', '--failures-of-ten', '5', *SIZE]
        with start([*words, '--out', str(given / 'set')], given.parent) as process:
            assert process.wait(PATIENCE_S) == 0, (given.parent / 'log').read_text()
        for number, episode in enumerate(sorted((given / 'set').glob(f'{TASK}_*')) * COPIES):
            shutil.copytree(episode, given / 'copies' / f'{TASK}_{number:05d}')
        (given / 'ready').touch()
    return given


def fresh(folder: Path) -> Path:
    """An empty folder for the results; with the checkpoint that `calibrate` writes into."""
    shutil.rmtree(folder, ignore_errors=True)
    source = share_path('resource', 'checkpoint')
    left_out = shutil.ignore_patterns('success_calibration.json', 'horizon.json')
    shutil.copytree(source, folder / 'checkpoint', ignore=left_out)
    return folder


@contextmanager
def start(words: list[str], folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command in a session of its own, as a shell starts it; it writes to `folder`/log."""
    folder.mkdir(parents=True, exist_ok=True)
    marked = {MARK: str(os.getpid()), 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)}
    with (folder / 'log').open('wb') as log:
        process = subprocess.Popen(
            [sys.executable, '-m', 'mtv_world_ros.cli', *words],
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
            env={**os.environ, **marked}, cwd=folder, start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        for pid in ours():
            _kill(pid)
        process.wait()


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def ours() -> list[int]:
    """Processes that a command of this harness started, directly or not."""
    mark = f'{MARK}={os.getpid()}'.encode()
    found = []
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            if mark in (folder / 'environ').read_bytes().split(b'\0'):
                found.append(int(folder.name))
        except OSError:  # it ended
            continue
    return found


def files(out: Path) -> dict[str, int]:
    """Names of results, with their sizes; logs, which grow as the command runs, are none."""
    found = {}
    for path in sorted(out.rglob('*')):
        name = path.relative_to(out).as_posix()
        if path.is_file() and path.name not in LOGS and not LOG_FOLDERS & {*path.parts}:
            found[name] = path.stat().st_size
    return found


def halves(out: Path, expected: dict[str, int], whole: dict[str, Any]) -> list[str]:
    """What bears a final name and is not whole, of a run that was interrupted."""
    wrong = []
    for name in files(out):
        if name not in expected or name.startswith('checkpoint/'):
            continue  # it says by its name that it is not finished, or is looked at below
        try:
            found = content(out / name)
        except Exception as error:
            wrong.append(f'{name}: {type(error).__name__}: {error}')
            continue
        if name in whole and found != whole[name]:
            wrong.append(f'{name}: {found}, whole {whole[name]}')
    return wrong


def unlisted(out: Path) -> list[str]:
    """Whole bags of episodes that their `episodes.json` does not name."""
    wrong = []
    for bag in out.glob('imagined/episode_*'):
        file = bag.parent / 'episodes.json'
        listed = json.loads(file.read_text()) if file.is_file() else []
        if bag.name not in {Path(entry['bag']).name for entry in listed}:
            wrong.append(f'{bag.name}: episodes.json does not name it')
    return wrong


def content(path: Path) -> Any:
    """Read a file to its end; how many messages or frames it has, where it has some.

    Raises:
        Exception: it cannot be read.
    """
    if path.suffix == '.json':
        json.loads(path.read_text())
    elif path.suffix == '.mcap':
        return sum(1 for _ in BagReader(path.parent).messages())
    elif path.suffix == '.safetensors':
        from safetensors.numpy import load_file

        return sorted(load_file(path))
    elif path.suffix in ('.png', '.jpg'):
        assert cv2.imread(str(path)) is not None, 'no picture'
    elif path.suffix == '.mp4':
        capture, count = cv2.VideoCapture(str(path)), 0
        while capture.read()[0]:
            count += 1
        return count
    elif path.suffix == '.parquet':
        import pyarrow.parquet

        return int(pyarrow.parquet.read_table(path).num_rows)
    else:
        assert path.stat().st_size, 'an empty file'
    return None


def wait_until_imported(process: subprocess.Popen) -> None:
    """Wait until a command handles signals, or ends.

    A signal while it is still imported ends it without a word, as it is meant to.
    """
    while process.poll() is None:
        status = Path(f'/proc/{process.pid}/status').read_text()
        caught = int(status.partition('SigCgt:')[2].split()[0], 16)
        if caught >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.01)


class Attack:
    """Interrupts one command.

    Args:
        name: of `COMMANDS`.
        given: folder of the inputs.
        folder: where it works.
    """

    def __init__(self, name: str, given: Path, folder: Path) -> None:
        self.name, self._given, self._folder = name, given, folder
        out = fresh(folder / 'whole')
        begin_s = time.monotonic()
        with start(COMMANDS[name](given, out), folder) as process:
            status = process.wait(PATIENCE_S)
        assert status == 0, self._log()
        self.whole_s = time.monotonic() - begin_s
        self.expected = files(out)
        found = {file: content(out / file) for file in self.expected}
        self.content = {} if name in BY_THE_CLOCK else found

    def attempt(self, way: str, after_s: float) -> tuple[str, float, str]:
        """How it ended (`done` or `stopped`), how long after the signal [s], and what is wrong."""
        number, is_group = WAYS[way]
        out = fresh(self._folder / 'out')
        with start(COMMANDS[self.name](self._given, out), self._folder) as process:
            try:
                process.wait(after_s)
            except subprocess.TimeoutExpired:
                wait_until_imported(process)
                if process.poll() is None:
                    (os.killpg if is_group else os.kill)(process.pid, number)
            sent_s = time.monotonic()
            try:
                status = process.wait(FROZEN_S)
            except subprocess.TimeoutExpired:
                return 'froze', FROZEN_S, f'it had not ended after {FROZEN_S:g} s'
            seconds = time.monotonic() - sent_s
            wrong = self._check_end(status, number) or self._check_processes()
        end = 'stopped' if status else 'done'
        if not wrong and seconds > LATE_S:
            wrong = f'it ended {seconds:.1f} s after the signal'
        wrong = wrong or self._check_said(out, status)
        return end, seconds, wrong or self._check_files(out, status)

    def _check_end(self, status: int, number: int) -> str:
        log = self._log()
        if 'Traceback' in log:
            return f'a traceback: {log[-1500:]}'
        # a shell shows a process that a signal ended as 128 + its number
        if status not in (0, 128 + number, -number):
            return f'status {status}: {log[-500:]}'
        return ''

    def _check_said(self, out: Path, status: int) -> str:
        """Its last line says that it was stopped, unless all results are there."""
        lines = [line for line in self._log().splitlines() if line.strip()]
        if not status or (lines and 'mtv-world: stopped' in lines[-1]):
            return ''
        return self._differences(out) and f'its last lines are {lines[-2:]}'

    def _check_processes(self) -> str:
        end_s = time.monotonic() + LINGER_S
        while (left := ours()) and time.monotonic() < end_s:
            time.sleep(0.1)
        return f'left {[_words(pid) for pid in left]}' if left else ''

    def _check_files(self, out: Path, status: int) -> str:
        if wrong := [*halves(out, self.expected, self.content), *unlisted(out)]:
            return f'half written or unlisted: {"; ".join(wrong[:3])}'
        if status and self._differences(out):
            return self._again(out)
        return self._differences(out)  # of one that was done as the signal came, none

    def _differences(self, out: Path) -> str:
        found = files(out)
        more, less = sorted(found.keys() - self.expected), sorted(self.expected.keys() - found)
        return f'more {more[:5]}, less {less[:5]}' if more or less else ''

    def _again(self, out: Path) -> str:
        """Run the same command once more."""
        words = COMMANDS[self.name](self._given, out)
        status = self._run(words)
        option = REPLACES.get(self.name, '')
        if status == 1 and option and f'or {option} to replace it' in self._log():
            status = self._run([*words, option])
        if status != 0:
            return f'again: status {status}: {self._log()[-500:]}'
        wrong = halves(out, self.expected, self.content)
        differing = self._differences(out)
        return f'again: {"; ".join(wrong[:3])} {differing}' if wrong or differing else ''

    def _run(self, words: list[str]) -> int:
        with start(words, self._folder) as process:
            return process.wait(PATIENCE_S)

    def _log(self) -> str:
        return (self._folder / 'log').read_text(errors='replace')


def _words(pid: int) -> str:
    try:
        return Path(f'/proc/{pid}/cmdline').read_bytes().replace(b'\0', b' ').decode()[:200]
    except OSError:
        return ''


def new_row(name: str, seed: int) -> dict[str, Any]:
    """The row of what was not interrupted yet."""
    return {'kind': name, 'commit': commit(), 'seed': seed, 'tried': 0, 'done': 0, 'stopped': 0,
            'worst_s': 0.0, 'failures': []}  # fmt: skip


def attack(row: dict[str, Any], count: int, given: Path, folder: Path) -> Iterator[None]:
    """Interrupt until the row has so many; yield after each."""
    if row['tried'] >= count:
        return
    one = Attack(row['kind'], given, folder)
    for number in range(row['tried'], count):
        rng = np.random.default_rng([row['seed'], number])
        way, after_s = list(WAYS)[number % len(WAYS)], float(rng.uniform(0, one.whole_s))
        end, seconds, wrong = one.attempt(way, after_s)
        row['tried'] += 1
        row['worst_s'] = max(row['worst_s'], seconds)
        if wrong:
            row['failures'].append(f'{way} after {after_s:.2f} of {one.whole_s:.1f} s: {wrong}')
        else:
            row[end] += 1
        yield


def main() -> int:
    """Interrupt; 1 if something was wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=30, help='signals to each command')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', nargs='+', choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'interrupts')
    arguments = parser.parse_args()
    # a shell starts background jobs deaf to SIGINT, and they start theirs so
    signal.signal(signal.SIGINT, signal.default_int_handler)
    out = arguments.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    file = out / 'interrupts.json'
    rows = {row['kind']: row for row in json.loads(file.read_text())} if file.is_file() else {}
    given = prepare(out / 'given')
    for name in arguments.only:
        row = rows.setdefault(name, new_row(name, arguments.seed))
        with tempfile.TemporaryDirectory(dir=out) as folder:
            for _ in attack(row, arguments.cases, given, Path(folder)):
                file.write_text(json.dumps(list(rows.values()), indent=1))
        sys.stdout.write(json.dumps(row, indent=1) + '\n')
        sys.stdout.flush()
    return int(any(row['failures'] for row in rows.values()))


if __name__ == '__main__':
    try:
        raise SystemExit(main())
    except MtvWorldError as error:
        raise SystemExit(f'{error}') from error
