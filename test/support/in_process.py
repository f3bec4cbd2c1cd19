"""A node in the process of its test: a context of its own, spun by a thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import gc
import io
import os
import signal
import threading
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl import rcutils_logger
from rclpy.logging import LoggingSeverity
from rclpy.node import Node

from mtv_world_ros.ros.run_node import guard_node

#: time that a node may take to end on a busy machine [s]
PATIENCE_S = 120.0
Listener = Callable[[str, str], object]
_listeners: list[Listener] = []


def _write_log(severity: Any, name: str, message: str, *place: Any) -> None:
    """Write a log message as rclpy does, and pass it on."""
    _rclpy_write_log(severity, name, message, *place)
    for listener in tuple(_listeners):
        listener(name, f'[{severity.name}] [{name}]: {message}')


_rclpy_write_log = rcutils_logger._rclpy.rclpy_logging_rcutils_log
rcutils_logger._rclpy.rclpy_logging_rcutils_log = _write_log


@contextmanager
def restored_process() -> Iterator[None]:
    """Give back what `run` changes for the rest of its process: handlers, environment, garbage."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    environment = dict(os.environ)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        os.environ.clear()
        os.environ.update(environment)
        gc.unfreeze()


def run_to_end(run: Callable[[], int]) -> tuple[int, str]:
    """Return the exit status of a node that ends by itself, and all that it wrote and logged."""
    said = io.StringIO()

    def listen(_: str, line: str) -> None:
        said.write(f'{line}\n')

    _listeners.append(listen)
    try:
        with restored_process(), redirect_stdout(said), redirect_stderr(said):
            return run(), said.getvalue()
    finally:
        _listeners.remove(listen)


class NodeInProcess:
    """A node that runs until `stop`, with what tests use of a process.

    Args:
        make: makes the node in a context; what it raises is raised here.
        words: arguments of the command line, such as `--ros-args`, `-p`, `seed:=3`.
    """

    def __init__(self, make: Callable[[Context], Node], words: Sequence[str] = ()) -> None:
        self._said: list[str] = []
        self._error: BaseException | None = None
        self._context = Context()
        rclpy.init(args=['node', *words], context=self._context)
        # the level is the process's: a node of another test may have set it to FATAL
        rclpy.logging.set_logger_level('', LoggingSeverity.INFO)
        self._name = ''
        _listeners.append(self._listen)
        try:
            self.node = make(self._context)
            guard_node(self.node)
            self._name = self.node.get_logger().name
        except BaseException:
            _listeners.remove(self._listen)
            self._context.try_shutdown()
            raise
        self._thread = threading.Thread(target=self._spin, name=self._name, daemon=True)
        self._thread.start()

    def _listen(self, name: str, line: str) -> None:
        """Keep what this node says; while it is made its name is not known."""
        if not self._name or name.startswith(self._name):
            self._said.append(line)

    def _spin(self) -> None:
        """Run callbacks until the context ends, then end the node, as its process would."""
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self.node)
        try:
            executor.spin()
        except ExternalShutdownException:
            pass
        except BaseException as error:
            # what fails after the shutdown says nothing, see `run`
            self._error = error if self._context.ok() else None
        finally:
            executor.shutdown(timeout_sec=0)
            close = getattr(self.node, 'close', self.node.destroy_node)
            close()
            self._context.try_shutdown()

    def stop(self) -> int:
        """End the node; return 0, or 1 if an exception ended it."""
        self._context.try_shutdown()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), f'{self._name} does not end'
        if self._listen in _listeners:
            _listeners.remove(self._listen)
        return int(self._error is not None)

    def output(self) -> str:
        """Return what the node logged, and the exception that ended it."""
        return '\n'.join([*self._said, *([] if self._error is None else [repr(self._error)])])
