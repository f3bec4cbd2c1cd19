"""What is written is opened by the viewers and libraries that the pages name."""

from pathlib import Path

import av
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import pytest
from rosbags.highlevel import AnyReader

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path

rerun = pytest.importorskip('rerun', reason='rerun-sdk is not installed')

DEMO = share_path('resource', 'demo_episode')


@pytest.fixture(scope='module')
def predictions(tmp_path_factory):
    out = tmp_path_factory.mktemp('written') / 'predictions'
    assert main(['replay', str(DEMO), '--offline', '--steps', '1', '--out', str(out)]) == 0
    return out


@pytest.mark.slow
def test_rerun_plays_every_video_without_a_transcoder(predictions, exported_demo):
    """Its viewer leaves H.264 out whose frames are stored in another order than shown."""
    videos = sorted([*predictions.rglob('*.mp4'), *exported_demo.rglob('*.mp4')])
    assert {video.name for video in videos} >= {'comparison.mp4', 'file-000.mp4'}
    for video in videos:
        with av.open(str(video)) as container:
            pts = [packet.pts for packet in container.demux(video=0) if packet.pts is not None]
        assert pts == sorted(pts), f"'{video}' stores frames in another order than it shows them"
        asset = rerun.AssetVideo(path=video)
        assert len(asset.read_frame_timestamps_nanos()) == len(pts) > 1


def test_rosbags_and_the_mcap_library_read_every_message(predictions, imported_demo):
    episodes = [DEMO, predictions, *sorted(imported_demo.glob('episode_*'))]
    for episode in episodes:
        with AnyReader([Path(episode)]) as reader:
            counts = {c.topic: c.msgcount for c in reader.connections}
            decoded = sum(
                reader.deserialize(raw, connection.msgtype) is not None
                for connection, _, raw in reader.messages()
            )
        assert decoded == sum(counts.values()) > 0
        (file,) = episode.glob('*.mcap')
        with file.open('rb') as stream:
            found = make_reader(stream, decoder_factories=[DecoderFactory()])
            assert sum(1 for _ in found.iter_decoded_messages()) == decoded
