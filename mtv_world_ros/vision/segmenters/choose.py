"""The segmenter of a name, with its weights and device."""

from __future__ import annotations

import os
from pathlib import Path

from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter, ObjectExamples
from mtv_world_ros.vision.segmenters.registry import EXAMPLES_SUFFIX, REGISTRY
from mtv_world_ros.vision.segmenters.sam import Sam2
from mtv_world_ros.vision.segmenters.segmenter import Segmenter
from mtv_world_ros.vision.segmenters.weights import SegmenterOptions, WEIGHTS_VARIABLE


class Auto:
    """Segmenter `sam2` where its weights are present, else `colour`."""

    @staticmethod
    def create(options: SegmenterOptions) -> Segmenter:
        """Return the segmenter; its `name` says which."""
        if options.has_models(*Sam2.models):
            return Sam2.create(options)
        return ColourSegmenter()


def choose_segmenter(
    choice: str = 'auto', *, weights: Path | None = None, device: str = 'cpu'
) -> Segmenter:
    """Return the segmenter of a name; `Segmenter.name` says which was chosen.

    Args:
        choice: a name of `registry.SEGMENTERS` or of an entry point, `module:Class`, or a file of
            examples, `*.safetensors`.
        weights: folder of weights, at any depth up to two; default: `MTV_WORLD_WEIGHTS`.
        device: device of the models: `cpu`, `cuda`, ...

    Raises:
        ConfigError: no such segmenter, it cannot be used, no folder, or its weights are not in
            there.
        CheckpointError: weights cannot be read.
    """
    if choice.endswith(EXAMPLES_SUFFIX):
        return ExampleSegmenter(ObjectExamples.load(Path(choice).expanduser()))
    named = os.environ.get(WEIGHTS_VARIABLE, '')
    folder = weights or (Path(named).expanduser() if named else None)
    return REGISTRY.create(choice, SegmenterOptions(name=choice, weights=folder, device=device))
