"""A policy server that is started here: on a free port, with a log, started again if it dies."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import signal
import socket
import subprocess
import time
import weakref

from mtv_world_ros.core.errors import PolicyServerError
from mtv_world_ros.core.processes import (
    ending_with_this_process,
    last_line,
    start_process,
    StoppedProcesses,
)

#: placeholder of the port in a command
PORT = '{port}'
#: number of consecutive starts without a valid answer after which the server is given up
MAX_STARTS = 3
_POLL_S = 0.1
_STOP_S = 5.0


class ServerProcess:
    """Runs the command of a server; it ends with this process.

    Attributes:
        port: TCP port of the server on this machine; 0 before the first start.

    Args:
        name: name of the policy; log files begin with it.
        command: program and arguments; `{port}` in them is replaced by a free port.
        logs: folder of the log files, one a start.
        start_timeout_s: longest wait until it listens [s].
    """

    def __init__(
        self, name: str, command: Sequence[str], logs: Path, start_timeout_s: float
    ) -> None:
        self._name, self._command, self._logs = name, tuple(command), logs
        self._start_timeout_s = start_timeout_s
        self._process: subprocess.Popen[bytes] | None = None
        self._log = Path()
        self._num_starts = self._num_fruitless = 0
        self.port = 0

    def ensure(self) -> bool:
        """Start the server unless it runs; return whether it did.

        Raises:
            PolicyServerError: the server does not start, or was given up.
        """
        if self._process is not None and self._process.poll() is None:
            return False
        if self._num_fruitless >= MAX_STARTS:
            raise PolicyServerError(
                f"the server of policy '{self._name}' is given up: it was started {MAX_STARTS} "
                f"times without a good answer; its last log is '{self._log}'"
            )
        self._start()
        return True

    def answered(self) -> None:
        """Note a good answer, which resets the count of starts."""
        self._num_fruitless = 0

    def stop(self) -> None:
        """End the server and its child processes."""
        if self._process is not None:
            _end(self._process)
            self._process = None

    def _start(self) -> None:
        self._num_starts += 1
        self._num_fruitless += 1
        self.port = _free_port()
        self._logs.mkdir(parents=True, exist_ok=True)
        log_name = f'{self._name}_{os.getpid()}_{self._num_starts}'
        self._log = self._logs / f'{log_name}.log'
        command = [part.replace(PORT, str(self.port)) for part in self._command]
        try:
            self._process = start_process(log_name, ending_with_this_process(command), self._logs)
        except OSError as error:
            raise PolicyServerError(
                f"the server of policy '{self._name}' cannot be started: {error}"
            ) from error
        weakref.finalize(self, _end, self._process)
        self._wait(self._process)

    def _wait(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until the server listens."""
        deadline, stopped = time.monotonic() + self._start_timeout_s, StoppedProcesses()
        while time.monotonic() < deadline:
            status = process.poll()
            if status is not None:
                raise PolicyServerError(
                    f"the server of policy '{self._name}' ended with status {status} when it was "
                    f"started: {last_line(self._log, 'its log is empty')} ('{self._log}')"
                )
            if said := stopped.report({f'{self._name}, its server': process}):
                self.stop()
                raise PolicyServerError(f"{said}; its log is '{self._log}'")
            if _listens(self.port):
                return
            time.sleep(_POLL_S)
        self.stop()
        raise PolicyServerError(
            f"the server of policy '{self._name}' did not listen on port {self.port} within "
            f"{self._start_timeout_s:g} s ('start_timeout_s'); its command must use {PORT}, its "
            f"log is '{self._log}'"
        )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def _listens(port: int) -> bool:
    try:
        socket.create_connection(('127.0.0.1', port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that leads a session, and the others of it."""
    if process.poll() is not None:
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            os.killpg(process.pid, signal.SIGCONT)  # one that stands still hears nothing
        except ProcessLookupError:
            break
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            continue
