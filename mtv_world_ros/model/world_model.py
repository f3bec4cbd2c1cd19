"""A trained checkpoint as a world model: frames in, frames out."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from mtv_world_ros.data_types import ByteArray, FloatArray
from mtv_world_ros.errors import CheckpointError, ModelMemoryError
from mtv_world_ros.model.actions import collate
from mtv_world_ros.model.card import spec_of
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.conditioning import (
    condition,
    condition_on_actions,
    Conditioning,
    decode_frames,
)
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.sampler import sample_latents

if TYPE_CHECKING:
    from mtv_world_ros.geometry.robot import RobotModel


class DiffusionWorldModel:
    """Denoises one chunk of multi-view video under a trajectory video, or under actions.

    Args:
        checkpoint: the trained parts.
        device: e.g. `cpu` or `cuda`.
        dtype: of the transformer's computations.
        robot: the trained one; needed where the checkpoint takes actions that are not drawn.

    Raises:
        CheckpointError: it is needed and missing.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        *,
        device: str = 'cpu',
        dtype: torch.dtype = torch.float32,
        robot: RobotModel | None = None,
    ) -> None:
        if checkpoint.actions is not None and robot is None:
            raise CheckpointError(
                f"a checkpoint of control '{checkpoint.actions.control}' needs the robot it was "
                "trained with; load it by 'load_pipeline', or give `robot`"
            )
        self.actions, self.robot = checkpoint.actions, robot
        self.device = torch.device(device)
        self.transformer = place(checkpoint.transformer, self.device, dtype).eval()
        self.autoencoder = place(checkpoint.autoencoder, self.device, dtype).eval()
        self.scheduler = checkpoint.scheduler
        self.spec = spec_of(checkpoint.card)

    def predict(
        self,
        start_frame: ByteArray,
        trajectory_frames: ByteArray,
        *,
        positions: FloatArray,
        seed: int,
        num_inference_steps: int,
        should_stop: Callable[[], bool],
    ) -> ByteArray:
        """Returns (V, T, H, W, 3) uint8 RGB frames; see `pipeline.WorldModel.predict`."""
        try:
            with torch.inference_mode():
                conditioning = self._condition(start_frame, trajectory_frames, positions)
                latents = sample_latents(
                    self.transformer,
                    self.scheduler,
                    conditioning,
                    seed=seed,
                    num_inference_steps=num_inference_steps,
                    should_stop=should_stop,
                )
                frames = decode_frames(self.autoencoder, latents.to(self.autoencoder.dtype))
                return frames[0].cpu().numpy()
        except (torch.OutOfMemoryError, MemoryError) as error:
            raise self._out_of_memory(trajectory_frames, error) from error
        except RuntimeError as error:
            if "can't allocate memory" not in str(error):
                raise
            raise self._out_of_memory(trajectory_frames, error) from error

    def _condition(
        self, start_frame: ByteArray, trajectory_frames: ByteArray, positions: FloatArray
    ) -> Conditioning:
        start = self._tensor(start_frame)
        if self.actions is None:
            return condition(self.autoencoder, start, self._tensor(trajectory_frames))
        assert self.robot is not None
        encoded = collate([self.actions.encode(self.robot, positions)])
        actions = torch.from_numpy(encoded).to(self.device)
        return condition_on_actions(self.autoencoder, start, actions, self.spec.num_frames)

    def _tensor(self, frames: ByteArray) -> torch.Tensor:
        return torch.from_numpy(np.array(frames))[None].to(self.device)

    def _out_of_memory(self, frames: ByteArray, error: Exception) -> ModelMemoryError:
        views, count, height, width, _ = frames.shape
        if self.device.type == 'cuda':
            torch.cuda.empty_cache()
        return ModelMemoryError(
            f'out of memory on {self.device} with {views} views of {count} frames of '
            f'{width}x{height}; use a smaller preset, another device, or free memory there '
            f'({str(error).splitlines()[0]})'
        )
