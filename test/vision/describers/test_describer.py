import numpy as np
import pytest

from mtv_world_ros.vision.describers.describer import (
    InstructionDescriber,
    objects_from_instruction,
)
from mtv_world_ros.vision.segmenters.colour import colour_of


@pytest.mark.parametrize(
    ('instruction', 'expected'),
    [
        ('place the red block to the left of the blue block', ('red block', 'blue block')),
        ('Stack the Yellow Block on the purple block.', ('yellow block', 'purple block')),
        ('put the green toy car, then the pink cup, in it', ('green toy car', 'pink cup')),
        ('move the red block next to the red block', ('red block',)),
        ('take the white plate and an orange', ('white plate',)),
        ('place the bread on the plate', ()),
        ('red', ()),
        ('', ()),
    ],
)
def test_objects_are_the_coloured_noun_phrases_in_order(instruction, expected):
    assert objects_from_instruction(instruction) == expected


def test_describer_needs_no_image():
    frame = np.zeros((2, 2, 3), np.uint8)
    (found,) = InstructionDescriber().describe(frame, 'lift the cyan cube')
    assert (found.name, found.colour, found.role) == ('cyan cube', 'cyan', None)
    assert InstructionDescriber().describe(frame, 'lift it') == ()


def test_colour_word_outside_the_palette_is_no_colour():
    assert colour_of('white plate') is None
    assert colour_of('Red block') == 'red'
