"""Inputs of peers to a running node, from a client with Fast DDS' default settings.

After each attack a whole scene and a plan must come to their end. Prints a row an attack; the exit
status is 1 if the node died, was blinded, lost a plan, or said nothing of what it refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import json
import os
from pathlib import Path
import signal
import sys
import tempfile
import time
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from mtv_world_ros.ros.messages.conversions import NANO, to_stamp
from robustness.default_client import SETTINGS
from robustness.node_messages import commit, DAMAGE, damaged
from robustness.usage import starved_s, usage
from test.support import ros_nodes as ros
from test.support.large_messages import empty_points

#: no plan takes longer, on a busy machine either [s]
PATIENCE_S = 20.0
#: whole scenes after an attack until a plan is done: two joint states must agree after a jump
NUM_TRIES = 3
#: damaged messages between two checks
FUZZ_STEP = 20
SIZE = (384, 288)
#: images of each view that come right after a plan, more than a shared buffer holds
NUM_IMAGES = 12
#: a lost plan comes again 3 s after it was sent, by the client's default heartbeat period [s]
STOP_S, LATE_S = 0.3, 2.0
#: after a stop signal all threads stand still; one that stops while it takes a message in makes
#: Fast DDS ask for that message again [s]
SETTLED_S = 0.05
NUM_PLANS = 5
#: processor time of a node from a plan that is too large to its answer, transport included [s]
MOST_CPU_S = 0.2
TOPICS = {
    'joints': '/joint_states',
    'plan': '/joint_trajectory',
    'image_low': '/low/image_raw',
    'info_low': '/low/camera_info',
}


class NodeInputs:
    """A node in a process of its own and a client in default settings.

    Args:
        folder: for the node's files and log.
    """

    def __init__(self, folder: Path) -> None:
        for name in SETTINGS:
            os.environ.pop(name, None)
            ros.ENVIRONMENT.pop(name, None)
        self.node = ros.start_node_process(folder, 'pace:=burst', 'max_image_age_s:=2.0')
        self.client = ros.Client()
        self.client.connect_inputs(ros.INPUTS)
        keys = [f'publishers.{topic}' for topic in ros.INPUTS]
        self.client.wait(lambda: all(self.value(key, '0') != '0' for key in keys), 'the node')
        self.plan()  # what comes first after two processes met each other may be lost

    def value(self, key: str, default: str = '') -> str:
        """A value of the node's newest diagnostics."""
        return self.client.diagnostic_values().get(key, default)

    def plan(self, **scene: Any) -> dict[str, str]:
        """Send a scene and a plan; return the plan's one end.

        Raises:
            AssertionError: it has none in time, or two.
        """
        stamp_ns = self.client.send_scene(**scene)
        self.client.spin_for(0.1)
        self.client.send_trajectory(stamp_ns=stamp_ns)
        self.client.wait(lambda: self.ends(stamp_ns), 'the end of a plan', PATIENCE_S)
        self.client.spin_for(0.05)
        (end,) = self.ends(stamp_ns)
        return end

    def ends(self, stamp_ns: int) -> list[dict[str, str]]:
        """Reports of the ends of a plan."""
        values = self.client.report_values()
        mine = [v for v in values if v.get('trajectory_stamp_ns') == str(stamp_ns)]
        return [v for v in mine if v['state'] in ros.ENDS]

    def expect_goes_on(self) -> None:
        """Raise unless a whole scene and a plan are judged."""
        ends = []
        for _ in range(NUM_TRIES):
            ends.append(self.plan())
            if ends[-1]['state'] == 'done':
                return
        raise AssertionError(f'the node is blinded: {ends[-1].get("text")}')

    def expect_counted(self, reason: str, act: Callable[[], object]) -> None:
        """Raise unless what is done is counted under a reason."""
        before = int(self.value(f'rejected.{reason}', '0'))
        act()
        self.client.wait(
            lambda: int(self.value(f'rejected.{reason}', '0')) > before, reason, PATIENCE_S
        )

    def close(self) -> tuple[int, str]:
        """End both; return the node's exit status and log."""
        self.client.close()
        return self.node.stop(), self.node.output()


def plans_behind_pictures(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """Images that come right after a plan, while the node has no time, do not push it out."""
    client = inputs.client
    images = {
        f'image_{view}': ros.to_image(ros.make_pixels(view, SIZE), ros.make_header(view, 0))
        for view in ros.VIEWS
    }

    def show() -> int:
        stamp_ns = int(client.now_ns())
        for message in images.values():
            message.header.stamp = to_stamp(stamp_ns)
        client.send_scene(stamp_ns, **images)
        return stamp_ns

    path = inputs.value('receive_path./joint_trajectory')
    assert path.startswith('UDP port '), path
    waited = []
    for _ in range(NUM_PLANS):
        show()
        client.spin_for(0.2)
        inputs.node.process.send_signal(signal.SIGSTOP)
        time.sleep(SETTLED_S)
        sent_s, stamp_ns = time.monotonic(), int(client.now_ns())
        before = starved_s(inputs.node.process.pid)
        client.send_trajectory(stamp_ns=stamp_ns)
        for _ in range(NUM_IMAGES):
            show()
        client.spin_for(STOP_S)
        inputs.node.process.send_signal(signal.SIGCONT)
        client.wait(lambda stamp=stamp_ns: inputs.ends(stamp), 'a plan', PATIENCE_S)
        after = starved_s(inputs.node.process.pid)  # how busy the machine is says nothing
        starved = max(wait - before.get(thread, 0.0) for thread, wait in after.items())
        waited.append(round(time.monotonic() - sent_s - starved, 2))
    assert max(waited) < LATE_S, f'plans were answered after {waited} s'


def samples_from_the_future(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """An image and a joint state an hour ahead are refused, counted, and blind nobody."""
    client = inputs.client
    stamp_ns = client.now_ns() + 3600 * NANO

    def send() -> None:
        for view in ros.VIEWS:
            client.publish(f'/{view}/image_raw', ros.make_image(view, stamp_ns))

    inputs.expect_counted('image_stale', send)
    state = ros.make_joint_state(stamp_ns)
    inputs.expect_counted('joint_state_stale', lambda: client.publish('/joint_states', state))


def late_frame(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """A frame that arrives after a newer one is not the newest."""
    client = inputs.client
    newest_ns = client.send_scene()
    client.spin_for(0.1)
    for view in ros.VIEWS:
        client.publish(f'/{view}/image_raw', ros.make_image(view, newest_ns - NANO // 2))
    client.spin_for(0.1)
    seen = len(client.report_values('chunk'))
    client.send_trajectory()
    client.wait(lambda: len(client.report_values('chunk')) > seen, 'a chunk', PATIENCE_S)
    stamp_ns = int(client.report_values('chunk')[seen]['observation_stamp_ns'])
    assert stamp_ns == newest_ns, f'the frame was {(newest_ns - stamp_ns) / NANO:.3f} s too old'


def tiny_images(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """Images of a few pixels are refused."""
    for size in ((4, 3), (8, 6)):
        images = {
            f'image_{view}': ros.make_image(
                view,
                inputs.client.now_ns(),
                width=size[0],
                height=size[1],
                step=3 * size[0],
                data=bytes(3 * size[0] * size[1]),
            )
            for view in ros.VIEWS
        }
        end = inputs.plan(**images)
        assert end.get('reason') == 'image_data', f'{size}: {end}'


def joints_of_other_devices(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """Joints that are not the robot's do not matter, whatever they hold."""
    names, home = (*ros.JOINTS, 'wheel_l', 'wheel_l'), [*ros.HOME, float('nan'), 2.0]
    before = inputs.value('rejected', '0')
    end = inputs.plan(joints=ros.make_joint_state(inputs.client.now_ns(), names, home))
    assert end['state'] == 'done', end
    inputs.client.spin_for(0.5)
    assert inputs.value('rejected', '0') == before


def one_bad_joint(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """A joint without a number is named and leaves the others."""
    home = [float('nan'), *ros.HOME[1:]]
    state = ros.make_joint_state(inputs.client.now_ns(), ros.JOINTS, home)
    inputs.expect_counted(
        'joint_state_invalid', lambda: inputs.client.publish('/joint_states', state)
    )
    assert f"joint '{ros.JOINTS[0]}'" in inputs.value('last_rejection')


def best_effort_policy(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """A policy that publishes best effort is told why it gets no answer."""
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    plans = inputs.client.node.create_publisher(ros.JointTrajectory, '/joint_trajectory', profile)

    def is_said() -> bool:
        texts = [status.message for status in inputs.client.statuses('/diagnostics')]
        return any('offers reliability best_effort, asked for is reliable' in t for t in texts)

    inputs.client.wait(is_said, 'the mismatch in /diagnostics', PATIENCE_S)
    inputs.client.node.destroy_publisher(plans)


def clock_that_is_no_time(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """A negative `/clock`, after a peer set `use_sim_time`."""
    client = inputs.client
    assert client.set(use_sim_time=True) == ''
    clock = client.node.create_publisher(Clock, '/clock', 10)
    client.wait(clock.get_subscription_count, 'a subscription of /clock')
    for stamp in (-1, -(2**31), 2**31 - 1):
        for _ in range(5):
            message = Clock()
            message.clock.sec = stamp
            clock.publish(message)
            client.spin_for(0.02)
    assert client.set(use_sim_time=False) == ''
    client.node.destroy_publisher(clock)


def plans_of_many_points(inputs: NodeInputs, rng: np.random.Generator) -> None:
    """Plans of 4.8 and 24 MB that hold points and no values: each is answered, at no cost."""
    client, pid = inputs.client, inputs.node.process.pid
    for count in (200_000, 1_000_000):
        stamp_ns, begin_s = int(client.now_ns()), _cpu_s(pid)
        memory_mb = usage(pid)['memory_mb']
        client.publish(TOPICS['plan'], empty_points(count, stamp_ns))
        client.wait(lambda stamp=stamp_ns: inputs.ends(stamp), 'the answer', PATIENCE_S)
        (end,) = inputs.ends(stamp_ns)
        spent_s, grown_mb = _cpu_s(pid) - begin_s, usage(pid)['memory_mb'] - memory_mb
        sys.stderr.write(f'{count} points: {spent_s:.2f} s of CPU, {grown_mb:+.0f} MB\n')
        assert end['reason'] == 'trajectory_malformed' and str(count) in end['text'], end
        assert spent_s < MOST_CPU_S, f'{spent_s:.2f} s of CPU for {count} points'


def _cpu_s(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


ATTACKS: dict[str, Callable[[NodeInputs, np.random.Generator], None]] = {
    attack.__name__: attack
    for attack in (
        plans_behind_pictures,
        samples_from_the_future,
        late_frame,
        tiny_images,
        joints_of_other_devices,
        one_bad_joint,
        best_effort_policy,
        clock_that_is_no_time,
        plans_of_many_points,
    )
}


def fuzz(inputs: NodeInputs, rng: np.random.Generator, cases: int) -> None:
    """Damaged messages on the topics of the node; each plan among them has one end."""
    for case in range(cases):
        key = str(rng.choice([key for key in DAMAGE if key in TOPICS]))
        message = damaged(key, rng)
        if rng.random() < 0.7 and key != 'plan':  # else its stamp is refused before the rest
            message.header.stamp = to_stamp(inputs.client.now_ns())
        inputs.client.publish(TOPICS[key], message)
        inputs.client.spin_for(0.005)
        if case % FUZZ_STEP == FUZZ_STEP - 1:
            inputs.expect_goes_on()


def run(folder: Path, seed: int, cases: int, names: Sequence[str]) -> list[dict[str, Any]]:
    """Try the attacks on one node; return a row of each."""
    inputs, rows = NodeInputs(folder), []
    attacks = {name: ATTACKS[name] for name in names}
    attacks['fuzz'] = lambda inputs, rng: fuzz(inputs, rng, cases)
    for name, attack in attacks.items():
        begin_s, wrong = time.monotonic(), ''
        try:
            attack(inputs, np.random.default_rng([seed, len(rows)]))
            inputs.expect_goes_on()
        except AssertionError as error:
            wrong = str(error)
        died = inputs.node.process.poll() is not None
        rows.append(
            {'attack': name, 'wrong': wrong, 'died': died, 's': time.monotonic() - begin_s}
        )
        if died:
            break
    status, log = inputs.close()
    rows.append(
        {'attack': 'end', 'wrong': '' if status == 0 else f'exit status {status}',
         'died': False, 'tracebacks': log.count('Traceback')}
    )  # fmt: skip
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Attacks; 1 if something went wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=2000, help='damaged messages')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--attacks', nargs='*', choices=list(ATTACKS), default=list(ATTACKS))
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        rows = run(Path(folder), options.seed, options.cases, options.attacks)
        log = (Path(folder) / 'node.log').read_text()
    for row in rows:
        sys.stdout.write(json.dumps({**row, 'seed': options.seed, 'commit': commit()}) + '\n')
    is_wrong = any(row['wrong'] or row['died'] or row.get('tracebacks') for row in rows)
    if is_wrong:
        sys.stderr.write(log)
    return int(is_wrong)


if __name__ == '__main__':
    raise SystemExit(main())
