"""Inspects a folder of episodes: each one, where its cameras stand, and what does not belong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mtv_world_ros.core.data_types import ByteArray, CameraModel
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.shown_text import markdown_cell
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.data.episode import Episode, MASKS_BY
from mtv_world_ros.inspection.inspect import Inspector
from mtv_world_ros.inspection.inspection_report import (
    aligned_rows,
    broken,
    Finding,
    Inspection,
    NUMBERS,
    Section,
    suspicious,
    VERDICTS,
    worst_verdict,
)
from mtv_world_ros.inspection.places import background, CameraPlaces, find_places

#: height of the line with an episode's name [px]
_NAME_PX = 20
#: width of one view in the overview picture [px]
_TILE_WIDTH_PX = 320
#: maximum number of episodes in the overview picture
_MAX_ROWS = 24
#: minimum shift of the projected robot after a camera moved; if smaller, the pose was not updated
#: [fraction of the background's shift]
_MIN_POSE_SHIFT = 0.25
#: larger shifts of the background count like this one [fraction of image width]
_MAX_BACKGROUND_SHIFT = 0.04
#: relative difference of focal lengths above which the views are of different cameras
_SAME_FOCAL = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderInspection:
    """Inspections of the episodes of a folder.

    Attributes:
        episodes: inspection of each episode, by name.
        failed: reasons why episodes could not be inspected, by name.
        places: places of each view's camera in `members`, by view.
        members: names of the episodes that have the view, by view.
        findings: findings about all episodes.
        notes: other things to know of all episodes.
    """

    episodes: dict[str, Inspection]
    failed: dict[str, str]
    places: dict[str, CameraPlaces]
    members: dict[str, list[str]]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst of all."""
        found = [inspection.verdict for inspection in self.episodes.values()]
        found += ['broken'] * bool(self.failed)
        return worst_verdict([*found, *(finding.verdict for finding in self.findings)])

    def place(self, view: str, name: str) -> str:
        """Return the place of an episode's camera, in a word."""
        if name not in self.members.get(view, []):
            return '-'
        return str(self.places[view].place[self.members[view].index(name)])


def inspect_folder(
    paths: Iterable[Path], inspector: Inspector, read: Callable[[Path], Episode]
) -> tuple[FolderInspection, dict[str, dict[str, ByteArray]]]:
    """Inspect episodes; return the inspection and the overlay pictures by episode and view.

    Args:
        paths: folders of the episodes.
        inspector: inspector of their robot.
        read: function that reads one episode.
    """
    inspections: dict[str, Inspection] = {}
    failed: dict[str, str] = {}
    pictures: dict[str, dict[str, ByteArray]] = {}
    backgrounds: dict[str, dict[str, ByteArray]] = {}
    known: dict[str, dict[str, CameraModel]] = {}
    posed: dict[str, dict[str, CameraModel]] = {}
    segmenters: dict[str, list[str]] = {}
    for path in paths:
        try:
            episode = read(path)
            inspections[path.name] = inspector.inspect(episode)
            pictures[path.name] = {
                view: inspector.picture(episode, view) for view in episode.views
            }
        except MtvWorldError as error:
            failed[path.name] = str(error)
            continue
        by = episode.info.metadata.get(MASKS_BY, '')
        if episode.masks and by:
            segmenters.setdefault(by, []).append(path.name)
        for view in episode.views:
            if inspector.stands_still(episode, view):
                backgrounds.setdefault(view, {})[path.name] = background(episode.images[view])
            unknown = episode.unknown.get(view, '')
            if not unknown:
                posed.setdefault(view, {})[path.name] = episode.cameras[view]
            if 'intrinsics' not in unknown:
                known.setdefault(view, {})[path.name] = episode.cameras[view]
    places = {view: find_places(list(found.values())) for view, found in backgrounds.items()}
    members = {view: list(found) for view, found in backgrounds.items()}
    found = FolderInspection(
        episodes=inspections, failed=failed, places=places, members=members,
        findings=(*_focal_findings(known), *_segmenter_findings(segmenters)),
    )  # fmt: skip
    return _with_places(_with_strangers(found), posed), pictures


def _focal_findings(known: dict[str, dict[str, CameraModel]]) -> list[Finding]:
    found = []
    for view, cameras in known.items():
        each = {name: camera.K[0, 0] / camera.width for name, camera in cameras.items()}
        middle = float(np.median(list(each.values())))
        others = [name for name, value in each.items() if abs(value / middle - 1) > _SAME_FOCAL]
        if others:
            found.append(
                suspicious(
                    f"view '{view}': the focal length of {', '.join(others)} differs from that of "
                    'the other episodes: another camera, or an estimate of one episode alone '
                    '(mtv-world fit camera FOLDER --focal estimate takes all)'
                )
            )
    return found


def _segmenter_findings(segmenters: dict[str, list[str]]) -> list[Finding]:
    """Report masks by other segmenters or other examples: they are of other pixels."""
    if len(segmenters) < 2:
        return []
    groups = '; '.join(f"'{by}': {' '.join(names)}" for by, names in segmenters.items())
    return [
        suspicious(
            f'masks are not by one segmenter ({groups}): import all with the same --segmenter or '
            '--objects'
        )
    ]


def _with_strangers(found: FolderInspection) -> FolderInspection:
    """Name episodes whose pictures share nothing with the others.

    Where the robot moves as it is drawn, the camera is the right one and the scene another.
    """
    inspections, notes = dict(found.episodes), list(found.notes)
    for view, places in found.places.items():
        names = found.members[view]
        alone = np.isinf(places.apart).sum(axis=1) == len(names) - 1
        if len(names) > 2 and alone.any() and not alone.all():
            for number in np.flatnonzero(alone):
                name = names[int(number)]
                text = f"view '{view}' shares no background with any other episode: another "
                if _fits(found, view, name):
                    notes.append(f'{name}: {text}scene, or light')
                    continue
                text += 'camera or scene, a mirrored or turned image'
                inspections[name] = _with(inspections[name], view, broken(text))
    return replace(found, episodes=inspections, notes=tuple(notes))


def _fits(found: FolderInspection, view: str, name: str) -> bool:
    """Return True if a view of an episode was checked completely and nothing is wrong."""
    sections = [section for section in found.episodes[name].views if section.name == view]
    return all(section.verdict == 'ok' for section in sections)


def _with_places(
    found: FolderInspection, posed: dict[str, dict[str, CameraModel]]
) -> FolderInspection:
    """Add a note on the places of each camera; a finding if one moved with an unchanged pose."""
    findings, notes = list(found.findings), list(found.notes)
    for view, places in found.places.items():
        names = found.members[view]
        count = len(set(places.place.tolist()))
        if count < 2:
            continue
        groups = [' '.join(np.array(names)[places.place == place]) for place in range(count)]
        text = f"view '{view}': the camera stands at {count} places ({'; '.join(groups)})"
        stale = _stale(names, places, posed.get(view, {}))
        if stale:
            pairs = ', '.join(f'{a} has the pose of {b}' for a, b in stale.items())
            findings.append(
                suspicious(
                    f'{text}, but {pairs}: one calibration for all is wrong (mtv-world '
                    'fit camera FOLDER)'
                )
            )
        else:
            notes.append(text)
    return replace(found, findings=tuple(findings), notes=tuple(notes))


def _stale(
    names: Sequence[str], places: CameraPlaces, posed: dict[str, CameraModel]
) -> dict[str, str]:
    """Episodes whose pose is that of an earlier one, though the camera was moved between them.

    Backgrounds that share nothing do not tell: another scene looks like that, too.
    """
    stale: dict[str, str] = {}
    for late, name in enumerate(names):
        for early, other in enumerate(names[:late]):
            if places.place[early] == places.place[late] or not {name, other} <= posed.keys():
                continue
            if np.isinf(places.apart[early, late]):
                continue
            shift = _shift(posed[other], posed[name])
            if shift < _MIN_POSE_SHIFT * min(places.apart[early, late], _MAX_BACKGROUND_SHIFT):
                stale.setdefault(name, other)
    return stale


def _shift(a: CameraModel, b: CameraModel) -> float:
    """Return the shift of a point at 1 m between two poses [fraction of image width]."""
    if a.mount_link != b.mount_link:
        return np.inf
    between = inverse(a.T_mount_camera) @ b.T_mount_camera
    turn = np.linalg.norm(Rotation.from_matrix(between[:3, :3]).as_rotvec())
    return float((turn + np.linalg.norm(between[:3, 3])) * a.K[0, 0] / a.width)


def _with(inspection: Inspection, view: str, finding: Finding) -> Inspection:
    def add(section: Section) -> Section:
        if section.name != view:
            return section
        return replace(section, findings=(*section.findings, finding))

    return replace(inspection, views=tuple(map(add, inspection.views)))


def table(found: FolderInspection) -> list[list[str]]:
    """Return the rows: episode, view, verdict, numbers, place of the camera, faults.

    The first is the head.

    A view is a row; what concerns all views of an episode is one more if something is wrong there.
    """
    rows = [
        ['episode', 'view', 'verdict', *(head for head, _ in NUMBERS.values()), 'place', 'wrong']
    ]
    for name, inspection in found.episodes.items():
        for section in inspection.sections:
            if section is inspection.recording and section.verdict == 'ok':
                continue
            place = found.place(section.name, name)
            cells = [name, section.name, section.verdict, *section.cells(), place]
            rows.append([*cells, ' / '.join(section.wrong)])
    for name, why in found.failed.items():
        rows.append([name, '-', 'broken', *('-' for _ in NUMBERS), '-', why])
    return rows


def _counts(found: FolderInspection) -> str:
    """Return how many views have each verdict, in words."""
    verdicts = [view.verdict for episode in found.episodes.values() for view in episode.views]
    each = [f'{verdicts.count(word)} {word}' for word in VERDICTS if word in verdicts]
    return f'{len(verdicts)} views: {", ".join(each)}'


def _conclusions(found: FolderInspection) -> list[str]:
    """Return the notes on all episodes; each check that was not possible is listed once."""
    unchecked: dict[str, list[str]] = {}
    for name, inspection in found.episodes.items():
        for section in inspection.sections:
            for text in section.unchecked:
                unchecked.setdefault(f'{section.name}: {text}', []).append(name)
    return [
        _counts(found),
        *(f'{finding.verdict}: {finding.text}' for finding in found.findings),
        *(f'not checked in {" ".join(names)}: {text}' for text, names in unchecked.items()),
        *found.notes,
    ]


def broken_parts(found: FolderInspection) -> dict[str, dict[str, str]]:
    """Return why views, or the `recording`, are broken, by episode and view."""
    parts: dict[str, dict[str, str]] = {}
    for name, inspection in found.episodes.items():
        texts = {
            section.name: '; '.join(f.text for f in section.findings if f.verdict == 'broken')
            for section in inspection.sections
        }
        parts[name] = {section: text for section, text in texts.items() if text}
    return parts | {name: {'recording': why} for name, why in found.failed.items()}


def folder_text(found: FolderInspection) -> str:
    """Return the table as text, followed by findings about all episodes."""
    return '\n'.join([*aligned_rows(table(found)), *_conclusions(found)])


def folder_markdown(found: FolderInspection, picture: str) -> str:
    """Return the report of all episodes, in Markdown."""
    head, *rows = table(found)
    lines = [f'# {found.verdict}', '', *(f'- {line}' for line in _conclusions(found))]
    lines += ['', f'| {" | ".join(head)} |', f'|{"---|" * len(head)}']
    lines += [f'| {" | ".join(map(markdown_cell, row))} |' for row in rows]
    return '\n'.join([*lines, '', f'![all episodes]({picture})', ''])


def folder_picture(pictures: dict[str, dict[str, ByteArray]]) -> ByteArray | None:
    """Return the overview (H, W, 3, RGB), one row per episode; None without pictures."""
    rows = [_row(name, views) for name, views in list(pictures.items())[:_MAX_ROWS]]
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    return np.ascontiguousarray(np.vstack(padded))


def _row(name: str, views: dict[str, ByteArray]) -> ByteArray:
    tiles: Sequence[ByteArray] = [_small(picture) for picture in views.values()]
    height = min(tile.shape[0] for tile in tiles)
    row = np.hstack([tile[:height] for tile in tiles])
    # above the pictures, which have times in their corners
    row = np.ascontiguousarray(np.pad(row, ((_NAME_PX, 0), (0, 0), (0, 0))))
    cv2.putText(row, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 0))
    return row


def _small(picture: ByteArray) -> ByteArray:
    """Return the first of the picture's frames, small."""
    half = picture[: picture.shape[0] // 2, : picture.shape[1] // 2]
    height = round(half.shape[0] * _TILE_WIDTH_PX / half.shape[1])
    return np.asarray(
        cv2.resize(half, (_TILE_WIDTH_PX, height), interpolation=cv2.INTER_AREA), np.uint8
    )
