"""Prepares a loaded model for serving: attention, offloaded or compiled blocks, decoder."""

from __future__ import annotations

import os
from pathlib import Path
import shutil

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
import torch

from mtv_world_ros.errors import CheckpointError, ConfigError
from mtv_world_ros.model.autoencoders import TinyAutoencoder, WanAutoencoder
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def prepare(
    transformer: MultiViewWanTransformer, serving: ServingOptions, device: torch.device
) -> None:
    """Changes the transformer in place, with its adapter in it.

    Raises:
        ConfigError: an option is not for this machine.
    """
    if serving.attention:
        _set_attention(transformer, serving.attention)
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


#: shapes that may be compiled: numbers of seeds, of views; torch gives up after 8
_MOST_SHAPES = 64
_COMPILERS = {'cpu': ('CXX', ('g++', 'clang++')), 'cuda': ('CC', ('gcc', 'clang', 'cc'))}


def compile_blocks(transformer: MultiViewWanTransformer, device: torch.device) -> None:
    """Compiles the repeated block once for all; shapes are static, another one compiles again.

    Raises:
        ConfigError: there is no compiler to do it.
    """
    variable, names = _COMPILERS.get(device.type, _COMPILERS['cuda'])
    named = os.environ.get(variable)
    if not any(shutil.which(name) for name in ([named] if named else names)):
        raise ConfigError(
            f'serving: compile=true needs a compiler ({" or ".join(names)}) on the path or named '
            f'by {variable}; install one (apt install g++), or leave it out'
        )
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, _MOST_SHAPES)
    transformer.compile_repeated_blocks(fullgraph=True, dynamic=False)
