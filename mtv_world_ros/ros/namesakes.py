"""Other nodes of the same name, by the `process` that each states in `/diagnostics`."""

from __future__ import annotations

import os
import secrets
import socket
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from mtv_world_ros.core.shown_text import shown
from mtv_world_ros.ros.messages.bounded import subscribe_bounded
from mtv_world_ros.ros.messages.conversions import values_of

#: key of the process in `/diagnostics`
PROCESS = 'process'
#: another node that was silent for this long is gone [s]
_GONE_S = 10.0
#: characters of another node's process that are shown
_MOST_CHARACTERS = 200
#: number of other nodes that are remembered
_MOST_OTHERS = 10


class Namesakes:
    """Watches `/diagnostics` for statuses under this node's name that it did not publish.

    Attributes:
        process: process number, host and a random word, different for every node.

    Args:
        node: owner of the subscription.
    """

    def __init__(self, node: Node) -> None:
        self.process = f'{os.getpid()} on host {socket.gethostname()} ({secrets.token_hex(4)})'
        self._log, self._name = node.get_logger(), node.get_fully_qualified_name()
        self._seen_s: dict[str, float] = {}
        subscribe_bounded(node, DiagnosticArray, '/diagnostics', self._take, 100)

    def warning(self) -> str:
        """Return the warning about other nodes of this name; empty = there are none."""
        now_s = time.monotonic()
        self._seen_s = {p: at for p, at in self._seen_s.items() if now_s - at < _GONE_S}
        if not self._seen_s:
            return ''
        others = ', '.join(f'process {process or "unknown"}' for process in self._seen_s)
        return (
            f"other nodes are named '{self._name}', too: {others}; each answers every plan. Stop "
            'one, or start it under another name (--ros-args -r __node:=NAME, -r __ns:=/NAME)'
        )

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if f'/{status.name}' != self._name:
                continue
            process = values_of(status).get(PROCESS, '')
            if process == self.process:
                continue
            process = shown(process, _MOST_CHARACTERS)
            is_new = process not in self._seen_s
            if is_new and len(self._seen_s) >= _MOST_OTHERS:
                continue
            self._seen_s[process] = time.monotonic()
            if is_new:
                self._log.warning(self.warning())
