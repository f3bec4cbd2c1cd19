"""Descriptions kept on disk, so that a frame is described once."""

from __future__ import annotations

from dataclasses import asdict
import hashlib
import json
from pathlib import Path

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import ConfigError, DescriptionError
from mtv_world_ros.files import write_whole
from mtv_world_ros.vision.describers.scene_objects import check_objects, SceneObject


class DescriptionCache:
    """One JSON file per description in a folder.

    Scenes without objects are kept like others; failures are never written here.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).expanduser()

    @staticmethod
    def key(frame: ByteArray, instruction: str, prompt_version: str, model: str) -> str:
        """Returns the sha256 of everything that an answer depends on."""
        digest = hashlib.sha256()
        for part in (str(frame.shape), instruction, prompt_version, model):
            digest.update(f'{len(part)}:{part}'.encode())
        digest.update(frame.tobytes())
        return digest.hexdigest()

    def get(self, key: str) -> tuple[SceneObject, ...] | None:
        """Returns what was kept; None if there is nothing, or nothing that can be read."""
        try:
            kept = json.loads(self._file(key).read_text(encoding='utf-8'))
            return check_objects(kept['objects'], complete=False)
        except (OSError, ValueError, KeyError, TypeError, DescriptionError):
            return None  # asked again, and written over

    def put(self, key: str, objects: tuple[SceneObject, ...], model: str) -> None:
        """Keeps a description; a reader sees the whole file or none.

        Raises:
            ConfigError: the folder cannot be written to.
        """
        content = {'model': model, 'objects': [asdict(item) for item in objects]}
        try:
            write_whole(self._file(key), json.dumps(content, indent=1) + '\n')
        except OSError as error:
            raise ConfigError(
                f"the describer's 'cache' folder '{self.folder}' cannot be written to ({error}); "
                'name another one, or none'
            ) from error

    def _file(self, key: str) -> Path:
        return self.folder / f'{key}.json'
