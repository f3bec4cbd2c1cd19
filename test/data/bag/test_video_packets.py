"""Video packets as ffmpeg_image_transport records them, made by FFmpeg's own encoders."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import av
import numpy as np
import pytest
from rosbags.rosbag2 import Writer

from mtv_world_ros.core.errors import EpisodeError, ObservationError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.video_packets import (
    check_packet,
    codec_of,
    from_first_key,
    VideoFrames,
)
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.bags import with_guessed_views

NUM, HEIGHT, WIDTH = 12, 48, 64


def frames() -> np.ndarray:
    """(12, 48, 64, 3) a bright square that wanders."""
    video = np.full((NUM, HEIGHT, WIDTH, 3), (40, 60, 80), np.uint8)
    for k, frame in enumerate(video):
        frame[10:26, 4 * k : 4 * k + 16] = (220, 180, 60)
    return video


def packets(encoder: str = 'libx264', named: str = 'h264;yuv420p;bgr8;bgr8') -> list:
    context = av.CodecContext.create(encoder, 'w')
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, 'yuv420p'
    context.time_base, context.gop_size, context.max_b_frames = Fraction(1, 10), 5, 0
    context.options = {'crf': '10', 'tune': 'zerolatency'} if encoder == 'libx264' else {}
    found = []
    for k, rgb in enumerate(frames()):
        frame = av.VideoFrame.from_ndarray(rgb, format='rgb24')
        frame.pts = k
        found += context.encode(frame)
    found += context.encode(None)
    return [
        SimpleNamespace(
            width=WIDTH, height=HEIGHT, encoding=named, pts=p.pts, flags=int(p.is_keyframe),
            data=np.frombuffer(bytes(p), np.uint8),
        )
        for p in found
    ]  # fmt: skip


@pytest.mark.parametrize(
    ('encoder', 'named'),
    [('libx264', 'h264;yuv420p;bgr8;bgr8'), ('libx264', 'libx264'), ('libx264', 'h264_nvenc'),
     ('mpeg4', 'mpeg4')],
)  # fmt: skip
def test_frames_are_those_that_were_encoded(encoder, named):
    video = VideoFrames('/cam/ffmpeg', packets(encoder, named))
    assert len(video) == NUM
    apart = np.abs(np.asarray(video).astype(int) - frames())
    assert apart.mean() < 4


def test_any_order_gives_the_same_frames():
    video = VideoFrames('/cam/ffmpeg', packets())
    whole = np.asarray(video)
    order = [7, 3, 3, 11, 0, 8]
    assert np.array_equal(video[order], whole[order])
    assert np.array_equal(video[4], whole[4])


def test_what_precedes_the_first_key_frame_is_left_out():
    stamped = list(enumerate(packets()))
    assert [stamp for stamp, _ in from_first_key(stamped[2:])] == list(range(5, NUM))


def test_unknown_codecs_and_empty_packets_are_refused():
    assert codec_of('hevc_vaapi;nv12;rgb8;rgb8') == 'hevc'
    packet = packets()[0]
    packet.encoding = 'telepathy'
    with pytest.raises(ObservationError, match="encoding 'telepathy' cannot be decoded"):
        check_packet(packet)
    packet.encoding, packet.data = 'h264', np.zeros(0, np.uint8)
    with pytest.raises(ObservationError, match='no data'):
        check_packet(packet)


def test_a_packet_without_an_image_is_named():
    broken = packets()
    broken[5].data = np.zeros(40, np.uint8)
    with pytest.raises(EpisodeError, match="'/cam/ffmpeg'"):
        VideoFrames('/cam/ffmpeg', broken)[5]


def test_a_bag_of_packets_is_read_as_a_view(tmp_path):
    store = messages.typestore()
    kind = messages.FFMPEG_PACKET
    with Writer(tmp_path / 'bag', version=9) as writer:
        connection = writer.add_connection('/front/image_raw/ffmpeg', kind, typestore=store)
        for k, packet in enumerate(packets()[2:]):
            stamp = 1_000_000_000 + k * 100_000_000
            message = messages.make(
                kind,
                header=messages.make_header(stamp, 'front'),
                is_bigendian=False,
                **vars(packet),
            )
            writer.write(connection, stamp, store.serialize_cdr(message, kind))
    episode = read_episode(tmp_path / 'bag', with_cameras=False)
    assert episode.views == ('front',)
    track = episode.images['front']
    assert track.stamps_ns[0] == 1_300_000_000  # of the first key frame
    assert np.abs(np.asarray(track.frames).astype(int) - frames()[5:]).mean() < 4
    assert any('3 packets before the first key frame' in text for text in episode.warnings)
    views = with_guessed_views(BagMapping(), tmp_path / 'bag').views
    assert {view: row.image for view, row in views.items()} == {'front': '/front/image_raw'}
