"""Inspects a folder of episodes: each one, where its cameras stand, and what does not belong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.lab.inspection.inspect import Inspector
from mtv_world_ros.lab.inspection.inspection_report import (
    broken,
    Finding,
    Inspection,
    Section,
    suspicious,
    worst,
)
from mtv_world_ros.lab.inspection.places import background, CameraPlaces, find_places

#: width of a tile of the picture, and the episodes it shows at most [px]
_TILE, _MOST_ROWS = 320, 24
#: focal lengths of a view that differ by more are of different cameras
_SAME_FOCAL = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderInspection:
    """Inspections of the episodes of a folder.

    Attributes:
        episodes: one of each, by name.
        failed: why an episode could not be inspected, by name.
        places: where each view's camera stands in `members`, by view.
        members: names of the episodes that have the view, by view.
        findings: about all episodes.
    """

    episodes: dict[str, Inspection]
    failed: dict[str, str]
    places: dict[str, CameraPlaces]
    members: dict[str, list[str]]
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> str:
        """The worst of all."""
        found = [inspection.verdict for inspection in self.episodes.values()]
        found += ['broken'] * bool(self.failed)
        return worst([*found, *(finding.verdict for finding in self.findings)])

    def place(self, view: str, name: str) -> str:
        """The place of an episode's camera, in a word."""
        if name not in self.members.get(view, []):
            return '-'
        return str(self.places[view].place[self.members[view].index(name)])


def inspect_folder(
    paths: Iterable[Path], inspector: Inspector, read: Callable[[Path], Episode]
) -> tuple[FolderInspection, dict[str, dict[str, ByteArray]]]:
    """Inspects episodes, and returns overlay pictures by episode and view beside.

    Args:
        paths: of the episodes.
        inspector: of their robot.
        read: reads one.
    """
    inspections: dict[str, Inspection] = {}
    failed: dict[str, str] = {}
    pictures: dict[str, dict[str, ByteArray]] = {}
    backgrounds: dict[str, dict[str, ByteArray]] = {}
    focal: dict[str, dict[str, float]] = {}
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
        for view in episode.views:
            if inspector.stands_still(episode, view):
                backgrounds.setdefault(view, {})[path.name] = background(episode.images[view])
            camera = episode.cameras[view]
            if 'intrinsics' in episode.unknown.get(view, ''):
                continue
            focal.setdefault(view, {})[path.name] = float(camera.K[0, 0]) / camera.width
    places = {view: find_places(list(found.values())) for view, found in backgrounds.items()}
    members = {view: list(found) for view, found in backgrounds.items()}
    found = FolderInspection(
        episodes=inspections, failed=failed, places=places, members=members,
        findings=(*_focal_findings(focal),),
    )  # fmt: skip
    return _with_strangers(found), pictures


def _focal_findings(focal: dict[str, dict[str, float]]) -> list[Finding]:
    found = []
    for view, each in focal.items():
        middle = float(np.median(list(each.values())))
        others = [name for name, value in each.items() if abs(value / middle - 1) > _SAME_FOCAL]
        if others:
            found.append(
                suspicious(
                    f"view '{view}': the focal length of {', '.join(others)} differs from that of "
                    'the other episodes: another camera, or an estimate of one episode alone '
                    '(mtv-world calibrate-camera FOLDER --focal estimate takes all)'
                )
            )
    return found


def _with_strangers(found: FolderInspection) -> FolderInspection:
    """Names moved cameras, and episodes whose pictures share nothing with the others."""
    findings, inspections = list(found.findings), dict(found.episodes)
    for view, places in found.places.items():
        names = found.members[view]
        count = len(set(places.place.tolist()))
        alone = np.isinf(places.apart).sum(axis=1) == len(names) - 1
        if len(names) > 2 and alone.any() and not alone.all():
            for number in np.flatnonzero(alone):
                name = names[int(number)]
                text = (
                    f"view '{view}' shares no background with any other episode: another camera "
                    'or scene, a mirrored or turned image'
                )
                inspections[name] = _with(inspections[name], view, broken(text))
        if count > 1:
            groups = [' '.join(np.array(names)[places.place == place]) for place in range(count)]
            findings.append(
                suspicious(
                    f"view '{view}': the camera stands at {count} places ({'; '.join(groups)}): "
                    'one calibration for all is wrong (mtv-world calibrate-camera FOLDER)'
                )
            )
    return replace(found, findings=tuple(findings), episodes=inspections)


def _with(inspection: Inspection, view: str, finding: Finding) -> Inspection:
    def add(section: Section) -> Section:
        if section.name != view:
            return section
        return replace(section, findings=(*section.findings, finding))

    return replace(inspection, views=tuple(map(add, inspection.views)))


def table(found: FolderInspection) -> list[list[str]]:
    """Rows: episode, verdict, place of each view's camera, findings; the first is the head."""
    views = list(found.places)
    rows = [['episode', 'verdict', *(f'place of {view}' for view in views), 'findings']]
    for name, inspection in found.episodes.items():
        texts = [
            f'{section.name}: {finding.text}'
            for section in (*inspection.views, inspection.recording)
            for finding in section.findings
            if finding.verdict != 'not checked'
        ]
        places = [found.place(view, name) for view in views]
        rows.append([name, inspection.verdict, *places, ' / '.join(texts)])
    for name, why in found.failed.items():
        rows.append([name, 'broken', *('-' for _ in views), why])
    return rows


def folder_text(found: FolderInspection) -> str:
    """The table as text, with what concerns all episodes below."""
    rows = table(found)
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]) - 1)]
    lines = [
        '  '.join(
            [*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]
        )
        for row in rows
    ]
    lines += [f'{finding.verdict}: {finding.text}' for finding in found.findings]
    return '\n'.join(line.rstrip() for line in lines)


def folder_markdown(found: FolderInspection, picture: str) -> str:
    """The report of all episodes, in Markdown."""
    head, *rows = table(found)
    lines = [f'# {found.verdict}', '']
    lines += [f'- {finding.verdict}: {finding.text}' for finding in found.findings]
    lines += ['', f'| {" | ".join(head)} |', f'|{"---|" * len(head)}']
    lines += [f'| {" | ".join(cell.replace("|", "/") for cell in row)} |' for row in rows]
    return '\n'.join([*lines, '', f'![all episodes]({picture})', ''])


def folder_picture(pictures: dict[str, dict[str, ByteArray]]) -> ByteArray | None:
    """(H, W, 3) RGB: a row an episode, its views beside each other; None without any."""
    rows = [_row(name, views) for name, views in list(pictures.items())[:_MOST_ROWS]]
    if not rows:
        return None
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    return np.ascontiguousarray(np.vstack(padded))


def _row(name: str, views: dict[str, ByteArray]) -> ByteArray:
    tiles: Sequence[ByteArray] = [_small(picture) for picture in views.values()]
    height = min(tile.shape[0] for tile in tiles)
    row = np.ascontiguousarray(np.hstack([tile[:height] for tile in tiles]))
    cv2.putText(row, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 0))
    return row


def _small(picture: ByteArray) -> ByteArray:
    """The first of the picture's frames, small."""
    half = picture[: picture.shape[0] // 2, : picture.shape[1] // 2]
    height = round(half.shape[0] * _TILE / half.shape[1])
    return np.asarray(cv2.resize(half, (_TILE, height), interpolation=cv2.INTER_AREA), np.uint8)
