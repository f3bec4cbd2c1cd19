"""Weights of a checkpoint folder: diffusers' layout, safetensors only."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
import shutil
from typing import Any, cast

import torch

from mtv_world_ros.control.control import Control
from mtv_world_ros.control.registry import save_control
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import CheckpointError, MtvWorldError
from mtv_world_ros.core.files import whole_folder
from mtv_world_ros.core.network_sizes import check_sizes
from mtv_world_ros.model.card import (
    ADAPTER_FOLDER,
    CheckpointCard,
    OBJECT_MOTION_FOLDER,
    ROBOT_FOLDER,
)
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.encoders import ImageEncoder, TextEncoder
from mtv_world_ros.model.parts import Autoencoder, build_autoencoder, build_scheduler, Scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.tensor_files import disk_errors, PICKLES, read_tensors
from mtv_world_ros.model.transformer.transformer import copy_of, MultiViewWanTransformer

WEIGHTS = 'diffusion_pytorch_model'
PARTS = ('transformer', 'autoencoder', 'scheduler')
#: in transformers' configurations of version 0.1.0, for actions that are not drawn
_OF_0_1 = ('control', 'action_dim', 'num_context_tokens')


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedModel:
    """The parts of a trained world model.

    Attributes:
        transformer: the diffusion transformer.
        autoencoder: pixels to latents and back.
        scheduler: noise levels and the step rule.
        card: inputs and outputs of the model, and its training data.
        text_encoder: umT5, in models with text.
        image_encoder: CLIP, in models with text.
        adapter: folder of a LoRA adapter for the transformer.
        object_motion: folder of the contact settings and the arms' response, for foresight.
        robot: folder of the robot that the model was trained on, and of the default calibration.
        control: control that is saved with the model; loaded with a robot, see
            `control.registry.load_control`.
    """

    transformer: MultiViewWanTransformer
    autoencoder: Autoencoder
    scheduler: Scheduler
    card: CheckpointCard
    text_encoder: TextEncoder | None = None
    image_encoder: ImageEncoder | None = None
    adapter: Path | None = None
    object_motion: Path | None = None
    robot: Path | None = None
    control: Control | None = None


def save_trained_model(
    model: TrainedModel, folder: Path, *, dtype: torch.dtype = torch.float32
) -> None:
    """Write a checkpoint folder, which appears under its name only when it is complete."""
    with disk_errors(), whole_folder(folder) as partial:
        stored = place(copy_of(model.transformer), torch.device('cpu'), dtype)
        stored.save_pretrained(partial / 'transformer', safe_serialization=True)
        cast(Any, model.autoencoder).save_pretrained(
            partial / 'autoencoder', safe_serialization=True
        )
        model.scheduler.save_pretrained(partial / 'scheduler')
        for encoder in (model.text_encoder, model.image_encoder):
            if encoder is not None:
                encoder.save(partial)
        for name, part in _folders(model).items():
            shutil.copytree(part, partial / name)
        model.card.write(partial)
        if model.control is not None:
            save_control(model.control, model.card.control, partial)


def _folders(model: TrainedModel) -> dict[str, Path]:
    """Return the folders of parts that are copied unchanged."""
    parts = {
        ADAPTER_FOLDER: model.adapter,
        OBJECT_MOTION_FOLDER: model.object_motion,
        ROBOT_FOLDER: model.robot,
    }
    return {name: part for name, part in parts.items() if part is not None}


def load_trained_model(
    checkpoint: Checkpoint, *, dtype: torch.dtype = torch.float32
) -> TrainedModel:
    """Read the weights of a checkpoint.

    Raises:
        CheckpointError: a part is missing, is a pickle, or belongs to another model.
    """
    try:
        return _load(checkpoint, dtype)
    except MtvWorldError:
        raise
    except Exception as error:  # configurations of other libraries raise all kinds of errors
        raise CheckpointError(
            f"checkpoint '{checkpoint}' cannot be loaded ({type(error).__name__}: {error}); "
            'copy or export it again'
        ) from error


def _load(checkpoint: Checkpoint, dtype: torch.dtype) -> TrainedModel:
    folder = checkpoint.folder
    for part in PARTS:
        if not (folder / part).is_dir():
            raise CheckpointError(f"checkpoint '{folder}' has no folder '{part}/'")
    pickles = [p.name for p in folder.rglob('*') if p.suffix in PICKLES]
    if pickles:
        raise CheckpointError(
            f"checkpoint '{folder}' holds pickle files {sorted(pickles)}; only safetensors are "
            'loaded: convert them and remove these'
        )
    with_text = (folder / 'text_encoder').is_dir()
    adapter, robot = folder / ADAPTER_FOLDER, folder / ROBOT_FOLDER
    return TrainedModel(
        transformer=_load_transformer(folder / 'transformer', dtype),
        autoencoder=_load_autoencoder(folder / 'autoencoder', dtype),
        scheduler=build_scheduler(_config(folder / 'scheduler' / 'scheduler_config.json')),
        card=checkpoint.card,
        text_encoder=TextEncoder(folder, dtype=dtype) if with_text else None,
        image_encoder=ImageEncoder.load(folder, dtype=dtype) if with_text else None,
        adapter=adapter if adapter.is_dir() else None,
        object_motion=checkpoint.object_motion,
        robot=robot if robot.is_dir() else None,
    )


def _load_transformer(folder: Path, dtype: torch.dtype) -> MultiViewWanTransformer:
    config = _config(folder / 'config.json')
    found, expected = config.get('_class_name'), MultiViewWanTransformer.__name__
    if found != expected:
        raise CheckpointError(f"'{folder}' holds a {found}, expected a {expected}")
    check_sizes(config, f"'{folder / 'config.json'}'")
    given = {name: value for name, value in config.items() if name not in _OF_0_1}
    with torch.device('meta'):
        transformer: Any = MultiViewWanTransformer.from_config(given)
    _fill(transformer, folder)
    return place(transformer, torch.device('cpu'), dtype).eval()


def _load_autoencoder(folder: Path, dtype: torch.dtype) -> Autoencoder:
    config = _config(folder / 'config.json')
    with torch.device('meta'):
        autoencoder: Any = build_autoencoder(config)
    _fill(getattr(autoencoder, 'vae', autoencoder), folder)
    return place(autoencoder, torch.device('cpu'), dtype).eval()


def _fill(module: Any, folder: Path) -> None:
    """Replace the module's meta tensors, which use no memory, by the stored ones."""
    tensors = read_tensors(folder, WEIGHTS)
    try:
        module.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        raise CheckpointError(f"'{folder}' does not fit its config: {error}") from error


def _config(file: Path) -> dict[str, Any]:
    try:
        values = read_json(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{file}' cannot be loaded: {error}") from error
    if not isinstance(values, dict):
        raise CheckpointError(f"'{file}' cannot be loaded: it must hold keys and values")
    for key, value in values.items():
        if isinstance(value, float) and not isfinite(value):
            raise CheckpointError(f"'{file}' has {key} {value}; give a finite number")
    return values
