import json

import pytest

from mtv_world_ros.data.splits import of_physics, select
from mtv_world_ros.errors import ConfigError, EpisodeError


@pytest.fixture
def dataset(tmp_path, make_episode):
    """Three episodes, two of them for testing, one with an unseen object."""
    marks = {'episode_0': None, 'episode_1': '', 'episode_2': 'object'}
    names = list(marks)
    for name in names:
        make_episode(name)
    card = {
        'splits': {'train': names[:1], 'test': names[1:]},
        'episodes': [{'name': name, 'zero_shot': mark} for name, mark in marks.items()],
    }
    (tmp_path / 'dataset.json').write_text(json.dumps(card))
    return tmp_path


def names(selection):
    return [path.name for path in selection.paths]


def test_held_out_split_is_the_default_where_there_is_one(dataset):
    found = select(dataset)
    assert names(found) == ['episode_1', 'episode_2']
    assert str(found) == '2 of 3 episodes, split test'
    assert {path.name: kind for path, kind in found.zero_shot.items()} == {'episode_2': 'object'}


def test_splits_are_chosen_by_name(dataset):
    assert names(select(dataset, 'train')) == ['episode_0']
    assert len(select(dataset, 'all').paths) == 3
    assert names(select(dataset, 'all', 2)) == ['episode_0', 'episode_1']
    with pytest.raises(ConfigError, match="'tests' .*did you mean 'test'"):
        select(dataset, 'tests')


def test_folder_without_a_card_is_scored_whole(dataset):
    (dataset / 'dataset.json').unlink()
    found = select(dataset)
    assert len(found.paths) == 3 and found.split == 'all' and not found.zero_shot
    with pytest.raises(ConfigError, match="split 'test'.*which has all"):
        select(dataset, 'test')


def test_what_cannot_be_used_is_an_error(dataset, tmp_path_factory):
    with pytest.raises(EpisodeError, match='holds no episodes'):
        select(tmp_path_factory.mktemp('empty'))
    card = json.loads((dataset / 'dataset.json').read_text())
    card['splits']['test'] = ['gone']
    (dataset / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(EpisodeError, match="split 'test' .* has no episodes"):
        select(dataset)
    (dataset / 'dataset.json').write_text('{"splits": 3')
    with pytest.raises(ConfigError, match='not a data set card'):
        select(dataset)


def test_episodes_of_one_physics_are_chosen_and_all_are_counted(tmp_path, make_episode):
    make_episode('usual')
    make_episode('late', metadata={'physics': 'delay_100ms'})
    make_episode('real', seed=None)
    found = select(tmp_path)
    same, text = of_physics(found)
    assert same == found
    assert sorted(text.split(', ')) == ['delay_100ms (1)', 'nominal (1)', 'not stated (1)']
    late, text = of_physics(found, 'delay_100ms')
    assert names(late) == ['late'] and text == 'delay_100ms (1)'
    with pytest.raises(ConfigError, match="'delay_100' .*did you mean 'delay_100ms'.*not stated"):
        of_physics(found, 'delay_100')


@pytest.mark.parametrize(
    ('seeds', 'says'),
    [((3, 3), 'keep the siblings of a scene in one split'), ((3, 4), 'siblings share a seed')],
)
def test_episodes_of_one_scene_are_in_one_split(dataset, seeds, says):
    card = json.loads((dataset / 'dataset.json').read_text())
    for entry, seed in zip(card['episodes'], seeds, strict=False):
        entry.update(scene='stack_00000', seed=seed)
    (dataset / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(ConfigError, match=says):
        select(dataset)
