"""Reads the raw messages of rosbag2 bags (MCAP, SQLite), including bags that were cut off."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager
import io
from pathlib import Path
import sqlite3
import struct
import tempfile
from typing import Any, BinaryIO, NamedTuple
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
import yaml
import zstandard

from mtv_world_ros.core.bounded_input import (
    limits,
    parse_yaml,
    placeholder,
    PREFIX,
    read_bytes,
    require_regular,
)
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.data.bag.foxglove import json_reader, protobuf_reader, Read, ros_reader
from mtv_world_ros.data.bag.ros1 import MAGIC as ROS1_MAGIC
from mtv_world_ros.data.bag.ros1 import Ros1Bag, Ros1Error
from mtv_world_ros.data.other_formats import conversion_hint

#: end of the names of ROS 1 bags
ROS1_SUFFIX = '.bag'
MAGIC = b'\x89MCAP0\r\n'
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_SQLITE_MAGIC = b'SQLite format 3\0'
#: page size, count of changes, number of pages, count of changes when that number was written
_SQLITE_HEAD = struct.Struct('>16xH6xII60xI4x')
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
_CHUNK = struct.Struct('<QQQII')
_READ_BYTES = 2**20
#: records that are looked into
_KNOWN = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)


class BagMessage(NamedTuple):
    """One recorded message.

    Attributes:
        topic: absolute topic name.
        msgtype: type of the message, e.g. `sensor_msgs/msg/Image`.
        stamp_ns: log time [ns].
        data: CDR bytes with encapsulation header.
        publish_ns: time of publication [ns].
    """

    topic: str
    msgtype: str
    stamp_ns: int
    data: bytes
    publish_ns: int = 0


_MORE = f'the environment variable {PREFIX}CHUNK_BYTES allows more'


class _Cut(Exception):
    """The recording is cut off or damaged from here on."""


class BagReader:
    """A rosbag2 folder of MCAP or SQLite files, or one such file; or a bag of ROS 1.

    Messages of ROS 1 and of Foxglove's schemas, also in Protobuf, are read as standard messages of
    ROS 2.

    Compression by file or by message (zstd) is undone. A bag that is cut off or damaged is read up
    to there; `truncated` then says where.

    Args:
        path: folder or file.
        as_recorded: messages are not translated, for copies.

    Attributes:
        truncated: reason why the record ends early; empty where it does not. Known after a pass.
        problems: other problems found, one line each.
        metadata: MCAP metadata records by name. Complete after a pass.
        custom_data: `custom_data` of metadata.yaml.
        listed_topics: message type of every topic that metadata.yaml lists, also of those
            without messages; empty where it does not list them.

    Raises:
        EpisodeError: there is no such bag, or it is stored as something else.
    """

    def __init__(self, path: Path | str, *, as_recorded: bool = False) -> None:
        self.path = Path(path)
        self._as_recorded = as_recorded
        self._readers: dict[tuple[str, bytes], Read | None] = {}
        self.truncated = ''
        self.problems: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.custom_data: dict[str, str] = {}
        self.listed_topics: dict[str, str] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._most_bytes = limits().chunk_bytes
        self._files = self._find_files()

    def topics(self) -> dict[str, str]:
        """Return message type of every topic that has messages, in order of first appearance."""
        return {message.topic: message.msgtype for message in self.messages()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages of `topics` (default: all) in the order they were recorded.

        Messages that are not in CDR are skipped and named in `problems`.

        Raises:
            EpisodeError: a file is neither MCAP nor SQLite, or uses an unknown compression.
        """
        self.truncated, self.metadata = '', {}
        for file in self._files:
            self._schemas, self._channels = {}, {}
            if problem := placeholder(file):
                raise EpisodeError(f"'{file}' {problem}")
            try:
                require_regular(file)
                with _decompressed(file) as plain:
                    for message in self._reader_of(plain)(plain, file, topics):
                        found = self._standard(_unpacked(message))
                        if found is not None:
                            yield found
            except _Cut as cut:
                self.truncated = f"'{file}' is cut off or damaged: {cut}"
                return
            except OSError as error:
                raise EpisodeError(f"cannot read '{file}': {error}") from error

    def _reader_of(
        self, plain: Path
    ) -> Callable[[Path, Path, Collection[str] | None], Iterator[BagMessage]]:
        if plain.suffix == '.db3':
            return self._sqlite
        with plain.open('rb') as stream:
            is_ros1 = stream.read(len(ROS1_MAGIC)) == ROS1_MAGIC
        return self._ros1 if is_ros1 else self._mcap

    def _standard(self, message: BagMessage) -> BagMessage | None:
        """Return a message as a standard one, where it is of Foxglove; None = left out."""
        if self._as_recorded or not message.msgtype.startswith('foxglove_msgs/'):
            return message
        key = (message.msgtype, b'')
        if key not in self._readers:
            self._readers[key] = ros_reader(message.msgtype)
        return self._translated(self._readers[key], message)

    def _translated(self, read: Read | None, message: BagMessage) -> BagMessage | None:
        if read is None:
            return message
        try:
            msgtype, data = read(message.data)
        except MtvWorldError as error:
            self._problem(f"'{message.topic}': a message was left out: {error}")
            return None
        return message._replace(msgtype=msgtype, data=data)

    def _packed(self, channel: Channel, message: BagMessage) -> BagMessage | None:
        """Return a message in Protobuf or JSON as a standard one; None = left out, by name."""
        schema = self._schemas[channel.schema_id]
        key = (schema.name, schema.data)
        if key not in self._readers:
            self._readers[key] = None
            try:
                make = json_reader if channel.message_encoding == 'json' else protobuf_reader
                self._readers[key] = make(schema)
            except EpisodeError as error:
                self._problem(f"'{channel.topic}' was left out: {error}")
        read = self._readers[key]
        return None if read is None else self._translated(read, message)

    def _ros1(
        self, plain: Path, file: Path, topics: Collection[str] | None
    ) -> Iterator[BagMessage]:
        if self._as_recorded:
            raise EpisodeError(
                f"'{file}' is a bag of ROS 1, whose messages are not copied as they are; "
                'import bag reads it, and rosbag reindex mends it'
            )
        bag = Ros1Bag(plain, self._most_bytes, self._problem)
        try:
            for topic, msgtype, stamp, data in bag.messages(topics):
                yield BagMessage(topic, msgtype, stamp, data)
        except Ros1Error as error:
            raise _Cut(str(error)) from error

    def declared(self) -> dict[str, tuple[str, str, str]]:
        """Return message type, `.msg` text and offered QoS profiles of the topics read by now."""
        found = {}
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            if schema is not None:
                text = schema.data.decode(errors='replace')
                profiles = channel.metadata.get('offered_qos_profiles', '')
                found[channel.topic] = (schema.name, text, profiles)
        return found

    def _find_files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        if not self.path.is_dir():
            raise EpisodeError(f"there is no episode '{self.path}'")
        information = self._read_information()
        self.listed_topics = _listed_topics(information)
        custom, paths = (information.get(key) for key in ('custom_data', 'relative_file_paths'))
        if isinstance(custom, Mapping):
            self.custom_data = {str(key): str(text) for key, text in custom.items()}
        names = paths if isinstance(paths, list) else []
        named = [self.path / Path(name).name for name in names if isinstance(name, str) and name]
        for file in named:
            if not file.is_file():
                self._problem(f"'{file}' is named in metadata.yaml but is not there")
        files = [file for file in named if file.is_file()] or [
            file for file in sorted(self.path.iterdir()) if file.is_file() and is_storage(file)
        ]
        if not files:
            raise EpisodeError(
                f"'{self.path}' is not a bag: it holds no .mcap or .db3 file"
                f'{conversion_hint(self.path)}'
            )
        return files

    def _read_information(self) -> Mapping[str, Any]:
        file = self.path / 'metadata.yaml'
        if not file.is_file():
            self._problem(f"'{self.path}' has no metadata.yaml (the recorder was killed?)")
            return {}
        try:
            content = parse_yaml(read_bytes(file, 'yaml_bytes'))
            return dict(content['rosbag2_bagfile_information'])
        except (yaml.YAMLError, OSError, LookupError, TypeError, ValueError) as error:
            reason = ' '.join(str(error).split())
            self._problem(f"'{file}' is not rosbag2 metadata and was ignored ({reason})")
            return {}

    def _problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    def _sqlite(
        self, plain: Path, file: Path, topics: Collection[str] | None
    ) -> Iterator[BagMessage]:
        """Messages of a rosbag2_storage_sqlite3 file, read in the order they were recorded."""
        with plain.open('rb') as stream:
            if stream.read(len(_SQLITE_MAGIC)) != _SQLITE_MAGIC:
                raise EpisodeError(f"'{file}' is not an SQLite file")
        lost = _lost_pages(plain)
        try:
            with closing(_open_sqlite(plain, self._most_bytes, is_cut=bool(lost))) as database:
                known = self._sqlite_topics(database, topics)
                wanted = ', '.join(str(number) for number in known)
                query = (
                    'SELECT topic_id, timestamp, data FROM messages '
                    # not by timestamp: the order shows where the recorder's clock was set back
                    f'WHERE topic_id IN ({wanted}) ORDER BY id'
                )
                if lost:  # an index needs what is not there
                    query = (
                        'SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id'
                    )
                for row in database.execute(query):
                    number, stamp, data = _typed(row, int, int, bytes)
                    if number in known:
                        name, msgtype = known[number]
                        yield BagMessage(name, msgtype, stamp, data)
            if lost:
                raise _Cut(lost)
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            raise _Cut(lost or str(error)) from error

    def _sqlite_topics(
        self, database: sqlite3.Connection, topics: Collection[str] | None
    ) -> dict[int, tuple[str, str]]:
        """Name and message type by number in the table of topics."""
        found = {}
        rows = database.execute('SELECT id, name, type, serialization_format FROM topics')
        for row in rows:
            number, name, msgtype, encoding = _typed(row, int, str, str, str)
            if encoding not in ('', 'cdr'):
                self._problem(f"'{name}' was left out: it is encoded as '{encoding}'")
            elif topics is None or name in topics:
                found[number] = name, msgtype
        return found

    def _mcap(
        self, plain: Path, file: Path, topics: Collection[str] | None
    ) -> Iterator[BagMessage]:
        with plain.open('rb') as stream:
            magic = stream.read(len(MAGIC))
            if not MAGIC.startswith(magic):
                raise EpisodeError(f"'{file}' is not an MCAP file: it starts with {magic!r}")
            for opcode, body in self._records(stream, file, plain.stat().st_size):
                parts = [(opcode, body)]
                if opcode == Opcode.CHUNK:
                    parts = _split(_decompress(body, stream.tell(), self._most_bytes))
                for inner, part in parts:
                    yield from self._take(inner, part, topics)

    def _records(self, stream: BinaryIO, file: Path, size: int) -> Iterator[tuple[int, bytes]]:
        """Yield the records up to the footer; the rest of a truncated chunk is a record, too."""
        data_ended = False
        while True:
            start = stream.tell()
            head = stream.read(_RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            if opcode == Opcode.FOOTER:
                return
            if opcode == 0 or start + _RECORD.size + length > size:
                if data_ended:
                    self._problem(
                        f"'{file}' lost its index after byte {start}; no message is lost"
                    )
                    return
                if opcode == Opcode.CHUNK:
                    yield opcode, stream.read(self._most_bytes)
                raise _Cut(f'no whole record at byte {start} of {size}')
            data_ended = data_ended or opcode == Opcode.DATA_END
            if opcode not in _KNOWN:
                stream.seek(length, io.SEEK_CUR)
                continue
            if length > self._most_bytes:
                raise _Cut(f'the record at byte {start} has {length} bytes; {_MORE}')
            yield opcode, stream.read(length)

    def _take(
        self, opcode: int, body: bytes, topics: Collection[str] | None
    ) -> Iterator[BagMessage]:
        if opcode == Opcode.MESSAGE:
            if len(body) < _MESSAGE.size:
                raise _Cut(f'a message of {len(body)} bytes')
            number, _, log_time, publish_time = _MESSAGE.unpack_from(body)
            channel = self._channels.get(number)
            if channel is None:
                raise _Cut(f'a message of channel {number}, which is not declared')
            if topics is not None and channel.topic not in topics:
                return
            data = body[_MESSAGE.size :]
            if self._is_packed(channel):
                packed = BagMessage(channel.topic, '', log_time, data, publish_time)
                found = self._packed(channel, packed)
                if found is not None:
                    yield found
            elif self._is_cdr(channel):
                msgtype = self._schemas[channel.schema_id].name
                yield BagMessage(channel.topic, msgtype, log_time, data, publish_time)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            try:
                self._declare(opcode, ReadDataStream(io.BytesIO(body)))
            except (McapError, UnicodeDecodeError, struct.error) as error:
                if opcode != Opcode.METADATA:
                    raise _Cut(f'a damaged declaration ({error!r})') from error
                self._problem(f"'{self.path}' has a damaged metadata record ({error!r})")

    def _declare(self, opcode: int, stream: ReadDataStream) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel
        else:
            record = Metadata.read(stream)
            self.metadata[record.name] = record.metadata

    def _is_packed(self, channel: Channel) -> bool:
        return (
            not self._as_recorded
            and channel.message_encoding in ('protobuf', 'json')
            and channel.schema_id in self._schemas
        )

    def _is_cdr(self, channel: Channel) -> bool:
        fits = channel.message_encoding == 'cdr' and channel.schema_id in self._schemas
        if not fits:
            self._problem(
                f"'{channel.topic}' was left out: it is encoded as "
                f"'{channel.message_encoding}', not as cdr with a schema"
            )
        return fits


def is_storage(file: Path) -> bool:
    """Return whether a file holds messages of a bag, by its name."""
    return Path(file.name.removesuffix('.zstd')).suffix in ('.mcap', '.db3', ROS1_SUFFIX)


def _lost_pages(file: Path) -> str:
    """Return a text on the missing bytes of an SQLite file, from its header; empty if complete."""
    with file.open('rb') as stream:
        head = stream.read(_SQLITE_HEAD.size)
    if len(head) < _SQLITE_HEAD.size or _journal(file):
        return ''
    page_size, changes, num_pages, valid_for = _SQLITE_HEAD.unpack(head)
    there, all_ = file.stat().st_size, (65536 if page_size == 1 else page_size) * num_pages
    is_cut = changes == valid_for and there < all_
    return f'{there} of {all_} bytes are there' if is_cut else ''


def _journal(file: Path) -> bool:
    """Return True if a recorder that was killed left its journal next to an SQLite file."""
    journal = file.with_name(f'{file.name}-wal')
    return journal.is_file() and journal.stat().st_size > 0


def _open_sqlite(file: Path, most_bytes: int, *, is_cut: bool) -> sqlite3.Connection:
    """Open an SQLite file read-only; SQLite writes next to it only if there is a journal.

    Args:
        file: the file.
        most_bytes: maximum size of a value [bytes].
        is_cut: the file is shorter than its header states.
    """
    mode = 'ro' if _journal(file) else 'ro&immutable=1'
    database = sqlite3.connect(f'{file.resolve().as_uri()}?mode={mode}', uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most_bytes)
    if is_cut:  # else SQLite refuses a file that is shorter than its header says
        database.execute('PRAGMA writable_schema=ON')
    # a view in their place could compute without end
    for name, kind in database.execute(
        "SELECT name, type FROM sqlite_master WHERE name IN ('topics', 'messages')"
    ):
        if kind != 'table':
            database.close()
            raise _Cut(f"'{name}' is a {kind}, not a table")
    return database


def _typed(row: tuple[Any, ...], *types: type) -> tuple[Any, ...]:
    """Return the values of a row; SQLite keeps whatever type was put into a column."""
    for value, kind in zip(row, types, strict=True):
        if not isinstance(value, kind):
            raise _Cut(f'a row holds {type(value).__name__} where {kind.__name__} belongs')
    return row


@contextmanager
def _decompressed(file: Path) -> Iterator[Path]:
    """Return the file, or a decompressed temporary copy if the whole file is compressed."""
    if file.suffix != '.zstd':
        yield file
        return
    with tempfile.TemporaryDirectory(prefix='mtv_world_bag_') as folder:
        plain = Path(folder) / file.stem
        try:
            with file.open('rb') as packed, plain.open('wb') as unpacked:
                zstandard.ZstdDecompressor().copy_stream(packed, unpacked)
        except zstandard.ZstdError as error:
            raise _Cut(f'it cannot be decompressed ({error})') from error
        yield plain


def _unpacked(message: BagMessage) -> BagMessage:
    """Undo `compression_mode: message`; CDR never begins like a zstd frame."""
    if not message.data.startswith(_ZSTD_MAGIC):
        return message
    try:
        data = zstandard.ZstdDecompressor().decompressobj().decompress(message.data)
    except zstandard.ZstdError as error:
        raise _Cut(f"a message of '{message.topic}' cannot be decompressed") from error
    return message._replace(data=data)


def _split(records: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the whole records in a decompressed chunk."""
    position = 0
    while position + _RECORD.size <= len(records):
        opcode, length = _RECORD.unpack_from(records, position)
        position += _RECORD.size
        if position + length > len(records):
            return
        yield opcode, records[position : position + length]
        position += length


def _listed_topics(information: Mapping[str, Any]) -> dict[str, str]:
    """Return the types of the topics in metadata.yaml; empty where they are not known.

    Messages of Foxglove are of another type after they were read.
    """
    try:
        rows = [row['topic_metadata'] for row in information['topics_with_message_count']]
        found = {str(row['name']): str(row['type']) for row in rows}
    except (LookupError, TypeError):
        return {}
    return {} if any(kind.startswith('foxglove') for kind in found.values()) else found


def _decompress(body: bytes, end: int, most: int) -> bytes:
    """Return the records of a chunk, at most its stated size; fewer if it was truncated."""
    if len(body) < _CHUNK.size:
        return b''
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    if size > most:
        raise _Cut(f'the chunk before byte {end} holds {size} bytes; {_MORE}')
    name_end = _CHUNK.size + name_length
    compression = body[_CHUNK.size : name_end]
    whole = len(body) >= name_end + 8
    if whole:
        (length,) = struct.unpack_from('<Q', body, name_end)
        whole = len(body) == name_end + 8 + length
    try:
        records = _inflate(compression, body[name_end + 8 :], size + 1)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise _Cut(f'the chunk before byte {end} cannot be decompressed ({error})') from error
    damaged = len(records) != size or (crc and zlib.crc32(records) != crc)
    if whole and damaged:
        raise _Cut(f'the chunk before byte {end} does not match its checksum')
    return records


def _inflate(compression: bytes, data: bytes, most: int) -> bytes:
    """Return the decompressed content, cut off at `most` bytes."""
    if not compression or not data:
        return data
    if compression == b'zstd':
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            content = bytearray()
            while len(content) < most:
                piece = stream.read(min(_READ_BYTES, most - len(content)))
                if not piece:
                    break
                content += piece
            return bytes(content)
    if compression == b'lz4':
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
    raise EpisodeError(
        f"the bag is compressed with '{compression.decode(errors='replace')}'; known are zstd "
        'and lz4'
    )
