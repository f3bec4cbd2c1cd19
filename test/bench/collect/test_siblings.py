import json

import pytest

from mtv_world_ros.bench.collect.collect_dataset import collect
from mtv_world_ros.bench.collect.episode_maker import CollectConfig
from mtv_world_ros.bench.collect.siblings import (
    find_boundary,
    SceneJob,
    search_siblings,
    SIBLINGS_FILE,
)
from mtv_world_ros.bench.world.randomize import RandomizationConfig
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.data.splits import select
from mtv_world_ros.errors import ConfigError, PolicyError, SimulatorError


def test_bisection_ends_on_both_sides_of_the_boundary():
    good, bad = find_boundary('high', lambda variant: variant.size('high') < 0.0234)
    assert 0.0215 < good.size('high') < 0.0234 <= bad.size('high') < 0.0255
    # `stop` is the other way round: no fault is 1
    good, bad = find_boundary('stop', lambda variant: variant.size('stop') > 0.7)
    assert bad.size('stop') <= 0.7 < good.size('stop') < 0.72


@pytest.mark.parametrize(
    ('kind', 'outcome', 'says'),
    [
        ('high', True, 'it always succeeds, up to 0.08 m'),
        ('high', False, 'it always fails, down to 0.00125 m'),
        ('miss', True, 'it is there or not, and has no size'),
    ],
)
def test_a_fault_without_a_boundary_is_named(kind, outcome, says):
    assert find_boundary(kind, lambda variant: outcome) == says


def test_sizes_out_of_reach_are_not_taken_for_failures():
    def succeeds(variant):
        if variant.size('lean') > 0.5:
            raise PolicyError('out of reach')
        return variant.size('lean') < 0.3

    good, bad = find_boundary('lean', succeeds)
    assert good.size('lean') < 0.3 <= bad.size('lean') < 0.32


@pytest.mark.parametrize(
    'config', [{'siblings': 1, 'kinds': ('high',)}, {'siblings': 3},
               {'siblings': 3, 'kinds': ('high',), 'policies': ('expert',)}]
)  # fmt: skip
def test_siblings_need_fault_kinds_and_at_least_two(config):
    with pytest.raises(SimulatorError, match='set --siblings and --faults'):
        CollectConfig(**config)


@pytest.mark.parametrize('at', ['scene', 'sibling'])
def test_unknown_keys_of_what_an_earlier_run_found_are_refused(at, tmp_path):
    sibling = {'scene': 'a_00000', 'number': 0, 'seed': 7, 'attempt': 0, 'policy': 'expert'}
    scene = {'siblings': [sibling], 'skipped': {}}
    (sibling if at == 'sibling' else scene)['sise'] = 0.1
    (tmp_path / SIBLINGS_FILE).write_text(json.dumps({'a_00000': scene}))

    def search():
        return search_siblings(
            [SceneJob(task='a', index=0, seed=7)], pytest.fail, tmp_path, 1, progress=False
        )

    with pytest.raises(SimulatorError, match=f'{SIBLINGS_FILE}.*sise.*move it away'):
        search()
    (sibling if at == 'sibling' else scene).pop('sise')
    (tmp_path / SIBLINGS_FILE).write_text(json.dumps({'a_00000': scene}))
    assert search()['a_00000'].siblings[0].seed == 7


def test_siblings_share_a_scene_and_their_outcomes_differ(tmp_path, opengl):
    config = CollectConfig(
        randomization=RandomizationConfig(width=64, height=48), kinds=('high', 'miss'), siblings=3
    )

    def run():
        return collect('place_block_a2b_left', 1, 5, tmp_path, config=config, progress=False)

    entries = run()
    names = [entry.name for entry in entries]
    assert names == [f'place_block_a2b_left_00000_{k:02d}' for k in range(3)]
    assert len({entry.seed for entry in entries}) == 1
    assert {entry.scene for entry in entries} == {'place_block_a2b_left_00000'}
    infos = [read_info(tmp_path / name) for name in names]
    assert [info.outcome for info in infos] == ['success', 'success', 'failure']
    said = [info.metadata for info in infos]
    assert said[0]['policy'] == 'expert' and said[0]['kind'] == ''
    sizes = [float(metadata['size']) for metadata in said[1:]]
    assert said[1]['kind'] == said[2]['kind'] == 'grasp_height' and 0 < sizes[0] < sizes[1] < 0.08
    assert said[2]['policy'] == f'expert-high-{sizes[1]:g}'
    assert [metadata['sibling'] for metadata in said] == ['0', '1', '2']
    assert all(0 <= float(metadata['diverges_s']) < 6 for metadata in said)
    assert run() == entries
    assert (tmp_path / SIBLINGS_FILE).is_file()
    assert len(select(tmp_path, 'train').paths) == 3

    card = json.loads((tmp_path / 'dataset.json').read_text())
    card['splits'] = {'train': names[:2], 'test': names[2:]}
    (tmp_path / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(ConfigError, match='keep the siblings of a scene in one split'):
        select(tmp_path, 'train')
    card['episodes'][1]['seed'] += 1
    (tmp_path / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(ConfigError, match='siblings share a seed'):
        select(tmp_path, 'train')
