"""Writes an untrained ACT whose ResNet is normalised for a dataset; runs in LeRobot's environment.

    ENV/bin/python benchmark/act_start.py DATASET OUT 'CONFIG AS JSON'

LeRobot's ACT freezes the ResNet's batch normalisation, which without pretrained weights is the
identity: what all images have in common then outweighs what differs, and a small policy goes
on without looking for thousands of steps. Here its means and variances are those of the
dataset's images, layer after layer, as the first step of batch normalisation would set them.
"""

# the imports are of another environment than this package's
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path
import sys

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
import torch
from torch import nn
from torchvision.ops import FrozenBatchNorm2d

#: images that the statistics are of, spread evenly over the dataset
NUM_IMAGES = 64


def main() -> None:
    """Writes the folder that `--policy.path` takes."""
    root, out, text = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
    values = json.loads(text)
    views = values.pop('views')
    torch.manual_seed(values.pop('seed'))
    dataset = LeRobotDataset(f'local/{root.name}', root=root)
    features = dataset.meta.features
    names = [f'observation.images.{view}' for view in views]
    inputs = {
        name: PolicyFeature(FeatureType.VISUAL, _channels_first(features[name]['shape']))
        for name in names
    }
    size = tuple(features['action']['shape'])
    config = ACTConfig(
        device='cpu',
        push_to_hub=False,
        pretrained_backbone_weights=None,
        input_features={'observation.state': PolicyFeature(FeatureType.STATE, size), **inputs},
        output_features={'action': PolicyFeature(FeatureType.ACTION, size)},
        **values,
    )
    policy = ACTPolicy(config)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    rows = torch.linspace(0, len(dataset) - 1, NUM_IMAGES).int().tolist()
    batch = {
        key: torch.stack([dataset[row][key] for row in rows])
        for key in ('observation.state', *names)
    }
    batch = before(batch)
    normalise(policy.model.backbone, torch.cat([batch[name] for name in names]))
    policy.save_pretrained(out)
    before.save_pretrained(out)
    after.save_pretrained(out)


@torch.no_grad()
def normalise(backbone: nn.Module, images: torch.Tensor) -> None:
    """Sets the statistics of every frozen batch normalisation to those of (N, 3, H, W) images."""

    def set_statistics(layer: FrozenBatchNorm2d, inputs: tuple[torch.Tensor]) -> None:
        layer.running_mean.copy_(inputs[0].mean((0, 2, 3)))
        layer.running_var.copy_(inputs[0].var((0, 2, 3)))

    layers = [layer for layer in backbone.modules() if isinstance(layer, FrozenBatchNorm2d)]
    hooks = [layer.register_forward_pre_hook(set_statistics) for layer in layers]
    backbone(images)
    for hook in hooks:
        hook.remove()


def _channels_first(shape: list[int]) -> tuple[int, int, int]:
    height, width, channels = shape
    return channels, height, width


if __name__ == '__main__':
    main()
