"""`mtv-world view`: what bags and evaluations show, in a file of the viewer and in a browser."""

from __future__ import annotations

from pathlib import Path
import socket
import urllib.request

import av
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.images import encode_jpeg
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagMessage
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.viewing import sheets
from mtv_world_ros.viewing.streams import add_message, read_streams, Streams

EPISODE = share_path('resource', 'demo_episode')
START_NS = 1_700_000_000_000_000_000


def write_predictions(path: Path, start_ns: int = START_NS) -> Path:
    """A bag under the node's topics, of the episode's time."""
    frame = np.full((72, 96, 3), 90, np.uint8)
    labels = np.zeros((72, 96), np.uint8)
    labels[10:20, 30:50] = 2
    with BagWriter(path) as writer:
        for k in range(3):
            stamp = start_ns + k * 200_000_000
            for stream in ('predicted', 'trajectory'):
                image = messages.make_compressed(stamp, 'low', encode_jpeg(frame, 90))
                topic = f'/world_model/low/{stream}/image_raw/compressed'
                writer.write_message(topic, messages.COMPRESSED_IMAGE, stamp, image)
            mask = messages.make_image(stamp, 'low', labels)
            writer.write_message('/world_model/low/mask/image_raw', messages.IMAGE, stamp, mask)
        value = messages.make('std_msgs/msg/Float64', data=0.75)
        writer.write_message('/world_model/success', 'std_msgs/msg/Float64', stamp, value)
    return path


@pytest.mark.parametrize(('is_bigendian', 'order'), [(0, '<u2'), (1, '>u2')])
def test_raw_images_of_16_bits_are_shown_whatever_the_order_of_their_bytes(is_bigendian, order):
    message = messages.make(
        messages.IMAGE, header=messages.make_header(1, 'low'), height=1, width=2,
        encoding='mono16', is_bigendian=is_bigendian, step=4,
        data=np.array([0x1234, 0xFF00], order).view(np.uint8),
    )  # fmt: skip
    streams, data = Streams(), messages.serialize(messages.IMAGE, message)
    add_message(streams, BagMessage('/low/image_raw', messages.IMAGE, 1, data))
    ((_, frame),) = streams.images['real', 'low']
    assert frame[0, :, 0].tolist() == [0x12, 0xFF]


def test_an_episode_and_its_predictions_are_of_one_time(tmp_path):
    streams = read_streams([EPISODE, write_predictions(tmp_path / 'predictions')])
    assert streams.views == ('low', 'high')
    assert streams.kinds == ('real', 'trajectory', 'imagined')
    assert len(streams.images['real', 'high']) == len(streams.masks['real', 'low']) == 71
    assert [s for s, _ in streams.images['imagined', 'low']] == [
        START_NS + k * 200_000_000 for k in range(3)
    ]
    assert streams.images['imagined', 'low'][0][1].shape == (72, 96, 3)
    assert set(np.unique(streams.masks['imagined', 'low'][0][1])) == {0, 2}
    assert [value for _, value in streams.success] == [0.75]
    assert any(text.startswith('instruction: ') for _, text in streams.words)
    assert {kind for kind, *_ in streams.joints} == {'real'}


def test_a_long_video_is_shorter_in_frames_and_bytes_not_in_time(tmp_path, monkeypatch):
    bag = write_predictions(tmp_path / 'predictions')
    monkeypatch.setattr(sheets, 'MAX_VIDEO_FRAMES', 2)
    sheet, video = sheets.write_pictures([bag], tmp_path)
    with av.open(str(video)) as container:
        stamps = [float(frame.time) for frame in container.decode(video=0)]
    assert stamps == [0.0, pytest.approx(0.4)]  # of 0, .2 and .4 s
    large = video.stat().st_size
    monkeypatch.setattr(sheets, 'MAX_VIDEO_BYTES', large - 1)
    sheets.write_pictures([bag], tmp_path)
    assert video.stat().st_size < large
    video.unlink()
    assert sheets.write_pictures([bag], tmp_path, has_video=False) == [sheet]
    assert sheet.is_file() and not video.exists()


def test_bags_of_different_times_are_refused(tmp_path):
    later = write_predictions(tmp_path / 'later', START_NS + 10**15)
    with pytest.raises(EpisodeError, match='of different times, 1000000 s .*; give one of them'):
        read_streams([EPISODE, later])
    assert read_streams([later]).views == ('low',)


def test_a_bag_without_images_is_refused(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        value = messages.serialize(
            'std_msgs/msg/Float64', messages.make('std_msgs/msg/Float64', data=1.0)
        )
        writer.write_raw('/success', 'std_msgs/msg/Float64', 1, value)
    with pytest.raises(EpisodeError, match='holds no images'):
        read_streams([tmp_path / 'bag'])


def test_the_command_writes_a_file_for_the_viewer(tmp_path, capsys):
    rerun = pytest.importorskip('rerun')
    del rerun
    predictions = write_predictions(tmp_path / 'predictions')
    file = tmp_path / 'out' / 'view.rrd'
    words = ['view', str(predictions), '--save', str(file)]
    assert main(words) == 0
    assert file.read_bytes()[:4] == b'RRF2' and file.stat().st_size > 3000
    assert f'written: {file}' in capsys.readouterr().out
    assert main(words) == 1
    assert "view.rrd' exists; give another --save FILE" in capsys.readouterr().err


def test_browsers_get_the_viewer_and_a_port_in_use_is_told(tmp_path):
    pytest.importorskip('rerun')
    from mtv_world_ros.viewing import rerun_log, viewer_process
    from mtv_world_ros.viewing.viewer_process import PageAddress

    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        port = taken.getsockname()[1]
        taken.listen()
        with pytest.raises(ConfigError, match=f'port {port} cannot be used .*another --port'):
            viewer_process.serve(rerun_log.recording('a'), None, PageAddress(port=port))
    streams = read_streams([write_predictions(tmp_path / 'predictions')])
    stream = rerun_log.recording('b')
    layout = rerun_log.layout({'/bag': streams})
    address = viewer_process.serve(stream, layout, PageAddress(port=port))
    rerun_log.log_streams(stream, streams, '/bag')
    page = urllib.request.urlopen(address.partition('?')[0]).read()
    assert b're_viewer' in page


def test_without_the_extra_one_line_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__('sys').modules, 'rerun', None)
    assert main(['view', str(EPISODE), '--save', str(tmp_path / 'x.rrd')]) == 1
    assert "pip install 'mtv_world_ros[view]'" in capsys.readouterr().err
    # packages are looked at first, before any path
    assert main(['view', 'nowhere']) == 1
    assert "pip install 'mtv_world_ros[view]'" in capsys.readouterr().err


def test_pictures_show_what_there_is_and_grey_where_there_is_nothing(tmp_path):
    from mtv_world_ros.viewing.sheets import comparison_frames, write_pictures
    from mtv_world_ros.viewing.video import decode_video

    predictions = write_predictions(tmp_path / 'predictions')
    alone = comparison_frames(read_streams([predictions]))
    assert alone.views == ('low',) and alone.times.tolist() == [0.0, 0.2, 0.4]
    assert (alone.real == 225).all() and abs(alone.imagined.astype(int) - 90).max() < 4
    both = comparison_frames(read_streams([EPISODE, predictions]))
    assert both.real.shape == (1, 3, 72, 96, 3) and both.real.std() > 20
    sheet, video = write_pictures([EPISODE, predictions], predictions)
    assert sheet.stat().st_size > 5000 and len(decode_video(video.read_bytes())) == 3
    # the bag can still be read with the pictures beside it
    assert read_streams([predictions]).kinds == ('trajectory', 'imagined')
    with pytest.raises(EpisodeError, match='no imagined frames'):
        comparison_frames(read_streams([EPISODE]))
