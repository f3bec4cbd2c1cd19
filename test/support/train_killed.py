"""Trains once undisturbed and once with kills; processes are forked, so that torch loads once.

    python train_killed.py OUT EPISODES PRESET

OUT gets `whole/`, `killed/` and `kills.json`: when each kill came.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import random
import signal
import sys
import time
import traceback

from test.support.sources import run_training

_KILLS = 4


def start(out: Path, episodes: Path, preset: Path) -> int:
    """Train in a process of its own and return its id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        run_training(out, episodes, preset, save_every=3)
        code = 0
    except BaseException:
        traceback.print_exc()  # `os._exit` below prints nothing
    finally:
        os._exit(code)


def finished(child: int) -> bool:
    """Whether a process ended, which it must have done well."""
    done, status = os.waitpid(child, os.WNOHANG)
    assert not done or status == 0, status
    return bool(done)


def written_at(out: Path) -> int:
    """When the state was written [ns]; 0 = there is none now, as between a save's two renames."""
    try:
        return (out / 'state' / 'state.json').stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def is_saving(out: Path) -> bool:
    """Whether the state is being written."""
    return any(out.glob('.state.mtv-new-*'))


def kill(child: int, out: Path, *, saving: bool, after: float) -> str | None:
    """Kill a process some seconds after it began to step, or then while it writes its state."""
    before = written_at(out)
    while written_at(out) in (0, before):
        if finished(child):
            return None
        time.sleep(0.001)
    time.sleep(after)
    while not finished(child):
        if not saving:
            break
        if not is_saving(out):
            continue
        os.kill(child, signal.SIGSTOP)
        _, status = os.waitpid(child, os.WUNTRACED)
        if not os.WIFSTOPPED(status):  # it ended meanwhile
            assert status == 0, status
            return None
        if is_saving(out):  # still, and it stands still
            break
        os.kill(child, signal.SIGCONT)
    else:
        return None
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return f'{"saving" if saving else "anywhere"}: {sorted(p.name for p in out.iterdir())}'


if __name__ == '__main__':
    folder, bags, file = (Path(argument) for argument in sys.argv[1:])
    random.seed(0)
    kills = []
    for number in range(_KILLS):
        process = start(folder / 'killed', bags, file)
        moment = random.random() * 0.1
        place = kill(process, folder / 'killed', saving=number % 2 == 1, after=moment)
        kills += [place] if place else []
    for name in ('killed', 'whole'):
        process = start(folder / name, bags, file)
        assert os.waitpid(process, 0)[1] == 0
    (folder / 'kills.json').write_text(json.dumps(kills))
