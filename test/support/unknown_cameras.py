"""Episodes whose camera poses are forgotten: no calibration.yaml, no /tf_static."""

from pathlib import Path

from mtv_world_ros.data.bag.copying import copy_companions, copy_metadata, write_copies
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter


def forget_poses(path: Path) -> None:
    """Take the poses of the cameras out of an episode; CameraInfo stays."""
    reader = BagReader(path)
    kept = [message for message in reader.messages() if message.topic != '/tf_static']
    with BagWriter(path, overwrite=True) as writer:
        for _ in write_copies(reader, writer, kept):
            pass
        copy_metadata(reader, writer)
        copy_companions(path, writer.folder)
    (path / 'calibration.yaml').unlink()
