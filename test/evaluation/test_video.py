from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.images import write_png
from mtv_world_ros.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.evaluation.results import compare
from mtv_world_ros.viewing.video import Comparison, contact_sheet, side_by_side, write_video


@pytest.fixture
def comparison(recordings, make_pipeline, oracle):
    pipeline, recording = make_pipeline(oracle), recordings[0]
    stretch = stretches(recording, pipeline.spec, 'imagine')[0]
    chunks = imagine_stretch(
        pipeline, recording, stretch, actions=recording, seed=0, num_inference_steps=1
    )
    return compare(chunks, stretch.frames[:, 1:])


def test_chunks_are_joined_in_time(comparison):
    assert np.allclose(comparison.times, np.arange(1, 10) / 5)
    assert (comparison.imagined == comparison.real).all()
    assert comparison.trajectory.shape == comparison.real.shape


def test_sheet_shows_every_view_and_kind_enlarged(comparison):
    sheet = contact_sheet(comparison, title='red to the left', notes=['J 0.9'], num_columns=4)
    assert sheet.dtype == np.uint8 and sheet.shape[1] > 4 * 192
    enlarged = cv2.resize(
        comparison.imagined[1, -1], None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST
    )
    height, width = enlarged.shape[:2]
    right = sheet[:, -width - 4 : -4]
    rows = range(len(right) - height + 1)
    assert any((right[row : row + height] == enlarged).all() for row in rows)


def test_sheet_grows_with_captions_and_shrinks_large_frames(comparison):
    captions = tuple(('J 0.5',) * 9 for _ in comparison.views)
    parts = {
        kind: comparison.frames(kind).repeat(8, axis=2).repeat(8, axis=3)
        for kind in ('real', 'trajectory', 'imagined')
    }
    large = Comparison(views=comparison.views, times=comparison.times, captions=captions, **parts)
    plain = Comparison(views=comparison.views, times=comparison.times, **parts)
    small, tall = contact_sheet(plain, tile_width=128), contact_sheet(large, tile_width=128)
    assert tall.shape[0] > small.shape[0] and tall.shape[1] == small.shape[1] < 9 * 160


def test_videos_of_different_length_are_refused(comparison):
    with pytest.raises(EpisodeError, match='imagined frames are'):
        Comparison(
            views=comparison.views,
            times=comparison.times,
            real=comparison.real,
            trajectory=comparison.trajectory,
            imagined=comparison.imagined[:, :-1],
        )


def test_picture_survives_writing(comparison, tmp_path):
    sheet = contact_sheet(comparison)
    write_png(tmp_path / 'new' / 'sheet.png', sheet)
    assert (cv2.imread(str(tmp_path / 'new' / 'sheet.png'))[..., ::-1] == sheet).all()
    assert [path.name for path in (tmp_path / 'new').iterdir()] == ['sheet.png']


def test_video_plays_with_every_frame(comparison, tmp_path):
    frames = side_by_side(comparison, tile_width=128)
    assert frames.shape[0] == 9 and frames.shape[1] % 2 == frames.shape[2] % 2 == 0
    write_video(tmp_path / 'side.mp4', frames, 5.0)
    with av.open(str(tmp_path / 'side.mp4')) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == 'h264' and stream.average_rate == 5
        played = [frame.to_ndarray(format='rgb24') for frame in container.decode(stream)]
    assert len(played) == 9
    assert np.abs(np.array(played, float) - frames).mean() < 6
    assert [path.name for path in tmp_path.iterdir()] == ['side.mp4']


def test_kinds_that_are_not_there_take_no_room(comparison):
    alone = replace(comparison, kinds=('imagined',))
    whole, sheet = contact_sheet(comparison), contact_sheet(alone)
    assert sheet.shape[0] < whole.shape[0] / 2 and sheet.shape[1] == whole.shape[1]
    assert side_by_side(alone).shape[2] < side_by_side(comparison).shape[2] / 2
