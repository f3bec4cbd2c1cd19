from dataclasses import replace
import json
import os
from pathlib import Path
import resource
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError, SimulatorError
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.simulation.collect.collect_dataset import collect, dataset_lock
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed, jobs_of, misses_grasp
from mtv_world_ros.simulation.collect.episode_maker import CollectConfig
from mtv_world_ros.simulation.collect.record import RecordConfig
from mtv_world_ros.simulation.recorded_scene import (
    recorded_task,
    SCENE,
    scene_of,
    TASK_DEFINITION,
)
from mtv_world_ros.simulation.scenes.randomize import RandomizationConfig
from mtv_world_ros.simulation.scenes.tasks import Task, task_named, tasks_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.simulator import situation_of
from mtv_world_ros.success.own_tasks import own_task
from mtv_world_ros.success.task import ever_and_final, load_task, stored_task
from test.support.own_task import write_shift_right

SMALL = CollectConfig(randomization=RandomizationConfig(width=96, height=72))
#: one of a single move and one of two, whose episodes are longer
TASKS = 'stack_blocks_two,collect_toy'
SEED = 4
COMMAND = (
    sys.executable, '-m', 'mtv_world_ros.cli', 'collect', '--task', TASKS, '--seed', str(SEED),
    '--width', '96', '--height', '72',
)  # fmt: skip


def _collect(out, tasks=TASKS, episodes=2, seed=SEED, **options):
    return collect(tasks, episodes, seed, out, config=SMALL, progress=False, **options)


@pytest.fixture(scope='module')
def data_set(tmp_path_factory):
    from mtv_world_ros.simulation.opengl import missing_opengl

    reason = missing_opengl()
    if reason:
        pytest.skip(reason)
    out = tmp_path_factory.mktemp('set')
    _collect(out)
    return out


def _names(out):
    return sorted(path.name for path in out.iterdir() if path.is_dir())


def _same(one: Path, other: Path):
    """Every message byte for byte with its stamp, the metadata, the calibration, the cards."""
    assert _names(one) == _names(other)
    for name in _names(one):
        assert list(BagReader(one / name).messages()) == list(
            BagReader(other / name).messages()
        ), name
        for file in ('metadata.yaml', 'calibration.yaml'):
            assert (one / name / file).read_bytes() == (other / name / file).read_bytes()
    for file in ('dataset.json', 'README.md', 'contact_sheet.png'):
        assert (one / file).read_bytes() == (other / file).read_bytes(), file


def _wait_for(condition, seconds=240.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_policies_take_turns_and_whatever_comes_of_it_is_kept(tmp_path):
    config = replace(SMALL, policies=('expert-stop-0', 'expert-late-0.2'))
    entries = collect(TASKS, 2, SEED, tmp_path, config=config, progress=False)
    said = {}
    for entry in entries:
        metadata = read_info(tmp_path / entry.name).metadata
        said[entry.name] = (metadata['policy'], entry.outcome)
        assert entry.attempt == 0 or entry.outcome == 'success'
    turns = ['expert-stop-0', 'expert-late-0.2', 'expert-late-0.2', 'expert-stop-0']
    assert [name for name, _ in said.values()] == turns
    stood = [outcome for name, outcome in said.values() if name == 'expert-stop-0']
    assert stood == ['failure'] * 2  # the arms never move
    still = read_episode(tmp_path / 'stack_blocks_two_00000').joint_states.positions
    assert np.ptp(still, axis=0).max() < 0.01
    text = (tmp_path / 'README.md').read_text()
    assert '--policies expert-stop-0,expert-late-0.2 --out DIR' in text
    assert 'a grasp misses' not in text
    with pytest.raises(SimulatorError, match='another seed|configuration'):
        _collect(tmp_path)


def test_a_policy_that_no_scene_allows_is_named(tmp_path, opengl):
    # the height from which it would drop is out of reach there
    config = replace(
        SMALL, policies=('expert-drop_high-0.04',), record=RecordConfig(max_attempts=2)
    )
    match = r"'collect_toy'.*'expert-drop_high-0.04' cannot be carried out in any of 2 scenes"
    with pytest.raises(SimulatorError, match=match):
        collect('collect_toy', 1, SEED, tmp_path, config=config, progress=False)


def test_an_episode_that_no_scene_allows_does_not_stop_the_set(tmp_path, opengl):
    config = replace(
        SMALL, policies=('expert-drop_high-0.04', 'expert'), record=RecordConfig(max_attempts=2)
    )
    said = []
    made = collect(
        'collect_toy', 2, SEED, tmp_path, config=config, progress=False, on_missing=said.append
    )
    assert [entry.name for entry in made] == ['collect_toy_00001']
    (reason,) = said
    assert reason.startswith("episode 0 of task 'collect_toy'") and '--task' in reason
    card = json.loads((tmp_path / 'dataset.json').read_text())
    assert len(card['episodes']) == 1


def test_the_command_says_what_was_made_and_draws_no_bar_into_a_file(data_set, tmp_path, capsys):
    out = shutil.copytree(data_set, tmp_path / 'set')
    words = list(COMMAND[COMMAND.index('collect') :])
    assert main([*words, '--episodes', '2', '--out', str(out)]) == 0
    card = json.loads((out / 'dataset.json').read_text())
    good = sum(entry['outcome'] == 'success' for entry in card['episodes'])
    counted = ', '.join(f'{w} {n}' for w, n in (('failure', 4 - good), ('success', good)) if n)
    said = capsys.readouterr()
    assert said.out == f'4 episodes ({counted}): {out}\n' and '%|' not in said.err


def test_a_task_of_ones_own_is_collected_and_known_again_from_its_episodes(tmp_path, opengl):
    own = write_shift_right(tmp_path)
    out = tmp_path / 'set'
    (entry,) = collect(str(own), 1, SEED, out, config=SMALL, failures_of_ten=0, progress=False)
    assert (entry.task, entry.outcome) == ('shift_right', 'success')
    episode = read_episode(out / 'shift_right_00000')
    assert episode.info.instruction.startswith('shift the ')
    definition = load_task(own)
    own.unlink()  # the episode and the card have it
    assert recorded_task(episode) == Task.of(definition, 'own')
    assert own_task(episode.info) == definition
    card = json.loads((out / 'dataset.json').read_text())
    assert stored_task(card['task_definitions']['shift_right'], 'card') == definition
    assert 'task_definition' not in card['episodes'][0]
    text = (out / 'README.md').read_text()
    assert f'--task shift_right.yaml --episodes 1 --seed {SEED}' in text
    assert 'JSON of a task that is not among the bundled ones' in text
    moved = write_shift_right(tmp_path, distance_m=0.12)
    with pytest.raises(SimulatorError, match="00000' is of another definition of the task 'shift"):
        collect(str(moved), 2, SEED, out, config=SMALL, progress=False)
    assert [path.name for path in out.glob('shift_*')] == ['shift_right_00000']


def test_episodes_of_bundled_tasks_name_theirs_alone(data_set):
    episode = read_episode(data_set / _names(data_set)[0])
    assert TASK_DEFINITION not in episode.info.metadata and own_task(episode.info) is None
    assert 'task_definitions' not in json.loads((data_set / 'dataset.json').read_text())
    assert recorded_task(episode) is task_named(episode.info.task)


@pytest.mark.parametrize('stored', ['{"name": ', '{"name": "x"}', '[1]'])
def test_a_stored_task_that_cannot_be_used_is_named(stored, data_set):
    episode = read_episode(data_set / _names(data_set)[0])
    info = replace(episode.info, metadata={**episode.info.metadata, TASK_DEFINITION: stored})
    with pytest.raises(MtvWorldError, match="'task_definition' of '.*"):
        recorded_task(replace(episode, info=info))


def test_unknown_policy_is_refused_before_anything_is_made(tmp_path, capsys):
    command = ['collect', '--task', TASKS, '--episodes', '1', '--out', str(tmp_path / 'set')]
    assert main([*command, '--policies', 'expert,expert-lat-0.6']) == 1
    assert "unknown fault 'lat' (did you mean 'late'?)" in capsys.readouterr().err
    assert not (tmp_path / 'set').exists()


@pytest.mark.parametrize('options', [['--policies', 'expert'], ['--moved-cameras', '0.5']])
def test_zero_shot_sets_take_neither_policies_nor_moved_cameras(options, tmp_path, capsys):
    command = ['collect', '--zero-shot', 'view', '--episodes', '1', '--out', str(tmp_path / 'set')]
    assert main([*command, *options]) == 1
    assert 'leave --policies and --moved-cameras out' in capsys.readouterr().err
    assert not (tmp_path / 'set').exists()


@pytest.mark.slow
def test_a_set_that_was_killed_in_the_middle_is_completed_by_the_same_command(data_set, tmp_path):
    """Also: the same seed gives the same bytes in other processes."""
    out = tmp_path / 'set'
    command = [*COMMAND, '--episodes', '2', '--workers', '2', '--out', str(out)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        _wait_for(lambda: out.is_dir() and _names(out) and _finished(out))
        process.kill()  # SIGKILL: nothing can be tidied up, and the workers are orphans
        process.wait()
    group = process.pid
    _wait_for(lambda: not _alive(group))
    finished = {path.name: path.stat().st_mtime_ns for path in _finished(out)}
    assert 1 <= len(finished) < 4
    for name in finished:
        assert list(BagReader(out / name).messages()) == list(
            BagReader(data_set / name).messages()
        )
    _collect(out)
    _same(data_set, out)
    assert all((out / name).stat().st_mtime_ns == at for name, at in finished.items())
    assert not list(out.glob('.*.tmp'))


def _finished(out):
    return [path for path in out.iterdir() if path.is_dir() and not path.name.startswith('.')]


def _alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_episodes_that_fit_stay_when_the_disk_is_full_and_the_rest_follows(data_set, tmp_path):
    out = tmp_path / 'set'
    sizes = {
        name: (data_set / name / f'{name}_0.mcap').stat().st_size for name in _names(data_set)
    }
    # the limit on the size of a file stands for a full disk: the same error at the same calls
    limit = (sizes['stack_blocks_two_00000'] + sizes['collect_toy_00000']) // 2
    assert sizes['stack_blocks_two_00000'] < limit < sizes['collect_toy_00000']
    run = subprocess.run(
        [*COMMAND, '--episodes', '1', '--out', str(out)],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert run.returncode == 1
    last = run.stderr.splitlines()[-1]
    assert 'cannot write' in last and 'collect_toy_00000' in last
    assert 'finished episodes are kept, so run the same command again' in last
    assert [path.name for path in _finished(out)] == ['stack_blocks_two_00000']
    card = json.loads((out / 'dataset.json').read_text())
    assert [entry['name'] for entry in card['episodes']] == ['stack_blocks_two_00000']
    assert len(_collect(out, episodes=1)) == 2
    for name in _names(out):
        assert list(BagReader(out / name).messages()) == list(
            BagReader(data_set / name).messages()
        ), name


def test_asking_for_a_part_leaves_the_rest_in_the_card(data_set, tmp_path):
    out = tmp_path / 'set'
    shutil.copytree(data_set, out)
    entries = _collect(out, tasks='stack_blocks_two', episodes=1)
    assert [entry.name for entry in entries] == ['stack_blocks_two_00000']
    _same(data_set, out)


def test_two_commands_do_not_write_into_one_set(data_set, tmp_path):
    with (
        dataset_lock(tmp_path),
        pytest.raises(SimulatorError, match='another `collect` is writing'),
    ):
        _collect(tmp_path)
    assert not _names(tmp_path)


def test_another_seed_or_configuration_or_kind_does_not_mix_into_a_set(data_set):
    with pytest.raises(SimulatorError, match='holds a data set of seed 4, not 5'):
        _collect(data_set, seed=5)
    with pytest.raises(SimulatorError, match='another configuration'):
        collect(TASKS, 1, SEED, data_set, progress=False)
    with pytest.raises(SimulatorError, match="of the kind 'tasks', not 'zero_shot'"):
        _collect(data_set, zero_shot='view')


def test_foreign_folder_under_an_episode_name_is_refused_and_another_one_ignored(tmp_path, opengl):
    (tmp_path / 'notes').mkdir()
    (tmp_path / 'stack_blocks_two_00000').mkdir()
    with pytest.raises(EpisodeError, match='not an episode'):
        _collect(tmp_path, tasks='stack_blocks_two')


def test_episodes_read_back_with_masks_commands_and_metadata(data_set):
    name = next(n for n in _names(data_set) if read_info(data_set / n).outcome == 'success')
    episode = read_episode(data_set / name)
    info, index = episode.info, int(name[-5:])
    assert info.robot == 'yam_bimanual' and info.task == name[:-6]
    assert all(item in info.instruction for item in info.objects[:2])
    assert info.seed == episode_seed(SEED, info.task, index, int(info.metadata['attempt']))
    assert 'zero_shot' not in info.metadata
    assert episode.views == ('low', 'high') and not episode.warnings
    stamps = episode.images['low'].stamps_ns
    assert set(np.diff(stamps)) == {100_000_000}
    # a joint sample at every frame's stamp
    assert set(stamps) <= set(episode.joint_states.stamps_ns)
    starts = np.array([start - stamps[0] for start, _ in episode.trajectories]) / 1e9
    assert starts == pytest.approx(np.arange(len(starts)) * 3.2)
    assert all(trajectory.velocities is not None for _, trajectory in episode.trajectories)
    ids = np.asarray(episode.masks['high'].frames[0])
    assert set(np.unique(ids)) == set(range(len(info.objects) + 1))


def test_rosbags_reads_every_message_of_an_episode(data_set):
    store, name = get_typestore(Stores.ROS2_JAZZY), 'collect_toy_00000'
    own = read_episode(data_set / name)
    found: dict[str, list] = {}
    with Reader(data_set / name) as reader:
        for connection, stamp, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
        assert reader.message_count == sum(map(len, found.values()))
    assert own.joint_states is not None
    assert [stamp for stamp, _ in found['/joint_states']] == own.joint_states.stamps_ns.tolist()
    positions = np.array([message.position for _, message in found['/joint_states']])
    assert (positions == own.joint_states.positions).all()
    for view in ('low', 'high'):
        frames = [stamp for stamp, _ in found[f'/{view}/image_raw/compressed']]
        assert frames == own.images[view].stamps_ns.tolist()
        assert frames == [stamp for stamp, _ in found[f'/{view}/mask/compressed']]


def test_card_counts_and_splits_the_episodes(data_set):
    card = json.loads((data_set / 'dataset.json').read_text())
    outcomes = {name: read_info(data_set / name).outcome for name in _names(data_set)}
    assert card['num_episodes'] == 4
    assert {entry['name']: entry['outcome'] for entry in card['episodes']} == outcomes
    assert card['splits'] == {
        split: [f'{task}_0000{index}' for task in ('collect_toy', 'stack_blocks_two')]
        for index, split in enumerate(('train', 'test'))
    }
    counts = card['tasks']['stack_blocks_two']
    stacks = [outcomes[f'stack_blocks_two_0000{index}'] for index in range(2)]
    assert (counts['episodes'], counts['success']) == (2, stacks.count('success'))
    lengths = [
        len(read_episode(data_set / f'stack_blocks_two_0000{index}').images['low'].stamps_ns)
        for index in range(2)
    ]
    assert counts['mean_frames'] == np.mean(lengths)
    assert counts['mean_duration_s'] == pytest.approx(np.mean(lengths) / 10 - 0.1)


def test_two_of_ten_episodes_miss_one_in_each_split():
    for seed in range(20):
        chosen = [index for index in range(30) if misses_grasp(seed, 'stack_blocks_two', index)]
        assert len(chosen) == 6
        assert sorted((index // 10, index % 2) for index in chosen) == [
            (block, split) for block in range(3) for split in range(2)
        ]


def test_counts_below_one_are_refused(tmp_path):
    with pytest.raises(SimulatorError, match='at least 1'):
        collect('all', 0, 0, tmp_path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path, opengl):
    (tmp_path / 'file').write_text('')
    with pytest.raises(SimulatorError, match='cannot write into .*file'):
        _collect(tmp_path / 'file' / 'set')


@pytest.mark.parametrize('num', [0, 2, 5, 10])
def test_so_many_of_ten_episodes_of_a_task_are_to_miss(tmp_path, num):
    tasks = tasks_named('stack_blocks_two,shake_bottle')
    jobs = jobs_of(tasks, 20, 3, tmp_path, num)
    for task in tasks:
        missed = [job.miss for job in jobs if job.task is task]
        assert sum(missed[:10]) == sum(missed[10:]) == num


def test_many_policies_come_up_in_few_episodes_as_each_task_begins_elsewhere(tmp_path):
    names = [f'expert-late-{number}' for number in range(12)]
    tasks = tasks_named('stack_blocks_two,shake_bottle,place_cup_plate')
    few, more = (jobs_of(tasks, count, 3, tmp_path, policies=names) for count in (4, 24))
    assert {job.policy for job in few} == set(names)
    turns = {(job.task.name, job.index): job.policy for job in more}
    assert all(turns[job.task.name, job.index] == job.policy for job in few)  # a set may grow
    for task in tasks:
        own = [job.policy for job in more if job.task is task]
        assert all(own.count(name) == 2 for name in names)


def test_more_than_ten_of_ten_cannot_miss(tmp_path):
    with pytest.raises(SimulatorError, match='--failures-of-ten'):
        jobs_of(tasks_named('shake_bottle'), 1, 0, tmp_path, 11)


def test_relations_on_recorded_poses_say_what_was_recorded(data_set, robot):
    outcomes = set()
    for name in _names(data_set):
        episode = read_episode(data_set / name)
        task, scene = task_named(episode.info.task), scene_of(episode, workcell_of(robot))
        assert episode.object_poses is not None
        stamps, poses = episode.object_poses
        rows = np.searchsorted(episode.joint_states.stamps_ns, stamps)
        openings = robot.gripper_openings(episode.joint_states.positions[rows])
        ever, final = ever_and_final(task.succeeds(situation_of(scene, task, poses, openings)))
        assert episode.info.metadata['ever'] == str(ever).lower()
        assert episode.info.metadata['final'] == str(final).lower()
        outcomes.add(episode.info.outcome == 'success')
        assert (ever and final) == (episode.info.outcome == 'success')
    assert True in outcomes


def test_an_episode_whose_scene_is_not_known_is_refused(data_set, robot):
    episode = read_episode(data_set / _names(data_set)[0])
    rest = {key: text for key, text in episode.info.metadata.items() if key != SCENE}
    seed = episode.info.seed
    assert seed is not None
    other = replace(episode, info=replace(episode.info, seed=seed + 1, metadata=rest))
    with pytest.raises(EpisodeError, match='record it again with mtv-world collect'):
        scene_of(other, workcell_of(robot))


def test_81_frames_at_16_fps_and_288x384_can_be_cut(tmp_path, data_set):
    """Clips of the paper's model; stamps are those of the control periods, at most 10 ms off."""
    from mtv_world_ros.core.files import share_path
    from mtv_world_ros.data.recording import load_recording
    from mtv_world_ros.data.recordings import clip_starts
    from mtv_world_ros.robot.file import load_robot
    from mtv_world_ros.training.training_config import load_training_config

    del data_set  # skips without OpenGL
    words = ['collect', '--task', 'stack_blocks_two', '--episodes', '1', '--fps', '16']
    assert main([*words, '--seed', '3', '--out', str(tmp_path)]) == 0
    (path,) = (folder for folder in tmp_path.iterdir() if (folder / 'metadata.yaml').is_file())
    spec = load_training_config('wan-1.3b').spec
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    recording = load_recording(path, spec, robot)
    assert recording.frames.shape[2:] == (288, 384, 3)
    ideal = np.arange(len(recording.times)) / 16
    assert np.abs(recording.times - ideal).max() <= 0.01 + 1e-6
    assert len(clip_starts(recording, spec)) > 0
    assert '--fps 16' in (tmp_path / 'README.md').read_text()
    assert main([*words[:-1], '60', '--out', str(tmp_path / 'x')]) == 1
