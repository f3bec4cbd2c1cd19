import cv2
import numpy as np
import pytest

from mtv_world_ros.core.errors import ObservationError
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter, PALETTE
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids, resize_masks

HEIGHT, WIDTH = 72, 96


def scene(blocks, size=8, gain=1.0, blur=0.0, grey=(150, 148, 145), seed=0):
    """One frame of shaded blocks {word: (x, y)} drawn 8 times larger, and their true masks."""
    rng = np.random.default_rng(seed)
    big = 8
    frame = np.full((HEIGHT * big, WIDTH * big, 3), grey, np.float32)
    frame *= np.linspace(0.85, 1.1, WIDTH * big)[None, :, None]
    masks = {}
    for word, (x, y) in blocks.items():
        mask = np.zeros(frame.shape[:2], np.float32)
        left, top, side = round(x * big), round(y * big), size * big
        mask[top : top + side, left : left + side] = 1
        colour = np.array(PALETTE[word], np.float32)
        frame[top : top + side // 2, left : left + side] = colour
        frame[top + side // 2 : top + side, left : left + side] = 0.6 * colour
        masks[word] = cv2.resize(mask, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) >= 0.5
    frame = cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    if blur:
        frame = cv2.GaussianBlur(frame, (0, 0), blur)
    frame = frame * gain + rng.normal(0, 2, frame.shape)
    return np.clip(frame, 0, 255).astype(np.uint8), masks


def video(blocks_per_frame, **options):
    """(1, T, H, W, 3) frames and {word: (T, H, W)} true masks."""
    drawn = [scene(blocks, seed=k, **options) for k, blocks in enumerate(blocks_per_frame)]
    words = {word for blocks in blocks_per_frame for word in blocks}
    empty = np.zeros((HEIGHT, WIDTH), bool)
    masks = {word: np.stack([m.get(word, empty) for _, m in drawn]) for word in words}
    return np.stack([frame for frame, _ in drawn])[None], masks


def segment(frames, *names, **options):
    return ColourSegmenter().segment(frames, names, **options)


@pytest.mark.parametrize('gain', [1.0, 0.5])
@pytest.mark.parametrize('word', list(PALETTE))
def test_small_shaded_block_of_every_colour_is_found(word, gain):
    frames, true = video([{word: (30.3 + k, 40)} for k in range(4)], gain=gain)
    found = segment(frames, f'{word} block')
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true[word]).mean() > 0.8


@pytest.mark.parametrize('word', list(PALETTE))
def test_blurred_block_keeps_its_outline(word):
    frames, true = video([{word: (30.5 + k, 40)} for k in range(4)], blur=1.5)
    found = segment(frames, f'{word} block')
    assert jaccard(found.masks[0, 0], true[word]).min() > 0.7


@pytest.mark.parametrize('word', list(PALETTE))
def test_colour_that_is_not_there_is_absent_amid_all_others(word):
    others = [other for other in PALETTE if other != word]
    blocks = {other: (4 + 12 * k, 20 + 2 * k) for k, other in enumerate(others)}
    frames, _ = video([blocks] * 2)
    found = segment(frames, f'{word} block')
    assert found.status == (('absent',),) and not found.masks.any()


def test_wooden_table_is_no_orange_block():
    frames, _ = video([{'red': (40, 40)}] * 2, grey=(165, 130, 95))
    found = segment(frames, 'orange block', 'red block')
    assert found.status[0][0] != 'ok' and found.status[0][1] == 'ok'


RED, ELSEWHERE = {'red': (40, 40)}, {'blue': (10, 10)}


def with_twin(frames):
    """Copy the block at (20, 40) to (60, 40)."""
    frames[:, :, 40:48, 60:68] = frames[:, :, 40:48, 20:28]
    return frames


def with_sliver(frames, first):
    """Show one row of red from a frame on."""
    frames[:, first:, 40, 40:52] = PALETTE['red']
    return frames


def growing():
    small, _ = video([RED] * 3, size=6)
    large, _ = video([{'red': (36, 36)}] * 3, size=14)
    return np.concatenate([small, large], 1)


@pytest.mark.parametrize(
    ('frames', 'status'),
    [
        (with_twin(video([{'red': (20, 40)}] * 2)[0]), 'ambiguous'),
        (video([{'red': (5, 40)}] * 3 + [{'red': (80, 40)}] * 3)[0], 'teleport'),
        (growing(), 'area_jump'),
        (video([RED] + [ELSEWHERE] * 3)[0], 'lost'),
        (video([{'red': (0, 40)}] + [{'blue': (40, 10)}] * 3)[0], 'out_of_view'),
        (with_sliver(video([RED] * 2 + [ELSEWHERE] * 3)[0], 2), 'barely_visible'),
        (with_sliver(video([RED] * 6 + [ELSEWHERE])[0], 6), 'ok'),
    ],
    ids=['twins', 'jumps', 'grows', 'vanishes', 'leaves', 'sliver', 'sliver for a moment'],
)
def test_doubts_about_what_is_followed_are_in_the_status(frames, status):
    assert segment(frames, 'red block').status == ((status,),)


def test_two_names_of_one_colour_are_ambiguous_without_start_masks():
    frames, _ = video([{'red': (20, 40)}] * 2)
    assert segment(frames, 'red block', 'red cup').status[0][0] == 'ambiguous'


def test_start_mask_resolves_two_blocks_of_one_colour():
    frames, true = video([{'red': (20, 40)}] * 2)
    found = segment(with_twin(frames), 'red block', first_masks=true['red'][None, :1])
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true['red']).min() > 0.8


def test_name_without_a_palette_word_is_out_of_palette():
    frames, _ = video([{'red': (20, 40)}])
    found = segment(frames, 'white plate', 'bread')
    assert found.status == (('out_of_palette', 'out_of_palette'),) and not found.masks.any()


def test_block_split_by_a_finger_is_one_object():
    frames, true = video([{'blue': (40, 40)}] * 2, size=10)
    frames[:, :, :, 44:46] = 60
    found = segment(frames, 'blue block')
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true['blue']).min() > 0.7


def test_jump_from_the_start_mask_is_a_teleport():
    frames, _ = video([{'red': (80, 40)}] * 3)
    _, start = video([{'red': (5, 40)}])
    found = segment(frames, 'red block', first_masks=start['red'][None])
    assert found.status == (('teleport',),)


def test_object_that_is_gone_from_the_start_mask_on_is_lost():
    frames, _ = video([{'blue': (10, 10)}] * 3)
    _, start = video([{'red': (40, 40)}])
    found = segment(frames, 'red block', first_masks=start['red'][None])
    assert found.status == (('lost',),) and not found.masks.any()


def test_start_masks_of_another_size_are_refused_with_both_sizes():
    frames, true = video([{'red': (20, 40)}] * 2)
    with pytest.raises(ObservationError, match=r'\(1, 1, 36, 48\).*\(1, 1, 72, 96\)'):
        segment(frames, 'red block', first_masks=resize_masks(true['red'][None, :1], 48, 36))


def test_start_masks_of_another_number_of_objects_are_refused():
    frames, true = video([{'red': (20, 40)}] * 2)
    with pytest.raises(ObservationError, match=r'want \(1, 2, 72, 96\)'):
        segment(frames, 'red block', 'blue block', first_masks=true['red'][None, :1])


def test_frames_that_are_not_bytes_are_refused():
    with pytest.raises(ObservationError, match='float64.*uint8'):
        segment(np.zeros((1, 1, HEIGHT, WIDTH, 3)), 'red block')


def carrot(num_frames=3, leaf=(40, 36), names=('orange carrot',), **more):
    """Segment an orange square under a green one, and return both masks of the truth."""
    blocks = {'orange': (40, 40), 'green': leaf, **more}
    frames, true = video([blocks] * num_frames, size=4)
    return segment(frames, *names), true


def test_green_of_a_carrot_belongs_to_it():
    found, true = carrot()
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true['orange'] | true['green']).min() > 0.8


def test_green_away_from_the_carrot_does_not():
    found, true = carrot(leaf=(40, 20))
    assert jaccard(found.masks[0, 0], true['orange']).min() > 0.8


def test_green_that_touches_a_block_does_not_belong_to_it():
    found, true = carrot(names=('orange block',))
    assert jaccard(found.masks[0, 0], true['orange']).min() > 0.8


def test_green_of_another_named_object_stays_its_own():
    found, true = carrot(names=('orange carrot', 'green cup'))
    assert jaccard(found.masks[0, 0], true['orange']).min() > 0.8
    assert jaccard(found.masks[0, 1], true['green']).min() > 0.8


def test_carrot_on_a_large_green_thing_does_not_swallow_it():
    frames, true = video([{'orange': (40, 40)}] * 3, size=4)
    frames[:, :, 44:64, 30:60] = PALETTE['green']
    found = segment(frames, 'orange carrot')
    assert jaccard(found.masks[0, 0], true['orange']).min() > 0.8


def test_green_carrot_has_no_part_of_its_own_colour():
    frames, true = video([{'green': (40, 40)}] * 2)
    assert jaccard(segment(frames, 'green carrot').masks[0, 0], true['green']).min() > 0.8


def test_short_occlusion_stays_ok_and_empty():
    shown, hidden = {'red': (40, 40)}, {'blue': (10, 10)}
    frames, _ = video([shown, shown, hidden, shown, shown])
    found = segment(frames, 'red block')
    assert found.status == (('ok',),)
    assert found.masks[0, 0].any((1, 2)).tolist() == [True, True, False, True, True]


def test_no_names_give_no_masks():
    frames, _ = video([{'red': (40, 40)}])
    assert segment(frames).masks.shape == (1, 0, 1, HEIGHT, WIDTH)


def test_black_frames_are_absent():
    found = segment(np.zeros((2, 3, HEIGHT, WIDTH, 3), np.uint8), 'red block')
    assert found.status == (('absent',), ('absent',))


def test_identity_image_gives_masks_in_the_order_asked_for():
    ids = np.array([[[[0, 1], [2, 2]]]], np.uint8)
    found = masks_from_ids(ids, ('red block', 'blue block'), ('blue block', 'red block', 'cup'))
    assert found.masks[0, :, 0].sum((1, 2)).tolist() == [2, 1, 0]
    assert found.status == (('ok', 'ok', 'absent'),)


def test_resized_mask_covers_half_pixels():
    mask = np.zeros((1, 8, 8), bool)
    mask[0, :4, :6] = True
    small = resize_masks(mask, 2, 2)
    assert small.tolist() == [[[True, True], [False, False]]]


def test_no_colour_that_may_count_is_left_out_by_its_saturation_in_hsv():
    """Over all colours: hue of a word, and a saturation in CIELAB that may be an object's."""
    segmenter = ColourSegmenter()
    words = list(PALETTE)
    least = np.array([segmenter._least_hsv([word]) for word in words])
    assert least[:, 1].min() > 10  # most of a grey image is left out
    floors = np.append(0.8 * 0.3 * segmenter._saturations, np.inf)  # infinity: of no word
    green, blue = np.meshgrid(np.arange(256), np.arange(256), indexing='ij')
    for red in range(256):
        rgb = np.stack([np.full_like(green, red), green, blue], -1).astype(np.uint8)
        lab = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB))
        lightness, a, b = np.moveaxis(lab.astype(np.float64), -1, 0)
        word = segmenter._word_of_ab[lab[..., 1].astype(int), lab[..., 2].astype(int)]
        saturation = np.hypot(a - 128, b - 128) / (lightness / 2.55 + 16)
        counts = (lightness >= 20) & (saturation > 0.999 * floors[word])
        hsv = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV))[counts]
        assert (hsv >= least[word[counts]]).all(), red
        # pixels are looked at in rows of those that may count
        row = rgb.reshape(1, -1, 3)[:, : red + 1]
        assert np.array_equal(
            cv2.cvtColor(row, cv2.COLOR_RGB2LAB)[0], lab.reshape(-1, 3)[: red + 1]
        )
