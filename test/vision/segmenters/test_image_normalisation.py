import ast
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image
import pytest
from transformers import image_utils
from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
    get_size_with_aspect_ratio,
    GroundingDinoImageProcessorPil,
)

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.vision.segmenters.grounding import (
    DINO_EDGES,
    IMAGENET,
    prepare,
    size_with_edges,
    stated_edges,
    stated_normalisation,
    SYMMETRIC,
)
from test.support.tables import table


def frame(height, width, seed=0):
    """A picture with edges and gradients."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    picture = np.array(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))
    picture[height // 4 : height // 2, width // 3 : width // 2] = (200, 30, 40)
    return picture


def published(model, name):
    """A constant of an image processor, read from its source: importing it wants torchvision."""
    package = Path(find_spec('transformers').origin).parent
    source = (package / 'models' / model / f'image_processing_{model}.py').read_text()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and getattr(node.targets[0], 'id', '') == name:
            value = ast.unparse(node.value)
            return getattr(image_utils, value, value)
    raise AssertionError(name)


@pytest.mark.parametrize(
    ('model', 'ours'), [('sam2', IMAGENET), ('sam3', SYMMETRIC), ('grounding_dino', IMAGENET)]
)
def test_constants_are_the_published_ones(model, ours):
    assert tuple(published(model, 'image_mean')) == ours.mean
    assert tuple(published(model, 'image_std')) == ours.std
    assert published(model, 'resample') == 'PILImageResampling.BILINEAR'


def test_detector_edges_are_the_published_ones():
    size = ast.literal_eval(published('grounding_dino', 'size'))
    assert (size['shortest_edge'], size['longest_edge']) == DINO_EDGES


@table(
    'height, width',
    product((48, 72, 480, 799, 800, 801, 1200), (64, 96, 640, 800, 1333, 1500)),
)
def test_size_follows_detrs_rule(height, width):
    assert size_with_edges(height, width, (800, 1333)) == tuple(
        get_size_with_aspect_ratio((height, width), 800, 1333)
    )


@pytest.mark.parametrize(('height', 'width'), [(72, 96), (300, 400), (96, 40)])
def test_detector_sees_what_its_published_processor_makes(height, width):
    picture = frame(height, width)
    size = {'shortest_edge': 128, 'longest_edge': 213}
    processor = GroundingDinoImageProcessorPil(size=size, do_pad=False)
    expected = processor(images=Image.fromarray(picture), return_tensors='pt')['pixel_values']
    ours = prepare(picture, size_with_edges(height, width, (128, 213)), IMAGENET, 'cpu')
    assert ours.shape == expected.shape
    # Pillow rounds after each direction: one grey level
    assert (ours - expected).abs().max() < 1.01 / 255 / 0.224


def test_square_frame_of_sam_equals_pillows_bilinear_one():
    picture = frame(72, 96)
    resized = Image.fromarray(picture).resize((128, 128), Image.Resampling.BILINEAR)
    expected = (np.asarray(resized, np.float64) / 255 - 0.5) / 0.5
    ours = prepare(picture, (128, 128), SYMMETRIC, 'cpu')[0].permute(1, 2, 0).numpy()
    assert np.abs(ours - expected).max() < 1.01 / 255 / 0.5


def test_white_and_black_reach_the_ends_of_the_scale():
    both = np.zeros((4, 4, 3), np.uint8)
    both[:2] = 255
    out = prepare(both, (4, 4), SYMMETRIC, 'cpu')
    assert out.max() == 1 and out.min() == -1 and out.shape == (1, 3, 4, 4)


def test_what_a_folder_states_wins():
    stated = stated_normalisation({'image_mean': [0, 0, 0], 'image_std': [1, 1, 1]}, IMAGENET)
    assert stated.mean == (0, 0, 0) and stated.std == (1, 1, 1)
    assert stated_normalisation({}, SYMMETRIC) == SYMMETRIC
    assert stated_edges({'size': {'shortest_edge': 600, 'longest_edge': 900}}) == (600, 900)
    assert stated_edges({'size': {'height': 9, 'width': 9}}) == DINO_EDGES


def test_statement_that_is_no_normalisation_is_refused():
    with pytest.raises(CheckpointError, match=r'image_std \(0, 1, 1\)'):
        stated_normalisation({'image_std': [0, 1, 1]}, IMAGENET)
