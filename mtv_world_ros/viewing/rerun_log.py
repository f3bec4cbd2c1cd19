"""Streams in the Rerun viewer: native, in a browser, or as a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import MissingPackageError, MtvWorldError
from mtv_world_ros.viewing.scored_rollout import ScoredRollout, StoredRollout
from mtv_world_ros.viewing.streams import Streams
from mtv_world_ros.viewing.video import KINDS
from mtv_world_ros.viewing.viewer_process import open_window, PageAddress, serve

APPLICATION = 'mtv_world'
#: RGB of outlines, by number of the object
_COLOURS = ((230, 60, 60), (60, 140, 240), (60, 190, 90), (240, 180, 40), (180, 90, 220))
_TIMELINE = 'time'
#: length of a file's beginning that has the recording's name [bytes]
_HEAD_BYTES = 1024
_OPEN_TO_OTHERS = 'Whoever reaches this address can see and copy what is shown, and write to it.'


def check_installed() -> None:
    """Raise a `ConfigError` where the Rerun SDK is not installed."""
    if find_spec('rerun') is None:
        raise MissingPackageError('the viewer', 'rerun')


def recording(name: str) -> Any:
    """Return a new Rerun recording.

    Raises:
        ConfigError: the Rerun SDK is not installed.
    """
    check_installed()
    import rerun

    return rerun.RecordingStream(APPLICATION, recording_id=name)


def is_recording(file: Path, name: str) -> bool:
    """Return whether a file is the recording of this name, also one that was cut off."""
    try:
        with file.open('rb') as stream:
            return name.encode() in stream.read(_HEAD_BYTES)
    except OSError:
        return False


def log_any(stream: Any, shown: Streams | ScoredRollout, root: str) -> None:
    """Log a bag or a scored rollout."""
    root = escaped(root)
    if isinstance(shown, Streams):
        log_streams(stream, shown, root)
    else:
        log_rollout(stream, shown, root)


def log_streams(stream: Any, streams: Streams, root: str, begin: int | None = None) -> None:
    """Log streams under an entity path, on a timeline in seconds.

    Second 0 is the stamp `begin` [ns], by default that of the first frame.
    """
    import rerun

    if begin is None:
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
    _mark_points(stream, f'{root}/success')
    for stamp, value in streams.success:
        log(stamp, 'success', rerun.Scalars(value))
    for stamp, text in streams.words:
        log(stamp, 'words', rerun.TextLog(text))


def log_rollout(stream: Any, scored: ScoredRollout, root: str) -> None:
    """Log a scored rollout: frames of all kinds, masks outlined, J per object, estimates."""
    import rerun

    rollout = scored.rollout
    for who, estimates in scored.estimates.items():
        _mark_points(stream, f'{root}/success/{who}')
        for time, value in estimates:
            stream.set_time(_TIMELINE, duration=time)
            stream.log(f'{root}/success/{who}', rerun.Scalars(value))
    for time, text in scored.words:
        stream.set_time(_TIMELINE, duration=time)
        stream.log(f'{root}/words', rerun.TextLog(text))
    _style_curves(stream, rollout, root)
    for index, time in enumerate(rollout.times):
        stream.set_time(_TIMELINE, duration=float(time))
        for v, view in enumerate(rollout.views):
            _log_view(stream, rollout, v, index, f'{root}/{view}')
            for o, name in enumerate(rollout.objects):
                value = float(rollout.j[v, o, index])
                stream.log(f'{root}/J/{view}/{escaped(name)}', rerun.Scalars(value))


def escaped(path: str) -> str:
    """Return an entity's path in Rerun's notation: spaces and signs have a backslash."""
    import rerun

    parts = (rerun.escape_entity_path_part(part) if part else '' for part in path.split('/'))
    return '/'.join(parts)


def _style_curves(stream: Any, rollout: StoredRollout, root: str) -> None:
    """Colour the curves of J like the objects' outlines, darker in each further view."""
    import rerun

    for o, name in enumerate(rollout.objects):
        for v, view in enumerate(rollout.views):
            colour = [round(part * 0.6**v) for part in _COLOURS[o % len(_COLOURS)]]
            lines = rerun.SeriesLines(colors=[colour], names=f'{name}, {view}')
            stream.log(f'{root}/J/{view}/{escaped(name)}', lines, static=True)


def _mark_points(stream: Any, path: str) -> None:
    """Mark the values of a curve: a single one draws no line."""
    import rerun

    lines, points = rerun.SeriesLines(widths=[1.5]), rerun.SeriesPoints(marker_sizes=[4.0])
    stream.log(path, lines, points, static=True)


def _log_view(stream: Any, rollout: StoredRollout, v: int, index: int, root: str) -> None:
    """Log frames of all kinds in a view, masks outlined."""
    import rerun

    shown = {'real': rollout.true_masks, 'imagined': rollout.masks}
    for kind in KINDS:
        frame = np.asarray(getattr(rollout, kind)[v, index])
        stream.log(f'{root}/{kind}', rerun.Image(frame).compress(jpeg_quality=92))
        if kind in shown:
            labels = np.zeros(frame.shape[:2], np.uint8)
            for number, mask in enumerate(shown[kind][v, :, index], start=1):
                labels[mask] = number
            stream.log(f'{root}/{kind}/outlines', _outlines(labels))


def _outlines(labels: ByteArray) -> Any:
    """Return the edges of the objects of a label image."""
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


def layout(roots: Mapping[str, Streams | ScoredRollout], table: str = '', active: int = 0) -> Any:
    """Return the blueprint: a tab per root; a row per view, its kinds side by side; curves.

    Args:
        roots: logged streams and rollouts, by path of their entities.
        table: path of a text that is a tab of its own, the first one; empty = none.
        active: number of the tab that is shown.
    """
    import rerun.blueprint as rrb

    tabs = [rrb.TextDocumentView(origin=escaped(table), name=table.strip('/'))] if table else []
    tabs += [_tab(root, shown, rrb) for root, shown in roots.items()]
    return rrb.Blueprint(rrb.Tabs(*tabs, active_tab=active), collapse_panels=True)


def _tab(root: str, shown: Streams | ScoredRollout, rrb: Any) -> Any:
    kinds, name, root = KINDS, root.strip('/') or 'recording', escaped(root)
    if isinstance(shown, Streams):
        kinds, views = shown.kinds, shown.views
        below = [rrb.TimeSeriesView(origin=f'{root}/joints', name='joints')]
        has_estimates = bool(shown.success)
    else:
        views, has_estimates = shown.rollout.views, bool(shown.estimates)
        below = [rrb.TimeSeriesView(origin=f'{root}/J', name='J per object')]
    rows = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=f'{root}/{view}/{kind}', name=f'{view}: {kind}')
                for kind in kinds
            )
        )
        for view in views
    ]
    if has_estimates:
        below.append(rrb.TimeSeriesView(origin=f'{root}/success', name='success'))
    below.append(rrb.TextLogView(origin=f'{root}/words', name='reports'))
    return rrb.Vertical(*rows, rrb.Horizontal(*below), row_shares=[3] * len(rows) + [2], name=name)


def open_viewer(
    stream: Any, blueprint: Any, address: PageAddress, save: Path | None, is_native: bool
) -> str:
    """Open the viewer for what is logged from here on; return a line for the user.

    Args:
        stream: stream of `recording`.
        blueprint: blueprint of `layout`; None = the viewer's own.
        address: address of the page for browsers.
        save: write a file for `rerun FILE` instead.
        is_native: open a window instead.

    Raises:
        ConfigError: a port is taken.
        MtvWorldError: the file cannot be written.
    """
    if save is not None:
        save.parent.mkdir(parents=True, exist_ok=True)
        with _disk_errors(save):
            stream.save(str(save), default_blueprint=blueprint)
        return f'written: {save}'
    if is_native:
        open_window(stream, blueprint)
        return 'opened a window'
    line = f'open {serve(stream, blueprint, address)}'
    return line if address.is_local else f'{line}\n{_OPEN_TO_OTHERS}'


def flush(stream: Any, save: Path | None) -> None:
    """Wait until the viewer or the file has all logged data.

    Raises:
        MtvWorldError: the file cannot be written; there is none then.
    """
    with _disk_errors(save):
        stream.flush()


@contextmanager
def _disk_errors(save: Path | None) -> Iterator[None]:
    """Name the file that the viewer's library cannot write, and remove what there is of it."""
    try:
        yield
    except RuntimeError as error:
        if save is None:
            raise
        save.unlink(missing_ok=True)
        raise MtvWorldError(
            f"'{save}' cannot be written: {error}; is its disk full? Make room, or choose another"
        ) from error
