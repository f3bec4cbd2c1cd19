"""Settings stored with results: checkpoints by their content, and a check of a folder."""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import sha256
import json
from pathlib import Path
from typing import Any

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import content_digest, plain
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.success.task import dump_task, TaskSpec


def fingerprint(
    checkpoint: Checkpoint,
    *,
    calibrated: bool = True,
    adapter: Path | None = None,
    task: str | TaskSpec | None = None,
) -> str:
    """Return the checkpoint's name with a hash of its files.

    Args:
        checkpoint: the checkpoint.
        calibrated: include the files of the calibration in the hash.
        adapter: LoRA adapter that is used with it.
        task: name or file of the task that is judged, or its definition.
    """
    from mtv_world_ros.success.calibration import FIT_FILES

    without = () if calibrated else FIT_FILES
    parts = [f'{checkpoint} ({checkpoint.digest(without)[:8]})']
    files = [] if adapter is None else [('adapter', adapter)]
    if isinstance(task, TaskSpec):
        text = json.dumps(dump_task(task), sort_keys=True)
        parts.append(f'task {task.name} ({sha256(text.encode()).hexdigest()[:8]})')
    elif task is not None and not task.endswith(('.yaml', '.yml')):
        parts.append(f'task {task}')
    elif task is not None:
        files += [('task', Path(task))]
    parts += [f'{what} {path} ({content_digest(path)[:8]})' for what, path in files]
    return ', '.join(parts)


def check_same_settings(results: Path, settings: Mapping[str, Any], overwrite: bool) -> None:
    """Refuse a folder of results that were made with other settings.

    Args:
        results: folder of JSON files, each with the `settings` it was made with.
        settings: settings of this run; stored ones may have more keys.
        overwrite: allow results of other settings, which are replaced.

    Raises:
        ConfigError: a file was made with other settings, or by another version.
    """
    wanted = plain(settings)
    for file in () if overwrite else sorted(results.glob('*.json')):
        try:
            stored = read_json(file)['settings']
            other = [key for key in wanted if stored[key] != wanted[key]]
        except (OSError, ValueError):
            continue  # not readable, thus nothing is lost
        except (KeyError, TypeError):
            raise ConfigError(
                f"'{file}' was written by another version; give another --out, or --overwrite to "
                'replace it'
            ) from None
        if other:
            differing = '; '.join(f'{k} {stored[k]!r}, now {wanted[k]!r}' for k in other)
            raise ConfigError(
                f"'{results.parent}' holds results with other settings ({differing}); give "
                'another --out, or --overwrite to replace them'
            )
