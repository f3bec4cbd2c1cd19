"""A loaded model made ready as the serving options say."""

from __future__ import annotations

from pathlib import Path

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
import torch

from mtv_world_ros.errors import CheckpointError, ConfigError
from mtv_world_ros.model.autoencoders import TinyAutoencoder, WanAutoencoder
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving.compiled import capture, compile_blocks
from mtv_world_ros.model.serving.float8 import convert
from mtv_world_ros.model.serving.options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def prepare(
    transformer: MultiViewWanTransformer, serving: ServingOptions, device: torch.device
) -> None:
    """Changes the transformer in place, with its adapter in it, on every process alike.

    Raises:
        ConfigError: an option is not for this machine.
    """
    if serving.attention:
        _set_attention(transformer, serving.attention)
    if serving.weights == 'float8':
        convert(transformer)
    if serving.offload:
        # each block comes while the one before computes; a CPU has no streams for that
        transformer.enable_group_offload(
            onload_device=device,
            offload_device=torch.device('cpu'),
            offload_type='block_level',
            num_blocks_per_group=1,
            use_stream=device.type == 'cuda',
        )
    if serving.compile:
        compile_blocks(transformer, device)
    if serving.cuda_graphs:
        capture(transformer, device)


def _set_attention(transformer: MultiViewWanTransformer, name: str) -> None:
    before, _ = _AttentionBackendRegistry.get_active_backend()
    try:
        transformer.set_attention_backend(name)
    except (ValueError, RuntimeError, ImportError) as error:
        raise ConfigError(f"serving: attention '{name}' cannot be used: {error}") from error
    finally:
        # diffusers sets it for all other models of the process, too
        _AttentionBackendRegistry.set_active_backend(before)


def decoder_of(
    autoencoder: Autoencoder, serving: ServingOptions, dtype: torch.dtype
) -> Autoencoder:
    """Returns what decodes: the autoencoder, on its device, or the tiny one in its place.

    Raises:
        CheckpointError: the tiny one's weights cannot be read, or are for other latents.
    """
    if not serving.tiny_decoder:
        return autoencoder
    if not isinstance(autoencoder, WanAutoencoder):
        raise CheckpointError(
            "tiny_decoder decodes Wan's latents, this checkpoint has an autoencoder of its own; "
            "leave it out of 'serving'"
        )
    return place(TinyAutoencoder.load(Path(serving.tiny_decoder)), autoencoder.device, dtype)
