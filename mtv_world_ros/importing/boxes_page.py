"""A page of first frames on which somebody draws boxes around objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mtv_world_ros.core.documents import clicked_frame, render
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.importing.object_boxes import LEAST_SIDE

#: recordings that are shown at most, spread evenly
_MOST = 40


def boxes_page(
    found: Mapping[str, Any], read: Callable[[Any], Episode], names: Sequence[str] = ()
) -> str:
    """Return the page, in HTML.

    Args:
        found: the recordings by name.
        read: function that reads a recording.
        names: names of objects, to choose from.

    Raises:
        MtvWorldError: a recording cannot be read.
    """
    chosen = np.unique(np.linspace(0, len(found) - 1, min(_MOST, len(found))).astype(int))
    recordings = list(found.items())
    views: dict[str, list[dict[str, object]]] = {}
    for number in chosen:
        name, recording = recordings[int(number)]
        for view, track in read(recording).images.items():
            if len(track.stamps_ns):
                frame = np.asarray(track.frames[0])
                views.setdefault(view, []).append(clicked_frame(name, 0.0, frame))
    return render(
        'boxes.html.j2', title='Where are the objects?', file='objects.yaml', views=views,
        names=list(names), least=LEAST_SIDE, left_out=len(found) - len(chosen),
    )  # fmt: skip
