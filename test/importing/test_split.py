"""Imports split recordings: what was trained on is not what is tested on."""

import json

import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.splits import splits_of
from mtv_world_ros.importing.split import parse_split, write_split


def recordings(*names):
    return {name: name for name in names}


def test_shares_are_read_and_others_refused():
    assert parse_split('75:25') == 75 and parse_split('1:1') == 50 and parse_split('off') == 100
    for wrong in ('75', '0:100', '75:0', 'half', '-1:2'):
        with pytest.raises(ConfigError, match='75:25'):
            parse_split(wrong)


def test_three_recordings_are_not_split_unless_asked_for(tmp_path):
    assert write_split(tmp_path, recordings('a', 'b', 'c'), None) == ''
    assert not (tmp_path / 'dataset.json').exists()
    assert 'split: 2 to train on, 1 to test on' in write_split(
        tmp_path, recordings('a', 'b', 'c'), 75
    )


@pytest.mark.parametrize('count, num_test', [(4, 1), (5, 1), (8, 2), (20, 5)])
def test_a_quarter_is_for_testing(count, num_test, tmp_path):
    names = [f'bag_{k}' for k in range(count)]
    line = write_split(tmp_path, recordings(*names), None)
    found = splits_of(tmp_path)
    assert len(found['test']) == num_test and len(found['train']) == count - num_test
    assert sorted(found['train'] + found['test']) == sorted(names)
    assert all(name in line for name in found['test'])


def test_never_all_are_for_testing(tmp_path):
    write_split(tmp_path, recordings('only'), 10)
    assert splits_of(tmp_path) == {'train': ['only'], 'test': []}


def test_off_leaves_no_card_and_moves_nothing(tmp_path):
    names = recordings(*'abcdefgh')
    assert write_split(tmp_path, names, 100) == ''
    assert not (tmp_path / 'dataset.json').exists()
    write_split(tmp_path, names, 75)
    before = splits_of(tmp_path)
    write_split(tmp_path, {**names, 'new': 'new'}, 100)
    assert splits_of(tmp_path)['test'] == before['test']
    assert 'new' in splits_of(tmp_path)['train']


def test_later_imports_move_nothing_and_go_on_with_the_shares(tmp_path):
    write_split(tmp_path, recordings('m', 'n', 'o', 'p'), None)
    before = splits_of(tmp_path)
    write_split(tmp_path, recordings(*'mnop', *'abcdefgh'), None)
    after = splits_of(tmp_path)
    assert set(before['train']) <= set(after['train'])
    assert set(before['test']) <= set(after['test'])
    assert (len(after['train']), len(after['test'])) == (9, 3)


def test_parts_of_a_recording_are_in_one_split(tmp_path):
    parts = {f'{bag}_part{k}': bag for bag in 'abcdefgh' for k in (1, 2)}
    write_split(tmp_path, parts, 50)
    found = splits_of(tmp_path)
    assert not {parts[e] for e in found['train']} & {parts[e] for e in found['test']}
    assert len(found['test']) == 8


def test_other_entries_of_the_card_stay(tmp_path):
    (tmp_path / 'dataset.json').write_text(json.dumps({'task_definitions': {'mine': {}}}))
    write_split(tmp_path, recordings(*'abcd'), None)
    assert json.loads((tmp_path / 'dataset.json').read_text())['task_definitions'] == {'mine': {}}
