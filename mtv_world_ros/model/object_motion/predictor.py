"""The object motion network in use: objects found in a frame, and where a plan takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path

import numpy as np
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.files import write_json
from mtv_world_ros.geometry.mask_geometry import centroids, locate
from mtv_world_ros.geometry.object_motion import ObjectMotion
from mtv_world_ros.geometry.object_shape import NUM_FEATURES, object_shapes
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.model.object_motion.network import (
    Memory,
    ObjectMotionNetwork,
    Scene,
    STEP_S,
)

#: of a checkpoint
FOLDER = 'object_motion'
_CONFIG, _WEIGHTS = 'config.json', 'model.safetensors'


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedObjects:
    """Objects on their way: what one chunk hands to the next.

    Attributes:
        reference: (O, 3) where they were found [m]; NaN = not found in two views, not tracked.
        scene_features: (O, V, F) of `object_shapes`.
        memory: of the network.
        tools: (A, 4, 4) T_base_tool one step before.
        openings: (A,) one step before.
    """

    reference: FloatArray
    scene_features: FloatArray
    memory: Memory | None = None
    tools: FloatArray | None = None
    openings: FloatArray | None = None


class ObjectMotionPredictor:
    """Where named objects go under commanded joints.

    Args:
        network: trained.
        robot: gives tools and grippers.
    """

    #: time between the joint positions that `advance` takes [s]
    step_s = STEP_S

    def __init__(self, network: ObjectMotionNetwork, robot: RobotModel) -> None:
        self._network, self._robot = network.eval(), robot

    def find(
        self,
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
        noise_m: float = 0.0,
        seed: int = 0,
    ) -> TrackedObjects:
        """Returns the objects of masks (V, O, H, W), best of the camera's own size.

        Args:
            masks: of one frame.
            cameras: V cameras at the masks' size.
            poses: V of T_base_camera (4, 4).
            noise_m: standard deviation of a disturbance of their places, for an ensemble [m].
            seed: of the disturbance.
        """
        pixels = centroids(masks)
        points = np.full((masks.shape[1], 3), np.nan)
        for item in range(masks.shape[1]):
            found = locate(cameras, poses, pixels[:, item])
            if found is not None:
                points[item] = found.point
        shapes = object_shapes(masks, points, cameras, poses)
        if noise_m:
            points = points + np.random.default_rng(seed).normal(0.0, noise_m, points.shape)
        return TrackedObjects(reference=points, scene_features=shapes.features)

    def advance(
        self, tracked: TrackedObjects, positions: FloatArray
    ) -> tuple[ObjectMotion, TrackedObjects]:
        """Returns where the objects are at each of (1 + T, J) positions, `step_s` apart.

        Row 0 is where the last call ended, or where the objects were found.
        """
        tools = self._robot.tool_poses(positions).transpose(1, 0, 2, 3)
        openings = self._robot.gripper_openings(positions).T
        first = tools[:1] if tracked.tools is None else tracked.tools[None]
        first_openings = openings[:1] if tracked.openings is None else tracked.openings[None]
        known = np.isfinite(tracked.reference).all(-1)
        scene = Scene(
            points=_tensor(np.where(known[:, None], tracked.reference, 0.0)),
            features=_tensor(tracked.scene_features),
            present=torch.from_numpy(known)[None],
            tools=_tensor(np.concatenate([first, tools])),
            openings=_tensor(np.concatenate([first_openings, openings])),
        )
        with torch.inference_mode():
            motion, memory = self._network.roll(scene, tracked.memory, skip=1)
        points = motion.points[0].double().numpy()
        points[:, ~known] = np.nan
        result = ObjectMotion(
            reference=tracked.reference,
            points=points,
            rotations=motion.rotations[0].double().numpy(),
        )
        later = TrackedObjects(
            reference=tracked.reference,
            scene_features=tracked.scene_features,
            memory=memory,
            tools=tools[-2] if len(tools) > 1 else first[0],
            openings=openings[-2] if len(openings) > 1 else first_openings[0],
        )
        return result, later


def _tensor(values: FloatArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))[None]


def save_network(network: ObjectMotionNetwork, folder: Path) -> None:
    """Writes a network into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    save_file(tensors, folder / _WEIGHTS)
    write_json(folder / _CONFIG, network.config)


def load_network(folder: Path) -> ObjectMotionNetwork | None:
    """Returns the network of a folder; None where there is no such folder.

    Raises:
        CheckpointError: what it holds is not whole.
    """
    if not folder.is_dir():
        return None
    try:
        network = ObjectMotionNetwork(**json.loads((folder / _CONFIG).read_text()))
        network.load_state_dict(load_file(folder / _WEIGHTS))
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"'{folder}' cannot be used: {error}; train it anew") from error
    return network


def num_features(num_views: int) -> int:
    """Returns how many numbers describe an object that so many views see."""
    return num_views * NUM_FEATURES
