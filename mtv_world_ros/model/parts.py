"""The exchangeable parts of a checkpoint, chosen by class name as in diffusers' config files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from diffusers import (
    AutoencoderKLWan,
    FlowMatchEulerDiscreteScheduler,
    UniPCMultistepScheduler,
)

from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.network_sizes import check_sizes
from mtv_world_ros.model.autoencoders import (
    SpaceToDepthAutoencoder,
    TinyAutoencoder,
    WanAutoencoder,
)

Autoencoder: TypeAlias = SpaceToDepthAutoencoder | WanAutoencoder | TinyAutoencoder
Scheduler: TypeAlias = FlowMatchEulerDiscreteScheduler | UniPCMultistepScheduler

_AUTOENCODERS = {'SpaceToDepthAutoencoder': SpaceToDepthAutoencoder, 'AutoencoderKLWan': None}
_SCHEDULERS = {
    'FlowMatchEulerDiscreteScheduler': FlowMatchEulerDiscreteScheduler,
    'UniPCMultistepScheduler': UniPCMultistepScheduler,
}


def build_autoencoder(config: Mapping[str, Any]) -> Autoencoder:
    """Return the autoencoder of a preset or config file, without trained weights.

    Args:
        config: arguments of the autoencoder; `_class_name` is `SpaceToDepthAutoencoder` (default)
            or `AutoencoderKLWan`.

    Raises:
        CheckpointError: another class.
    """
    name, arguments = _split(config, 'SpaceToDepthAutoencoder', _AUTOENCODERS, 'autoencoder')
    if name == 'AutoencoderKLWan':
        return WanAutoencoder(AutoencoderKLWan.from_config(arguments))  # type: ignore[arg-type]
    return SpaceToDepthAutoencoder.from_config(arguments)  # type: ignore[return-value]


def build_scheduler(config: Mapping[str, Any]) -> Scheduler:
    """Return the noise schedule of a preset or config file.

    Args:
        config: arguments of the scheduler; `_class_name` is `FlowMatchEulerDiscreteScheduler`
            (default) or `UniPCMultistepScheduler`.

    Raises:
        CheckpointError: another class, or UniPC without flow matching.
    """
    name, arguments = _split(config, 'FlowMatchEulerDiscreteScheduler', _SCHEDULERS, 'scheduler')
    flow = arguments.get('use_flow_sigmas') and arguments['prediction_type'] == 'flow_prediction'
    if name == 'UniPCMultistepScheduler' and not flow:
        raise CheckpointError(
            'scheduler UniPCMultistepScheduler predicts no flow; set prediction_type: '
            'flow_prediction and use_flow_sigmas: true'
        )
    return _SCHEDULERS[name].from_config(arguments)  # type: ignore[return-value]


def check_video(autoencoder: Autoencoder, transformer: Any, spec: WorldModelSpec) -> None:
    """Check that a chunk divides into latents and tokens.

    Args:
        autoencoder: autoencoder whose compression decides; `SpaceToDepthAutoencoder` divides every
            chunk.
        transformer: configuration of the transformer.
        spec: size and number of frames.

    Raises:
        CheckpointError: a chunk does not divide into latents and tokens.
    """
    if not isinstance(autoencoder, WanAutoencoder):
        return
    in_time, in_space = autoencoder.frames_per_latent, autoencoder.pixels_per_latent
    step = in_space * transformer['patch_size'][-1]
    if spec.num_frames % in_time:
        raise CheckpointError(
            f'num_frames {spec.num_frames} does not fit the autoencoder, which merges {in_time} '
            f'frames behind the observed one; set video.num_frames to a multiple of {in_time}'
        )
    if spec.width % step or spec.height % step:
        raise CheckpointError(
            f'frames of {spec.width}x{spec.height} do not divide into tokens of {step}x{step} '
            f'pixels; set video.width and video.height to multiples of {step}'
        )


def _split(
    config: Mapping[str, Any], default: str, known: Mapping[str, object], what: str
) -> tuple[str, dict[str, Any]]:
    arguments = dict(config)
    name = arguments.pop('_class_name', default)
    if name not in known:
        raise CheckpointError.unknown(what, name, known)
    check_sizes(arguments, what)
    return name, arguments
