from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel, JointTrajectory
from mtv_world_ros.data.episode_writer import EpisodeWriter

HEIGHT, WIDTH, FRAMES = 48, 64, 8
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
JOINTS = ('left_joint1', 'left_joint2', 'left_gripper')


def camera(view: str, width: int = WIDTH, height: int = HEIGHT) -> CameraModel:
    focal = 1.1 * width
    return CameraModel(
        view=view,
        width=width,
        height=height,
        K=np.array([[focal, 0, width / 2], [0, focal + 1, height / 2], [0, 0, 1]]),
        mount_link='base',
        T_mount_camera=np.array([[1, 0, 0, 0.1], [0, 0, 1, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1]]),
    )


def picture(index: int) -> np.ndarray:
    """Smooth, so that JPEG keeps it, and different for each index."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    planes = [(x * 3 + 10 * index) % 256, y * 4, np.full_like(x, 20 * index % 256)]
    return np.stack(planes, axis=-1).clip(0, 255).astype(np.uint8)


def object_ids(index: int) -> np.ndarray:
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[5:15, 5 + index : 20 + index] = 1
    ids[30:40, 30:50] = 2
    return ids


def trajectory() -> JointTrajectory:
    times = np.array([0.1, 0.25, 0.5])
    positions = np.arange(9.0).reshape(3, 3) / 7
    return JointTrajectory(
        joint_names=JOINTS, times=times, positions=positions, velocities=positions * 2
    )


def write_episode(
    path: Path,
    *,
    compressed: bool = True,
    views: tuple[str, ...] = ('low', 'high'),
    seed: int | None = 7,
    metadata: dict[str, str] | None = None,
) -> Path:
    cameras = [camera(view) for view in views]
    with EpisodeWriter(
        path,
        task='stack_blocks_two',
        instruction='stack the red block on the blue block',
        robot='yam_bimanual',
        cameras=cameras,
        seed=seed,
        objects=('red block', 'blue block'),
        metadata={'simulator': 'test', **(metadata or {})},
    ) as writer:
        writer.write_instruction(START_NS)
        writer.write_trajectory(START_NS, trajectory())
        for index in range(FRAMES):
            stamp = START_NS + index * PERIOD_NS
            for model in cameras:
                writer.write_image(model.view, stamp, picture(index), compressed=compressed)
                writer.write_mask(model.view, stamp, object_ids(index))
                writer.write_camera_info(model.view, stamp, model)
            writer.write_joint_states(stamp, JOINTS, [index, index / 3, -index])
        writer.outcome = 'success'
    return path


@pytest.fixture
def make_episode(tmp_path) -> Callable[..., Path]:
    """Record an episode of 8 frames, 48 x 64, and return its folder."""

    def make(name: str = 'episode', **options: object) -> Path:
        return write_episode(tmp_path / name, **options)  # type: ignore[arg-type]

    return make


@pytest.fixture(scope='module')
def episode_path(tmp_path_factory) -> Path:
    """The same, recorded once for tests that only read it."""
    return write_episode(tmp_path_factory.mktemp('episodes') / 'episode')
