"""Segmenters by name: those of the package, of entry points, and of `module:Class`."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path

from mtv_world_ros.core.entry_points import SEGMENTERS as GROUP
from mtv_world_ros.core.registry import Registry
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter, ObjectExamples, SUFFIX
from mtv_world_ros.vision.segmenters.sam import Sam2
from mtv_world_ros.vision.segmenters.segmenter import Segmenter
from mtv_world_ros.vision.segmenters.weights import SegmenterOptions, WEIGHTS_VARIABLE

_HERE = 'mtv_world_ros.vision.segmenters'


class Auto:
    """SAM 2 where its weights are present, else the segmenter by colour."""

    @staticmethod
    def create(options: SegmenterOptions) -> Segmenter:
        """Return the segmenter; its `name` says which."""
        if options.has_models(*Sam2.models):
            return Sam2.create(options)
        return ColourSegmenter()


#: name -> class, imported when it is chosen
SEGMENTERS: Mapping[str, str] = {
    'auto': f'{_HERE}.choose:Auto',
    'colour': f'{_HERE}.colour:ColourSegmenter',
    'sam2': f'{_HERE}.sam:Sam2',
    'sam3': f'{_HERE}.sam:Sam3',
}
_REGISTRY = Registry(
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
    return choice if choice.endswith(SUFFIX) else _REGISTRY.check(choice)


def choose_segmenter(
    choice: str = 'auto', *, weights: Path | None = None, device: str = 'cpu'
) -> Segmenter:
    """Return the segmenter of a name; `Segmenter.name` says which was chosen.

    Args:
        choice: `auto` (SAM 2 where the weights are present, else by colour), `colour`, `sam2`
            (MM-Grounding-DINO and SAM 2), `sam3`, the name of an entry point, `module:Class`, or
            a file of examples, `*.safetensors`.
        weights: folder of weights, at any depth up to two; default: `MTV_WORLD_WEIGHTS`.
        device: device of the models: `cpu`, `cuda`, ...

    Raises:
        ConfigError: no such segmenter, it cannot be used, no folder, or its weights are not in
            there.
        CheckpointError: weights cannot be read.
    """
    if choice.endswith(SUFFIX):
        return ExampleSegmenter(ObjectExamples.load(Path(choice).expanduser()))
    named = os.environ.get(WEIGHTS_VARIABLE, '')
    folder = weights or (Path(named).expanduser() if named else None)
    return _REGISTRY.create(choice, SegmenterOptions(name=choice, weights=folder, device=device))
