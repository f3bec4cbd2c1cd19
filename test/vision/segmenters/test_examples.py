"""Objects by boxes that were drawn once, against the masks that the scenes were drawn with."""

import cv2
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from mtv_world_ros.vision.segmenters.examples import ExampleSegmenter, ObjectExamples

HEIGHT, WIDTH = 120, 200
#: a colour that no palette has, on a white table with a board; the plate is white as the table
BROWN, BOARD, TABLE, PLATE = (120, 75, 45), (205, 165, 100), (215, 215, 212), (228, 228, 226)


def scene(mug=None, plate=(120, 60), arm=None, size=(24, 18), seed=0, shift=(0, 0)):
    """A frame, and true masks of `brown mug` (left, top) and `plate` (middle)."""
    rng = np.random.default_rng(seed)
    dx, dy = shift
    frame = np.full((HEIGHT, WIDTH, 3), TABLE, np.float32)
    frame[:25] = (110, 108, 105)  # the wall
    cv2.rectangle(frame, (70 + dx, 35 + dy), (170 + dx, 95 + dy), BOARD, -1)
    masks = {}
    if plate is not None:
        disc = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.ellipse(disc, (plate[0] + dx, plate[1] + dy), (26, 15), 0, 0, 360, 1, -1)
        frame[disc > 0] = PLATE
        cv2.ellipse(frame, (plate[0] + dx, plate[1] + dy), (16, 9), 0, 0, 360, (195, 195, 193), 1)
        masks['plate'] = disc > 0
    if mug is not None:
        box = np.s_[mug[1] : mug[1] + size[1], mug[0] : mug[0] + size[0]]
        frame[box] = BROWN
        frame[box][size[1] // 2 :] *= 0.75
        masks['brown mug'] = np.zeros((HEIGHT, WIDTH), bool)
        masks['brown mug'][box] = True
        if 'plate' in masks:
            masks['plate'] &= ~masks['brown mug']
    if arm is not None:
        frame[:, arm : arm + 20] = (30, 30, 32)
        for mask in masks.values():
            mask[:, arm : arm + 20] = False
    frame += rng.normal(0, 2, frame.shape)
    return np.clip(frame, 0, 255).astype(np.uint8), masks


@pytest.fixture(scope='module')
def examples():
    frame, _ = scene(mug=(30, 70))
    boxes = {'brown mug': (28, 68, 56, 90), 'plate': (92, 43, 148, 77)}
    return ObjectExamples.of([(frame, boxes)])


@pytest.fixture(scope='module')
def segmenter(examples):
    return ExampleSegmenter(examples)


def video(*scenes):
    """(1, T, H, W, 3) frames and true masks by name (T, H, W)."""
    frames, masks = zip(*scenes, strict=True)
    names = masks[0]
    return np.stack(frames)[None], {n: np.stack([row[n] for row in masks]) for n in names}


def test_the_object_is_cut_out_of_its_box(examples):
    frame, true = scene(mug=(30, 70))
    for example, (left, top, wide, high) in zip(
        examples.examples, ((28, 68, 28, 22), (92, 43, 56, 34)), strict=True
    ):
        at = np.s_[top - high : top + 2 * high, max(0, left - wide) : left + 2 * wide]
        wanted = true[example.name][at][: len(example.mask)]
        assert jaccard(example.mask[None], wanted[None])[0] > 0.8, example.name


def test_what_stands_out_is_found_by_its_colours_anywhere_and_followed(segmenter):
    frames, true = video(*(scene(mug=(100 + 4 * k, 30 + 3 * k), seed=k + 1) for k in range(8)))
    found = segmenter.segment(frames, ('brown mug',))
    assert segmenter.stands_out['brown mug']
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true['brown mug']).min() > 0.8


def test_a_side_in_the_shade_belongs_to_what_stands_out():
    """Its colour is also that of a cable elsewhere: by colours alone it is found in part."""

    def shaded(left, top, seed):
        frame, masks = scene(mug=(left, top), plate=None, seed=seed)
        noise = np.random.default_rng(seed).normal(0, 2, (HEIGHT, WIDTH, 3))
        dark = np.clip(np.array([52, 48, 46]) + noise, 0, 255).astype(np.uint8)
        frame[top + 11 : top + 18, left : left + 24] = dark[top + 11 : top + 18, left : left + 24]
        frame[112:] = dark[112:]
        return frame, masks['brown mug']

    frame, _ = shaded(30, 70, 0)
    segmenter = ExampleSegmenter(ObjectExamples.of([(frame, {'brown mug': (28, 68, 56, 90)})]))
    assert segmenter.stands_out['brown mug']
    for left, top in ((90, 40), (120, 65), (40, 60)):
        frame, true = shaded(left, top, left)
        found = segmenter.segment(frame[None, None], ('brown mug',))
        assert found.status == (('ok',),)
        assert jaccard(found.masks[0, 0], true[None])[0] > 0.85


def test_what_has_the_colours_of_the_table_is_found_by_its_picture(segmenter):
    """The camera was moved by some pixels since the box was drawn."""
    frames, true = video(*(scene(shift=(-9, 6), seed=k + 1) for k in range(3)))
    found = segmenter.segment(frames, ('plate',))
    assert not segmenter.stands_out['plate']
    assert found.status == (('ok',),)
    assert jaccard(found.masks[0, 0], true['plate']).min() > 0.8


def test_an_arm_in_front_leaves_what_is_seen_of_a_plate(segmenter):
    frames, true = video(*(scene(arm=170 - 6 * k, seed=k + 1) for k in range(12)))
    found = segmenter.segment(frames, ('plate',))
    shown = true['plate'].sum((1, 2)) > 0.5 * true['plate'][0].sum()
    assert shown.sum() > 8
    assert jaccard(found.masks[0, 0], true['plate'])[shown].min() > 0.75


def test_a_block_on_the_plate_is_not_the_plate(segmenter):
    """From masks of the first frame on, as imagined frames are followed."""
    frames, true = video(*(scene(mug=(40 + 9 * k, 52), seed=k + 1) for k in range(9)))
    names = ('plate', 'brown mug')
    first = np.stack([true[name][0] for name in names])[None]
    found = segmenter.segment(frames[:, 1:], names, first, frames[:, 0])
    assert not (found.masks[0, 0] & found.masks[0, 1]).any()
    assert found.status == (('ok', 'ok'),)
    for mask, name in zip(found.masks[0], names, strict=True):
        assert jaccard(mask, true[name][1:]).min() > 0.75, name


def test_frames_of_half_the_size(segmenter):
    frames, true = video(*(scene(mug=(30 + 2 * k, 70), seed=k + 1) for k in range(4)))
    small = np.stack([cv2.resize(f, None, fx=0.5, fy=0.5, interpolation=3) for f in frames[0]])
    found = segmenter.segment(small[None], ('brown mug', 'plate'))
    assert found.status == (('ok', 'ok'),)
    for mask, name in zip(found.masks[0], ('brown mug', 'plate'), strict=True):
        wanted = np.stack([m[::2, ::2] for m in true[name]])
        assert jaccard(mask, wanted).min() > 0.7, name


def test_a_scene_without_them_has_neither(segmenter):
    frames, _ = video(*(scene(mug=None, plate=None, seed=k) for k in range(3)))
    found = segmenter.segment(frames, ('brown mug', 'plate'))
    assert found.status == (('absent', 'absent'),)
    assert not found.masks.any()


def test_no_frames_have_no_masks(segmenter):
    frames = np.zeros((2, 0, HEIGHT, WIDTH, 3), np.uint8)
    assert segmenter.segment(frames, ('plate',)).masks.shape == (2, 1, 0, HEIGHT, WIDTH)


def test_two_that_look_alike_are_ambiguous(segmenter):
    frame, _ = scene(mug=(30, 70))
    frame[60:78, 175:199] = frame[70:88, 30:54]
    assert segmenter.segment(frame[None, None], ('brown mug',)).status == (('ambiguous',),)


def test_names_without_examples_are_found_by_their_colour_words(segmenter):
    frame, _ = scene(mug=(30, 70))
    frame[95:111, 10:30] = (210, 25, 35)
    found = segmenter.segment(frame[None, None], ('brown mug', 'red block', 'thing'))
    assert found.status == (('ok', 'ok', 'out_of_palette'),)
    assert found.masks[0, 1, 0, 95:111, 10:30].mean() > 0.9


def test_examples_are_the_same_after_they_were_stored(examples, segmenter, tmp_path):
    examples.save(tmp_path / 'objects.safetensors')
    again = choose_segmenter(str(tmp_path / 'objects.safetensors'))
    frames, _ = video(scene(mug=(90, 40), seed=3))
    names = ('plate', 'brown mug')
    want, have = segmenter.segment(frames, names), again.segment(frames, names)
    assert again.name == segmenter.name
    assert have.status == want.status and (have.masks == want.masks).all()


@pytest.mark.parametrize(
    ('name', 'change', 'says'),
    [
        ('0.frame', lambda a: a[..., 0], 'uint8'),
        ('0.frame', lambda a: a.astype(np.float32), 'uint8'),
        ('0.mask', lambda a: a[1:], 'the mask of'),
        ('0.mask', np.zeros_like, 'the mask of'),
        ('0.size', lambda a: -a, 'the size of'),
        ('elsewhere', lambda a: a[:0], 'empty'),
    ],
)
def test_examples_that_do_not_fit_each_other_are_named(examples, tmp_path, name, change, says):
    file = tmp_path / 'objects.safetensors'
    examples.save(file)
    tensors = load_file(file)
    tensors[name] = np.ascontiguousarray(change(tensors[name]))
    save_file(tensors, file, metadata={'0': 'brown mug', '1': 'plate'})
    with pytest.raises(ConfigError, match=says):
        choose_segmenter(str(file))


@pytest.mark.parametrize('content', [None, b'', b'{"a": 1}', b'\x00' * 64])
def test_a_file_without_examples_is_named(tmp_path, content):
    file = tmp_path / 'objects.safetensors'
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match='has no examples of objects'):
        choose_segmenter(str(file))
