from __future__ import annotations

from pathlib import Path
import re
import shutil

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter

TYPE = 'std_msgs/msg/UInt8MultiArray'
CHANNEL = {'topic': '/noise', 'message_encoding': 'cdr'}


def payload(index: int, size: int = 20_000) -> bytes:
    """Do not compress, so that cuts fall anywhere."""
    return b'\0\1\0\0' + np.random.default_rng(index).bytes(size)


def write_noise(path: Path, count: int = 40) -> Path:
    """About 800 kB: four chunks."""
    with BagWriter(path) as writer:
        for index in range(count):
            writer.write_raw('/noise', TYPE, 1000 + index, payload(index))
    return path


def write_with_mcap(path: Path, *, count: int = 5, encoding: str = 'cdr', **options) -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream, **options)
        writer.start(profile='ros2')
        schema = writer.register_schema(TYPE, 'ros2msg', messages.definition(TYPE).encode())
        channel = writer.register_channel('/noise', encoding, schema)
        for index in range(count):
            writer.add_message(channel, index, payload(index, 100), index)
        writer.finish()
    return path


def read(path: Path) -> tuple[list, list[str]]:
    """All messages, and what was wrong with the bag: where it is cut first."""
    reader = BagReader(path)
    found = list(reader.messages())
    return found, [*filter(None, [reader.truncated]), *reader.problems]


@pytest.fixture(scope='module')
def noise(tmp_path_factory) -> Path:
    return write_noise(tmp_path_factory.mktemp('bags') / 'noise')


def chunks(path: Path) -> list:
    with path.open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def test_messages_come_as_recorded(noise):
    found, _ = read(noise)
    assert [m.stamp_ns for m in found] == list(range(1000, 1040))
    assert all(m.data == payload(i) for i, m in enumerate(found))
    assert {(m.topic, m.msgtype) for m in found} == {('/noise', TYPE)}
    assert len(chunks(noise / 'noise_0.mcap')) >= 3


@pytest.mark.parametrize('in_folder', [True, False])
def test_wherever_a_bag_is_cut_it_is_read_up_to_there(noise, tmp_path, in_folder):
    content = (noise / 'noise_0.mcap').read_bytes()
    (tmp_path / 'cut').mkdir()
    cut_file = tmp_path / 'cut' / 'noise_0.mcap'
    if in_folder:
        shutil.copy(noise / 'metadata.yaml', tmp_path / 'cut')
    data_end = max(c.chunk_start_offset + c.chunk_length for c in chunks(noise / 'noise_0.mcap'))
    counts = []
    for length in [*range(0, 60), *range(60, data_end, 9973), data_end]:
        cut_file.write_bytes(content[:length])
        reader = BagReader(tmp_path / 'cut' if in_folder else cut_file)
        found = list(reader.messages())
        assert 'cut off' in reader.truncated
        assert str(cut_file) in reader.truncated
        assert all(m.data == payload(i) for i, m in enumerate(found))
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == 40
    # also the whole messages of the chunk that was cut
    assert len(set(counts)) > len(chunks(noise / 'noise_0.mcap')) + 1


def test_a_cut_index_loses_no_message_and_is_mentioned(noise, tmp_path):
    content = (noise / 'noise_0.mcap').read_bytes()
    for missing in (1, 8, 20, 36, 60, 100):
        (tmp_path / 'a.mcap').write_bytes(content[:-missing])
        reader = BagReader(tmp_path / 'a.mcap')
        assert len(list(reader.messages())) == 40
        assert reader.truncated == ''
        if missing > 8 + 29:
            assert 'lost its index' in reader.problems[0]


def test_a_damaged_chunk_ends_the_record(noise, tmp_path):
    content = bytearray((noise / 'noise_0.mcap').read_bytes())
    second = chunks(noise / 'noise_0.mcap')[1]
    content[second.chunk_start_offset + 100_000] ^= 0xFF
    (tmp_path / 'a.mcap').write_bytes(content)
    reader = BagReader(tmp_path / 'a.mcap')
    found = list(reader.messages())
    assert 0 < len(found) < 40
    assert 'checksum' in reader.truncated
    assert all(m.data == payload(i) for i, m in enumerate(found))


def test_a_damaged_length_ends_the_record(noise, tmp_path):
    content = bytearray((noise / 'noise_0.mcap').read_bytes())
    second = chunks(noise / 'noise_0.mcap')[1]
    content[second.chunk_start_offset + 1 : second.chunk_start_offset + 9] = b'\xff' * 8
    (tmp_path / 'a.mcap').write_bytes(content)
    reader = BagReader(tmp_path / 'a.mcap')
    assert len(list(reader.messages())) >= 10
    assert 'cut off or damaged' in reader.truncated


@pytest.mark.parametrize(
    'options',
    [
        {'compression': CompressionType.NONE},
        {'compression': CompressionType.LZ4},
        {'compression': CompressionType.ZSTD, 'chunk_size': 150},
        {'use_chunking': False},
        {'enable_crcs': False},
    ],
)
def test_every_layout_of_mcap_is_read(options, tmp_path):
    path = write_with_mcap(tmp_path / 'a.mcap', **options)
    found, _ = read(path)
    assert [m.data for m in found] == [payload(i, 100) for i in range(5)]


@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.LZ4])
def test_cut_chunks_of_every_compression_give_what_they_have(compression, tmp_path):
    path = write_with_mcap(tmp_path / 'a.mcap', count=3000, compression=compression)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 3])
    found, problems = read(path)
    assert len(found) > 300
    assert 'cut off' in problems[0]


def test_messages_that_are_not_cdr_are_left_out_and_named(tmp_path):
    path = write_with_mcap(tmp_path / 'a.mcap', encoding='json')
    found, problems = read(path)
    assert not found
    (said,) = problems
    assert said.startswith(
        "'/noise' was left out: its JSON schema 'std_msgs/msg/UInt8MultiArray' is not"
    )


def test_only_the_topics_asked_for_come(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        for topic in ('/a', '/b', '/c'):
            writer.write_raw(topic, TYPE, 0, payload(0, 10))
    found = BagReader(tmp_path / 'bag').messages({'/b', '/c', '/d'})
    assert [m.topic for m in found] == ['/b', '/c']


def test_files_of_a_split_bag_are_read_in_order(tmp_path):
    folder = tmp_path / 'bag'
    folder.mkdir()
    for name in ('bag_0.mcap', 'bag_1.mcap', 'bag_10.mcap'):
        write_with_mcap(folder / name, count=2)
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        '  relative_file_paths: [bag_0.mcap, bag_1.mcap, bag_10.mcap, bag_11.mcap]\n'
    )
    found, problems = read(folder)
    assert len(found) == 6
    assert "bag_11.mcap' is named in metadata.yaml but is not there" in problems[0]


@pytest.mark.parametrize('content', [None, '', '- 1', 'a: {', 'rosbag2_bagfile_information: 3'])
def test_a_folder_is_read_without_usable_metadata_yaml(content, noise, tmp_path):
    shutil.copytree(noise, tmp_path / 'noise')
    (tmp_path / 'noise' / 'metadata.yaml').unlink()
    if content is not None:
        (tmp_path / 'noise' / 'metadata.yaml').write_text(content)
    found, problems = read(tmp_path / 'noise')
    assert len(found) == 40 and len(problems) == 1
    assert 'metadata' in problems[0]


@pytest.mark.parametrize(
    ('name', 'content', 'reason'),
    [
        ('a.mcap', b'this is text, not MCAP', "not an MCAP file: it starts with b'this is "),
        ('a.mcap', b'\x89MCAP\r\n\0\0', 'not an MCAP file'),
        ('a.db3', b'this is text, not SQLite', 'not an SQLite file'),
        ('a.db3', b'SQLite format 3\0', 'cut off or damaged: file is not a database'),
        ('a.mcap.zstd', b'(\xb5/\xfd', 'not an MCAP file|cut off'),
    ],
)
@pytest.mark.parametrize('in_folder', [True, False])
def test_other_files_are_refused_by_name(name, content, reason, in_folder, tmp_path):
    file = tmp_path / name
    file.write_bytes(content)
    try:
        said = read(tmp_path if in_folder else file)[1][0]
    except EpisodeError as error:
        said = str(error)
    assert re.search(reason, said)


def test_what_is_no_bag_is_refused(tmp_path):
    with pytest.raises(EpisodeError, match='there is no episode'):
        BagReader(tmp_path / 'missing')
    with pytest.raises(EpisodeError, match='holds no .mcap or .db3 file'):
        BagReader(tmp_path)


def test_an_unknown_compression_is_named(tmp_path):
    path = write_with_mcap(tmp_path / 'a.mcap', compression=CompressionType.ZSTD)
    path.write_bytes(path.read_bytes().replace(b'\x04\0\0\0zstd', b'\x04\0\0\0zmtv'))
    with pytest.raises(EpisodeError, match="compressed with 'zmtv'; known are zstd and lz4"):
        read(path)


@pytest.mark.parametrize(
    ('damaged', 'expected'),
    [
        (b'\x06\0\0\0/noise', 'damaged declaration'),
        (b'\x04\0\0\0note', 'damaged metadata record'),
    ],
)
def test_damaged_declarations_and_metadata_are_mentioned(damaged, expected, tmp_path):
    path = tmp_path / 'a.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start(profile='ros2')
        writer.add_metadata('note', {'key': 'text'})
        schema = writer.register_schema(TYPE, 'ros2msg', b'')
        channel = writer.register_channel('/noise', 'cdr', schema)
        writer.add_message(channel, 1, payload(0, 10), 1)
        writer.finish()
    content = path.read_bytes()
    path.write_bytes(content.replace(damaged, damaged[:4] + b'\xff' * (len(damaged) - 4), 1))
    found, problems = read(path)
    assert expected in problems[0]
    assert len(found) == (1 if 'metadata' in expected else 0)
