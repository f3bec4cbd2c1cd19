"""Streams in the Rerun viewer: native, in a browser, or as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.evaluation.results import StoredRollout
from mtv_world_ros.viewing.streams import KINDS, Streams

APPLICATION = 'mtv_world'
#: RGB of outlines, by number of the object
_COLOURS = ((230, 60, 60), (60, 140, 240), (60, 190, 90), (240, 180, 40), (180, 90, 220))
_TIMELINE = 'time'


def recording(name: str) -> Any:
    """Returns a new Rerun recording.

    Raises:
        ConfigError: the Rerun SDK is not installed.
    """
    try:
        import rerun
    except ModuleNotFoundError as error:
        raise ConfigError(
            "the viewer is not installed: pip install 'mtv_world_ros[view]'"
        ) from error
    return rerun.RecordingStream(APPLICATION, recording_id=name)


def log_streams(stream: Any, streams: Streams, root: str = '') -> None:
    """Logs everything that a bag shows, on a timeline in seconds from its first frame.

    Args:
        stream: of `recording`.
        streams: what is shown.
        root: path of its entities.
    """
    import rerun

    begin = min(found[0][0] for found in streams.images.values())

    def log(stamp_ns: int, path: str, shown: Any) -> None:
        stream.set_time(_TIMELINE, duration=(stamp_ns - begin) * 1e-9)
        stream.log(f'{root}/{path}', shown)

    images = ((key, *item) for key, frames in streams.images.items() for item in frames)
    for (kind, view), stamp, frame in images:
        log(stamp, f'{view}/{kind}', rerun.Image(frame).compress(jpeg_quality=92))
    outlines = ((key, *item) for key, masks in streams.masks.items() for item in masks)
    for (kind, view), stamp, labels in outlines:
        log(stamp, f'{view}/{kind}/outlines', _outlines(labels))
    joints = ((*row[:2], pair) for row in streams.joints for pair in zip(*row[2:], strict=True))
    for kind, stamp, (name, value) in joints:
        log(stamp, f'joints/{kind}/{name}', rerun.Scalars(float(value)))
    for stamp, value in streams.success:
        log(stamp, 'success', rerun.Scalars(value))
    for stamp, text in streams.words:
        log(stamp, 'words', rerun.TextLog(text))


def log_rollout(stream: Any, rollout: StoredRollout, root: str) -> None:
    """Logs a scored episode: frames of all kinds, masks outlined, J per object."""
    import rerun

    for index, time in enumerate(rollout.times):
        stream.set_time(_TIMELINE, duration=float(time))
        for v, view in enumerate(rollout.views):
            shown = {'real': rollout.true_masks, 'imagined': rollout.masks}
            for kind in KINDS:
                frame = np.asarray(getattr(rollout, kind)[v, index])
                stream.log(f'{root}/{view}/{kind}', rerun.Image(frame).compress(jpeg_quality=92))
                if kind in shown:
                    labels = np.zeros(frame.shape[:2], np.uint8)
                    for number, mask in enumerate(shown[kind][v, :, index], start=1):
                        labels[mask] = number
                    stream.log(f'{root}/{view}/{kind}/outlines', _outlines(labels))
            for o, name in enumerate(rollout.objects):
                value = float(rollout.j[v, o, index])
                stream.log(f'{root}/J/{view}/{name}', rerun.Scalars(value))


def _outlines(labels: ByteArray) -> Any:
    """Edges of the objects of a label image."""
    import rerun

    strips, colours = [], []
    for number in np.unique(labels[labels > 0]):
        edges, _ = cv2.findContours(
            (labels == number).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        for edge in edges:
            strips.append(np.concatenate([edge[:, 0], edge[:1, 0]]).astype(np.float32) + 0.5)
            colours.append(_COLOURS[(int(number) - 1) % len(_COLOURS)])
    return rerun.LineStrips2D(strips, colors=colours, radii=-1.0)


def layout(roots: dict[str, Streams | StoredRollout]) -> Any:
    """Returns the blueprint: a tab per root; a row per view, its kinds side by side; curves.

    Args:
        roots: what was logged, by path of its entities.
    """
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Tabs(*(_tab(root, shown, rrb) for root, shown in roots.items())), collapse_panels=True
    )


def _tab(root: str, shown: Streams | StoredRollout, rrb: Any) -> Any:
    kinds = shown.kinds if isinstance(shown, Streams) else KINDS
    rows = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=f'{root}/{view}/{kind}', name=f'{view}: {kind}')
                for kind in kinds
            )
        )
        for view in shown.views
    ]
    if isinstance(shown, Streams):
        below = [
            rrb.TimeSeriesView(origin=f'{root}/joints', name='joints'),
            rrb.TextLogView(origin=f'{root}/words', name='reports'),
        ]
        if shown.success:
            below.insert(1, rrb.TimeSeriesView(origin=f'{root}/success', name='success'))
    else:
        below = [rrb.TimeSeriesView(origin=f'{root}/J', name='J per object')]
    name = root.strip('/') or 'recording'
    return rrb.Vertical(*rows, rrb.Horizontal(*below), row_shares=[3] * len(rows) + [2], name=name)


def save(stream: Any, blueprint: Any, path: Path) -> None:
    """Sends what is logged from here on to a file for `rerun FILE`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stream.save(str(path), default_blueprint=blueprint)


def serve(stream: Any, blueprint: Any, port: int) -> str:
    """Serves the viewer to browsers on this machine; returns its address.

    Raises:
        ConfigError: the port, or the one above it for the data, is taken.
    """
    import rerun

    for number in (port, port + 1):
        _check_port(number)
    data = stream.serve_grpc(grpc_port=port + 1, default_blueprint=blueprint)
    rerun.serve_web_viewer(web_port=port, open_browser=False, connect_to=data)
    return f'http://localhost:{port}/?url={data}'


def _check_port(port: int) -> None:
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(('127.0.0.1', port))
        except OSError as error:
            raise ConfigError(
                f'port {port} cannot be used ({error.strerror}); give another --port (the data '
                'take the one above it)'
            ) from error
