"""Names of views, made of the names of their image topics."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from mtv_world_ros.data.bag.unused_topics import has_no_colours, plain_topic

#: parts of an image topic's name that say nothing of the view
_NOT_A_VIEW = {'image', 'image_raw', 'image_rect', 'image_color', 'image_rect_color', 'color',
               'rgb', 'camera', 'image_rect_raw', 'image_rectified', 'rect', 'raw', 'rectified',
               'image_mono'}  # fmt: skip


def guess_views(topics: Collection[str]) -> dict[str, str]:
    """Return image topics by a view's name: the last part of the topic that tells views apart.

    Depth, infrared and masks are left out. Of raw and compressed images of a view the raw ones
    are taken, of several forms of them (`image_raw`, `image_rect`) the first by name.
    """
    found: dict[tuple[str, ...], str] = {}
    for topic in sorted(topics):
        plain = plain_topic(topic)
        if not has_no_colours(plain):
            parts = [part for part in plain.split('/') if part]
            told = tuple(part for part in parts if part not in _NOT_A_VIEW)
            found.setdefault(told or ('camera',), plain)
    names = _told_apart({parts: parts for parts in found})
    if len(set(names.values())) < len(names):
        names = {parts: '_'.join(parts) for parts in found}
    return {names[parts]: topic for parts, topic in found.items()}


def _told_apart(
    wanted: Mapping[tuple[str, ...], Sequence[str]],
) -> dict[tuple[str, ...], str]:
    """Return the last part of each name; of those that end alike, the part to the left of it.

    Args:
        wanted: parts of each name that are not looked at yet, by all of its parts.
    """
    alike: dict[str, list[tuple[str, ...]]] = {}
    for parts, ahead in wanted.items():
        alike.setdefault(ahead[-1], []).append(parts)
    names = {}
    for last, group in alike.items():
        ahead = {parts: wanted[parts][:-1] for parts in group}
        if len(group) > 1 and all(ahead.values()):
            names |= _told_apart(ahead)
        else:  # one that has no further part is told apart by all of its parts
            names |= {parts: last if len(group) == 1 else '_'.join(parts) for parts in group}
    return names
