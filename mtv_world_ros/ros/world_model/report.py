"""What `~/report` says about a chunk, about the end of a rollout, and about a refusal."""

from __future__ import annotations

from math import isnan

from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.live_fidelity import Scored
from mtv_world_ros.ros.world_model.prediction_publisher import Sent, stamp_of
from mtv_world_ros.ros.world_model.worker import Chunk, Ended, Request


def chunk_values(chunk: Chunk, sent: Sent, settings: Settings) -> dict[str, object]:
    """Keys and values of a published chunk; stamps in ns, durations in s."""
    prediction, request = chunk.prediction, chunk.request
    num_frames = len(prediction.rollout.video.times)
    model_s = sum(prediction.seconds.values())
    values = {
        **request_values(request),
        'chunk': prediction.chunk,
        'num_chunks': prediction.num_chunks,
        'chunk_seed': prediction.rollout.seed,
        'observation_stamp_ns': prediction.stamp_ns,
        'source_stamp_ns': chunk.scene.source_stamp_ns,
        'first_stamp_ns': stamp_of(chunk, 0, 'target'),
        'last_stamp_ns': stamp_of(chunk, -1, 'target'),
        'stamp_mode': settings.stamp_mode,
        'frames': num_frames,
        'frames_published': sent.num_frames,
        'frames_dropped': num_frames - sent.num_frames,
        'latency_s': chunk.ready_s - request.received_s,
        'first_frame_s': sent.first_s - request.received_s if sent.num_frames else float('nan'),
        'last_frame_s': sent.last_s - request.received_s if sent.num_frames else float('nan'),
        'real_time_factor': num_frames * frame_s(chunk) / model_s,
    }
    values |= {f'stage_s.{_key(stage)}': s for stage, s in prediction.seconds.items()}
    values['stage_s.publish'] = sent.publish_s
    # the request may leave it to the checkpoint
    values['num_inference_steps'] = prediction.num_inference_steps
    return values | _estimate_values(chunk) | _trust_values(chunk, settings.trusted_jaccard)


def frame_s(chunk: Chunk) -> float:
    """Time between two predicted frames [s]."""
    times = chunk.prediction.rollout.video.times
    before = chunk.prediction.trajectory_video.times[0]
    return float(times[0] - before)


def ended_values(ended: Ended) -> dict[str, object]:
    """Keys and values of a rollout's end."""
    values = {**request_values(ended.request), 'num_chunks': ended.num_chunks}
    if ended.reason is not None:
        values |= {'reason': ended.reason.value, 'text': ended.text}
    return values


def request_values(request: Request) -> dict[str, object]:
    """What identifies a plan and how it is imagined."""
    return {
        'rollout': request.rollout,
        'trajectory_stamp_ns': request.stamp_ns,
        'mode': 'imagine' if request.imagine else 'observe',
        'seed': request.seed,
        'num_inference_steps': request.num_inference_steps,
        'instruction': request.instruction,
    }


def rejection_values(error: Rejection, trajectory_stamp_ns: int) -> dict[str, object]:
    """Keys and values of a trajectory that never became a rollout."""
    return {
        'trajectory_stamp_ns': trajectory_stamp_ns,
        'reason': error.reason.value,
        'text': str(error),
    }


def _estimate_values(chunk: Chunk) -> dict[str, object]:
    prediction = chunk.prediction
    success, masks = prediction.success, prediction.masks
    values: dict[str, object] = {
        'success': success.probability,
        'success_low': success.interval[0],
        'success_high': success.interval[1],
        'success_spread': success.spread,
        'success_num_seeds': success.num_seeds,
        'success_calibrated': success.is_calibrated,
        'success_reasons': '; '.join(success.reasons),
        'objects': masks.names,
        'segmenter': prediction.segmenter,
    }
    for row, view in enumerate(prediction.rollout.video.views):
        for column, name in enumerate(masks.names):
            values[f'jaccard.{view}.{_key(name)}'] = float(success.jaccard[row, column])
            values[f'mask_status.{view}.{_key(name)}'] = masks.status[row][column]
    return values


def fidelity_values(scored: Scored) -> dict[str, object]:
    """Keys and values of a chunk whose real frames came."""
    prediction, found = scored.chunk.prediction, scored.fidelity
    values: dict[str, object] = {
        **request_values(scored.chunk.request),
        'chunk': prediction.chunk,
        'frames_compared': found.num_frames,
        'fidelity_jaccard': found.mean,
    }
    for row, view in enumerate(prediction.rollout.video.views):
        for column, name in enumerate(found.names):
            values[f'fidelity.{view}.{_key(name)}'] = float(found.jaccard[row, column])
            values[f'fidelity_copy.{view}.{_key(name)}'] = float(found.copy[row, column])
    return values


def _trust_values(chunk: Chunk, level: float) -> dict[str, object]:
    """How far the chunk's end is from the last real frame, and how far J is to be trusted [s]."""
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
