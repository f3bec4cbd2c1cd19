"""Counts and publishes what happens: `~/report` at once, `/diagnostics` once a period."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from math import isnan
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.node import Node

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.status_publisher import READY, StatusPublisher
from mtv_world_ros.ros.world_model.chunk_outcomes import ScoredChunk, Sent
from mtv_world_ros.ros.world_model.prediction_publisher import stamp_of
from mtv_world_ros.ros.world_model.worker import Chunk, Ended, Foreseen, Request

_LEVELS = {
    'rejected': DiagnosticStatus.WARN,
    'failed': DiagnosticStatus.ERROR,
}

#: values of reports whose median and extremes `/diagnostics` shows
_KEPT = ('latency_s', 'lead_s', 'first_frame_s', 'frame_lead_s', 'real_time_factor')
#: chunks that latencies are taken over
_WINDOW = 50
#: a rejection shows as a warning for this long [s]
_WARN_S = 5.0
#: reports that are kept for a subscriber that is busy: each plan has one end
REPORTS_KEPT = 1000
#: rollouts ended in a row without a verdict that are worth a warning
_STARVED = 5
#: reasons that mean something is broken here and not in what was sent
_ERRORS = (Reason.OUT_OF_MEMORY, Reason.WORKER_STUCK, Reason.INTERNAL_ERROR)


#: end of an empty trajectory, in words
STOPS = 'it has no points: the plans before it are given up, and the robot holds'


class Reporter:
    """Publishes reports and diagnostics.

    Args:
        node: owner of the publishers and the logger.
        settings: the present parameters.
        state: further rows of `/diagnostics`, called for each message.
        missing: inputs that the node lacks, as text, called for each message.
    """

    def __init__(
        self,
        node: Node,
        settings: Callable[[], Settings],
        state: Callable[[], Mapping[str, object]],
        missing: Callable[[], Sequence[str]],
    ) -> None:
        self._node = node
        self._settings, self._state, self._missing = settings, state, missing
        self._tally = Tally()
        self._status = StatusPublisher(node, 'rollout', REPORTS_KEPT)
        self.name_robot('')

    def name_robot(self, name: str) -> None:
        """Set the hardware id: a robot's name behind the node's namespace."""
        self._status.hardware_id = f'{self._node.get_namespace()}/{name}'.strip('/')

    def count(self, what: str) -> None:
        """Count an event that is no rejection."""
        self._tally.counts[what] += 1

    def reject(self, error: Rejection) -> None:
        """Count a refused message; `/diagnostics` says why at its next period."""
        self._tally.reject(error, time.monotonic())
        self._node.get_logger().warning(
            f'rejected ({error.reason}): {error}', throttle_duration_sec=1.0
        )

    def reject_trajectory(self, error: Exception, trajectory_stamp_ns: int) -> None:
        """Count and report a refused trajectory; `/diagnostics` says why at once."""
        if not isinstance(error, Rejection):
            self.crash(error)
            error = Rejection(Reason.INTERNAL_ERROR, f'{type(error).__name__}: {error}')
        self.reject(error)
        values = {'reason': error.reason.value, 'text': str(error)}
        self._publish_report('rejected', {'trajectory_stamp_ns': trajectory_stamp_ns, **values})
        self.publish_diagnostics()

    def stopped(self, trajectory_stamp_ns: int) -> None:
        """Count and report an empty trajectory, which stopped the plans before it."""
        self.count('trajectories_empty')
        values = {'trajectory_stamp_ns': trajectory_stamp_ns, 'num_chunks': 0, 'text': STOPS}
        self._publish_report('done', values)

    def guarded(self, handle: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that counts exceptions of the handler and does not raise."""

        def callback(*messages: Any) -> None:
            try:
                handle(*messages)
            except Rejection as error:
                self.reject(error)
            except Exception as error:  # the node never dies of a message
                self.crash(error)

        return callback

    def served(self, serve: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return the service's callback as one that always answers."""

        def callback(request: Any, response: Any) -> Any:
            try:
                return serve(request, response)
            except Exception as error:  # the node never dies of a request
                self.crash(error)
                response.success, response.message = False, f'{type(error).__name__}: {error}'
                return response

        return callback

    def crash(self, error: Exception) -> None:
        """Count and log an unexpected exception."""
        if not self._node.context.ok():
            return  # ROS was shut down under a callback
        self._node.get_logger().error(''.join(traceback.format_exception(error)))
        text = f'{type(error).__name__}: {error}'
        self._tally.reject(Rejection(Reason.INTERNAL_ERROR, text), time.monotonic())

    def foreseen(self, found: Foreseen) -> None:
        """Report the estimate of a chunk whose frames are not imagined yet."""
        values = {
            **_request_values(found.request),
            'chunk': found.chunk,
            'num_chunks': found.num_chunks,
            'latency_s': found.ready_s - found.request.received_s,
            **_success_values(found.success),
        }
        self._publish_report('foreseen', values)

    def judged(self, chunk: Chunk) -> None:
        """Count and report a chunk that was predicted; its estimate is out."""
        values = _chunk_values(chunk, self._settings())
        self._tally.counts['chunks'] += 1
        if isnan(chunk.prediction.success.probability):
            self._tally.counts['chunks_without_verdict'] += 1
        self._add_seconds(values)
        is_seen = chunk.prediction.in_view.any()
        self._publish_report('chunk', values, *(() if is_seen else (DiagnosticStatus.WARN,)))

    def sent(self, chunk: Chunk, sent: Sent) -> None:
        """Count and report a chunk whose frames are out, or whose rest was dropped."""
        values, counts = _sent_values(chunk, sent), self._tally.counts
        counts['frames_published'] += sent.num_frames
        counts['frames_dropped'] += len(chunk.prediction.video.times) - sent.num_frames
        self._add_seconds(values)
        values['frames_published_total'] = counts['frames_published']
        self._publish_report('published', values)

    def scored(self, scored: ScoredChunk) -> None:
        """Report how a chunk compares with the real frames that came for it."""
        self._publish_report('fidelity', _fidelity_values(scored))

    def ended(self, ended: Ended) -> None:
        """Count and report the end of a rollout."""
        self._tally.end(ended.state, is_judged=ended.success is not None)
        if ended.trace:
            self._node.get_logger().error(ended.trace)
        if ended.reason is not None:
            self.reject(Rejection(ended.reason, ended.text))
        try:
            self._publish_report(ended.state, _ended_values(ended))
        except Exception as error:  # a plan gets its end, whatever is in its values
            self.crash(error)
            self._publish_report(ended.state, {'trajectory_stamp_ns': ended.request.stamp_ns})
        if ended.reason is not None:
            self.publish_diagnostics()

    def publish_diagnostics(self) -> None:
        """Publish `/diagnostics`."""
        now_s = time.monotonic()
        state = self._state()
        num_policies, missing = int(str(state['policies'])), self._missing()
        level, message = self._tally.level(now_s, num_policies=num_policies, missing=missing)
        values = {**state, **self._tally.values(now_s)}
        self._status.diagnose(level, message, values)

    def _add_seconds(self, values: Mapping[str, object]) -> None:
        """Keep the durations for `/diagnostics`."""
        kept = {
            name: value
            for name, value in values.items()
            if name.startswith('stage_s.') or name in _KEPT
            if isinstance(value, float)
        }
        self._tally.add_seconds(kept)

    def _publish_report(
        self, state: str, values: Mapping[str, object], level: bytes | None = None
    ) -> None:
        self._status.report(state, values, level or _LEVELS.get(state, DiagnosticStatus.OK))


class Tally:
    """Counters of messages and rollouts; times are of `time.monotonic`."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._last: tuple[float, Reason, str] | None = None
        self._seconds: dict[str, deque[float]] = {}
        self._fruitless = 0

    def reject(self, error: Rejection, now_s: float) -> None:
        """Count a refused message or rollout."""
        self._rejected[error.reason] += 1
        self._last = (now_s, error.reason, str(error))

    def end(self, state: str, *, is_judged: bool) -> None:
        """Count the end of a rollout, and whether it had an estimate."""
        self.counts[f'rollouts_{state}'] += 1
        starved = state == 'preempted' and not is_judged
        self._fruitless = self._fruitless + 1 if starved else 0

    def add_seconds(self, seconds: Mapping[str, float]) -> None:
        """Take the durations of a chunk [s], by name."""
        for name, value in seconds.items():
            self._seconds.setdefault(name, deque(maxlen=_WINDOW)).append(value)

    def level(
        self, now_s: float, *, num_policies: int = 1, missing: Sequence[str] = ()
    ) -> tuple[bytes, str]:
        """Return the diagnostic level and all problems.

        Args:
            now_s: present time [s].
            num_policies: number of publishers of trajectories.
            missing: inputs that the node lacks, as text.
        """
        level, texts = DiagnosticStatus.WARN, []
        if self._last is not None and now_s - self._last[0] < _WARN_S:
            _, reason, text = self._last
            level = DiagnosticStatus.ERROR if reason in _ERRORS else level
            texts.append(f'{reason}: {text}')
        if num_policies > 1:
            texts.append(
                f'{num_policies} publishers of joint trajectories: each pre-empts the rollouts of '
                'the others; stop all but one'
            )
        if self._fruitless >= _STARVED:
            texts.append(
                f'the last {self._fruitless} rollouts were pre-empted before their first verdict: '
                'trajectories arrive faster than they are judged'
            )
        texts += [', '.join(missing)] if missing else []
        return (level, ' | '.join(texts)) if texts else (DiagnosticStatus.OK, READY)

    def values(self, now_s: float) -> dict[str, object]:
        """Return keys and values: counts, `rejected.<reason>`, the last rejection, latencies."""
        values: dict[str, object] = dict(self.counts)
        values['rejected'] = sum(self._rejected.values())
        values |= {f'rejected.{reason}': n for reason, n in sorted(self._rejected.items())}
        if self._last is not None:
            when, reason, text = self._last
            values['last_rejection'] = f'{reason}: {text}'
            values['last_rejection_age_s'] = now_s - when
        for name, window in self._seconds.items():
            values[f'{name}.last'] = window[-1]
            values[f'{name}.median'] = float(np.median(window))
            values[f'{name}.min'] = min(window)
            values[f'{name}.max'] = max(window)
        return values


def _chunk_values(chunk: Chunk, settings: Settings) -> dict[str, object]:
    """Return the keys and values of a predicted chunk; stamps in ns, durations in s."""
    prediction, request = chunk.prediction, chunk.request
    num_frames = len(prediction.video.times)
    frame_s = float(prediction.video.times[0] - prediction.trajectory_video.times[0])
    values = {
        **_chunk_identity(chunk),
        'chunk_seed': prediction.seed,
        'observation_stamp_ns': prediction.stamp_ns,
        'source_stamp_ns': chunk.scene.source_stamp_ns,
        'first_stamp_ns': stamp_of(chunk, 0, 'target'),
        'last_stamp_ns': stamp_of(chunk, -1, 'target'),
        'stamp_mode': settings.stamp_mode,
        'frames': num_frames,
        'latency_s': chunk.ready_s - request.received_s,
        'lead_s': chunk.lead_s,
        'real_time_factor': num_frames * frame_s / sum(prediction.seconds.values()),
    }
    values |= {f'stage_s.{_key(stage)}': s for stage, s in prediction.seconds.items()}
    # the request may leave it to the checkpoint
    values['num_inference_steps'] = prediction.num_inference_steps
    return values | _estimate_values(chunk) | _trust_values(chunk, settings.trusted_jaccard)


def _sent_values(chunk: Chunk, sent: Sent) -> dict[str, object]:
    """Return the keys and values of a chunk whose frames are out, or whose rest was dropped."""
    values = _chunk_identity(chunk)
    values |= {
        'frames_published': sent.num_frames,
        'frames_dropped': len(chunk.prediction.video.times) - sent.num_frames,
        'stage_s.publish': sent.publish_s,
    }
    if sent.num_frames:
        received_s = chunk.request.received_s
        values['first_frame_s'] = sent.out_s[0] - received_s
        values['last_frame_s'] = sent.out_s[-1] - received_s
        values['frame_lead_s'] = float(np.median(sent.leads_s))
    return values


def _chunk_identity(chunk: Chunk) -> dict[str, object]:
    """Return the identity of a chunk: plan, number, rollout."""
    prediction = chunk.prediction
    return {
        **_request_values(chunk.request),
        'chunk': prediction.chunk,
        'num_chunks': prediction.num_chunks,
    }


def _ended_values(ended: Ended) -> dict[str, object]:
    """Keys and values of a rollout's end, with the last estimate of the plan if there is one."""
    values = {**_request_values(ended.request), 'num_chunks': ended.num_chunks}
    if ended.success is not None:
        values |= _success_values(ended.success)
    if ended.reason is not None:
        values['reason'] = ended.reason.value
    if ended.text:
        values['text'] = ended.text
    return values


def _request_values(request: Request) -> dict[str, object]:
    """Return the identity of a plan and the options of its rollout."""
    return {
        'rollout': request.rollout,
        'trajectory_stamp_ns': request.stamp_ns,
        'mode': 'imagine' if request.imagine else 'observe',
        'seed': request.settings.seed,
        'num_inference_steps': request.settings.num_inference_steps,
        'instruction': request.instruction,
    }


def _estimate_values(chunk: Chunk) -> dict[str, object]:
    prediction = chunk.prediction
    success, masks = prediction.success, prediction.masks
    values: dict[str, object] = {
        **_success_values(success),
        'objects': masks.names,
        'segmenter': prediction.segmenter,
    }
    for row, view in enumerate(prediction.video.views):
        values[f'in_view.{view}'] = float(prediction.in_view[row])
        for column, name in enumerate(masks.names):
            values[f'jaccard.{view}.{_key(name)}'] = float(success.jaccard[row, column])
            values[f'mask_status.{view}.{_key(name)}'] = masks.status[row][column]
    return values


def _success_values(success: SuccessEstimate) -> dict[str, object]:
    return {
        'success': success.probability,
        'success_low': success.interval[0],
        'success_high': success.interval[1],
        'success_spread': success.spread,
        'success_num_seeds': success.num_seeds,
        'success_calibrated': success.is_calibrated,
        'success_trust': success.trust,
        'success_reasons': '; '.join(success.reasons),
    }


def _fidelity_values(scored: ScoredChunk) -> dict[str, object]:
    """Return the keys and values of a chunk whose real frames came."""
    prediction = scored.chunk.prediction
    values: dict[str, object] = {
        **_request_values(scored.chunk.request),
        'chunk': prediction.chunk,
        'frames_compared': scored.num_frames,
        'fidelity_jaccard': scored.mean,
    }
    for row, view in enumerate(prediction.video.views):
        for column, name in enumerate(scored.names):
            values[f'fidelity.{view}.{_key(name)}'] = float(scored.jaccard[row, column])
            values[f'fidelity_copy.{view}.{_key(name)}'] = float(scored.copy[row, column])
    return values


def _trust_values(chunk: Chunk, level: float) -> dict[str, object]:
    """Return the chunk's distance from the last real frame, and the trusted horizon [s]."""
    trusted_s = chunk.prediction.trusted_seconds(level)
    end_s = chunk.prediction.imagined_seconds
    known = 'yes' if end_s <= trusted_s + 1e-6 else 'no'
    return {
        'imagined_s': end_s,
        'trusted_s': trusted_s,
        'trusted_jaccard': level,
        'trusted': 'not measured' if isnan(trusted_s) else known,
    }


def _key(name: str) -> str:
    return name.replace(' ', '_')
