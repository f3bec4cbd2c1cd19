"""Encoded training clips on disk, used only while their settings and episodes are unchanged."""

from __future__ import annotations

from collections.abc import Mapping
import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors import safe_open, SafetensorError
from safetensors.torch import save
from torch import Tensor

from mtv_world_ros.bounded_input import parse_json, read_json
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.files import write_whole

#: bytes of tensors that are gathered before they are written
SHARD_BYTES = 256 * 2**20
SETTINGS = 'settings.json'
_STEM = 'latents'
_LABELS = 'labels'


def digest_of(*values: Any) -> str:
    """Returns 32 hexadecimal digits for plain values."""
    text = json.dumps(values, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


class LatentCache:
    """Tensors of clips in shards of safetensors, a folder for each combination of settings.

    A shard appears under its name only when it is whole, so that a run that was killed is resumed
    at its last shard.

    Args:
        root: holds caches of any settings.
        settings: everything that the tensors of all clips depend on, as plain values.
        shard_bytes: size at which a shard is written.

    Attributes:
        folder: of these settings.
        notes: caches in `root` that are not used, and why.
    """

    def __init__(
        self, root: Path, settings: Mapping[str, Any], *, shard_bytes: int = SHARD_BYTES
    ) -> None:
        self.root, self.settings = root, json.loads(json.dumps(settings, default=list))
        self.folder = root / digest_of(self.settings)
        self.notes = [] if self.folder.is_dir() else _other_settings(root, self.settings)
        self._shard_bytes = shard_bytes
        self._shards: dict[str, Any] = {}
        self._labels: dict[str, str] = {}
        self._waiting: dict[str, Tensor] = {}
        self._waiting_labels: dict[str, str] = {}
        for file in sorted(self.folder.glob(f'{_STEM}-*.safetensors')):
            self._open(file)

    def __contains__(self, key: str) -> bool:
        return key in self._shards

    def __len__(self) -> int:
        return len(self._shards)

    def read(self, key: str) -> dict[str, Tensor]:
        """Returns the tensors of a clip by name.

        Raises:
            TrainingError: the latents are missing.
        """
        if key not in self._shards:
            raise TrainingError(f"latent cache '{self.folder}' has no clip {key}")
        shard = self._shards[key]
        names = shard.keys()
        mine = [name for name in names if name.startswith(f'{key}/')]
        return {name.partition('/')[2]: shard.get_tensor(name) for name in mine}

    def changed(self, labels: Mapping[str, str]) -> list[str]:
        """Returns the labels of clips that are here with another content.

        Args:
            labels: names of the clips, by key.
        """
        held = {label: key for key, label in self._labels.items()}
        return sorted(
            label for key, label in labels.items() if key not in self._shards and label in held
        )

    def add(self, key: str, label: str, tensors: Mapping[str, Tensor]) -> None:
        """Adds the tensors of a clip; they are on disk once its shard is full, or after `flush`.

        Raises:
            TrainingError: the disk is full, or the folder cannot be written.
        """
        for name, tensor in tensors.items():
            self._waiting[f'{key}/{name}'] = tensor.detach().cpu().contiguous()
        self._waiting_labels[key] = label
        if sum(t.nbytes for t in self._waiting.values()) >= self._shard_bytes:
            self.flush()

    def flush(self) -> None:
        """Writes the clips that wait.

        Raises:
            TrainingError: the disk is full, or the folder cannot be written.
        """
        if not self._waiting:
            return
        data = save(self._waiting, {_LABELS: json.dumps(self._waiting_labels)})
        number = len(list(self.folder.glob(f'{_STEM}-*.safetensors')))
        while (file := self.folder / f'{_STEM}-{number:05d}.safetensors').exists():
            number += 1
        try:
            text = json.dumps(self.settings, indent=2, sort_keys=True) + '\n'
            write_whole(self.folder / SETTINGS, text)
            write_whole(file, data)
        except OSError as error:
            raise TrainingError(
                f"latent cache '{self.folder}' cannot be written: {error.strerror or error}; the "
                f'shard takes {len(data) / 1e6:.1f} MB, the {len(self)} clips before it are kept. '
                'Free some space and run the same command again, or give --latent-cache another '
                'folder'
            ) from error
        self._waiting, self._waiting_labels = {}, {}
        self._open(file)

    def _open(self, file: Path) -> None:
        try:
            shard: Any = safe_open(file, framework='pt')
            labels = dict(
                parse_json((shard.metadata() or {})[_LABELS], 'what it says of its clips')
            )
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            self.notes.append(
                f"'{file}' is damaged ({error}): its clips are encoded again; remove it"
            )
            return
        self._shards |= dict.fromkeys(labels, shard)
        self._labels |= labels


def _other_settings(root: Path, mine: Mapping[str, Any]) -> list[str]:
    """Settings in which the neighbouring caches differ."""
    notes = []
    for file in sorted(root.glob(f'*/{SETTINGS}')):
        try:
            theirs = dict(read_json(file))
        except (OSError, TypeError, ValueError):
            continue
        names = sorted(set(mine) | set(theirs))
        differing = [name for name in names if mine.get(name) != theirs.get(name)]
        changes = [f'{n} was {theirs.get(n)}, is {mine.get(n)}' for n in differing]
        notes.append(f"'{file.parent}' is not used: {'; '.join(changes)}")
    return notes
