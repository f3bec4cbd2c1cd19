"""Writes rosbag2 MCAP folders: any topic of the standard message packages as raw bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import errno
import os
from pathlib import Path
import secrets
import shutil
from threading import Lock
from types import TracebackType
from typing import cast, IO, Self

from mcap.writer import CompressionType, Writer

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import is_free, replace_folder
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.metadata import (
    bag_information,
    dump,
    dump_qos,
    Qos,
    TopicRecord,
)

#: small chunks: a cut file loses little more than its last chunk
CHUNK_BYTES = 256 * 1024
#: space kept free for metadata, and what the index needs for a chunk and a channel in it
_RESERVE_BYTES = 1024 * 1024
_INDEX_BYTES = (128, 16)
RESERVE_NAME = '.reserve'


class BagWriter:
    """Writer of topics of the standard message packages into a rosbag2 MCAP folder.

    Everything is written into a hidden folder next to `path` that gets its name in `close()`,
    so a crash leaves nothing under `path`; `mtv-world recover` finds such a folder. As a context
    manager it closes when the block ends and drops the record when it raises. Messages may come
    from several threads.

    Args:
        path: folder to make.
        overwrite: replace an existing bag.
        keep: whether everything that was recorded stays: space for the index is reserved, so that
            the bag is closed whole even on a full disk; a block that raises closes it, too.

    Raises:
        EpisodeError: `path` exists (and not `overwrite`) or its parent cannot be written.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False, keep: bool = False) -> None:
        self.path = Path(path)
        self._overwrite, self._keep = overwrite, keep
        self._check_free()
        self._file_name = f'{self.path.name}_0.mcap'
        self._topics: dict[str, tuple[int, TopicRecord]] = {}
        self._schemas: dict[str, int] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._lock = Lock()
        self._folder, self._file = self._open()
        stream = cast('IO[bytes]', self._file)  # all that the writer calls of it
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='mtv_world_ros')
        self._failure = ''

    @property
    def num_messages(self) -> int:
        """Number of messages recorded by now."""
        return sum(record.message_count for _, record in self._topics.values())

    @property
    def folder(self) -> Path:
        """Folder for files that go with the bag (hidden until `close()`)."""
        return self._folder

    def declare(
        self, topic: str, msgtype: str, qos: Qos | None = None, definition: str = ''
    ) -> None:
        """Add a topic, with the QoS profile that `ros2 bag play` will offer.

        `definition` is the `.msg` text of a type outside of the standard packages. Topics that are
        not declared get a reliable profile of depth 10 at their first message.

        Raises:
            EpisodeError: the type is unknown, or the topic has another type already.
        """
        with self._lock:
            self._channel(topic, msgtype, qos, definition)

    def write_raw(
        self,
        topic: str,
        msgtype: str,
        stamp_ns: int,
        data: bytes,
        *,
        publish_ns: int | None = None,
    ) -> None:
        """Record one message.

        Args:
            topic: absolute topic name.
            msgtype: type of the message, e.g. `sensor_msgs/msg/Image`.
            stamp_ns: log time [ns] (receipt; in episodes equal to the header's stamp).
            data: CDR bytes with encapsulation header, as a raw subscription gives them.
            publish_ns: time of publication [ns]; by default the log time.

        Raises:
            EpisodeError: unknown type, a topic of another type, a negative stamp, or the disk
                does not take it (full); what was written before is kept until `close`.
        """
        if stamp_ns < 0:
            raise EpisodeError(f"'{topic}': stamp {stamp_ns} ns is negative")
        with self._lock:
            if self._failure:
                raise EpisodeError(self._failure)
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
            self._store(self._file.flush)

    def write_message(self, topic: str, msgtype: str, stamp_ns: int, message: object) -> None:
        """Record a message of `messages.make`; see `write_raw`."""
        self.write_raw(topic, msgtype, stamp_ns, messages.serialize(msgtype, message))

    def flush(self) -> None:
        """Hand what was recorded to the operating system: a kill loses nothing of it.

        Raises:
            EpisodeError: the disk does not take it.
        """
        with self._lock:
            if not self._file.closed and not self._failure:
                self._store(self._writer.flush)

    def set_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Set the MCAP metadata record `name`, also found in metadata.yaml's custom_data."""
        self._metadata[name] = {key: str(value) for key, value in values.items()}

    def close(self) -> None:
        """Finish the record and give it its name; a second call does nothing.

        Raises:
            EpisodeError: something else took the name meanwhile, or the disk does not take the
                rest; the record is dropped, or with `keep` stays in the hidden folder.
        """
        with self._lock:
            if self._file.closed:
                return
            try:
                self._finish()
                self._check_free()
                self._take_name()
            except (OSError, EpisodeError) as error:
                raise EpisodeError(self._left_behind(str(error))) from error
            finally:
                self._file.close()
                if not self._keep:
                    self._drop()

    def abort(self) -> None:
        """Delete the unfinished recording. Does nothing after `close()`."""
        with self._lock:
            if not self._file.closed:
                self._drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None or self._keep:
            self.close()
        else:
            self.abort()

    def _check_free(self) -> None:
        if is_free(self.path):
            return
        if not self._overwrite:
            raise EpisodeError(f"'{self.path}' exists already; choose another name, or remove it")
        if not (self.path / 'metadata.yaml').is_file():
            raise EpisodeError(f"'{self.path}' is not a bag folder; it will not be overwritten")

    def _open(self) -> tuple[Path, _Spool]:
        parent = Path(os.path.realpath(self.path)).parent  # a link stays a link
        try:
            parent.mkdir(parents=True, exist_ok=True)
            folder = parent / f'.{self.path.name}.{secrets.token_hex(4)}.tmp'
            folder.mkdir()  # who may read it is the user's choice (umask)
            return folder, _Spool(folder / self._file_name, reserves=self._keep)
        except OSError as error:
            raise EpisodeError(f"cannot write '{self.path}': {error}") from error

    def _store(self, flush: Callable[[], None]) -> None:
        try:
            flush()
        except OSError as error:
            self._failure = f"cannot write '{self.path}': {error}"
            raise EpisodeError(self._failure) from error

    def _left_behind(self, reason: str) -> str:
        if not self._keep:
            return reason
        return (
            f"{reason}; what was recorded is in '{self._folder}': make room and call "
            '`mtv-world recover` with it'
        )

    def _channel(
        self, topic: str, msgtype: str, qos: Qos | None, definition: str = ''
    ) -> tuple[int, TopicRecord]:
        if self._file.closed:
            raise EpisodeError(f"'{self.path}' is closed; '{topic}' cannot be recorded any more")
        known = self._topics.get(topic)
        if known is None:
            known = self._add_channel(topic, msgtype, qos or Qos(), definition)
            self._topics[topic] = known
            self._file.num_channels = len(self._topics)
        elif known[1].msgtype != msgtype:
            raise EpisodeError(f"'{topic}' is recorded as {known[1].msgtype}, not as {msgtype}")
        return known

    def _add_channel(
        self, topic: str, msgtype: str, qos: Qos, definition: str
    ) -> tuple[int, TopicRecord]:
        is_foreign = definition and not messages.is_standard(msgtype)
        if msgtype not in self._schemas:
            text = definition if is_foreign else messages.definition(msgtype)
            self._schemas[msgtype] = self._writer.register_schema(
                name=msgtype, encoding='ros2msg', data=text.encode()
            )
        type_hash = '' if is_foreign else messages.type_hash(msgtype)
        record = TopicRecord(name=topic, msgtype=msgtype, type_hash=type_hash, qos=qos)
        channel = self._writer.register_channel(
            topic=topic,
            message_encoding='cdr',
            schema_id=self._schemas[msgtype],
            metadata={'offered_qos_profiles': dump_qos(qos), 'topic_type_hash': record.type_hash},
        )
        return channel, record

    def _finish(self) -> None:
        if self._failure:
            self.set_metadata('recording', {'cut_off': self._failure})
        custom = {key: text for part in self._metadata.values() for key, text in part.items()}
        records = [record for _, record in self._topics.values()]
        information = bag_information(
            self._file_name, records, self._first_ns or 0, self._last_ns, custom
        )
        for name, values in self._metadata.items():
            self._writer.add_metadata(name, values)
        self._writer.add_metadata('rosbag2', {'serialized_metadata': dump(information)})
        self._file.release()
        self._writer.finish()
        self._file.flush()
        self._file.sync()
        self._file.close()
        (self._folder / 'metadata.yaml').write_text(
            dump({'rosbag2_bagfile_information': information}), encoding='utf-8'
        )

    def _take_name(self) -> None:
        path = Path(os.path.realpath(self.path))
        if is_free(path):
            self._folder.rename(path)
            return
        replace_folder(self._folder, path)

    def _drop(self) -> None:
        self._file.close()
        shutil.rmtree(self._folder, ignore_errors=True)


class _Spool:
    """The file of a bag: what the disk does not take stays in memory, and the file stays whole.

    Args:
        path: file to make.
        reserves: whether to hold space for the index, so that `release` makes room for it.

    Attributes:
        num_channels: number of channels of the bag; the index grows with it.
    """

    def __init__(self, path: Path, *, reserves: bool) -> None:
        self._file = path.open('xb', buffering=0)
        self._reserve_path = path.with_name(RESERVE_NAME)
        self._pending = bytearray()
        self._size = 0
        self._largest = 0
        self._num_flushes = 0
        self.num_channels = 0
        self._reserved = 0 if reserves else -1

    @property
    def closed(self) -> bool:
        return self._file.closed

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._size + len(self._pending)

    def flush(self) -> None:
        """Write what is pending, whole or not at all.

        Raises:
            OSError: the disk does not take it; it stays pending.
        """
        if not self._pending:
            return
        self._num_flushes += 1
        self._largest = max(self._largest, len(self._pending))
        self._reserve()
        done = 0
        try:
            with memoryview(self._pending) as data:
                while done < len(data):
                    done += self._file.write(data[done:])
        except OSError:
            self._file.truncate(self._size)
            self._file.seek(self._size)
            raise
        self._size += done
        self._pending.clear()

    def release(self) -> None:
        """Give the reserved space back, for the index; nothing is reserved from now on."""
        self._reserved = -1
        self._reserve_path.unlink(missing_ok=True)

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def _reserve(self) -> None:
        """Reserve disk space for the next chunk and for the index of all chunks."""
        chunk, channel = _INDEX_BYTES
        index = self._num_flushes * (chunk + channel * self.num_channels)
        needed = _RESERVE_BYTES + 2 * self._largest + index
        if not 0 <= self._reserved < needed:
            return
        with self._reserve_path.open('ab') as file:
            try:
                os.posix_fallocate(file.fileno(), 0, 2 * needed)
            except OSError as error:
                if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                    raise
        self._reserved = 2 * needed
