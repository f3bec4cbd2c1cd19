"""Writes rosbag2 MCAP folders: any topic of the standard message packages as raw bytes."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import shutil
import tempfile
from threading import Lock
from types import TracebackType
from typing import IO, Self

from mcap.writer import CompressionType, Writer

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.metadata import (
    bag_information,
    dump_information,
    dump_metadata_yaml,
    dump_qos,
    Qos,
    TopicRecord,
)
from mtv_world_ros.errors import EpisodeError

#: small chunks: a cut file loses little more than its last chunk
CHUNK_BYTES = 256 * 1024


class BagWriter:
    """Records topics of the standard message packages as a rosbag2 MCAP folder.

    Everything is written into a hidden folder beside `path` that gets its name in `close()`,
    so a crash leaves nothing under `path`. As a context manager it closes when the block
    ends and drops the record when it raises. Messages may come from several threads.

    Raises:
        EpisodeError: `path` exists (and not `overwrite`) or its parent cannot be written.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        self._check_free()
        self._file_name = f'{self.path.name}_0.mcap'
        self._topics: dict[str, tuple[int, TopicRecord]] = {}
        self._schemas: dict[str, int] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._lock = Lock()
        self._folder, self._file = self._open()
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='mtv_world_ros')

    @property
    def folder(self) -> Path:
        """Folder for files that go with the bag (hidden until `close()`)."""
        return self._folder

    def declare(self, topic: str, msgtype: str, qos: Qos | None = None) -> None:
        """Adds a topic, with the QoS profile that `ros2 bag play` will offer.

        Topics that are not declared get a reliable profile of depth 10 at their first message.

        Raises:
            EpisodeError: the type is unknown, or the topic has another type already.
        """
        with self._lock:
            self._channel(topic, msgtype, qos)

    def write_raw(
        self,
        topic: str,
        msgtype: str,
        stamp_ns: int,
        data: bytes,
        *,
        publish_ns: int | None = None,
    ) -> None:
        """Records one message.

        Args:
            topic: absolute topic name.
            msgtype: e.g. `sensor_msgs/msg/Image`.
            stamp_ns: log time [ns] (receipt; in episodes equal to the header's stamp).
            data: CDR bytes with encapsulation header, as a raw subscription gives them.
            publish_ns: time of publication [ns]; by default the log time.

        Raises:
            EpisodeError: unknown type, a topic of another type, or a negative stamp.
        """
        if stamp_ns < 0:
            raise EpisodeError(f"'{topic}': stamp {stamp_ns} ns is negative")
        with self._lock:
            channel, record = self._channel(topic, msgtype, None)
            self._writer.add_message(
                channel,
                log_time=stamp_ns,
                publish_time=stamp_ns if publish_ns is None else publish_ns,
                sequence=record.message_count,
                data=bytes(data),
            )
            record.message_count += 1
            self._first_ns = min(stamp_ns, stamp_ns if self._first_ns is None else self._first_ns)
            self._last_ns = max(stamp_ns, self._last_ns)

    def set_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Sets the MCAP metadata record `name`, also found in metadata.yaml's custom_data."""
        self._metadata[name] = {key: str(value) for key, value in values.items()}

    def close(self) -> None:
        """Finishes the record and gives it its name; a second call does nothing.

        Raises:
            EpisodeError: something else took the name meanwhile; the record is dropped.
        """
        with self._lock:
            if self._file.closed:
                return
            try:
                self._finish()
                self._check_free()
                self._take_name()
            finally:
                self._drop()

    def abort(self) -> None:
        """Deletes the unfinished recording. Does nothing after `close()`."""
        with self._lock:
            self._drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _check_free(self) -> None:
        if self.path.exists() and not self._overwrite:
            raise EpisodeError(
                f"'{self.path}' exists already; choose another name or overwrite it"
            )
        if self.path.exists() and not (self.path / 'metadata.yaml').is_file():
            raise EpisodeError(f"'{self.path}' is not a bag folder; it will not be overwritten")

    def _open(self) -> tuple[Path, IO[bytes]]:
        parent = self.path.absolute().parent
        try:
            parent.mkdir(parents=True, exist_ok=True)
            folder = Path(
                tempfile.mkdtemp(dir=parent, prefix=f'.{self.path.name}.', suffix='.tmp')
            )
            folder.chmod(0o755)
            return folder, (folder / self._file_name).open('wb')
        except OSError as error:
            raise EpisodeError(f"cannot write '{self.path}': {error}") from error

    def _channel(self, topic: str, msgtype: str, qos: Qos | None) -> tuple[int, TopicRecord]:
        if self._file.closed:
            raise EpisodeError(f"'{self.path}' is closed; '{topic}' cannot be recorded any more")
        known = self._topics.get(topic)
        if known is None:
            known = self._topics[topic] = self._add_channel(topic, msgtype, qos or Qos())
        elif known[1].msgtype != msgtype:
            raise EpisodeError(f"'{topic}' is recorded as {known[1].msgtype}, not as {msgtype}")
        return known

    def _add_channel(self, topic: str, msgtype: str, qos: Qos) -> tuple[int, TopicRecord]:
        if msgtype not in self._schemas:
            text = messages.definition(msgtype)
            self._schemas[msgtype] = self._writer.register_schema(
                name=msgtype, encoding='ros2msg', data=text.encode()
            )
        record = TopicRecord(
            name=topic, msgtype=msgtype, type_hash=messages.type_hash(msgtype), qos=qos
        )
        channel = self._writer.register_channel(
            topic=topic,
            message_encoding='cdr',
            schema_id=self._schemas[msgtype],
            metadata={'offered_qos_profiles': dump_qos(qos), 'topic_type_hash': record.type_hash},
        )
        return channel, record

    def _finish(self) -> None:
        custom = {key: text for part in self._metadata.values() for key, text in part.items()}
        records = [record for _, record in self._topics.values()]
        information = bag_information(
            self._file_name, records, self._first_ns or 0, self._last_ns, custom
        )
        for name, values in self._metadata.items():
            self._writer.add_metadata(name, values)
        self._writer.add_metadata(
            'rosbag2', {'serialized_metadata': dump_information(information)}
        )
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        (self._folder / 'metadata.yaml').write_text(
            dump_metadata_yaml(information), encoding='utf-8'
        )

    def _take_name(self) -> None:
        if not self.path.exists():
            self._folder.rename(self.path)
            return
        old = self._folder.with_suffix('.old')
        self.path.rename(old)
        self._folder.rename(self.path)
        shutil.rmtree(old, ignore_errors=True)

    def _drop(self) -> None:
        self._file.close()
        shutil.rmtree(self._folder, ignore_errors=True)
