"""Frames as players show them, and frames beside rows of another rate."""

from fractions import Fraction
import json
import shutil

import av
import cv2
import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.lerobot_episodes import import_dataset
from mtv_world_ros.importing.video_frames import (
    frames_at,
    match_frames,
    Presentation,
    video_offset,
    VideoFileFrames,
)

FPS = 10


def picture(height=48, width=64, level=60):
    """A corner each in red (top left), green (top right) and blue (bottom left)."""
    image = np.full((height, width, 3), level, np.uint8)
    image[:16, :16] = 250, 20, 20
    image[:16, -16:] = 20, 250, 20
    image[-16:, :16] = 20, 20, 250
    return image


def write(path, images, *, times=None, turn=0, mirror=False, aspect=None):
    """A video; `turn` is counterclockwise, as the container has it [degrees]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    base = Fraction(1, 9000)
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=FPS, options={'crf': '8', 'g': '4'})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.codec_context.time_base = 'yuv420p', base
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if turn or mirror:
            stream.set_display_rotation(turn, mirror)
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format='rgb24')
            frame.pts = round((k / FPS if times is None else times[k]) / base)
            frame.time_base = base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize('turn', [90, 180, 270])
def test_turned_frames_are_as_another_decoder_shows_them(tmp_path, turn):
    path = write(tmp_path / 'a.mp4', [picture()] * 3, turn=turn)
    _, shown = cv2.VideoCapture(str(path)).read()  # OpenCV turns frames by itself
    frames = VideoFileFrames(path)
    np.testing.assert_allclose(frames[0], shown[..., ::-1], atol=2)
    expected = np.rot90(picture(), turn // 90)
    assert np.abs(frames[0].astype(int) - expected).mean() < 5
    found = list(frames_at(path, np.arange(3) / FPS, 0.02))
    np.testing.assert_array_equal(found[2], frames[2])
    words = {90: '90 degrees counterclockwise', 180: '180 degrees', 270: '90 degrees clockwise'}
    assert f'turned by {words[turn]} (display matrix' in frames.note


@pytest.mark.parametrize(('turn', 'said'), [(0, 'mirrored left to right'), (90, 'and mirrored')])
def test_mirrored_frames_are_mirrored_after_the_turn(tmp_path, turn, said):
    frames = VideoFileFrames(write(tmp_path / 'a.mp4', [picture()], turn=turn, mirror=True))
    expected = np.rot90(picture(), turn // 90)[:, ::-1]
    assert np.abs(frames[0].astype(int) - expected).mean() < 5
    assert said in frames.note


def test_a_turn_by_another_angle_is_refused(tmp_path):
    path = write(tmp_path / 'a.mp4', [picture()], turn=30)
    with pytest.raises(EpisodeError, match=r'turns frames by -?30.0 degrees'):
        VideoFileFrames(path)


@pytest.mark.parametrize(
    ('aspect', 'turn', 'size'),
    [
        (Fraction(4, 3), 0, (48, 85)),
        (Fraction(1, 2), 0, (96, 64)),
        (Fraction(2, 1), 90, (128, 48)),
        (Fraction(1, 1), 0, (48, 64)),
    ],
)
def test_pixels_that_are_not_square_are_stretched(tmp_path, aspect, turn, size):
    frames = VideoFileFrames(write(tmp_path / 'a.mp4', [picture()], aspect=aspect, turn=turn))
    assert frames[0].shape[:2] == size
    assert ('pixels are not square' in frames.note) == (aspect != 1)
    red = (frames[0][..., 0] > 150) & (frames[0][..., 1] < 100)
    # 16 x 16 stored pixels are a part of the picture's area that stretching keeps
    assert red.mean() == pytest.approx(16 * 16 / (48 * 64), rel=0.15)


def test_an_upright_video_with_square_pixels_is_left_alone(tmp_path):
    frames = VideoFileFrames(write(tmp_path / 'a.mp4', [picture()] * 2))
    assert frames.note == '' and frames[0].shape == (48, 64, 3)
    assert Presentation().apply(picture()).tobytes() == picture().tobytes()


def test_chosen_frames_are_decoded_in_any_order(tmp_path):
    images = [picture(level=20 + 15 * k) for k in range(12)]
    frames = VideoFileFrames(write(tmp_path / 'a.mp4', images)).chosen(np.array([1, 4, 5, 10]))
    levels = [int(frames[k][24, 32, 0]) for k in (3, 0, 2, 1, -1)]
    np.testing.assert_allclose(levels, [170, 35, 95, 80, 170], atol=6)
    assert len(frames) == 4 and frames[1:3].shape == (2, 48, 64, 3)
    assert frames.times is not None
    np.testing.assert_allclose(frames.times, [0.1, 0.4, 0.5, 1.0])
    with pytest.raises(IndexError):
        frames[4]


UNEVEN = np.cumsum(np.tile([0.033, 0.1, 0.067], 17))[:50]
UNEVEN -= UNEVEN[0]


@pytest.mark.parametrize(
    ('frames', 'rows', 'timed', 'expected', 'said'),
    [
        # as many, at one rate
        (np.arange(50) / 10, np.arange(50) / 10, True, np.arange(50) / 10, ''),
        # as many, but the file of the video states a rate that it was not recorded at
        (np.arange(50) / 30, np.arange(50) / 10, True, np.arange(50) / 10, 'as there are as many'),
        # three frames a row
        (np.arange(150) / 30, np.arange(50) / 10, True, np.arange(148) / 30, '2 frames after the'),
        # a frame every third row
        (np.arange(17) / 3.333, np.arange(50) / 10, False, np.arange(17) / 3.333, 'keep the'),
        # uneven frames, a row each
        (UNEVEN, UNEVEN, True, UNEVEN, ''),
        # uneven frames, even rows, as many
        (UNEVEN, np.arange(50) * UNEVEN[-1] / 49, True, None, 'keep the times of the video'),
        # the same, but rows have no times of their own
        (UNEVEN, np.arange(50) / 15, False, np.arange(50) / 15, ''),
        # one rate, the video ends early
        (np.arange(40) / 10, np.arange(50) / 10, True, np.arange(40) / 10, '40 frames and 50'),
        # times of the video are not known
        (None, np.arange(50) / 10, True, np.arange(50) / 10, ''),
    ],
)  # fmt: skip
def test_frames_are_matched_by_time_where_times_are_known(frames, rows, timed, expected, said):
    count = 50 if frames is None else len(frames)
    match = match_frames(frames, count, rows, rows_are_timed=timed)
    if expected is None:  # frames after the last row are left out, the others keep their times
        expected = frames[frames <= rows[-1] + 1e-6]
    np.testing.assert_allclose(match.times, expected, atol=1e-9)
    np.testing.assert_array_equal(match.numbers, np.arange(len(expected)))
    assert said in match.note and bool(said) == bool(match.note)


def test_what_contradicts_is_refused_and_the_mapping_decides():
    frames, rows = np.arange(300) / 30, np.arange(50) / 10
    with pytest.raises(EpisodeError, match="300 frames over 9.97 s and 50 rows .*'frame_times'"):
        match_frames(frames, 300, rows, rows_are_timed=True)
    by_time = match_frames(frames, 300, rows, rows_are_timed=True, source='video')
    assert len(by_time.numbers) == 148 and by_time.times[-1] == pytest.approx(4.9)
    by_number = match_frames(frames, 300, rows, rows_are_timed=True, source='rows')
    np.testing.assert_allclose(by_number.times, rows)
    with pytest.raises(EpisodeError, match='no times that increase'):
        match_frames(None, 300, rows, rows_are_timed=True, source='video')


@pytest.mark.parametrize(('unit', 'factor'), [('ms', 1e3), ('us', 1e6), ('ns', 1e9)])
def test_times_in_another_unit_are_named(unit, factor):
    with pytest.raises(EpisodeError, match=f"set 'time_unit: {unit}' in the mapping"):
        match_frames(np.arange(50) / 10, 50, np.arange(50) / 10 * factor, rows_are_timed=True)


def test_turned_videos_in_a_lerobot_folder_are_turned_and_named(datasets, make_mapping, tmp_path):
    root = shutil.copytree(datasets('v2.1'), tmp_path / 'set')
    video = root / 'videos/chunk-000/observation.images.front/episode_000000.mp4'
    count = json.loads((root / 'meta/episodes.jsonl').read_text().splitlines()[0])['length']
    write(video, [picture()] * count, turn=180)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1]
    said = "view 'front': frames are turned by 180 degrees (display matrix of the file)"
    assert sum(said in line for line in summary.warnings[0]) == 1
    assert not any('display matrix' in line for line in summary.warnings[1])
    episode = read_episode(tmp_path / 'out/episode_000000', with_cameras=False)
    shown = np.asarray(episode.images['front'].frames[0]).astype(int)
    assert np.abs(shown - np.rot90(picture(), 2)).mean() < 8


def test_a_calibration_of_frames_that_lie_on_their_side_is_refused(
    datasets, make_mapping, tmp_path
):
    root = shutil.copytree(datasets('v2.1'), tmp_path / 'set')
    video = root / 'videos/chunk-000/observation.images.front/episode_000000.mp4'
    count = json.loads((root / 'meta/episodes.jsonl').read_text().splitlines()[0])['length']
    write(video, [picture()] * count, turn=90)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [1]
    assert 'images of 48x64, but its K is for 128x96: they are turned' in summary.failed[0]


def test_a_video_at_another_rate_than_its_rows_is_named(tmp_path):
    path = write(tmp_path / 'a.mp4', [picture()] * 12, times=np.arange(12) / 30)
    with pytest.raises(EpisodeError, match='has 12 frames, as many as there are rows, but its'):
        list(frames_at(path, np.arange(12) / 10, 0.025))
    path = write(tmp_path / 'b.mp4', [picture()] * 12)
    with pytest.raises(EpisodeError, match=r'frames are 0.100 s apart and rows 0.033 s'):
        list(frames_at(path, np.arange(36) / 30, 0.008))


@pytest.mark.parametrize(
    ('shift_s', 'is_alone', 'found_s'),
    [
        (0.0, True, 0.0),
        (0.02, True, 0.0),  # within a quarter of a period
        (0.04, True, 0.04),
        (-0.04, False, -0.04),  # a drifting index of a file with several episodes
        (1.5, True, 1.5),  # the file begins late, and has a frame for each row
        (1.5, False, 0.0),  # the frames may be those of another episode
    ],
)
def test_a_constant_distance_of_frames_from_rows_is_found(tmp_path, shift_s, is_alone, found_s):
    rows = np.arange(12) / FPS + (1.0 if not is_alone else 0.0)
    frames = rows + shift_s
    if not is_alone:  # others before and behind, unless they begin late
        frames = np.arange(-5 if shift_s < 1 else 0, 20) / FPS + rows[0] + shift_s
    path = write(tmp_path / 'a.mkv', [picture()] * len(frames), times=frames - min(0, frames[0]))
    offset = video_offset(path, rows - min(0, frames[0]), 0.25 / FPS, is_alone=is_alone)
    assert offset == pytest.approx(found_s, abs=2e-3)


def test_frames_that_drift_apart_from_rows_have_no_constant_distance(tmp_path):
    path = write(tmp_path / 'a.mp4', [picture()] * 40, times=0.04 + np.arange(40) / 9.7)
    assert video_offset(path, np.arange(40) / FPS, 0.25 / FPS, is_alone=True) == 0.0


@pytest.mark.parametrize(('kind', 'late_s'), [('v2.1', 0.3), ('v2.1', 0.04), ('v3.0', 0.04)])
def test_a_video_that_is_off_its_rows_is_shifted_and_named(
    datasets, make_mapping, tmp_path, kind, late_s
):
    root = shutil.copytree(datasets(kind), tmp_path / 'set')
    for video in (root / 'videos').rglob('*.mp4'):
        if 'front' not in str(video):
            continue
        with av.open(str(video)) as container:
            frames = [f.to_ndarray(format='rgb24') for f in container.decode(video=0)]
        write(video, frames, times=late_s + np.arange(len(frames)) / FPS)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    for number, count in enumerate((12, 9)):
        said = f"view 'front': its frames are {1000 * late_s:+.1f} ms from the times of the rows"
        assert sum(said in line for line in summary.warnings[number]) == 1
        track = read_episode(tmp_path / f'out/episode_{number:06d}', with_cameras=False)
        shown = [float(np.asarray(frame).mean()) for frame in track.images['front'].frames]
        np.testing.assert_allclose(shown, 20 + 16 * np.arange(count) + 3 * number, atol=3)


#: weights of red and blue in the luma, and the numbers of FFmpeg's colour spaces
MATRICES = {'601': (0.299, 0.114, 5), '709': (0.2126, 0.0722, 1), '2020': (0.2627, 0.0593, 9)}


def yuv(rgb, red, blue, is_full):
    """Return Y, Cb and Cr of 8 bits, by the definition of the recommendations."""
    r, g, b = np.array(rgb) / 255
    y = red * r + (1 - red - blue) * g + blue * b
    u, v = (b - y) / 2 / (1 - blue), (r - y) / 2 / (1 - red)
    scaled = (255 * y, 128 + 255 * u, 128 + 255 * v)
    if not is_full:
        scaled = (16 + 219 * y, 128 + 224 * u, 128 + 224 * v)
    return np.rint(scaled)


@pytest.mark.parametrize('is_full', [False, True], ids=['limited', 'full'])
@pytest.mark.parametrize('name', MATRICES)
def test_colours_follow_the_colour_space_of_the_video(tmp_path, name, is_full):
    red, blue, number = MATRICES[name]
    colours = [(200, 30, 30), (30, 160, 60)]
    planes = np.zeros((3, 48, 64), np.uint8)
    planes[:, :, :32] = yuv(colours[0], red, blue, is_full)[:, None, None]
    planes[:, :, 32:] = yuv(colours[1], red, blue, is_full)[:, None, None]
    path, base = tmp_path / 'a.mkv', Fraction(1, FPS)
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('ffv1', rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 64, 48, 'yuv444p'
        stream.codec_context.colorspace = number
        stream.codec_context.color_range = 2 if is_full else 1
        for k in range(2):
            frame = av.VideoFrame.from_ndarray(planes, format='yuv444p')
            frame.colorspace, frame.color_range = number, 2 if is_full else 1
            frame.pts, frame.time_base = k, base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    frames = VideoFileFrames(path)
    np.testing.assert_allclose(frames[1][24, [16, 48]], colours, atol=2)
