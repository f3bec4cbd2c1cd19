"""Runs a node until a signal ends it, and shuts down without a traceback."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import ctypes
import gc
import os
from pathlib import Path
import signal
import sys
import tempfile
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import (
    get_current_signal_handlers_options,
    SignalHandlerOptions,
    uninstall_signal_handlers,
)

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.processes import (
    end_on_signals,
    PARENT_VARIABLE,
    prepare_output,
)
from mtv_world_ros.ros.guarded_clock import guard_clock
from mtv_world_ros.ros.messages.request_limits import guard_services
from mtv_world_ros.ros.parameters import guard_parameter_services
from mtv_world_ros.ros.receive_paths import receive_paths, resolved_topics

_PR_SET_PDEATHSIG = 1
AnyNode = TypeVar('AnyNode', bound=Node)


def end_with_parent() -> None:
    """Send this process SIGINT when its parent process ends, even by a kill.

    Only where the parent asks for it (`child_processes`), and only on Linux.
    """
    parent = os.environ.pop(PARENT_VARIABLE, '')
    if not parent or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != int(parent):  # gone before the signal was set
        sys.exit(1)


def guard_node(node: Node) -> None:
    """Guard a node against messages and requests on which rclpy raises."""
    guard_parameter_services(node)
    guard_services(node)
    guard_clock(node)


def spin_forever(node: Node) -> None:
    """Handle callbacks one after the other until ROS shuts down."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        _end_signal_thread()


def run(
    make: Callable[[], AnyNode],
    args: Sequence[str] | None = None,
    *,
    spin: Callable[[AnyNode], None] = spin_forever,
    signals: SignalHandlerOptions = SignalHandlerOptions.ALL,
    help_text: str = '',
    name: str = '',
    own_paths: Sequence[Sequence[str]] = (),
) -> int:
    """Create a node and spin it until it is done, or until SIGINT or SIGTERM.

    Fast DDS is set to send soon again what a reliable subscriber missed, unless it has a profile.

    Args:
        make: function that returns the node; where it has `close()`, that ends it.
        args: command line with the program's name; default: the process' own.
        spin: function that runs the node's callbacks until shutdown.
        signals: signals that rclpy handles; NO = the node has handlers of its own.
        help_text: printed instead if the command line has `--help`.
        name: name of the node, before remapping; needed for `own_paths`.
        own_paths: topics that do not share their receive buffers with images, in groups that share
            a port (see `receive_paths`).

    Returns:
        The exit status: 1 after an error of the user's or of the disk, whose text goes to stderr,
        else 0. A signal n that comes while the node is made ends the process with 128 + n.
    """
    prepare_output()
    if help_text and '--help' in (sys.argv if args is None else args):
        sys.stdout.write(f'{help_text}\n')
        return 0
    end_with_parent()
    starting = end_on_signals('mtv_world_ros')
    find_log_folder()
    try:
        init_ros(args, signals=signals)
    except ConfigError as error:
        sys.stderr.write(f'ConfigError: {error}\n')
        return 1
    node: AnyNode | None = None
    failure = ''
    try:
        words = sys.argv if args is None else args
        groups = [resolved_topics(words, name, topics) for topics in own_paths]
        with receive_paths(groups) as paths:
            node = make()
        guard_node(node)
        for note in paths.notes:
            node.get_logger().info(note)
        starting.is_over = True  # from now on rclpy's handler, or the node's own, ends it
        spin(node)
    except ExternalShutdownException:
        pass
    except Exception as error:
        if not rclpy.ok():  # the shutdown came first: what failed after it says nothing
            return 0
        if not isinstance(error, (MtvWorldError, OSError)):
            raise
        failure = f'{type(error).__name__}: {error}\n'
    finally:
        _shut_down(node)
    sys.stderr.write(failure)  # the last line of a log is why the process ended
    return int(bool(failure))


def init_ros(
    args: Sequence[str] | None,
    context: Context | None = None,
    *,
    signals: SignalHandlerOptions | None = None,
) -> None:
    """Initialise ROS from a command line.

    Args:
        args: command line with the program's name; default: the process' own.
        context: ROS context to initialise; default: the process' own.
        signals: signals that rclpy handles; default: all in the process' own context, else none.

    Raises:
        ConfigError: an argument or a parameter file is refused.
    """
    words = None if args is None else list(args)
    try:
        rclpy.init(args=words, context=context, signal_handler_options=signals)
    except RuntimeError as error:  # rclpy's own classes for this are private
        raise ConfigError(_why_refused(error)) from error


def _why_refused(error: Exception) -> str:
    """Return why rclpy refused the command line or a parameter file, and what is valid."""
    detail = str(error).partition('failed to initialize rcl: ')[2] or str(error)
    hint = ''
    if 'same type' in detail:
        hint = '; all items of a list must be of one type: write [1.0, 2.0], or ["a", "1"]'
    elif 'parameter override' in detail:
        hint = '; expected -p NAME:=VALUE with VALUE in YAML, e.g. -p seed:=3'
    return f'the arguments after --ros-args cannot be used: {detail}{hint}'


def find_log_folder() -> None:
    """Let ROS log into a temporary folder where it cannot write its own (a read-only home)."""
    home = os.environ.get('ROS_HOME') or Path.home() / '.ros'
    folder = Path(os.environ.get('ROS_LOG_DIR') or Path(home) / 'log')
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except (OSError, RuntimeError) as error:
        other = tempfile.mkdtemp(prefix='ros_log_')
        os.environ['ROS_LOG_DIR'] = other
        sys.stderr.write(f"'{folder}' cannot be written ({error}); ROS logs into '{other}'\n")


def _end_signal_thread() -> None:
    """Join rclpy's thread that shuts ROS down after a signal, and restore the handlers before it.

    At each signal that thread walks, without a lock, over a list from which the end of an executor
    takes away: at a second signal it would read freed memory.
    """
    if get_current_signal_handlers_options() != SignalHandlerOptions.NO:
        uninstall_signal_handlers()


def _shut_down(node: Node | None) -> None:
    """End the node; a second Ctrl-C (a launcher sends one too) does not disturb it."""
    _end_signal_thread()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if node is not None:
        if node.executor is not None:
            # after a callback of an event its iterator holds all inputs and outputs: destroyed or
            # not, they would keep the middleware's threads running into the end of the process
            node.executor.shutdown(timeout_sec=0)
        close = getattr(node, 'close', node.destroy_node)
        close()
    rclpy.try_shutdown()
    gc.freeze()  # a last search for cycles in half a million objects takes Python a second or more
