import json
import re
import shutil

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.cli.fits.success import result_kinds
from mtv_world_ros.core.errors import ConfigError, EpisodeError, PolicyError
from mtv_world_ros.data import splits
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.splits import of_physics, recorded_kinds, refuse_test_kinds, select
from mtv_world_ros.evaluation.evaluate_episodes import make_jobs


def write_episode(folder, *, seed=0, **metadata):
    """Without frames."""
    with EpisodeWriter(
        folder, task='stack', instruction='stack', robot='yam_bimanual', seed=seed,
        metadata=metadata,
    ) as writer:  # fmt: skip
        writer.outcome = 'failure'
        writer.write_instruction(1_700_000_000_000_000_000)


@pytest.fixture
def dataset(tmp_path):
    """Three episodes, two of them for testing, one with an unseen object."""
    marks = {'episode_0': None, 'episode_1': '', 'episode_2': 'object'}
    names = list(marks)
    for name in names:
        write_episode(tmp_path / name)
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
    empty = tmp_path_factory.mktemp('empty')
    with pytest.raises(EpisodeError, match='holds no episodes.*; record some .*mtv-world collect'):
        select(empty)
    (empty / 'meta').mkdir()
    (empty / 'meta' / 'info.json').write_text('{}')
    hint = re.escape(f'import lerobot {empty} --robot ROBOT --out DIR makes episodes of')
    for read in (select, BagReader):
        with pytest.raises(EpisodeError, match=f'it is a LeRobot data set, which .*{hint}'):
            read(empty)
    card = json.loads((dataset / 'dataset.json').read_text())
    card['splits']['test'] = ['gone']
    (dataset / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(EpisodeError, match="split 'test' .* has no episodes"):
        select(dataset)
    (dataset / 'dataset.json').write_text('{"splits": 3')
    with pytest.raises(ConfigError, match='not a data set card'):
        select(dataset)


def test_episodes_of_one_physics_are_chosen_and_all_are_counted(tmp_path):
    write_episode(tmp_path / 'usual')
    write_episode(tmp_path / 'late', physics='delay_100ms')
    write_episode(tmp_path / 'real', seed=None)
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


@pytest.fixture
def policy_dataset(tmp_path):
    """Episodes without frames, one a policy; the last two are not scripted."""
    policies = ('expert', 'expert-late-0.6', 'expert-high-0.02-shed-0.03', 'pi0', '')
    for number, policy in enumerate(policies):
        metadata = {'policy': policy} if policy else {}
        write_episode(tmp_path / 'set' / f'stack_{number:05d}', **metadata)
    return tmp_path / 'set'


def test_kinds_are_those_of_the_recorded_policy(policy_dataset):
    assert recorded_kinds(sorted(policy_dataset.iterdir())) == {
        policy_dataset / 'stack_00000': (),
        policy_dataset / 'stack_00001': ('gripper_delay',),
        policy_dataset / 'stack_00002': ('grasp_height', 'shaken_off_over_goal'),
    }


def test_episodes_that_are_called_alike_have_kinds_of_their_own(policy_dataset):
    shutil.copytree(policy_dataset / 'stack_00001', policy_dataset / 'more' / 'stack_00002')
    paths = list_episodes(policy_dataset)
    kinds = result_kinds(paths)
    for job in make_jobs(paths, {}, seed=0):
        wanted = recorded_kinds([job.path]).get(job.path)
        assert kinds.get(job.name) == wanted
    late = ('gripper_delay',)
    both = ('grasp_height', 'shaken_off_over_goal')
    assert sorted(kinds.values()) == [(), both, late, late]


@pytest.mark.parametrize(
    ('command', 'what'),
    [
        (['train', '{set}', '--out', '{out}'], 'training'),
        (['fit', 'success', 'bundled', '{set}', '--no-store', '--out', '{out}'], 'calibration'),
    ],
)
def test_a_test_kind_in_a_training_or_calibration_set_is_refused(
    command, what, policy_dataset, tmp_path, capsys
):
    out = tmp_path / 'out'
    for metadata in policy_dataset.glob('*/metadata.yaml'):  # else it is refused for its views
        metadata.write_text(metadata.read_text().replace('topics_with_', 'no_topics_with_'))
    assert main([word.format(set=policy_dataset, out=out) for word in command]) == 1
    said = capsys.readouterr().err
    assert f'fault kinds of the split test are not for {what}' in said
    assert "'expert-high-0.02-shed-0.03' has shaken_off_over_goal; choose kinds of" in said
    assert not out.exists()


def test_an_episode_says_its_split_itself_and_no_simulator_is_asked(tmp_path, monkeypatch):
    for number, split in enumerate(('', 'calibrate,train', 'test,train')):
        policy = f'expert-unheard_of-{number}'
        write_episode(tmp_path / f'{number}', policy=policy, fault_split=split)
    monkeypatch.setattr(splits, 'policy_kind', None)
    refuse_test_kinds([tmp_path / '0', tmp_path / '1'], 'training')
    with pytest.raises(PolicyError, match='split test are not for training: .*unheard_of-2'):
        refuse_test_kinds([tmp_path / name for name in '012'], 'training')
