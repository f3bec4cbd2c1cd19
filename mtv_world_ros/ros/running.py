"""Runs a node until it is told to stop, and shuts down without a traceback."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import signal
import sys

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from mtv_world_ros.errors import MtvWorldError


def run(make: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Makes a node and spins it until SIGINT, SIGTERM or its own shutdown of ROS.

    Args:
        make: makes the node; if it has `close()`, that ends it.
        args: command line; default: the process' own.

    Returns:
        The exit status: 1 after a user error, whose text goes to stderr, else 0.
    """
    rclpy.init(args=None if args is None else list(args))
    node: Node | None = None
    try:
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except MtvWorldError as error:
        sys.stderr.write(f'{type(error).__name__}: {error}\n')
        return 1
    except Exception:
        if rclpy.ok():
            raise
    finally:
        _shut_down(node)
    return 0


def _shut_down(node: Node | None) -> None:
    """Ends the node; a second Ctrl-C (a launcher sends one too) does not disturb it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if node is not None:
        close = getattr(node, 'close', node.destroy_node)
        close()
    rclpy.try_shutdown()
