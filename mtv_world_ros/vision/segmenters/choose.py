"""Choice of the segmenter, by name and by the weights that are available."""

from __future__ import annotations

import os
from pathlib import Path
from typing import get_args, Literal

from mtv_world_ros.core.errors import ConfigError, nearest
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter, ObjectExamples, SUFFIX
from mtv_world_ros.vision.segmenters.sam import sam2_segmenter, sam3_segmenter
from mtv_world_ros.vision.segmenters.segmenter import Segmenter
from mtv_world_ros.vision.segmenters.weights import find_weights, VISION_MODELS

SegmenterName = Literal['auto', 'colour', 'sam2', 'sam3']
#: choices of `choose_segmenter`
SEGMENTERS = get_args(SegmenterName)
#: the environment variable that names the folder of public weights
WEIGHTS_VARIABLE = 'MTV_WORLD_WEIGHTS'


def choose_segmenter(
    choice: str = 'auto', *, weights: Path | None = None, device: str = 'cpu'
) -> Segmenter:
    """Return the segmenter of that name; `Segmenter.name` says what it became.

    Args:
        choice: `auto` (SAM 2 where the weights are present, else by colour), `colour`, `sam2`
            (MM-Grounding-DINO and SAM 2), `sam3`, or a file of examples, `*.safetensors`.
        weights: folder of weights, at any depth up to two; default: `MTV_WORLD_WEIGHTS`.
        device: of the models: `cpu`, `cuda`, ...

    Raises:
        ConfigError: no such segmenter, no folder, or its weights are not in there.
        CheckpointError: weights cannot be read.
    """
    if choice.endswith(SUFFIX):
        return ExampleSegmenter(ObjectExamples.load(Path(choice).expanduser()))
    if choice not in SEGMENTERS:
        raise ConfigError(
            f"segmenter is '{choice}'{nearest(choice, SEGMENTERS)}; it must be one of "
            f'{", ".join(SEGMENTERS)}, or the objects.safetensors of an import with --objects'
        )
    named = os.environ.get(WEIGHTS_VARIABLE, '')
    folder = weights or (Path(named).expanduser() if named else None)
    if choice == 'colour' or (choice == 'auto' and folder is None):
        return ColourSegmenter()
    if folder is None:
        raise ConfigError(
            f"segmenter is '{choice}', whose weights are looked for in the folder that "
            f'{WEIGHTS_VARIABLE} names; it is not set'
        )
    found = find_weights(folder)
    needed = ('sam3_video',) if choice == 'sam3' else ('mm-grounding-dino', 'sam2_video')
    missing = [kind for kind in needed if kind not in found]
    if missing and choice == 'auto':
        return ColourSegmenter()
    if missing:
        names = ', '.join(f'{kind} ({VISION_MODELS[kind][1]})' for kind in missing)
        raise ConfigError(f"segmenter is '{choice}', but '{folder}' holds no {names}")
    if choice == 'sam3':
        return sam3_segmenter(found['sam3_video'], device=device)
    return sam2_segmenter(found['mm-grounding-dino'], found['sam2_video'], device=device)
