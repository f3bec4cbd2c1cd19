"""A small imported Wan checkpoint, and predictions of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.model.wan_weights import import_weights
from mtv_world_ros.model.world_model import DiffusionWorldModel
from test.support.wan_files import AUTOENCODER, CARD, SCHEDULER, TRANSFORMER, write_videox

VIEWS, T = 2, 4


def imported(root: Path) -> Path:
    """A checkpoint folder, float32."""
    import_weights(
        write_videox(root / 'public', dtype=torch.float32),
        root / 'checkpoint',
        transformer=TRANSFORMER,
        autoencoder=AUTOENCODER,
        scheduler=SCHEDULER,
        card=CARD,
    )
    return root / 'checkpoint'


def frames(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (*shape, 32, 32, 3), np.uint8)


def predict(model: DiffusionWorldModel, *, seed: int = 0, steps: int = 2, **changes: Any):
    arguments = {
        'start_frame': frames(VIEWS),
        'control': ControlInputs.drawn(frames(VIEWS, 1 + T, seed=1)),
        'positions': np.zeros((1 + T, 14)),
        'seed': seed,
        'num_inference_steps': steps,
        'should_stop': lambda: False,
    }
    return model.predict(**{**arguments, **changes})
