import numpy as np
import pytest
import torch
from transformers import Sam2VideoModel
from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

from mtv_world_ros.vision.segmenters.grounding import IMAGENET, prepare
from mtv_world_ros.vision.segmenters.prompted import (
    drop_old,
    reach,
    start_session,
    track_masks,
)
from mtv_world_ros.vision.segmenters.sam import Sam2Video, Sam3Video

HEIGHT, WIDTH = 48, 64


@pytest.fixture(scope='module')
def sam2(weights):
    return Sam2Video(weights / 'tracker')


@pytest.fixture(scope='module')
def sam3(weights):
    return Sam3Video(weights / 'third')


@pytest.fixture(params=['sam2', 'sam3'])
def video(request):
    return request.getfixturevalue(request.param)


def clip(num_frames, seed=0):
    """Noise over a square that wanders, and the square's mask in the first frame."""
    rng = np.random.default_rng(seed)
    frames = rng.integers(60, 120, (num_frames, HEIGHT, WIDTH, 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        frame[15:30, 10 + index : 25 + index] = (220, 40, 30)
    masks = np.zeros((2, HEIGHT, WIDTH), bool)
    masks[0, 15:30, 10:25] = True
    masks[1, 2:12, 40:60] = True
    return frames, masks


@pytest.mark.slow
def test_dropping_what_is_out_of_reach_changes_no_mask(video, monkeypatch):
    frames, masks = clip(22)
    dropped = list(track_masks(video, frames[0], masks, frames[1:]))
    monkeypatch.setattr('mtv_world_ros.vision.segmenters.prompted.drop_old', lambda *_: None)
    kept = list(track_masks(video, frames[0], masks, frames[1:]))
    assert np.array_equal(kept, dropped)
    assert len({mask.tobytes() for mask in kept}) > 5  # and there were masks that differ


def test_keeping_too_little_changes_masks(sam2, monkeypatch):
    """What the test above compares is sensitive to what is dropped."""
    frames, masks = clip(22)
    kept = np.array(list(track_masks(sam2, frames[0], masks, frames[1:])))
    monkeypatch.setattr('mtv_world_ros.vision.segmenters.prompted.reach', lambda config: 1)
    assert not np.array_equal(kept, list(track_masks(sam2, frames[0], masks, frames[1:])))


def stored_entries(session):
    """How many frames and outputs a session holds."""
    kept = [*session.output_dict_per_obj.values(), session.frames_tracked_per_obj]
    return len(session.processed_frames) + sum(len(s) for stores in kept for s in stores.values())


def test_stored_entries_stop_growing(video):
    frames, masks = clip(2)
    session = start_session(video, frames[0], masks)
    counts = []
    for index in range(1, 27):
        video.advance(session, frames[index % 2], index)
        drop_old(session, index, reach(video.tracker.config))
        counts.append(stored_entries(session))
    # the public configuration: 7 memories, 16 object pointers; 2 objects
    assert counts[18] == counts[22] == counts[25] == 2 * (1 + 2 * 18)


def test_streamed_masks_are_those_of_the_models_own_loop_over_the_whole_video(weights, sam2):
    frames, masks = clip(20)
    model = Sam2VideoModel.from_pretrained(weights / 'tracker').eval()
    pixels = torch.cat([prepare(frame, (64, 64), IMAGENET, 'cpu') for frame in frames])
    session = Sam2VideoInferenceSession(
        video=pixels, video_height=HEIGHT, video_width=WIDTH, dtype=torch.float32
    )
    for number, mask in enumerate(masks):
        large = torch.tensor(mask).float()[None, None]
        large = torch.nn.functional.interpolate(
            large, size=(64, 64), mode='bilinear', antialias=True
        )
        session.add_mask_inputs(session.obj_id_to_idx(number), 0, (large >= 0.5).float())
    session.obj_with_new_inputs = [0, 1]
    expected = []
    for output in model.propagate_in_video_iterator(session, start_frame_idx=0):
        logits = torch.nn.functional.interpolate(
            output.pred_masks, size=(HEIGHT, WIDTH), mode='bilinear', align_corners=False
        )
        expected.append(logits[:, 0].numpy() > 0)
    ours = list(track_masks(sam2, frames[0], masks, frames[1:]))
    assert np.array_equal(expected[1:], ours)


def test_prompt_of_a_single_pixel_is_not_lost(sam2):
    frames, masks = clip(1)
    masks[0] = False
    masks[0, 20, 20] = True
    session = start_session(sam2, frames[0], masks)
    assert session.mask_inputs_per_obj[0][0].any()


def test_nothing_to_track_yields_empty_rows(sam2):
    frames, masks = clip(3)
    assert [m.shape for m in track_masks(sam2, frames[0], masks[:0], frames)] == [
        (0, HEIGHT, WIDTH)
    ] * 3
