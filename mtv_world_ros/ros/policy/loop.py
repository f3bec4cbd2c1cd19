"""An episode of a policy: observe, ask, imagine, observe what was imagined, on a strict clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import time
from typing import Protocol

import numpy as np
from sensor_msgs.msg import Image, JointState

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation, WorldModelSpec
from mtv_world_ros.policies.policy import first_part, Policy
from mtv_world_ros.rollout.candidates import CandidatePolicy
from mtv_world_ros.ros.bags.player import ENDS
from mtv_world_ros.ros.messages.conversions import NANO, to_ns, to_positions
from mtv_world_ros.ros.messages.image_messages import to_rgb
from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.parameters import at_start, Mode, NodeSettings, parameter
from mtv_world_ros.ros.policy.policy_thread import Actor, PolicyAnswer

_SECONDS = (0.001, 86400.0)
#: a rollout that ends later ends the episode [s]
ROLLOUT_TIMEOUT_S = 300.0
#: frames that arrive later after the end of their rollout are lost [s]
FRAMES_TIMEOUT_S = 10.0


class PolicySettings(NodeSettings):
    """Parameters of the node `policy`; checkpoint and robot must be the world model's."""

    policy: str = at_start('scripted', 'Policy YAML, or the name of one in `config/policies`.')
    world_model: str = at_start('/world_model', "The world model node's name.")
    diagnostics_period_s: float = at_start(0.5, 'Period of /diagnostics [s].', (0.05, 60.0))
    mode: Mode = parameter(
        'imagine', 'Later observations: `imagine` = predictions, `observe` = cameras.'
    )
    instruction: str = parameter('', 'The instruction that the policy gets.')
    task: str = parameter('', 'Task of the scene, for policies that know it (scripted).')
    scene_seed: int = parameter(-1, 'Seed of the scene, for the same; -1 = none.', (-1, 2**62))
    recording: str = parameter('', 'Episode folder, for policies that repeat it (recorded).')
    recording_ns: int = parameter(
        0, 'Stamp in it at which the episode begins, for the same [ns].', (0, 2**62)
    )
    seed: int = parameter(0, "Seed of the policy's own randomness.", (0, 2**31 - 1))
    candidates: int = at_start(
        1,
        'Number of plans (seeds) that the policy is asked for when an episode begins. They are '
        'compared in simulated futures, and the best one acts; the first where none is better.',
        (1, 64),
    )
    max_chunks: int = parameter(
        0, 'An episode ends after this number of chunks; 0 = no limit.', (0, 10**6)
    )
    execute_s: float = parameter(
        0.0,
        'Part of an answer that is executed before the policy is asked again [s]; 0 = one chunk.',
        (0.0, 3600.0),
    )
    answer_timeout_s: float = parameter(60.0, 'A later answer ends the episode [s].', _SECONDS)
    observation_timeout_s: float = parameter(
        30.0, 'An episode ends without an observation for this time [s].', _SECONDS
    )


def chunk_stamps(start_ns: int, num_frames: int, fps: float) -> list[int]:
    """Return the stamps of a chunk's frames [ns], given its start stamp."""
    return [start_ns + round((k + 1) / fps * NANO) for k in range(num_frames)]


class PredictedFrames:
    """Keeps the predicted frames and joint states since the last `clear`.

    Args:
        views: names of the V views, in the model's order.
        joint_names: J names, in the robot's order.
    """

    def __init__(self, views: Sequence[str], joint_names: Sequence[str]) -> None:
        self._joint_names = tuple(joint_names)
        self._images: dict[str, dict[int, Image]] = {view: {} for view in views}
        self._joints: dict[int, JointState] = {}

    def add_image(self, view: str, message: Image) -> None:
        """Store a predicted image."""
        self._images[view][to_ns(message.header.stamp)] = message

    def add_joint_state(self, message: JointState) -> None:
        """Store a predicted joint state."""
        self._joints[to_ns(message.header.stamp)] = message

    def clear(self) -> None:
        """Drop all stored messages."""
        for stored in (*self._images.values(), self._joints):
            stored.clear()

    def missing(self, stamps: Sequence[int]) -> list[str]:
        """Return the names of the frames at these stamps that were not received."""
        streams = {**self._images, 'joint_states': self._joints}
        return [
            f'{name} at {stamp} ns'
            for name, stored in streams.items()
            for stamp in stamps
            if stamp not in stored
        ]

    def unexpected(self, stamps: Sequence[int]) -> list[int]:
        """Return the stamps of received images that are not among these."""
        found = {stamp for stored in self._images.values() for stamp in stored}
        return sorted(found - set(stamps))

    def observation(self, stamp_ns: int, before: Observation) -> Observation:
        """Return the frames at a stamp as an observation, with the cameras of an earlier one.

        Raises:
            Rejection: an image or the joint state cannot be read.
        """
        frames = [to_rgb(stored[stamp_ns]) for stored in self._images.values()]
        positions = to_positions(self._joints[stamp_ns])
        height, width = frames[0].shape[:2]
        return Observation(
            cameras=tuple(scaled(camera, width, height) for camera in before.cameras),
            frames=np.stack(frames),
            positions=np.array([positions[name] for name in self._joint_names]),
            stamp_ns=stamp_ns,
        )


#: ends of an episode that are no fault
GOOD_ENDS = ('done', 'max_chunks', 'stopped')
#: of the world model's reports of chunks: what the last one says is what an episode amounts to
ESTIMATE = ('success', 'success_low', 'success_high', 'success_trust', 'success_reasons')
#: what an episode waits for, and how it ends where that does not come
_OVERDUE = {
    'resetting': 'late',
    'acting': 'late',
    'observing': 'no_observation',
    'imagining': 'unanswered',
    'collecting': 'frames_missing',
}


class Outputs(Protocol):
    """Publishers and sensors that the loop uses."""

    def send(self, trajectory: JointTrajectory, stamp_ns: int) -> None:
        """Publish an answer under the stamp of the observation that it answers."""
        ...

    def report(self, state: str, values: Mapping[str, object]) -> None:
        """Report a chunk, the beginning or the end of an episode."""
        ...

    def fault(self, kind: str, text: str) -> None:
        """Count a fault."""
        ...

    def observe(self) -> Observation:
        """Return a real observation.

        Raises:
            Rejection: there is none.
        """
        ...


@dataclass(slots=True)
class _Chunk:
    """One cycle: times [s] of `time.monotonic`, and the world model's report."""

    begin_s: float
    policy_s: float = 0.0
    sent_s: float = 0.0
    report: Mapping[str, str] | None = None


class PolicyLoop:
    """Runs episodes of a policy, one after the other, in the caller's thread.

    Args:
        spec: spec of the world model.
        joint_names: J names, in the robot's order.
        actor: asks the policy.
        frames: store of what the world model publishes.
        outputs: publishers and clients of the node.
    """

    def __init__(
        self,
        spec: WorldModelSpec,
        joint_names: Sequence[str],
        actor: Actor,
        frames: PredictedFrames,
        outputs: Outputs,
    ) -> None:
        self._joint_names = tuple(joint_names)
        self._spec, self._actor, self._frames, self._out = spec, actor, frames, outputs
        self.phase = 'idle'
        self.episode = 0
        self.num_chunks = 0
        self._estimate: dict[str, str] = {}
        self._ticket = 0
        self._sent: set[str] = set()
        self._deadline_s = float('inf')
        self._why_waiting = ''
        self._observation: Observation | None = None

    def start(self, make: Callable[[], Policy], settings: PolicySettings) -> None:
        """Begin an episode, and end the running one.

        Args:
            make: returns the policy, in the actor's thread.
            settings: hold for the whole episode.
        """
        if self.phase != 'idle':
            self.end('stopped', 'another episode begins')
        self._settings = settings
        self._policy: Policy | None = None
        self.episode += 1
        self.num_chunks = 0
        self._estimate = {}
        self._observation = None
        self._frames.clear()

        def reset() -> None:
            self._policy = make()
            self._policy.reset(seed=settings.seed)

        self._out.report('started', self._values())
        self._ask('resetting', reset)

    def end(self, how: str, text: str = '') -> None:
        """End the episode, if one runs."""
        if self.phase == 'idle':
            return
        if how not in GOOD_ENDS:
            self._out.fault(how, text)
        self.phase = 'idle'
        self._ticket += 1  # what the policy still answers is too late
        self._out.report('ended', {**self._values(), **self._estimate, 'how': how, 'text': text})

    def on_answers(self) -> None:
        """Handle the policy's answers."""
        for answer in self._actor.take():
            if answer.ticket != self._ticket:
                self._out.fault('late_answer', 'an answer came after its episode had ended')
            elif answer.error:
                self.end('policy_failed', answer.error)
            elif self.phase == 'resetting':
                self._wait('observing', self._settings.observation_timeout_s)
            else:
                self._execute(answer)

    def on_report(self, values: Mapping[str, str]) -> None:
        """Handle a report of the world model about a rollout."""
        state, stamp = values.get('state', ''), values.get('trajectory_stamp_ns', '')
        if self.phase == 'idle':
            return
        if stamp not in self._sent:
            if state in ('chunk', 'done'):
                self.end('another_policy', f'a trajectory stamped {stamp} ns was imagined')
        elif self.phase == 'imagining' and self._is_mine(stamp):
            if state == 'chunk':
                self._chunk.report = values
            elif state == 'done':
                self._wait('collecting', FRAMES_TIMEOUT_S)
                self.tick()
            elif state in ENDS:
                reason = values.get('reason', '')
                self.end(state, f'{reason}: {values["text"]}' if reason else 'by somebody else')

    def tick(self) -> None:
        """Continue with received data, or ends an overdue episode; call it periodically."""
        if self.phase == 'observing':
            self._observe()
        elif self.phase == 'collecting':
            self._collect()
        if self.phase != 'idle' and time.monotonic() > self._deadline_s:
            self.end(_OVERDUE[self.phase], self._why_waiting or f'while {self.phase}')

    def _is_mine(self, stamp: str) -> bool:
        return self._observation is not None and stamp == str(self._observation.stamp_ns)

    def _wait(self, phase: str, seconds: float) -> None:
        self.phase, self._why_waiting = phase, ''
        self._deadline_s = time.monotonic() + seconds

    def _ask(self, phase: str, question: Callable[[], JointTrajectory | None]) -> None:
        self._ticket += 1
        self._wait(phase, self._settings.answer_timeout_s)
        self._actor.ask(self._ticket, question)

    def _observe(self) -> None:
        try:
            observation = self._out.observe()
        except Rejection as error:
            self._why_waiting = f'{error.reason}: {error}'
            return
        if self._observation is None or observation.stamp_ns > self._observation.stamp_ns:
            self._act(observation)

    def _act(self, observation: Observation) -> None:
        self._observation = observation
        policy, instruction = self._policy, self._settings.instruction
        assert policy is not None
        self._chunk = _Chunk(time.monotonic())
        self._ask('acting', lambda: policy.act(observation, instruction))

    def _execute(self, answer: PolicyAnswer) -> None:
        assert self._observation is not None
        if answer.trajectory is None:
            self.end('done')
            return
        seconds = self._settings.execute_s or self._spec.num_frames / self._spec.fps
        start = self._start_of(answer.trajectory, self._observation)
        stamp_ns = self._observation.stamp_ns
        self._chunk.policy_s = answer.seconds
        self._chunk.sent_s = time.monotonic()
        self._frames.clear()
        self._sent.add(str(stamp_ns))
        self._wait('imagining', ROLLOUT_TIMEOUT_S)
        self._out.send(first_part(answer.trajectory, start, seconds), stamp_ns)

    def _start_of(self, trajectory: JointTrajectory, observation: Observation) -> FloatArray:
        """Return the measured positions of the trajectory's joints.

        Its first row for joints of others.
        """
        seen = dict(zip(self._joint_names, observation.positions, strict=True))
        named = zip(trajectory.joint_names, trajectory.positions[0], strict=True)
        return np.array([seen.get(name, first) for name, first in named])

    def _collect(self) -> None:
        report, before = self._chunk.report, self._observation
        assert before is not None
        if report is None:
            self._why_waiting = 'the rollout is done, but of its chunk there was no report'
            return
        num_frames = int(report['frames'])
        # real frames may be newer than those answered; predicted ones stand still meanwhile
        is_strict = self._settings.mode == 'imagine' and self.num_chunks > 0
        start_ns = before.stamp_ns if is_strict else int(report['observation_stamp_ns'])
        stamps = chunk_stamps(start_ns, num_frames, self._spec.fps)
        missing = self._frames.missing(stamps)
        unexpected = self._frames.unexpected(stamps)
        if unexpected:
            text = f'frames at {unexpected} ns, expected {stamps[0]} to {stamps[-1]} ns'
            self.end('off_clock', text)
            return
        if missing:
            self._why_waiting = f'{len(missing)} frames, the first of {missing[0]}'
            return
        self.num_chunks += 1
        self._report_chunk(report, num_frames)
        self._go_on(stamps[-1], before)

    def _go_on(self, stamp_ns: int, before: Observation) -> None:
        if 0 < self._settings.max_chunks <= self.num_chunks:
            self.end('max_chunks')
        elif self._settings.mode == 'observe':
            self._wait('observing', self._settings.observation_timeout_s)
        else:
            self._act(self._frames.observation(stamp_ns, before))

    def _report_chunk(self, report: Mapping[str, str], num_frames: int) -> None:
        now_s, chunk = time.monotonic(), self._chunk
        self._estimate = {key: report[key] for key in ESTIMATE if key in report}
        stages = {key: value for key, value in report.items() if key.startswith('stage_s.')}
        values = {
            **self._values(),
            'first_stamp_ns': report['first_stamp_ns'],
            'last_stamp_ns': report['last_stamp_ns'],
            'frames': num_frames,
            'loop_s': now_s - chunk.begin_s,
            'policy_s': chunk.policy_s,
            'rollout_s': now_s - chunk.sent_s,
            'latency_s': report['latency_s'],
            **stages,
            'success': report.get('success', 'nan'),
        }
        self._out.report('chunk', values)

    def _choice(self) -> dict[str, object]:
        """The plan that was chosen, where the policy has several candidates."""
        policy = self._policy
        return {'choice': policy.choice} if isinstance(policy, CandidatePolicy) else {}

    def _values(self) -> dict[str, object]:
        settings = self._settings
        return {
            'episode': self.episode,
            'num_chunks': self.num_chunks,
            'policy': self._policy.name if self._policy is not None else settings.policy,
            'seed': settings.seed,
            'task': settings.task,
            'scene_seed': settings.scene_seed,
            'instruction': settings.instruction,
            'mode': settings.mode,
            **self._choice(),
        }
