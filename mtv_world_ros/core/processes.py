"""Processes: signals that end this one, and child nodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import gc
import io
import os
from pathlib import Path
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from types import FrameType

from mtv_world_ros.core.shown_text import shown

#: longest clean-up of a command that a signal stops [s]
_TIDY_S = 5.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: environment variable with the parent's process number: a node ends with its parent
PARENT_VARIABLE = 'MTV_WORLD_PARENT'
_STOP_S = 30.0
#: time after which a stopped process (SIGSTOP) is given up [s]
STOPPED_S = 5.0
#: longer gaps between two looks mean that this process was stopped as well [s]
_LONGEST_GAP_S = 2.0
_TAIL_BYTES = 4000
#: new objects after which Python searches the youngest for cycles; its own number is 700 or 2,000
_OBJECTS_A_SEARCH = 5_000


def prepare_process() -> None:
    """Set how threads wait, unless the environment says so, and how often cycles are searched for.

    Libraries read the first as they are loaded, so that a program calls this before it imports
    them. Threads of torch that wait for one another spin by default: where another process takes a
    core, those that wait use up the time that the last one needs, and all is many times as slow.
    NumPy's matrices are small here, and its threads spin, too: several threads take more CPU time
    than one (four times as much in a search) and the same wall-clock time.

    Half a million objects that the import of torch and diffusers makes stay. Searches for cycles
    among them take an eighth of the time that a command takes to load.
    """
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    first, *later = gc.get_threshold()
    if first:  # 0 = no searches at all
        gc.set_threshold(max(first, _OBJECTS_A_SEARCH), *later)


class Stopped(KeyboardInterrupt):
    """A signal asks the process to stop.

    Attributes:
        signum: number of the signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__()
        self.signum = signum


class Starting:
    """Ends the process at once on a signal, whatever it imports or makes, until `is_over`.

    Args:
        name: name of the program, for the line on stderr.
    """

    def __init__(self, name: str) -> None:
        self._name, self.is_over = name, False

    def __call__(self, signum: int, _: FrameType | None) -> None:
        """Handle the signal."""
        if not self.is_over:
            text = f'{self._name}: stopped while starting ({signal.Signals(signum).name})\n'
            os.write(2, text.encode())
            os._exit(128 + signum)


def end_on_signals(name: str) -> Starting:
    """Let SIGINT and SIGTERM end this process while it starts; ignored ones stay ignored."""
    starting = Starting(name)
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, starting)
    return starting


@contextmanager
def ended_by_signals(name: str) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the process in the block, if this is its main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    end_on_signals(name)
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: it was not installed from Python
                signal.signal(number, handler)


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM raise `Stopped` in the block, as SIGINT raises KeyboardInterrupt.

    A clean-up longer than `_TIDY_S` is ended, and so is any at a second SIGTERM. An existing
    handler of SIGTERM stays.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    timer = threading.Timer(_TIDY_S, _give_up_tidying)
    timer.daemon = True

    def stop(signum: int, _: FrameType | None) -> None:
        signal.signal(signum, signal.SIG_DFL)
        timer.start()
        raise Stopped(signum)

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        timer.cancel()
        if signal.getsignal(signal.SIGTERM) is stop:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _give_up_tidying() -> None:
    text = f'mtv-world: stopped (SIGTERM); it was not tidied up within {_TIDY_S:g} s\n'
    os.write(2, text.encode())
    os._exit(128 + signal.SIGTERM)


def prepare_output() -> None:
    """Let stdout and stderr print every text, and each line at once.

    Characters that they lack are escaped.
    With `LC_ALL=C` and no UTF-8 mode they are ASCII, and names of files may hold any bytes.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace', line_buffering=True)


def private_domain() -> dict[str, str]:
    """Return the environment with a ROS domain of its own, unless one is set."""
    environment = dict(os.environ)
    environment.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 100)))
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return environment


def module_command(name: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of `mtv_world_ros.ros`."""
    return [sys.executable, '-m', f'mtv_world_ros.ros.{name}', *arguments]


def ros_arguments(
    parameters: Mapping[str, object], remaps: Mapping[str, str] | None = None
) -> list[str]:
    """Command-line arguments that set parameters (empty texts are left out) and rename topics."""
    flags = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        flags += ['-p', f'{name}:={text}'] if text else []
    for name, other in (remaps or {}).items():
        flags += ['-r', f'{name}:={other}']
    return flags


def start_process(
    name: str, command: Sequence[str], logs: Path, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a node in a session of its own; it writes to `logs/<name>.log`.

    To be called from the main thread: the node ends with the thread that started it.
    """
    parent = {PARENT_VARIABLE: str(os.getpid())}
    with (logs / f'{name}.log').open('wb') as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**(os.environ if environment is None else environment), **parent},
            start_new_session=True,
        )


def ending_with_this_process(command: Sequence[str]) -> list[str]:
    """Return a command that is killed with this process, where the system can do that.

    To be started from the main thread: the kernel looks at the thread.
    """
    program = shutil.which('setpriv')
    return [*([program, '--pdeathsig', 'KILL', '--'] if program else []), *command]


def last_line(log: Path, otherwise: str) -> str:
    """Return the last line of a log; `otherwise` where it is empty."""
    tail = log.read_bytes()[-_TAIL_BYTES:].decode(errors='replace')
    lines = [line.strip() for line in tail.splitlines() if line.strip()]
    return shown(lines[-1]) if lines else otherwise


def how_it_ended(name: str, process: subprocess.Popen[bytes], logs: Path) -> str:
    """Return the exit status of a process of `start_process` and its last line, in words."""
    text = last_line(logs / f'{name}.log', 'its log is empty')
    return f"'{name}' ended with status {process.returncode}: {text} (logs are in '{logs}')"


class StoppedProcesses:
    """Detects stopped processes (SIGSTOP), which never end; to be polled many times a second."""

    def __init__(self) -> None:
        self._since: dict[int, float] = {}
        self._looked_s = 0.0

    def find(self, pids: Iterable[int]) -> int | None:
        """Return the number of a process that has been stopped for `STOPPED_S`, or None."""
        now_s = time.monotonic()
        if now_s - self._looked_s > _LONGEST_GAP_S:  # a terminal stopped this process as well
            self._since.clear()
        self._looked_s = now_s
        self._since = {pid: self._since.get(pid, now_s) for pid in pids if _is_stopped(pid)}
        found = (pid for pid, since_s in self._since.items() if now_s - since_s > STOPPED_S)
        return next(found, None)

    def report(self, processes: Mapping[str, subprocess.Popen[bytes]]) -> str:
        """Return which named process has been stopped for `STOPPED_S`, in words; or empty."""
        found = self.find(process.pid for process in processes.values())
        names = [name for name, process in processes.items() if process.pid == found]
        return f"'{names[0]}' was stopped and stood still for {STOPPED_S:g} s" if names else ''


def _is_stopped(pid: int) -> bool:
    try:
        text = Path(f'/proc/{pid}/stat').read_text()
    except OSError:  # it ended, or the system has no such files
        return False
    return text.rpartition(')')[2].split()[0] == 'T'


def stop_process(process: subprocess.Popen[bytes] | None) -> None:
    """End a node with SIGINT and wait for it; kill it where that does not help."""
    if process is None or process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGCONT)  # a stopped process handles no signal
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def threads_each(workers: int) -> int:
    """Return the usable cores' share of each of some processes, at least 1."""
    return max(len(os.sched_getaffinity(0)) // max(workers, 1), 1)


def is_helper_rank() -> bool:
    """Return whether `torchrun` started this process beside the one that writes."""
    return os.environ.get('RANK', '0') != '0' and 'WORLD_SIZE' in os.environ
