"""The world model of a checkpoint, on a device; imports torch."""

from __future__ import annotations

from dataclasses import replace

from mtv_world_ros.control.control import InputLayout, VIDEO_ONLY
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.runtime import (
    check_device,
    choose_dtype,
    keep_freed_memory,
    set_num_threads,
)
from mtv_world_ros.model.serving import ServingOptions
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.world_model import DiffusionWorldModel


def load_world_model(
    checkpoint: Checkpoint,
    *,
    device: str = 'cpu',
    dtype: str = 'auto',
    num_threads: int = 0,
    serving: str = '',
    layout: InputLayout = VIDEO_ONLY,
) -> DiffusionWorldModel:
    """Return the world model of a checkpoint.

    Device, number format, threads and serving options are those of `Pipeline.load`; the adapter is
    the checkpoint's, and the layout has the inputs of its control.

    Raises:
        CheckpointError: a part is missing or wrong.
        ConfigError: this machine has no such device, or a serving option is wrong.
    """
    options = ServingOptions.parse(serving)
    check_device(device)
    set_num_threads(num_threads)
    number_format = choose_dtype(dtype, device)
    loaded = load_trained_model(checkpoint, dtype=number_format)
    if checkpoint.adapter is not None:
        loaded = replace(loaded, adapter=checkpoint.adapter, card=checkpoint.card)
        inputs = layout.transformer_arguments()
        if inputs and loaded.transformer.control_tokens is None:  # the adapter brings the weights
            loaded.transformer.add_control_inputs(**inputs)
    model = DiffusionWorldModel(loaded, device=device, dtype=number_format, serving=options)
    if model.device.type == 'cpu':
        keep_freed_memory()
    return model
