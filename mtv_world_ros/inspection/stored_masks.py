"""Plausibility check of the object masks that an import stored."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data.episode import Episode, MASKS_BY
from mtv_world_ros.inspection.inspection_report import Finding, suspicious

#: minimum fraction of the frames of a view in which an object must have a mask
_SEEN = 0.5
#: maximum fraction of a still camera's image that an object fills; more is probably background
_LARGE = 0.15


def check_masks(episode: Episode) -> tuple[dict[str, str], list[Finding]]:
    """Count how often a segmenter's masks show each object, by view; with notes on oddities."""
    by = episode.info.metadata.get(MASKS_BY, '')
    areas = episode.mask_areas() if by else {}
    measures, findings = {}, []
    for number, name in enumerate(episode.info.objects if areas else ()):
        seen = {view: float((area[number] > 0).mean()) for view, area in areas.items()}
        measures[f'{name}, seen in'] = ', '.join(f'{v} {s:.0%}' for v, s in seen.items())
        if max(seen.values()) < _SEEN:
            findings.append(
                suspicious(
                    f"object '{name}' is found in {max(seen.values()):.0%} of the frames of a "
                    f"view at most, by '{by}': name it otherwise, or draw boxes (--objects)"
                )
            )
        large = [v for v, area in areas.items() if np.median(area[number]) > _LARGE]
        if len(large) == len(areas):
            findings.append(
                suspicious(
                    f"object '{name}' fills more than {_LARGE:.0%} of every view, by '{by}': "
                    'is that the object, or what lies behind it?'
                )
            )
    return measures, findings
