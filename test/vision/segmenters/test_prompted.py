import os

import numpy as np
import pytest
import torch

from mtv_world_ros.core.errors import ModelMemoryError, ObservationError
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.choose import choose_segmenter, WEIGHTS_VARIABLE
from mtv_world_ros.vision.segmenters.grounding import GroundingConfig, MMGroundingDino
from mtv_world_ros.vision.segmenters.prompted import PromptedSegmenter
from mtv_world_ros.vision.segmenters.sam import (
    BoxedFinder,
    sam2_segmenter,
    Sam2Video,
    sam3_segmenter,
)
from mtv_world_ros.vision.segmenters.tracking import TrackingConfig
from test.support.tiny_vision import save_sam2

HEIGHT, WIDTH = 48, 64
NAMES = ('red block', 'blue cup')
#: random models find every name, none of them surely
EAGER = GroundingConfig(min_score=1e-6, sure_score=2e-6, rival_share=1.0, same_box=1.1)
UNSURE = GroundingConfig(min_score=1e-6, sure_score=0.99, rival_share=1.0, same_box=1.1)
NEVER = GroundingConfig(min_score=0.99, sure_score=0.995)
#: masks of random models jump about
CALM = TrackingConfig(max_step=10, max_growth=1e6, max_missing=0.5)


def make(weights, kind, grounding=EAGER, tracking=CALM):
    if kind == 'sam3':
        return sam3_segmenter(weights / 'third', grounding=grounding, tracking=tracking)
    folders = weights / 'some org' / 'detector', weights / 'tracker'
    return sam2_segmenter(*folders, grounding=grounding, tracking=tracking)


@pytest.fixture(scope='module')
def segmenters(weights):
    return {kind: make(weights, kind) for kind in ('sam2', 'sam3')}


@pytest.fixture(params=['sam2', 'sam3'])
def segmenter(request, segmenters):
    return segmenters[request.param]


@pytest.fixture(scope='module')
def blind(weights, tmp_path_factory):
    """A SAM 2 that sees no object in any frame after the prompt."""
    video = Sam2Video(save_sam2(tmp_path_factory.mktemp('blind'), present=-20.0))
    finder = BoxedFinder(MMGroundingDino(weights / 'some org' / 'detector'), video)
    return PromptedSegmenter(name='blind', finder=finder, video=video)


def frames(num_views=2, num_frames=3, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (num_views, num_frames, HEIGHT, WIDTH, 3), dtype=np.uint8)


def start_masks(num_views=2):
    masks = np.zeros((num_views, 2, HEIGHT, WIDTH), bool)
    masks[:, 0, 10:20, 10:20] = True
    masks[:, 1, 30:40, 40:50] = True
    return masks


def test_names_alone_give_masks_in_every_frame(segmenter):
    found = segmenter.segment(frames(), NAMES)
    assert found.masks.shape == (2, 2, 3, HEIGHT, WIDTH) and found.names == NAMES
    assert found.status == (('ok', 'ok'),) * 2
    assert found.masks.any((3, 4)).all()


def test_first_frames_masks_are_found_again_as_start_of_the_whole_video(segmenter):
    whole = segmenter.segment(frames(), NAMES)
    first = segmenter.segment(frames()[:, :1], NAMES)
    assert np.array_equal(whole.masks[:, :, 0], first.masks[:, :, 0])
    rest = segmenter.segment(
        frames()[:, 1:],
        NAMES,
        first_masks=first.masks[:, :, 0],
        first_frames=frames()[:, 0],
    )
    assert np.array_equal(whole.masks[:, :, 1:], rest.masks)


def test_given_masks_are_the_prompt_and_not_the_names(segmenter):
    given = {'first_masks': start_masks(), 'first_frames': frames(seed=1)[:, 0]}
    found = segmenter.segment(frames(), NAMES, **given)
    renamed = segmenter.segment(frames(), ('white plate', 'bread'), **given)
    assert np.array_equal(found.masks, renamed.masks)
    other = segmenter.segment(frames(), NAMES, **{**given, 'first_masks': start_masks()[:, ::-1]})
    assert np.array_equal(found.masks, other.masks[:, ::-1])


def test_same_start_and_same_frames_give_the_same_masks(segmenter):
    """The true video scored against itself is the ceiling of 1."""
    given = {'first_masks': start_masks(), 'first_frames': frames(seed=1)[:, 0]}
    one, two = (segmenter.segment(frames(), NAMES, **given) for _ in range(2))
    assert np.array_equal(one.masks, two.masks)


def test_views_do_not_share_memory(segmenter):
    both = segmenter.segment(frames(), NAMES, first_masks=start_masks())
    alone = segmenter.segment(frames()[1:], NAMES, first_masks=start_masks()[1:])
    assert np.array_equal(both.masks[1:], alone.masks)


def test_frame_of_the_start_masks_is_followed_not_copied_where_it_is_not_given(segmenter):
    found = segmenter.segment(frames(), NAMES, first_masks=start_masks())
    assert not np.array_equal(found.masks[:, :, 0], start_masks())


def test_empty_start_mask_is_absent_and_leaves_the_others_alone(segmenter):
    masks = start_masks()
    masks[0, 0] = False
    found = segmenter.segment(frames(), NAMES, first_masks=masks)
    assert found.status == (('absent', 'ok'), ('ok', 'ok'))
    assert not found.masks[0, 0].any() and found.masks[0, 1].any()


@pytest.mark.parametrize('kind', ['sam2', 'sam3'])
def test_name_that_is_not_found_is_absent(weights, kind):
    found = make(weights, kind, grounding=NEVER).segment(frames(), NAMES)
    assert found.status == (('absent', 'absent'),) * 2 and not found.masks.any()


@pytest.mark.parametrize('kind', ['sam2', 'sam3'])
def test_name_that_is_found_without_certainty_says_so(weights, kind):
    found = make(weights, kind, grounding=UNSURE).segment(frames(1), NAMES)
    assert found.status == (('low_confidence', 'low_confidence'),)


def test_object_that_the_tracker_no_longer_sees_is_lost(blind):
    found = blind.segment(
        frames(), NAMES, first_masks=start_masks(), first_frames=frames(seed=1)[:, 0]
    )
    assert found.status == (('lost', 'lost'),) * 2 and not found.masks.any()


def test_object_last_seen_at_the_edge_is_out_of_view(blind):
    masks = start_masks(1)
    masks[0, 0] = False
    masks[0, 0, :5, 10:20] = True
    found = blind.segment(frames(1), NAMES, first_masks=masks)
    assert found.status == (('out_of_view', 'lost'),)


def test_masks_that_jump_are_doubted(weights):
    strict = TrackingConfig(max_step=0.001, max_growth=1e6)
    found = make(weights, 'sam2', tracking=strict).segment(
        frames(1), NAMES, first_masks=start_masks(1)
    )
    assert found.status == (('teleport', 'teleport'),)


def test_masks_of_another_size_are_refused_with_both_sizes(segmenter):
    small = start_masks()[..., ::2, ::2]
    with pytest.raises(ObservationError, match=r'\(2, 2, 24, 32\).*\(2, 2, 48, 64\)'):
        segmenter.segment(frames(), NAMES, first_masks=small)


def test_start_frames_of_another_size_are_refused(segmenter):
    small = frames()[:, 0, ::2, ::2]
    with pytest.raises(ObservationError, match=r'\(2, 24, 32, 3\)'):
        segmenter.segment(frames(), NAMES, first_masks=start_masks(), first_frames=small)


def test_device_without_memory_says_what_to_set(segmenter, monkeypatch):
    def full(*_):
        raise torch.OutOfMemoryError('CUDA out of memory')

    monkeypatch.setattr(type(segmenter.video), 'advance', full)
    with pytest.raises(ModelMemoryError, match="does not fit on 'cpu'.*set another device"):
        segmenter.segment(frames(), NAMES, first_masks=start_masks())


@pytest.mark.weights
def test_public_weights_outline_two_blocks():
    segmenter = choose_segmenter()
    if segmenter.name == 'colour':
        pytest.skip(f'no MM-Grounding-DINO and SAM 2 in {os.environ[WEIGHTS_VARIABLE]}')
    scene = np.full((1, 3, 240, 320, 3), 150, np.uint8)
    true = np.zeros((1, 2, 3, 240, 320), bool)
    for index in range(3):
        true[0, 0, index, 100:150, 60 + 5 * index : 110 + 5 * index] = True
        true[0, 1, index, 120:170, 200:250] = True
    scene[true[:, 0]], scene[true[:, 1]] = (210, 25, 35), (15, 105, 220)
    found = segmenter.segment(scene, ('red square', 'blue square'))
    assert found.status == (('ok', 'ok'),)
    assert jaccard(found.masks, true).min() > 0.8


@pytest.mark.gpu
@pytest.mark.parametrize('kind', ['sam2', 'sam3'])
def test_masks_on_a_gpu_are_those_of_the_cpu(weights, segmenters, kind):
    given = {'first_masks': start_masks(), 'first_frames': frames(seed=1)[:, 0]}
    if kind == 'sam3':
        there = sam3_segmenter(weights / 'third', device='cuda', grounding=EAGER)
    else:
        folders = weights / 'some org' / 'detector', weights / 'tracker'
        there = sam2_segmenter(*folders, device='cuda', grounding=EAGER)
    here = segmenters[kind].segment(frames(), NAMES, **given)
    masks = there.segment(frames(), NAMES, **given).masks
    assert (masks == here.masks).mean() > 0.98
    assert there.segment(frames(), NAMES).masks.any()


def test_no_names_give_no_masks(segmenter):
    assert segmenter.segment(frames(), ()).masks.shape == (2, 0, 3, HEIGHT, WIDTH)


def test_no_frames_are_absent(segmenter):
    found = segmenter.segment(frames(num_frames=0), NAMES)
    assert found.status == (('absent', 'absent'),) * 2
