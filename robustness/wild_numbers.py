"""Files that are whole but for one number: what is read of them is refused, or within reason.

`mutated` bytes seldom are a number of another size; here one leaf of a JSON or YAML file is. What
is read is judged by numbers of this module's own: what no robot or camera has is a failure.
"""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

#: put in the place of a number, beside multiples of it
NUMBERS = (
    1e12, -1e12, 1e308, -1e308, 1e30, 1e-300, 0, -1, 10**15, float('nan'), float('inf'), True,
    False, '1', None, [], 2**63, 2**31, 1e6,
)  # fmt: skip
FACTORS = (1e-9, 1e-6, 1e3, 1e6, 1e9, -1.0)
#: of contact, in the units of the file: what matter and machines have
CONTACT = {
    'finger_stiffness': (1e-2, 1e7), 'finger_damping': (1e-4, 1e6), 'finger_mass_kg': (1e-5, 100),
    'pad_stiffness': (1, 1e8), 'grip_friction': (1e-3, 20), 'table_friction': (1e-3, 20),
    'density': (1, 3e4), 'tray_kg': (1e-4, 1e3), 'rim_m': (1e-5, 1), 'wall_m': (1e-5, 1),
    'table_m': (-1e3, 1e3), 'num_motions': (1, 100),
}  # fmt: skip


def _leaves(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where numbers stand."""
    if isinstance(values, dict):
        return [p for key, value in values.items() for p in _leaves(value, (*path, key))]
    if isinstance(values, list):
        return [p for key, value in enumerate(values) for p in _leaves(value, (*path, key))]
    return [path] if isinstance(values, int | float) and not isinstance(values, bool) else []


def with_wild_number(samples: list[bytes], rng: np.random.Generator) -> bytes:
    """A sample with another number; what stands before a line break at the front stays a name."""
    sample = samples[rng.integers(len(samples))]
    name, _, content = sample.partition(b'\n')
    is_named = name.endswith(b'.json') and content.startswith(b'{')
    values = yaml.safe_load(content if is_named else sample)
    places = _leaves(values)
    if places:
        *path, last = places[rng.integers(len(places))]
        parent = values
        for key in path:
            parent = parent[key]
        chosen = NUMBERS[rng.integers(len(NUMBERS))]
        if rng.random() < 0.4:
            chosen = parent[last] * FACTORS[rng.integers(len(FACTORS))]
        parent[last] = chosen
    out = json.dumps(values).encode()  # which is YAML as well, but for numbers that are none
    if not is_named and not sample.lstrip().startswith(b'{'):
        out = yaml.safe_dump(values).encode()
    return name + b'\n' + out if is_named else out


def weights(samples: list[bytes], rng: np.random.Generator) -> bytes:
    """A safetensors file of which one value is no number."""
    from safetensors.torch import load, save

    tensors = load(samples[rng.integers(len(samples))])
    names = [name for name, tensor in tensors.items() if tensor.is_floating_point()]
    tensor = tensors[names[rng.integers(len(names))]].reshape(-1)
    tensor[int(rng.integers(len(tensor)))] = float(rng.choice([np.nan, np.inf, -np.inf]))
    return bytes(save(tensors))


def judged(read: Callable[[bytes, Path], Any], judge: Callable[[Any], None]) -> Any:
    """What reads, and then judges."""

    def run(data: bytes, folder: Path) -> None:
        found = read(data, folder)
        if found is not None:
            judge(found)

    return run


def no_survivors(read: Callable[[bytes, Path], Any], is_whole: Callable[[bytes], bool]) -> Any:
    """What reads what must be refused, unless it is whole."""

    def run(data: bytes, folder: Path) -> None:
        read(data, folder)
        assert is_whole(data), 'values that are no numbers were read as weights'

    return run


def are_finite(data: bytes) -> bool:
    """Whether all values of a safetensors file are finite."""
    from safetensors.numpy import load

    return all(np.isfinite(tensor).all() for tensor in load(data).values())


def plausible_contact(contact: Any) -> None:
    """Within what matter and machines have."""
    for name, (low, high) in CONTACT.items():
        value = getattr(contact, name)
        assert value is None or low <= value <= high, f'{name} is {value}'


def plausible_response(response: Any) -> None:
    """An arm answers within seconds, and no unit makes it stiffer than that."""
    for name in ('compliance', 'armature', 'damping', 'lead'):
        values = getattr(response, name)
        assert ((values >= 0) & (values <= 100)).all(), f'{name} is {values}'
    assert response.floor is None or abs(response.floor) < 1e3, f'floor is {response.floor}'


def plausible_robot(robot: Any) -> None:
    """All of it is within a kilometre, and is where numbers say."""
    middle = np.clip((robot.lower + robot.upper) / 2, -10, 10)
    middle = np.where(np.isfinite(middle), middle, 0.0)
    places = robot.tool_poses(middle[None])[..., :3, 3]
    assert np.isfinite(places).all() and (np.abs(places) < 1e3).all(), f'a tool is at {places}'
    ends = np.stack([robot.lower, robot.upper])
    assert (np.isinf(ends) | (np.abs(ends) < 1e4)).all(), f'limits are {ends}'


def plausible_cameras(cameras: Any) -> None:
    """There are some, of a size that sensors have, within a kilometre of what carries them."""
    assert cameras, 'no view at all'
    for camera in cameras.values():
        assert not isinstance(camera.width, bool) and not isinstance(camera.height, bool)
        assert 1 < camera.width < 1e6 and 1 < camera.height < 1e6, 'size'
        assert (np.abs(camera.T_mount_camera[:3, 3]) < 2e3).all(), 'place'


def plausible_checkpoint(checkpoint: Any) -> None:
    """Its card is of a camera and a chunk."""
    card = checkpoint.card
    assert 1e-3 <= card.fps <= 1e4, f'fps is {card.fps}'
    for name in ('width', 'height', 'num_frames', 'num_inference_steps'):
        value = getattr(card, name)
        assert not isinstance(value, bool) and 1 <= value <= 1e5, f'{name} is {value}'
    assert np.isfinite(card.guidance_scale) and abs(card.guidance_scale) < 1e4, 'guidance'


def plausible_scene(scene: Any) -> None:
    """Objects of a room, and commands for minutes at most."""
    _, solids, commands = scene
    assert np.isfinite(commands).all() and (np.abs(commands) < 100).all(), 'commands'
    assert len(commands) < 20_000, f'{len(commands)} commands'
    for solid in solids:
        assert (solid.size > 0).all() and (solid.size < 1e3).all(), f'size is {solid.size}'
        assert (np.abs(solid.centre) < 1e3).all() and abs(solid.yaw) < 1e3, 'place'
