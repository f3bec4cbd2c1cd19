"""Recordings at the model's size kept on disk, keyed by everything they depend on."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data_types import CameraModel, JointTrajectory, WorldModelSpec
from mtv_world_ros.geometry.robot import RobotModel

#: raised when what is stored, or how it is computed, changes
_VERSION = 2


def cached_recording(
    path: Path, spec: WorldModelSpec, robot: RobotModel, cache: Path
) -> Recording:
    """Returns `load_recording`'s result, from the cache where it is current.

    The key holds the bag's files (name, size, time), views, size, and robot: a changed episode
    or setting misses the cache instead of using what is stale.
    """
    stored = cache / f'{_key(path, spec, robot)}.npz'
    if stored.is_file():
        return _load(stored, path)
    recording = load_recording(path, spec, robot)
    cache.mkdir(parents=True, exist_ok=True)
    partial = stored.with_suffix('.partial.npz')
    _save(partial, recording)
    partial.rename(stored)
    return recording


def _key(path: Path, spec: WorldModelSpec, robot: RobotModel) -> str:
    files = sorted((f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in path.iterdir())
    parts = [_VERSION, str(path.resolve()), files, spec.views, spec.width, spec.height,
             robot.name, robot.joint_names]  # fmt: skip
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def _save(file: Path, recording: Recording) -> None:
    commands = recording.commands
    text = {
        'task': recording.task,
        'outcome': recording.outcome,
        'instruction': recording.instruction,
        'objects': recording.objects,
        'joint_names': commands.joint_names,
        'stamp_ns': recording.stamp_ns,
        'cameras': [
            {
                'view': c.view,
                'width': c.width,
                'height': c.height,
                'distortion_model': c.distortion_model,
                'mount_link': c.mount_link,
            }
            for c in recording.cameras
        ],
    }
    arrays = {
        'times': recording.times,
        'frames': recording.frames,
        'positions': recording.positions,
        'command_times': commands.times,
        'command_positions': commands.positions,
    }
    if recording.object_ids is not None:
        arrays['object_ids'] = recording.object_ids
    if recording.object_poses is not None:
        arrays['object_poses'] = recording.object_poses
    if commands.velocities is not None:
        arrays['command_velocities'] = commands.velocities
    for index, camera in enumerate(recording.cameras):
        arrays[f'K_{index}'] = camera.K
        arrays[f'distortion_{index}'] = camera.distortion
        arrays[f'pose_{index}'] = camera.T_mount_camera
    np.savez(file, text=np.array(json.dumps(text)), **arrays)  # type: ignore[arg-type]


def _load(file: Path, path: Path) -> Recording:
    with np.load(file, allow_pickle=False) as stored:
        text = json.loads(str(stored['text']))
        cameras = tuple(
            CameraModel(
                K=stored[f'K_{i}'],
                distortion=stored[f'distortion_{i}'],
                T_mount_camera=stored[f'pose_{i}'],
                **row,
            )
            for i, row in enumerate(text['cameras'])
        )
        names = stored.files
        return Recording(
            path=Path(path),
            task=text['task'],
            outcome=text['outcome'],
            instruction=text['instruction'],
            objects=tuple(text['objects']),
            cameras=cameras,
            times=stored['times'],
            frames=stored['frames'],
            object_ids=stored['object_ids'] if 'object_ids' in names else None,
            positions=stored['positions'],
            commands=JointTrajectory(
                joint_names=text['joint_names'],
                times=stored['command_times'],
                positions=stored['command_positions'],
                velocities=stored['command_velocities'] if 'command_velocities' in names else None,
            ),
            stamp_ns=text['stamp_ns'],
            object_poses=stored['object_poses'] if 'object_poses' in names else None,
        )
