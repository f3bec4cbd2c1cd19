"""Formats of recordings that are not read, and what converts them."""

from __future__ import annotations

from pathlib import Path
import shlex

#: what a folder or file of a format is known by, and what converts it
_ZARR = (
    'zarr is not read: LeRobot converts it (its scripts for UMI and PushT), then mtv-world import '
    'lerobot; or copy its arrays into HDF5, one file an episode, for mtv-world import videos'
)
_HDF5 = 'HDF5 is read by mtv-world import videos, see config/datasets/aloha.yaml'
_RLDS = (
    'RLDS (TFRecord) is not read: LeRobot converts it, then mtv-world import lerobot; or copy its '
    'steps into HDF5, one file an episode, images as JPEG, for mtv-world import videos'
)
#: where shards of an RLDS data set are below the folder that is given: NAME/1.0.0/
_SHARDS = ('*.tfrecord*', '*/*.tfrecord*', '*/*/*.tfrecord*')


def unread_hint(folder: Path) -> str:
    """Return a hint on converting zarr arrays or RLDS, after a semicolon; empty = neither."""
    if _is_zarr(folder):
        return f'; {_ZARR}'
    if '.tfrecord' in folder.name or any(next(folder.glob(one), None) for one in _SHARDS):
        return f'; {_RLDS}'
    return ''


def _is_zarr(path: Path) -> bool:
    """Return whether a path is a zarr array or group, a zipped one, or a folder that holds one."""
    if path.name.endswith(('.zarr', '.zarr.zip')):
        return True
    if not path.is_dir():
        return False
    names = {entry.name for entry in path.iterdir()}
    return bool(names & {'.zgroup', '.zarray', 'zarr.json'}) or any(
        name.endswith(('.zarr', '.zarr.zip')) for name in names
    )


def conversion_hint(path: Path) -> str:
    """Return a hint on reading or converting a file that is no bag, after a semicolon."""
    if hint := unread_hint(path):
        return hint
    names = [path.name] if path.is_file() else []
    if path.is_dir():
        names = [entry.name for entry in path.iterdir()]
    if any(name.endswith(('.hdf5', '.h5')) for name in names):
        return f'; {_HDF5}'
    if (path / 'meta' / 'info.json').is_file():
        words = ['mtv-world', 'import', 'lerobot', str(path), '--robot', 'ROBOT', '--out', 'DIR']
        return f'; it is a LeRobot data set, which {shlex.join(words)} makes episodes of'
    return ''
