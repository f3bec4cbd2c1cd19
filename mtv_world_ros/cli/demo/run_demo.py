"""Runs the demo, reads back what the node published, and writes a table, pictures and a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.cli.demo.node_processes import DemoOptions, NODE, record_through_node
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.estimate_words import estimate_lines
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.core.images import write_png
from mtv_world_ros.data.bag.image_decoding import raw_to_rgb
from mtv_world_ros.data.bag.messages import deserialize, header_stamp
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.evaluation.imagined_stretches import Stretch
from mtv_world_ros.evaluation.metrics.jaccard_scores import (
    episode_means,
    score_frames,
    score_rows,
    ScoreRow,
    true_masks,
)
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.viewing.video import Comparison, contact_sheet, side_by_side, write_video
from mtv_world_ros.vision.segmenters.choose import choose_segmenter

#: line above the table
_ABOUT_J = (
    'J: overlap of an object in imagined and real frames, 0 = none, 1 = the same pixels; still: '
    'the same of a still picture, the first frame held'
)


def run_demo(episode: Path, out: Path, options: DemoOptions) -> str:
    """Replay an episode through the node and return the printed table.

    Writes `contact_sheet.png`, `comparison.mp4`, `predictions/` and `report.json` into `out`.

    Raises:
        EpisodeError: the episode cannot be used or a process failed.
    """
    checkpoint = Checkpoint.open(options.checkpoint)
    spec, robot = checkpoint.spec, checkpoint.load_robot()
    recording = load_recording(episode, spec, robot)
    record_through_node(episode, spec.views, out, options)
    predictions = read_predictions(out / 'predictions', spec.views)
    comparison, rows = _score(recording, predictions.chunks, spec.views)
    report = _report(recording, predictions, rows, spec.views)
    write_whole(out / 'report.json', json.dumps(report, indent=2) + '\n')
    notes = sheet_notes(report, spec.views)
    text = '\n'.join([*_object_rows(report), *notes, *_speed_notes(report)])
    sheet = contact_sheet(comparison, title=recording.instruction, notes=notes)
    write_png(out / 'contact_sheet.png', sheet)
    write_video(out / 'comparison.mp4', side_by_side(comparison), spec.fps)
    return f'{text}\n\nwritten to {out}: contact_sheet.png comparison.mp4 predictions/ report.json'


def _score(
    recording: Recording, chunks: Sequence[RecordedChunk], views: tuple[str, ...]
) -> tuple[Comparison, list[ScoreRow]]:
    """Return the frames that are both recorded and imagined, and their J."""
    segmenter = choose_segmenter('colour')
    rows: list[ScoreRow] = []
    shown: list[tuple[np.ndarray, ...]] = []
    for index, chunk in enumerate(chunks):
        start_ns = int(chunk.report['observation_stamp_ns'])
        indices = _frames_at(recording, np.concatenate([[start_ns], chunk.stamps_ns]))
        kept = len(indices) - 1
        if kept < 1:
            continue
        stretch = Stretch.of(recording, index, indices)
        truth = true_masks(stretch, segmenter, recording.objects, recording.objects, use_ids=False)
        predicted = chunk.predicted[:, :kept]
        scores = score_frames(predicted, truth, segmenter)
        rows += score_rows(stretch, views, truth, scores, {})
        times = (chunk.stamps_ns[:kept] - recording.stamp_ns) * 1e-9
        shown.append((times, stretch.frames[:, 1:], chunk.trajectory[:, :kept], predicted))
    times, real, trajectory, imagined = (
        np.concatenate(column, axis=min(part, 1))
        for part, column in enumerate(zip(*shown, strict=True))
    )
    comparison = Comparison(
        views=views, times=times, real=real, trajectory=trajectory, imagined=imagined
    )
    return comparison, rows


def _frames_at(recording: Recording, stamps_ns: np.ndarray) -> np.ndarray:
    """Return the recorded frames at the stamps, up to the recording's end."""
    seconds = (stamps_ns - recording.stamp_ns) * 1e-9
    inside = seconds <= recording.times[-1] + 0.05
    return np.abs(recording.times[None] - seconds[inside, None]).argmin(axis=1)


def _report(
    recording: Recording,
    predictions: Predictions,
    rows: Sequence[ScoreRow],
    views: tuple[str, ...],
) -> dict[str, Any]:
    reports = [chunk.report for chunk in predictions.chunks]
    sent = [r for r in predictions.reports if r.get('state') == 'published']
    published = sum(int(report['frames_published']) for report in sent) * len(views)
    keys = ('j_object_mean', 'j_moving', 'j_copy_mean', 'j_copy_moving')
    means = {view: episode_means(rows, view) for view in views}
    judged = _whole_chunks(recording, predictions.chunks)
    success = float(judged[-1].report['success'])
    return {
        'episode': recording.path.name,
        'instruction': recording.instruction,
        'outcome': recording.outcome,
        'chunks': len(reports),
        'frames_published': published,
        'frames_received': predictions.num_frames,
        'camera_infos_received': predictions.num_infos,
        'latency_s': [float(report['latency_s']) for report in reports],
        'lead_s': [float(report['lead_s']) for report in reports],
        'real_time_factor': float(np.median([float(r['real_time_factor']) for r in reports])),
        'success': _known(success),
        'success_by_chunk': [_known(float(chunk.report['success'])) for chunk in judged],
        'success_reasons': judged[-1].report['success_reasons'],
        'reasons_by_chunk': [chunk.report['success_reasons'] for chunk in judged],
        'views': {view: {key: _known(means[view][key]) for key in keys} for view in views},
        'objects': [
            {
                'view': row.view,
                'object': row.name,
                'chunk': row.stretch,
                'moving': row.moving,
                'status': row.status,
                'j': _known(row.j),
                'j_copy': _known(row.j_copy),
            }
            for row in rows
            if row.name
        ],
    }


def _whole_chunks(
    recording: Recording, chunks: Sequence[RecordedChunk]
) -> Sequence[RecordedChunk]:
    """Return the chunks that start before the recording ends."""
    end_ns = recording.stamp_ns + round(float(recording.times[-1]) * 1e9)
    return [c for c in chunks if int(c.report['observation_stamp_ns']) < end_ns] or chunks


def _known(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _object_rows(report: dict[str, Any]) -> list[str]:
    lines = [_ABOUT_J, f'{"view":8} {"object":16} {"chunk":>5} {"moves":>5} {"J":>6} {"still":>6}']
    for row in report['objects']:
        lines.append(
            f'{row["view"]:8} {row["object"]:16} {row["chunk"]:5d} '
            f'{"yes" if row["moving"] else "no":>5} {_number(row["j"])} {_number(row["j_copy"])}'
            f'{"" if row["status"] == "ok" else "  " + row["status"]}'
        )
    return lines


def sheet_notes(report: dict[str, Any], views: tuple[str, ...]) -> list[str]:
    """Return the lines below the contact sheet; none depends on the load of the machine."""
    lines = []
    for view in views:
        means = report['views'][view]
        lines.append(
            f'{view:8} moving objects: J {_number(means["j_moving"])}, still picture '
            f'{_number(means["j_copy_moving"])}; all objects: J {_number(means["j_object_mean"])}'
        )
    lines += estimate_lines(
        f'success after each chunk (recorded outcome: {report["outcome"]})',
        report['success_by_chunk'],
        report['reasons_by_chunk'],
    )
    return lines


def _speed_notes(report: dict[str, Any]) -> list[str]:
    lines = []
    latencies = ', '.join(f'{value:.2f}' for value in report['latency_s'])
    lines.append(f'from a plan to the verdict on each chunk: {latencies} s')
    leads = ', '.join(map(_early_or_late, report['lead_s']))
    lines.append(f'verdicts, against the end of the motion that they are about: {leads}')
    lines.append(
        f'{report["chunks"]} chunks (parts of a plan that are imagined at once), '
        f'{report["frames_received"]} of {report["frames_published"]} frames received; '
        f'{report["real_time_factor"]:.1f} s of video for a second of computing'
    )
    return lines


def _early_or_late(lead_s: float) -> str:
    return f'{abs(lead_s):.2f} s {"before" if lead_s >= 0 else "after"} it'


def _number(value: float | None) -> str:
    return '     -' if value is None else f'{value:6.3f}'


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedChunk:
    """A chunk as a subscriber saw it.

    Attributes:
        report: rows of `~/report`, as text by key.
        stamps_ns: (T,) predicted times.
        predicted: (V, T, H, W, 3) uint8 RGB.
        trajectory: (V, T, H, W, 3) uint8 RGB.
    """

    report: dict[str, str]
    stamps_ns: np.ndarray
    predicted: ByteArray
    trajectory: ByteArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Everything that was recorded from the node; counts of images are over all views."""

    chunks: tuple[RecordedChunk, ...]
    reports: tuple[dict[str, str], ...]
    num_frames: int
    num_infos: int


def read_predictions(bag: Path, views: Sequence[str]) -> Predictions:
    """Read the bag that the recorder made.

    Raises:
        EpisodeError: no chunk in it, or a frame of a chunk is missing.
    """
    images: dict[tuple[str, int], list[ByteArray]] = {}
    reports: list[dict[str, str]] = []
    num_infos = 0
    reader = BagReader(bag)
    for message in reader.messages():
        name = message.topic.removeprefix(f'{NODE}/')
        if name.endswith('/image_raw'):
            decoded = deserialize(message.msgtype, message.data)
            key = (name.removesuffix('/image_raw'), header_stamp(decoded))
            images.setdefault(key, []).append(raw_to_rgb(decoded))
        elif name.endswith('/predicted/camera_info'):
            num_infos += 1
        elif name == 'report':
            reports += _values(deserialize(message.msgtype, message.data))
    chunks = [report for report in reports if report.get('state') == 'chunk']
    if not chunks:
        states = '; '.join(report.get('text', report.get('state', '')) for report in reports)
        raise EpisodeError(
            f"'{bag}' holds no imagined chunk; the node reported: {states or 'none'}"
        )
    return Predictions(
        chunks=tuple(_chunk(report, images, views) for report in chunks),
        reports=tuple(reports),
        num_frames=sum(len(v) for k, v in images.items() if k[0].endswith('/predicted')),
        num_infos=num_infos,
    )


def _values(array: Any) -> list[dict[str, str]]:
    return [{pair.key: pair.value for pair in status.values} for status in array.status]


def _chunk(
    report: dict[str, str],
    images: dict[tuple[str, int], list[ByteArray]],
    views: Sequence[str],
) -> RecordedChunk:
    first, last = int(report['first_stamp_ns']), int(report['last_stamp_ns'])
    count = int(report['frames'])
    stamps = sorted({s for (name, s) in images if name == f'{views[0]}/predicted'})
    inside = np.array([s for s in stamps if first <= s <= last])
    if len(inside) != count:
        raise EpisodeError(
            f'{len(inside)} of {count} frames of rollout {report.get("rollout")} chunk '
            f'{report.get("chunk")} were received; the machine was too busy, run the demo again'
        )
    # where rollouts overlap, a stamp was predicted twice; each chunk takes the oldest left
    frames = {
        stream: np.stack(
            [np.stack([_take(images, (f'{v}/{stream}', int(s))) for s in inside]) for v in views]
        )
        for stream in ('predicted', 'trajectory')
    }
    return RecordedChunk(
        report=report,
        stamps_ns=inside,
        predicted=frames['predicted'],
        trajectory=frames['trajectory'],
    )


def _take(images: dict[tuple[str, int], list[ByteArray]], key: tuple[str, int]) -> ByteArray:
    found = images.get(key)
    if not found:
        raise EpisodeError(f'no frame of {key[0]} at {key[1]} ns was received')
    return found.pop(0) if len(found) > 1 else found[0]
