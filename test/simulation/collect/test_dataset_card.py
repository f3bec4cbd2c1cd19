from dataclasses import replace

import cv2
import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel, JointTrajectory
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.images import write_png
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.simulation.collect.contact_sheet import contact_sheet, film_strip
from mtv_world_ros.simulation.collect.dataset_card import (
    card_of,
    read_entry,
    TASKS_SET,
    write_file,
    ZERO_SHOT_SET,
)
from mtv_world_ros.simulation.collect.dataset_readme import commands, readme
from mtv_world_ros.simulation.collect.episode_maker import CollectConfig, plain_config
from mtv_world_ros.simulation.collect.record import RecordConfig
from mtv_world_ros.simulation.scenes.tasks import tasks_named

START_NS, HEIGHT, WIDTH = 1_700_000_000_000_000_000, 24, 32


def _camera(view):
    focal = np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0.1, 0.2, 0.9)
    return CameraModel(
        view=view, width=WIDTH, height=HEIGHT, K=focal, mount_link='base', T_mount_camera=pose
    )


@pytest.fixture
def make(tmp_path):
    """Write an episode whose k-th frame is of grey level 20 k (low) and 255 - 20 k (high)."""

    def write(task, index, outcome='success', frames=11, attempt=0, **more):
        name = '_'.join(filter(None, (more.get('zero_shot'), task, f'{index:05d}')))
        with EpisodeWriter(
            tmp_path / name,
            task=task,
            instruction='stack the red block on the blue block',
            robot='yam_bimanual',
            cameras=[_camera('low'), _camera('high')],
            seed=7,
            objects=('red block', 'blue block'),
            metadata={'attempt': str(attempt), 'index': str(index), **more},
        ) as writer:
            writer.outcome = outcome
            writer.write_instruction(START_NS)
            for k in range(frames):
                stamp = START_NS + 100_000_000 * k
                for view, level in (('low', 20 * k), ('high', 255 - 20 * k)):
                    writer.write_image(view, stamp, np.full((HEIGHT, WIDTH, 3), level, np.uint8))
                writer.write_joint_states(stamp, ('joint',), [0.1 * k])
            points = JointTrajectory(
                joint_names=('joint',), times=np.array([0.1]), positions=np.zeros((1, 1))
            )
            writer.write_trajectory(START_NS, points)
        return read_entry(tmp_path / name)

    return write


def _card(entries, kind=TASKS_SET, seed=3):
    import dataclasses
    import json

    config = json.loads(json.dumps(dataclasses.asdict(CollectConfig())))
    return card_of(kind, seed, config, entries)


def test_an_entry_knows_length_split_and_outcome(make):
    entry = make('stack_blocks_two', 1, outcome='failure', frames=8, attempt=2)
    assert (entry.num_frames, entry.duration_s, entry.split) == (8, 0.7, 'test')
    assert (entry.outcome, entry.attempt, entry.zero_shot) == ('failure', 2, None)
    assert make('shake_bottle', 0, zero_shot='view').split == 'test'


def test_expert_success_counts_the_attempts_of_successes_alone(make):
    entries = [
        make('shake_bottle', 0),
        make('shake_bottle', 1, attempt=2, frames=9),
        make('shake_bottle', 2, outcome='failure', attempt=5, frames=4),
    ]
    counts = _card(entries)['tasks']['shake_bottle']
    assert counts['expert_success_rate'] == 0.5  # 2 of 1 + 3 attempts
    assert (counts['episodes'], counts['success'], counts['failure']) == (3, 2, 1)
    assert (counts['mean_frames'], counts['mean_duration_s']) == (8.0, 0.7)


def test_a_film_strip_shows_first_to_last_frame_and_every_view(make, tmp_path):
    strip = film_strip(tmp_path / make('shake_bottle', 0).name, 3, 16)
    assert strip.shape == (2 * 14, 3 * 18, 3)
    for row, levels in ((6, (0, 100, 200)), (20, (255, 155, 55))):
        assert [int(strip[row, column, 0]) for column in (8, 26, 44)] == pytest.approx(
            levels, abs=2
        )


def test_the_contact_sheet_has_a_row_per_task_and_a_blank_for_what_is_missing(make, tmp_path):
    entries = [
        make('shake_bottle', 0),
        make('shake_bottle', 1, outcome='failure'),
        make('stack_blocks_two', 0),
        make('stack_blocks_two', 1),
    ]
    sheet = contact_sheet(tmp_path, entries, num_frames=3, width=16)
    row = 18 + 2 * 14 + 6
    assert sheet.shape == (2 * row, 2 * 3 * 18 + 6, 3)
    right = 3 * 18 + 6
    assert (sheet[18:46, right:].reshape(-1, 3) == sheet[18:46, : right - 6].reshape(-1, 3)).all()
    assert (sheet[row + 18 : row + 46, right:] == 235).all()
    larger = contact_sheet(tmp_path, entries, pairs=2, num_frames=3, width=16)
    assert larger.shape[0] == 3 * row
    write_png(tmp_path / 'sheet.png', sheet)
    assert (cv2.imread(str(tmp_path / 'sheet.png'))[..., ::-1] == sheet).all()


def test_the_command_on_the_card_makes_the_same_set(make):
    tasks = [task.name for task in tasks_named('all')]
    entries = [make(task, index) for task in tasks for index in range(2)]
    assert commands(_card(entries), entries) == [
        'mtv-world collect --task all --episodes 2 --seed 3 --out DIR'
    ]
    entries.append(make('shake_bottle', 2))
    rest = ','.join(sorted(set(tasks) - {'shake_bottle'}))
    assert set(commands(_card(entries), entries)) == {
        'mtv-world collect --task shake_bottle --episodes 3 --seed 3 --out DIR',
        f'mtv-world collect --task {rest} --episodes 2 --seed 3 --out DIR',
    }


@pytest.mark.parametrize(
    ('config', 'options'),
    [
        ({}, ''),
        ({'kinds': ('high', 'miss')}, ' --faults high,miss'),
        (
            {'record': RecordConfig(pictures='first', frame_period_s=0.2)},
            ' --fps 5 --pictures first',
        ),
        ({'moved_share': 0.5, 'policies': ('expert',)}, ' --moved-cameras 0.5 --policies expert'),
    ],
)
def test_every_option_is_in_the_command_and_then_python_is_not_named(
    make, tmp_path, config, options
):
    entries = [make('shake_bottle', 0)]
    card = card_of(TASKS_SET, 3, plain_config(CollectConfig(**config)), entries)
    assert commands(card, entries) == [
        f'mtv-world collect --task shake_bottle --episodes 1 --seed 3{options} --out DIR'
    ]
    assert 'made from Python' not in readme(tmp_path, card, entries)


def test_the_card_of_a_zero_shot_set_gives_one_command_where_kinds_took_turns(make):
    entries = [make('shake_bottle', k, zero_shot=kind) for kind, k in
               (('view', 0), ('object', 0), ('view', 1))]  # fmt: skip
    assert commands(_card(entries, ZERO_SHOT_SET), entries) == [
        'mtv-world collect --zero-shot view,object --episodes 3 --seed 3 --out DIR'
    ]


def test_the_text_says_what_is_in_the_written_episodes(make, tmp_path):
    entries = [make('stack_blocks_two', 0, frames=8), make('stack_blocks_two', 1, 'failure', 8)]
    text = readme(tmp_path, _card(entries), entries)
    assert '# Simulated benchmark: 2 episodes of 1 task\n' in text
    assert '| stack_blocks_two | 2 | 1 | 1 | 100 % of 1 | 0.7 s, 8 frames |' in text
    assert '1 train, 1 test' in text
    # focal length, position and angle of the camera as written above
    assert '| low | 32 x 24 px | 40 px | (0.10, 0.20, 0.90) m | 90 deg |' in text
    assert '| block | 4 | blue, red |' in text
    assert '| `/low/image_raw/compressed` | `sensor_msgs/msg/CompressedImage` | 8 |' in text
    assert '| `/instruction` | `std_msgs/msg/String` | 1 |' in text
    assert '| `attempt` | seeds dropped before this one | `0` |' in text


def test_the_text_is_the_same_in_whatever_order_the_episodes_were_finished(make, tmp_path):
    entries = [
        replace(make('stack_blocks_two', index), objects=(f'red {noun}', 'blue block'))
        for index, noun in enumerate(('cup', 'plate', 'bowl'))
    ]
    text = readme(tmp_path, _card(entries), entries)
    assert readme(tmp_path, _card(entries[::-1]), entries[::-1]) == text
    assert text.index('| bowl |') < text.index('| cup |') < text.index('| plate |')


def test_a_file_that_cannot_be_written_says_what_to_do(tmp_path):
    (tmp_path / 'card').mkdir()
    with pytest.raises(SimulatorError, match='run the same command again'):
        write_file(tmp_path / 'card', b'new')
