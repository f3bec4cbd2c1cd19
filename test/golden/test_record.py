"""The golden record notices what differs, and what is only another processor."""

from copy import deepcopy
import importlib.util
import json
import os
from pathlib import Path
import sys

import numpy as np
import pytest

HERE = Path(__file__).parent


@pytest.fixture(scope='module')
def record():
    """The script; what it sets for its own process is undone."""
    environment, path = dict(os.environ), list(sys.path)
    spec = importlib.util.spec_from_file_location('golden_record', HERE / 'record.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:] = path
    return module


@pytest.fixture
def replay():
    return json.loads((HERE / 'replay.json').read_text())


def test_what_is_recorded_is_equal_to_itself(record):
    for name in record.SECTIONS:
        found = json.loads((HERE / f'{name}.json').read_text())
        assert record.differences(name, found, deepcopy(found)) == []


def change(found, *keys, by):
    *places, last = keys
    for key in places:
        found = found[key]
    found[last] = by(found[last])


@pytest.mark.parametrize(
    ('keys', 'small', 'large'),
    [
        (('images imagined low', 'last', 3), 0.012, 0.05),
        (('images trajectory high', 'first', 0), 0.012, 0.05),
        (('masks imagined low', 'last', 1), 0.001, 0.01),
        (('joints imagined', 7, 1), 0.001, 0.01),
        (('success', 1), 0.01, 0.1),
    ],
)
def test_last_bits_are_no_difference_and_another_result_is(record, replay, keys, small, large):
    now = deepcopy(replay)
    change(now, *keys, by=lambda value: value + small)
    assert record.differences('replay', replay, now) == []
    now = deepcopy(replay)
    change(now, *keys, by=lambda value: value - large)
    (said,) = record.differences('replay', replay, now)
    assert f'{keys[0]}.' in said or keys[0] in said


@pytest.mark.parametrize(
    'change_one',
    [
        lambda now: now['images imagined low'].update(stamps='0'),
        lambda now: now.pop('masks imagined high'),
        lambda now: now['success'].append(0.5),
        lambda now: now['joints imagined'][0].__setitem__(0, 47),
        lambda now: now['words'].append('failed'),
    ],
    ids=['stamps', 'a view less', 'an estimate more', 'a frame less', 'a text more'],
)
def test_stamps_counts_and_texts_are_compared_exactly(record, replay, change_one):
    now = deepcopy(replay)
    change_one(now)
    assert record.differences('replay', replay, now)


def test_a_moved_object_is_seen_in_the_coarse_picture(record):
    """An object of a thirtieth of the width, moved by its own size."""
    frames = np.full((2, 72, 96, 3), 150, np.uint8)
    frames[0, 40:46, 48:54] = frames[1, 40:46, 60:66] = 20
    before, after = (record._levels(frame) for frame in frames)
    key = {'images imagined low': {'last': before}}
    assert record.differences('replay', key, {'images imagined low': {'last': after}})


def test_results_keep_numbers_by_key_and_the_shape_of_texts(record):
    found = record.summary({'rates': [0.5, 1.0, None], 'note': 'held by 12.5 mm', 'is_ok': True})
    assert found['rates[]'] == [2, 0.75, 0.25]
    other = record.summary({'rates': [0.5, 1.0, None], 'note': 'held by 9 mm', 'is_ok': False})
    assert found['note (text)'] == other['note (text)']
    assert found['is_ok (text)'] != other['is_ok (text)']
