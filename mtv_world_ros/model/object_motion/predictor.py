"""The object motion network in use: objects found in a frame, and where a plan takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import json
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.files import write_json
from mtv_world_ros.geometry.mask_geometry import centroids, locate_all
from mtv_world_ros.geometry.object_motion import ObjectMotion
from mtv_world_ros.geometry.object_shape import NUM_FEATURES, object_shapes
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.model.object_motion.network import (
    Memory,
    ObjectMotionNetwork,
    Scene,
    STEP_S,
)

_CONFIG, _WEIGHTS = 'config.json', 'model.safetensors'


class ObjectMotionPredictor:
    """Finds objects in a frame; `TrackedObjects` says where they go.

    Args:
        network: trained.
        robot: gives tools and grippers.
    """

    def __init__(self, network: ObjectMotionNetwork, robot: RobotModel) -> None:
        self.network, self.robot = network.eval(), robot

    def find(
        self, masks: BoolArray, cameras: Sequence[CameraModel], poses: Sequence[FloatArray]
    ) -> TrackedObjects:
        """Returns the objects of masks (V, O, H, W), best of the camera's own size.

        Args:
            masks: of one frame.
            cameras: V cameras at the masks' size.
            poses: V of T_base_camera (4, 4).
        """
        points = locate_all(cameras, poses, centroids(masks))
        features = object_shapes(masks, points, cameras, poses)
        return TrackedObjects(model=self, reference=points, features=features)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedObjects:
    """Objects on their way; what one chunk hands to the next.

    Attributes:
        model: says where they go.
        reference: (O, 3) where they were found [m]; NaN = not found in two views, not tracked.
        features: (O, V, F) of `object_shapes`.
        memory: of the network; None = nothing has moved yet.
        tools: (A, 4, 4) T_base_tool one step before.
        openings: (A,) one step before.
    """

    model: ObjectMotionPredictor
    reference: FloatArray
    features: FloatArray
    memory: Memory | None = None
    tools: FloatArray | None = None
    openings: FloatArray | None = None

    @property
    def step_s(self) -> float:
        """Time between the joint positions that `advance` takes [s]."""
        return STEP_S

    def advance(self, positions: FloatArray) -> tuple[ObjectMotion, TrackedObjects]:
        """Returns where they are at each of (1 + T, J) positions, `step_s` apart, and then.

        Row 0 is where they are now.
        """
        robot = self.model.robot
        tools = robot.tool_poses(positions).transpose(1, 0, 2, 3)
        openings = robot.gripper_openings(positions).T
        before = tools[0] if self.tools is None else self.tools
        opened = openings[0] if self.openings is None else self.openings
        tools = np.concatenate([before[None], tools])
        openings = np.concatenate([opened[None], openings])
        known = np.asarray(np.isfinite(self.reference).all(-1))
        scene = Scene(
            points=_tensor(np.where(known[:, None], self.reference, 0.0)),
            features=_tensor(self.features),
            present=torch.from_numpy(known)[None],
            tools=_tensor(tools),
            openings=_tensor(openings),
        )
        with torch.inference_mode():
            motion, memory = self.model.network.roll(scene, self.memory, skip=1)
        points = motion.points[0].double().numpy()
        points[:, ~known] = np.nan
        moved = ObjectMotion(
            reference=self.reference,
            points=points,
            rotations=motion.rotations[0].double().numpy(),
        )
        return moved, replace(self, memory=memory, tools=tools[-2], openings=openings[-2])


def _tensor(values: FloatArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))[None]


def save_network(network: ObjectMotionNetwork, folder: Path) -> None:
    """Writes a network into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    save_file(tensors, folder / _WEIGHTS)
    write_json(folder / _CONFIG, network.config)


def load_network(folder: Path) -> ObjectMotionNetwork:
    """Reads a network.

    Raises:
        CheckpointError: the folder is not there, or what it holds is not whole.
    """
    try:
        network = ObjectMotionNetwork(**json.loads((folder / _CONFIG).read_text()))
        network.load_state_dict(load_file(folder / _WEIGHTS))
    except (OSError, ValueError, TypeError, RuntimeError, SafetensorError) as error:
        raise CheckpointError(f"'{folder}' cannot be used: {error}; train it anew") from error
    return network


def num_features(num_views: int) -> int:
    """Returns how many numbers describe an object that so many views see."""
    return num_views * NUM_FEATURES
