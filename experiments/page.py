"""Result pages: what ran, where, when and at which commit, and a Markdown table.

    python experiments/page.py

lists the pages of experiments/results that are older than what they describe; with the kind of a
page (see `DESCRIBES`; any other is about the bundled checkpoint) it prints the line that such a
page has to end with.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date
from io import BytesIO
import os
from pathlib import Path
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
import time

import numpy as np

from mtv_world_ros.cli.shared_options import machine
from mtv_world_ros.core.files import content_digest
from mtv_world_ros.core.processes import prepare_process
from mtv_world_ros.model.checkpoint import checkpoint_folder

ROOT = Path(__file__).resolve().parents[1]
#: what speed is compared with
OLD_TAG = 'v0.1.0'
#: kind of page -> what it describes: other numbers may come out once that has changed
DESCRIBES = {
    'camera_calibration': ('mtv_world_ros/inspection',),
    'camera_check': ('mtv_world_ros/vision',),
    'cpu_speed': ('mtv_world_ros/model', 'mtv_world_ros/training'),
    'doctor': ('mtv_world_ros/inspection',),
    'foresight': ('mtv_world_ros/ros',),
    'interval_coverage': ('mtv_world_ros/evaluation/metrics',),
    'learned_policies': (
        'mtv_world_ros/ranking',
        'mtv_world_ros/simulation',
        'mtv_world_ros/policies',
    ),
    'robustness': ('mtv_world_ros',),
    'segmenter': ('mtv_world_ros/vision/segmenters',),
    'serving': ('mtv_world_ros/model',),
    'training_speed': ('mtv_world_ros/training',),
    'trajectory_video': ('mtv_world_ros/control',),
    'wan': ('mtv_world_ros/model',),
    'wan_training_speed': ('mtv_world_ros/training', 'mtv_world_ros/model'),
}
#: kinds of pages whose numbers are a checkpoint's; by default the bundled one's
OF_A_CHECKPOINT = (
    'foresight',
    'learned_policies',
    'serving',
)
_MADE = re.compile(
    r'^Made at commit `(\w+)(\+?)`, (?:no checkpoint|(\w+) checkpoint `(\w+)`)\. '
    r'Describes: (.+)\.$',
    re.M,
)


def cpu_s(pid: int) -> float:
    """CPU time that a process has used [s], all threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def parse_arguments(
    text: str | None,
    repeats: int,
    more: Callable[[argparse.ArgumentParser], None] = lambda parser: None,
) -> argparse.Namespace:
    """The options that all benchmarks share, --repeats, --seed, --machine, --out, and `more`."""
    prepare_process()  # before torch is loaded
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--repeats', type=int, default=repeats, help='n of each median')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument(
        '--machine', default=f'cpu{os.cpu_count()}', help='name of the machine on the page'
    )
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    more(parser)
    return parser.parse_args()


def measure(
    candidates: Mapping[str, Callable[[], object]], repeats: int
) -> dict[str, tuple[float, float, float]]:
    """Return median, 5th and 95th percentile of the CPU time [ms] of each candidate.

    CPU time of this process, which other work on the machine lengthens less than wall time.
    """
    found = {}
    for name, times in in_turns(candidates, repeats, clock=time.process_time).items():
        median, low, high = (1e3 * float(at) for at in np.percentile(times, (50, 5, 95)))
        found[name] = (median, low, high)
    return found


def in_turns(
    works: Mapping[str, Callable[[], object]],
    repeats: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
    warm_up: int = 1,
) -> dict[str, list[float]]:
    """Return the times [s] of pieces of work that take turns, so that they can be compared.

    Whatever else the machine does, heat included, meets all of them alike. Every other turn goes
    backwards: whoever comes first in a turn is not always the same.

    Args:
        works: by name.
        repeats: turns that count.
        clock: tells the time [s].
        warm_up: turns before those.
    """
    spent: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(warm_up + repeats):
        for name in sorted(works, key=list(works).index, reverse=turn % 2 == 1):
            begun = clock()
            works[name]()
            spent[name].append(clock() - begun)
    return {name: times[warm_up:] for name, times in spent.items()}


def ratio(above: Sequence[float], below: Sequence[float]) -> float:
    """Return the median of the ratios of two works' times of the same turns."""
    return float(np.median([a / b for a, b in zip(above, below, strict=True)]))


@contextmanager
def old_checkout() -> Iterator[Path]:
    """A temporary folder with the files of `OLD_TAG`, which this version is compared with.

    Raises:
        FileNotFoundError: the repository has no such tag.
    """
    with tempfile.TemporaryDirectory() as folder:
        packed = subprocess.run(['git', 'archive', OLD_TAG], cwd=ROOT, capture_output=True)
        if packed.returncode:
            raise FileNotFoundError(f"there is no tag '{OLD_TAG}' here; run 'git fetch --tags'")
        with tarfile.open(fileobj=BytesIO(packed.stdout)) as files:
            files.extractall(folder, filter='data')
        yield Path(folder)


def machine_line() -> str:
    """Processor, cores, system, load and version of Python."""
    load = f', load {os.getloadavg()[0]:.1f}' if hasattr(os, 'getloadavg') else ''
    return f'{machine()}{load}; Python {platform.python_version()}'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def publish(
    what: str, title: str, command: str, body: str, options: argparse.Namespace, versions: str
) -> None:
    """Print the page, and write `<what>_<machine>_<date>.md` where --out is given."""
    today = date.today().isoformat()
    page = (
        f'# {title}\n\n`{command}`, machine `{options.machine}` ({machine_line()}, {versions}), '
        f'{today}, seed {options.seed}, n = {options.repeats}.\n\n{body}\n\n'
        f'{made_line(what, getattr(options, "checkpoint", None))}\n'
    )
    print(page)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / f'{what}_{options.machine}_{today}.md'
        beside = path.with_suffix('.part')
        beside.write_text(page, encoding='utf-8')
        beside.replace(path)
        print(f'written: {path}')


def made_line(what: str, checkpoint: str | Path | None = None) -> str:
    """The line of a page with commit (+ = with changes on top), checkpoint and what it is about.

    Args:
        what: kind of page; the longest beginning of it in `DESCRIBES` counts.
        checkpoint: folder or `bundled`; None = as `OF_A_CHECKPOINT` says.
    """
    kind = max((name for name in DESCRIBES if what.startswith(name)), key=len, default='')
    packed = ROOT / 'COMMIT'  # of a tree that `gpu.py pack` made
    commit = packed.read_text() if packed.is_file() else 'unknown'
    commit = _git(ROOT, 'rev-parse', '--short', 'HEAD') or commit
    changed = '+' if _git(ROOT, 'status', '--porcelain', '--untracked-files=no') else ''
    held = 'no checkpoint'
    if checkpoint is None and kind in ('', *OF_A_CHECKPOINT):
        checkpoint = 'bundled'
    if checkpoint is not None:
        digest = content_digest(checkpoint_folder(checkpoint))[:8]
        held = f'{"bundled" if str(checkpoint) == "bundled" else "other"} checkpoint `{digest}`'
    parts = ', '.join(f'`{path}`' for path in DESCRIBES.get(kind, ())) or 'the checkpoint'
    return f'Made at commit `{commit}{changed}`, {held}. Describes: {parts}.'


def why_stale(page: Path, root: Path = ROOT, bundled: str = '') -> list[str]:
    """Return why a page is older than what it describes; empty = it is not, as far as is known.

    Args:
        page: its path.
        root: of the repository; without its history, commits are not looked at.
        bundled: first 8 digits of the bundled checkpoint's hash.

    Raises:
        ValueError: the page does not say at which commit and with which checkpoint it was made.
    """
    found = _MADE.search(page.read_text(encoding='utf-8'))
    if found is None:
        raise ValueError(
            f'{page.name} has no line "Made at commit ..., checkpoint ..."; '
            'python experiments/page.py KIND prints it'
        )
    commit, _, kind, digest, about = found.groups()
    reasons = []
    if kind == 'bundled' and digest != bundled:
        reasons.append(f'of checkpoint {digest}, the bundled one is {bundled}')
    for path in re.findall('`(.+?)`', about):
        later = _git(root, 'rev-list', '--count', f'{commit}..HEAD', '--', path)
        if later not in ('', '0'):
            reasons.append(f'{later} commits changed {path} after {commit}')
    return reasons


def _git(folder: Path, *words: str) -> str:
    """What git prints; empty where there is no git, no history or no such commit."""
    try:
        done = subprocess.run(['git', *words], cwd=folder, capture_output=True, text=True)
    except OSError:
        return ''
    return done.stdout.strip() if done.returncode == 0 else ''


def main() -> None:
    """Print what the command line asks for."""
    if sys.argv[1:]:
        print(made_line(sys.argv[1]))
        return
    current = content_digest(checkpoint_folder('bundled'))[:8]
    for path in sorted((ROOT / 'experiments' / 'results').glob('*.md')):
        for reason in why_stale(path, bundled=current):
            print(f'{path.name}: {reason}')


if __name__ == '__main__':
    main()
