"""A process that shares the transformer's sequence with the one that predicts.

Started by `Followers`; commands come as lines of JSON, tensors by torch.distributed. It ends with
its input.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
import sys
from typing import Any

import torch

from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving.context_parallel import join, open_store, receive, split
from mtv_world_ros.model.serving.prepare import prepare
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def main() -> None:
    """Follows until the input ends."""
    lines = map(json.loads, sys.stdin)
    start = next(lines)
    torch.set_num_threads(start['num_threads'])
    device = torch.device(start['device'])
    join(open_store(start['port']), start['rank'], start['size'], device)
    with torch.inference_mode():
        _follow(lines, start, device)


def _follow(lines: Iterator[dict[str, Any]], start: dict[str, Any], device: torch.device) -> None:
    transformer: Any = None
    for line in lines:
        tensors = receive(line['tensors'], device)
        if line['command'] == 'run':
            transformer(**tensors)
        elif transformer is None:
            transformer = _build(start, tensors, device)
        else:
            transformer.load_state_dict(tensors)


def _build(
    start: dict[str, Any], weights: dict[str, torch.Tensor], device: torch.device
) -> MultiViewWanTransformer:
    with torch.device('meta'):
        transformer: Any = MultiViewWanTransformer.from_config(start['config'])
    transformer.load_state_dict(weights, assign=True)
    place(transformer, device, getattr(torch, start['dtype'])).eval()
    split(transformer)
    prepare(transformer, ServingOptions(**start['serving']), device)
    return transformer


if __name__ == '__main__':
    main()
