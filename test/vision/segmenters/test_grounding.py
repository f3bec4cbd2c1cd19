from typing import Any

import numpy as np
from PIL import Image
import pytest
import torch
from transformers import AutoTokenizer, MMGroundingDinoForObjectDetection
from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
    GroundingDinoImageProcessorPil,
)
from transformers.models.grounding_dino.processing_grounding_dino import GroundingDinoProcessor

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.vision.segmenters.grounding import (
    _prompt,
    _tokens_of,
    box_iou,
    choose_boxes,
    GroundingConfig,
    MMGroundingDino,
)

LEFT, RIGHT = [0.0, 0.0, 10.0, 10.0], [50.0, 0.0, 60.0, 10.0]
NEAR_LEFT = [1.0, 0.0, 10.0, 10.0]


def choose(boxes, scores, names=('red block', 'blue cup'), **config):
    found = choose_boxes(np.array(boxes), np.array(scores), names, GroundingConfig(**config))
    return found.boxes.tolist(), found.status


def test_every_name_gets_its_best_box():
    boxes, status = choose([LEFT, RIGHT], [[0.6, 0.3], [0.1, 0.5]])
    assert boxes == [LEFT, RIGHT] and status == ('ok', 'ok')


def test_name_whose_best_box_is_another_names_is_absent():
    boxes, status = choose([LEFT], [[0.6, 0.5]])
    assert boxes[0] == LEFT and np.isnan(boxes[1]).all() and status == ('ok', 'absent')


def test_score_below_the_threshold_is_absent():
    assert choose([LEFT], [[0.2, 0.0]])[1] == ('absent', 'absent')


def test_unsure_box_is_low_confidence():
    assert choose([LEFT], [[0.3, 0.0]])[1][0] == 'low_confidence'


def test_two_places_that_fit_alike_are_ambiguous():
    assert choose([LEFT, RIGHT], [[0.6, 0.0], [0.55, 0.0]])[1][0] == 'ambiguous'


def test_second_place_that_fits_much_less_is_no_rival():
    assert choose([LEFT, RIGHT], [[0.6, 0.0], [0.3, 0.0]])[1][0] == 'ok'


def test_two_boxes_of_one_place_are_no_rivals():
    assert choose([LEFT, NEAR_LEFT], [[0.6, 0.0], [0.58, 0.0]])[1][0] == 'ok'


def test_two_names_for_one_place_leave_the_weaker_one_ambiguous():
    assert choose([LEFT, NEAR_LEFT], [[0.6, 0.0], [0.0, 0.5]])[1] == ('ok', 'ambiguous')


def test_name_given_twice_is_ambiguous():
    _, status = choose([LEFT, RIGHT], [[0.6, 0.6], [0.1, 0.1]], names=('cup', 'cup'))
    assert status == ('ambiguous', 'ambiguous')


def test_iou_of_half_overlapping_boxes_is_a_third():
    boxes = np.array([LEFT, [5.0, 0, 15, 10], RIGHT, [np.nan] * 4])
    assert box_iou(boxes, np.array(LEFT)) == pytest.approx([1, 1 / 3, 0, 0])


def test_thresholds_out_of_order_are_refused():
    with pytest.raises(ConfigError, match='min_score is 0.5 and sure_score 0.4'):
        GroundingConfig(min_score=0.5, sure_score=0.4)


def test_tokens_of_a_name_are_its_words(weights):
    tokenizer = AutoTokenizer.from_pretrained(weights / 'some org' / 'detector')
    names = ('red block', 'Blue  cup.', 'white plate')
    text, spans = _prompt(names)
    encoded = tokenizer(text, return_offsets_mapping=True)
    chosen = _tokens_of(spans, np.array(encoded['offset_mapping']))
    words = np.array(tokenizer.convert_ids_to_tokens(encoded['input_ids']))
    assert text == 'red block. blue cup. white plate.'
    assert [words[mask].tolist() for mask in chosen] == [
        ['red', 'block'],
        ['blue', 'cup'],
        ['white', 'plate'],
    ]


def test_box_is_the_one_that_the_published_processor_gives(weights):
    """Image preparation, text, scores and scale against the processor of transformers."""
    folder = weights / 'some org' / 'detector'
    frame = np.random.default_rng(3).integers(0, 256, (60, 100, 3), dtype=np.uint8)
    images = GroundingDinoImageProcessorPil.from_pretrained(folder)
    processor: Any = GroundingDinoProcessor(images, AutoTokenizer.from_pretrained(folder))
    inputs = processor(images=Image.fromarray(frame), text='blue cup.', return_tensors='pt')
    model = MMGroundingDinoForObjectDetection.from_pretrained(folder).eval()
    with torch.inference_mode():
        output = model(**inputs)
    every = processor.post_process_grounded_object_detection(
        output, threshold=0.0, target_sizes=[(60, 100)]
    )[0]
    # tokens: [CLS] blue cup . [SEP]
    best = output.logits[0, :, 1:3].sigmoid().mean(1).argmax()
    expected = every['boxes'][best].numpy().clip(0, [100, 60, 100, 60])
    detector = MMGroundingDino(folder, config=GroundingConfig(min_score=1e-6, sure_score=2e-6))
    found = detector.find(frame, ('blue cup',))
    assert found.boxes[0] == pytest.approx(expected, abs=0.2)
    assert np.ptp(every['boxes'].numpy(), axis=0).min() > 1  # there were others to choose from


def test_more_names_than_the_text_holds_are_refused(weights):
    detector = MMGroundingDino(weights / 'some org' / 'detector')
    with pytest.raises(ConfigError, match="20 object names make 62 tokens.*40.*'objects'"):
        detector.find(np.zeros((8, 8, 3), np.uint8), ('red block',) * 20)


def test_no_names_find_nothing(weights):
    detector = MMGroundingDino(weights / 'some org' / 'detector')
    assert detector.find(np.zeros((8, 8, 3), np.uint8), ()).boxes.shape == (0, 4)
