import shutil

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.data import splits
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.splits import recorded_kinds, refuse_test_kinds
from mtv_world_ros.errors import PolicyError
from mtv_world_ros.lab.cli.calibrate import result_kinds
from mtv_world_ros.lab.evaluation.evaluate_episodes import make_jobs


@pytest.fixture
def dataset(tmp_path):
    """Episodes without frames, one a policy; the last two are not scripted."""
    policies = ('expert', 'expert-late-0.6', 'expert-high-0.02-shed-0.03', 'pi0', '')
    for number, policy in enumerate(policies):
        metadata = {'policy': policy} if policy else {}
        with EpisodeWriter(
            tmp_path / 'set' / f'stack_{number:05d}', task='stack', instruction='stack',
            robot='yam_bimanual', cameras=[], seed=0, objects=(), metadata=metadata,
        ) as writer:  # fmt: skip
            writer.outcome = 'failure'
            writer.write_instruction(1_700_000_000_000_000_000)
    return tmp_path / 'set'


def test_kinds_are_those_of_the_recorded_policy(dataset):
    assert recorded_kinds(sorted(dataset.iterdir())) == {
        dataset / 'stack_00000': (),
        dataset / 'stack_00001': ('gripper_delay',),
        dataset / 'stack_00002': ('grasp_height', 'shaken_off_over_goal'),
    }


def test_episodes_that_are_called_alike_have_kinds_of_their_own(dataset):
    shutil.copytree(dataset / 'stack_00001', dataset / 'more' / 'stack_00002')
    paths = list_episodes(dataset)
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
        (['calibrate', 'bundled', '{set}', '--no-store', '--out', '{out}'], 'calibration'),
    ],
)
def test_a_test_kind_in_a_training_or_calibration_set_is_refused(
    command, what, dataset, tmp_path, capsys
):
    out = tmp_path / 'out'
    assert main([word.format(set=dataset, out=out) for word in command]) == 1
    said = capsys.readouterr().err
    assert f'fault kinds of the split test are not for {what}' in said
    assert "'expert-high-0.02-shed-0.03' has shaken_off_over_goal; choose kinds of" in said
    assert not out.exists()


def test_an_episode_says_its_split_itself_and_no_simulator_is_asked(tmp_path, monkeypatch):
    for number, split in enumerate(('', 'calibrate,train', 'test,train')):
        with EpisodeWriter(
            tmp_path / f'{number}', task='stack', instruction='stack', robot='yam_bimanual',
            cameras=[], seed=0, objects=(),
            metadata={'policy': f'expert-unheard_of-{number}', 'fault_split': split},
        ) as writer:  # fmt: skip
            writer.outcome = 'failure'
            writer.write_instruction(1_700_000_000_000_000_000)
    monkeypatch.setattr(splits, 'policy_kind', None)
    refuse_test_kinds([tmp_path / '0', tmp_path / '1'], 'training')
    with pytest.raises(PolicyError, match='split test are not for training: .*unheard_of-2'):
        refuse_test_kinds([tmp_path / name for name in '012'], 'training')
