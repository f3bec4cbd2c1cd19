"""Segmenters by name: those of the package, of entry points, and of `module:Class`."""

from __future__ import annotations

from collections.abc import Mapping

from mtv_world_ros.core.entry_points import SEGMENTERS as GROUP
from mtv_world_ros.core.registry import Registry

_HERE = 'mtv_world_ros.vision.segmenters'
#: ending of a file of examples, `objects.safetensors`, which is a choice, too
EXAMPLES_SUFFIX = '.safetensors'
#: name -> class, imported when it is chosen
SEGMENTERS: Mapping[str, str] = {
    'auto': f'{_HERE}.choose:Auto',
    'colour': f'{_HERE}.colour:ColourSegmenter',
    'sam2': f'{_HERE}.sam:Sam2',
    'sam3': f'{_HERE}.sam:Sam3',
}
REGISTRY = Registry(
    kind='segmenter',
    bundled=SEGMENTERS,
    group=GROUP,
    setting='--segmenter (the node: segmenter)',
    made_required=('name', 'segment'),
    protocol=f'{_HERE}.segmenter.Segmenter',
    others='the objects.safetensors of an import with --objects',
)


def check_segmenter_name(choice: str) -> str:
    """Return a valid choice; nothing is imported or read.

    Raises:
        ConfigError: it is neither registered, nor `module:Class`, nor a file of examples.
    """
    return choice if choice.endswith(EXAMPLES_SUFFIX) else REGISTRY.check(choice)
