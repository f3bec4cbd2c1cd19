import json
import shutil

import numpy as np
import pytest

from mtv_world_ros.data.mcap_reader import iter_messages, read_episode
from mtv_world_ros.errors import EpisodeError, SimulatorError
from mtv_world_ros.sim.collect import collect
from mtv_world_ros.sim.episode_maker import CollectConfig
from mtv_world_ros.sim.jobs import episode_seed, misses
from mtv_world_ros.sim.randomize import RandomizationConfig

SMALL = CollectConfig(randomization=RandomizationConfig(width=96, height=72))


@pytest.fixture(scope='module')
def data_set(tmp_path_factory):
    from mtv_world_ros.sim.opengl import missing_opengl

    reason = missing_opengl()
    if reason:
        pytest.skip(reason)
    out = tmp_path_factory.mktemp('set')
    collect('all', 1, 4, out, config=SMALL, progress=False)
    return out


def _stream(path):
    return [tuple(message) for message in iter_messages(path)]


def test_the_same_seed_gives_byte_equal_episodes_in_other_processes(data_set, tmp_path):
    collect('all', 1, 4, tmp_path, config=SMALL, workers=2, progress=False)
    names = sorted(path.name for path in data_set.iterdir())
    assert names == sorted(path.name for path in tmp_path.iterdir()) and len(names) == 3
    for name in names[1:] if names[0] == 'dataset.json' else names[:-1]:
        if (data_set / name).is_dir():
            assert _stream(data_set / name) == _stream(tmp_path / name)
    cards = [(folder / 'dataset.json').read_text() for folder in (data_set, tmp_path)]
    assert cards[0] == cards[1]


def test_a_rerun_keeps_finished_episodes_and_makes_the_missing_one(data_set, tmp_path):
    out = tmp_path / 'set'
    shutil.copytree(data_set, out)
    lost, kept = out / 'stack_blocks_two_00000', out / 'place_block_a2b_left_00000'
    before, times = _stream(lost), (kept / 'metadata.yaml').stat().st_mtime_ns
    shutil.rmtree(lost)
    collect('all', 1, 4, out, config=SMALL, progress=False)
    assert _stream(lost) == before
    assert (kept / 'metadata.yaml').stat().st_mtime_ns == times


def test_another_seed_or_configuration_does_not_mix_into_a_set(data_set):
    with pytest.raises(SimulatorError, match='holds a data set of seed 4, not 5'):
        collect('all', 1, 5, data_set, config=SMALL, progress=False)
    with pytest.raises(SimulatorError, match='another configuration'):
        collect('all', 1, 4, data_set, progress=False)


def test_foreign_folder_under_an_episode_name_is_refused(data_set, tmp_path):
    (tmp_path / 'place_block_a2b_left_00000').mkdir()
    with pytest.raises(EpisodeError, match='not an episode'):
        collect('place_block_a2b_left', 1, 4, tmp_path, config=SMALL, progress=False)


def test_episodes_read_back_with_masks_commands_and_metadata(data_set):
    episode = read_episode(data_set / 'place_block_a2b_left_00000')
    info = episode.info
    assert (info.task, info.outcome, info.robot) == (
        'place_block_a2b_left', 'success', 'yam_bimanual',
    )  # fmt: skip
    assert info.instruction.startswith(f'place the {info.objects[0]} to the left of the ')
    assert info.seed == episode_seed(4, info.task, 0, int(info.metadata['attempt']))
    assert episode.views == ('low', 'high') and not episode.warnings
    stamps = episode.images['low'].stamps_ns
    assert len(stamps) == 71 and set(np.diff(stamps)) == {100_000_000}
    # a joint sample at every frame's stamp
    assert set(stamps) <= set(episode.joint_states.stamps_ns)
    starts = [(start - stamps[0]) / 1e9 for start, _ in episode.trajectories]
    assert starts == [0.0, 3.2, 6.4]
    assert all(trajectory.velocities is not None for _, trajectory in episode.trajectories)
    ids = np.asarray(episode.masks['high'].frames[0])
    assert set(np.unique(ids)) == set(range(len(info.objects) + 1))


def test_card_counts_and_splits_the_episodes(data_set):
    card = json.loads((data_set / 'dataset.json').read_text())
    assert card['num_episodes'] == 2 and len(card['episodes']) == 2
    assert card['splits'] == {
        'train': ['place_block_a2b_left_00000', 'stack_blocks_two_00000'], 'test': [],
    }  # fmt: skip
    assert card['tasks']['stack_blocks_two']['episodes'] == 1


def test_two_of_ten_episodes_miss_one_in_each_split():
    for seed in range(20):
        chosen = [index for index in range(30) if misses(seed, 'stack_blocks_two', index)]
        assert len(chosen) == 6
        assert sorted((index // 10, index % 2) for index in chosen) == [
            (block, split) for block in range(3) for split in range(2)
        ]


def test_counts_below_one_are_refused(tmp_path):
    with pytest.raises(SimulatorError, match='at least 1'):
        collect('all', 0, 0, tmp_path)
