"""A peer that sends what no client sends: every node of the package outlives it and answers.

    python -m robustness.hostile_peer [NODE ...]

starts each node as a process of its own, sends requests and messages that once ended one, and
prints a table: which node lived, and how long the next ordinary request took. The exit status is 1
where a node ended, or did not answer in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from mtv_world_ros.core.files import share_path
from robustness.accidents import chain, diamonds, entity_bomb, nested, star, urdf_of

#: longest time until an ordinary request is answered after an attack [s]
MOST_S = 2.0
#: a busy machine takes long to load a model [s]
_START_S = 180.0
_ENVIRONMENT = {
    'ROS_DOMAIN_ID': str(random.SystemRandom().randint(1, 100)),
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
}
EPISODE = str(share_path('resource', 'demo_episode'))


def commands(folder: Path) -> dict[str, list[str]]:
    """Return the arguments of every node, by its name."""
    return {
        'world_model': ['world_model.node'],
        'policy': ['policy.node', '--ros-args', '-p', 'policy:=expert'],
        'player': ['bags.player', EPISODE, '--no-wait', '--loop'],
        'recorder': ['bags.recorder', str(folder / 'bag'), '/a_topic', '--wait-timeout', '900'],
        'viewer': ['live_viewer', '--save', str(folder / 'live.rrd')],
    }


class Peer:
    """A node that talks to the others."""

    def __init__(self) -> None:
        import rclpy

        os.environ.update(_ENVIRONMENT)
        rclpy.init(args=['peer', '--ros-args', '--log-level', 'ERROR'])
        self.node = rclpy.create_node('hostile_peer')

    def spin(self, until: Callable[[], bool], most_s: float) -> bool:
        """Handle callbacks until something holds; return whether it does."""
        import rclpy

        end_s = time.monotonic() + most_s
        while not until() and time.monotonic() < end_s:
            rclpy.spin_once(self.node, timeout_sec=0.02)
        return until()

    def call(self, kind: Any, name: str, request: Any, most_s: float) -> float | None:
        """Call a service; return how long the answer took [s], or None."""
        client = self.node.create_client(kind, name)
        try:
            if not self.spin(client.service_is_ready, most_s):
                return None
            begin_s = time.monotonic()
            future = client.call_async(request)
            return time.monotonic() - begin_s if self.spin(future.done, most_s) else None
        finally:
            self.node.destroy_client(client)

    def answers(self, name: str, most_s: float = MOST_S) -> float | None:
        """Return how long a node takes to list its parameters [s]; None = too long."""
        from rcl_interfaces.srv import ListParameters

        return self.call(
            ListParameters, f'/{name}/list_parameters', ListParameters.Request(), most_s
        )

    def publish(self, kind: Any, topic: str, messages: list[Any]) -> None:
        """Publish messages to whoever subscribes, one after the other."""
        from mtv_world_ros.ros.qos_profiles import LATCHED

        publisher = self.node.create_publisher(kind, topic, LATCHED)
        self.spin(lambda: publisher.get_subscription_count() > 0, 3.0)
        for message in messages:
            publisher.publish(message)
            self.spin(lambda: False, 0.3)
        self.node.destroy_publisher(publisher)


def strange_parameters(peer: Peer, name: str) -> None:
    """Set parameters to values of types that do not exist."""
    from rcl_interfaces import srv
    from rcl_interfaces.msg import Parameter, ParameterValue

    for kind in (200, 11, 255):
        rows = [Parameter(name='use_sim_time', value=ParameterValue(type=kind))]
        for service in (srv.SetParameters, srv.SetParametersAtomically):
            topic = (
                'set_parameters' if service is srv.SetParameters else 'set_parameters_atomically'
            )
            peer.call(service, f'/{name}/{topic}', service.Request(parameters=rows), MOST_S)


def strange_descriptions(peer: Peer, _: str) -> None:
    """Publish descriptions of robots that recursive parsers do not survive."""
    from std_msgs.msg import String

    texts: list[Callable[[], str]] = [
        lambda: chain(4_000), lambda: chain(1_900), lambda: star(20_000), lambda: diamonds(40),
        lambda: nested(200_000),
    ]  # fmt: skip
    made = [urdf_of(make) for make in texts] + [entity_bomb()]
    peer.publish(String, '/robot_description', [String(data=text.decode()) for text in made])


def strange_diagnostics(peer: Peer, _: str) -> None:
    """Publish diagnostics whose numbers are none."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    keys = ('subscribers./joint_trajectory', 'policies', 'frames', 'chunk', 'state', 'lifecycle')
    statuses = [
        DiagnosticStatus(name=name, values=[KeyValue(key=key, value=value) for key in keys])
        for name in ('world_model: world_model', 'policy: policy', '', 'x' * 5_000)
        for value in ('x', '-1', '1e999', '9' * 5_000, '')
    ]
    for topic in ('/diagnostics', '/world_model/report'):
        peer.publish(DiagnosticArray, topic, [DiagnosticArray(status=statuses)])


ATTACKS = {
    'values of unknown types': strange_parameters,
    'robot descriptions': strange_descriptions,
    'diagnostics': strange_diagnostics,
}


@contextmanager
def node(name: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run one node; SIGINT ends it."""
    module, *arguments = commands(folder)[name]
    with (folder / f'{name}.log').open('wb') as log:
        process = subprocess.Popen(
            [sys.executable, '-m', f'mtv_world_ros.ros.{module}', *arguments],
            stdout=log, stderr=subprocess.STDOUT, env={**os.environ, **_ENVIRONMENT},
            start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def main() -> int:
    """Attack each node in each way; return 1 where one did not outlive it."""
    peer, failed = Peer(), 0
    for name in sys.argv[1:] or commands(Path()):
        with tempfile.TemporaryDirectory() as folder, node(name, Path(folder)) as process:
            is_up = peer.answers(name, _START_S) is not None
            for attack, send in ATTACKS.items():
                if is_up and process.poll() is None:
                    send(peer, name)
                seconds = peer.answers(name) if process.poll() is None else None
                is_well = is_up and seconds is not None and process.poll() is None
                said = f'answers in {1000 * seconds:.0f} ms' if seconds is not None else 'WRONG'
                print(f'{name:12} {attack:24} {said}', flush=True)
                if not is_well:
                    failed = 1
                    print((Path(folder) / f'{name}.log').read_text()[-1500:])
                    break
    return failed


if __name__ == '__main__':
    sys.exit(main())
