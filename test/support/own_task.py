"""A task that is not bundled: its file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mtv_world_ros.data.episode import TASK_DEFINITION
from mtv_world_ros.success.task import dump_task, load_task

SHIFT_RIGHT = """
name: shift_right
instruction: shift the {a} to the right
relations: [{kind: shifted, subject: a, offset_m: [0.1, 0, 0]}]
scene:
  roles:
    - {role: a, shapes: [cup], x_range: [-0.2, -0.15]}
    - {role: b, x_range: [0.1, 0.2]}
  moves:
    - {subject: a, reference: start, offset: [0.1, 0.0]}
"""


def write_shift_right(folder: Path, *, distance_m: float = 0.1) -> Path:
    """Write the file; another distance is another definition of the same name."""
    path = folder / 'shift_right.yaml'
    path.write_text(SHIFT_RIGHT.replace('[0.1, 0, 0]', f'[{distance_m}, 0, 0]'))
    return path


def shift_right_episode(folder: Path, *, distance_m: float = 0.1) -> dict[str, Any]:
    """Return the options of `make_episode` for an episode that defines the task."""
    path = write_shift_right(folder, distance_m=distance_m)
    definition = json.dumps(dump_task(load_task(path)))
    path.unlink()
    return {
        'task': 'shift_right',
        'instruction': 'shift the red block to the right',
        'metadata': {TASK_DEFINITION: definition},
    }
