"""The base checkpoint of a training: a transformer to adapt, and frozen encoders."""

from __future__ import annotations

from dataclasses import dataclass
import hashlib
import json
from pathlib import Path
from typing import Any

import torch

from mtv_world_ros.control.control import InputLayout, VIDEO_ONLY
from mtv_world_ros.control.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.model.card import CheckpointCard, SHARED_KEYS
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.parts import check_video
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.trained_model import load_trained_model, TrainedModel
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.adapter import add_adapter
from mtv_world_ros.training.clips.encoding import Encoders
from mtv_world_ros.training.training_config import TrainingConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A loaded checkpoint, ready to be trained.

    Attributes:
        folder: folder of the checkpoint.
        checkpoint: parts of the model; the transformer has a new adapter where the preset trains
            one.
        encoders: encoders on the device.
        digest: hash of the transformer's weights.
    """

    folder: Path
    checkpoint: TrainedModel
    encoders: Encoders
    digest: str


def needs_base(config: TrainingConfig) -> bool:
    """Return True if the preset needs a base checkpoint: an adapter, or a model with text."""
    return config.lora.rank > 0 or config.transformer.get('context') != 'none'


def load_base(
    config: TrainingConfig,
    checkpoint: Checkpoint | None,
    device: torch.device,
    dtype: torch.dtype,
    *,
    seed: int,
    layout: InputLayout = VIDEO_ONLY,
) -> Base:
    """Load a checkpoint and add a new adapter, drawn by the seed, where the preset trains one.

    Encoders have the number format of forward and backward, as in serving. umT5 is loaded to
    encode the prompt, then freed.

    Raises:
        TrainingError: there is no checkpoint, or its model is not the preset's.
        CheckpointError: the checkpoint cannot be loaded.
    """
    if checkpoint is None:
        raise TrainingError(
            'this preset trains on top of a checkpoint; give --init FOLDER, which '
            "'mtv-world import wan' makes of public weights"
        )
    folder, loaded = checkpoint.folder, load_trained_model(checkpoint, dtype=dtype)
    digest, inputs = _digest(loaded.transformer), layout.transformer_arguments()
    if inputs and loaded.transformer.control_tokens is None:
        torch.manual_seed(seed)
        loaded.transformer.add_control_inputs(**inputs)
    _check_transformer(config, layout, loaded.transformer, folder)
    _check_card(config, loaded.card, folder)
    autoencoder = place(loaded.autoencoder, device, dtype).eval().requires_grad_(False)
    check_video(autoencoder, loaded.transformer.config, loaded.card.spec)
    text = image = None
    if loaded.text_encoder is not None and loaded.image_encoder is not None:
        text = loaded.text_encoder.encode(loaded.card.prompt, device).clone()
        image = loaded.image_encoder.to(device, dtype)
    if config.lora.rank:
        torch.manual_seed(seed)
        add_adapter(loaded.transformer, rank=config.lora.rank, alpha=config.lora.alpha)
    return Base(
        folder=folder,
        checkpoint=loaded,
        encoders=Encoders(autoencoder=autoencoder, text=text, image=image, history=config.history),
        digest=digest,
    )


def _check_transformer(
    config: TrainingConfig,
    layout: InputLayout,
    transformer: MultiViewWanTransformer,
    folder: Path,
) -> None:
    held: Any = transformer.config
    inputs = {'context_input': None, 'frame_input': None, **layout.transformer_arguments()}
    for name, wanted in {**config.transformer, **inputs}.items():
        value = held.get(name)
        if _plain(value) != _plain(wanted):
            raise TrainingError(
                f"the transformer of '{folder}' has {name} {value}, the preset {wanted}; give "
                '--preset the one it was made with, or --init another checkpoint'
            )


def _check_card(config: TrainingConfig, card: CheckpointCard, folder: Path) -> None:
    """Check the base's card: an adapter is served with it, so it has to be trained with it."""
    mine = config.card({}).plain()
    rendering = TrajectoryVideoConfig(**card.rendering).model_dump()
    theirs = {**card.plain(), 'rendering': rendering}
    # an adapter brings its own control, in its card
    names = {*SHARED_KEYS, 'rendering', 'history'} - {'control'}
    for name in sorted(names):
        held, wanted = theirs.get(name), mine.get(name)
        if _plain(held) != _plain(wanted):
            section = f'video.{name}' if name in SHARED_KEYS else name
            raise TrainingError(
                f"'{folder}' says {name} {held} in world_model.json, the preset {wanted}; set "
                f'{section} to the same, or make the checkpoint with this preset'
            )


def _digest(transformer: MultiViewWanTransformer) -> str:
    """Digest of the first numbers of every tensor, in the coarsest number format."""
    digest = hashlib.sha256()
    for name, tensor in transformer.state_dict().items():
        first = tensor.flatten()[:64].to('cpu', torch.bfloat16).view(torch.int16)
        digest.update(name.encode() + first.numpy().tobytes())
    return digest.hexdigest()[:16]


def _plain(value: Any) -> Any:
    """Return the value as JSON stores it: tuples become lists."""
    return json.loads(json.dumps(value))
