"""`mtv-world import videos`: frames, joints, poses and what is wrong, against what was written."""

import csv
import json

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.viewing.video import encode_video

FPS, ROWS = 5, 12


@pytest.fixture(scope='module')
def franka():
    return load_robot(robot_path('franka'))


@pytest.fixture(scope='module')
def positions(franka):
    """(ROWS, 8) joints that move, the gripper closing."""
    rest = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])
    way = np.linspace(0, 1, ROWS)[:, None] * np.array([0.3, 0.2, -0.1, 0.2, 0.1, -0.2, 0.3])
    return np.concatenate([rest + way, np.linspace(0.04, 0.0, ROWS)[:, None]], axis=1)


def grey(number):
    """Frames whose grey level says which one it is."""
    return np.stack([np.full((48, 64, 3), 15 * k + 20, np.uint8) for k in range(number)])


def write_raw(folder, name, positions, frames=ROWS, as_csv=False, **more):
    """A recording: one video, and a table of its rows."""
    (folder / 'videos' / name).mkdir(parents=True)
    (folder / 'videos' / name / 'front.mp4').write_bytes(encode_video(grey(frames), FPS))
    (folder / 'rows').mkdir(exist_ok=True)
    shown = positions.copy()
    shown[:, 7] = 1 - positions[:, 7] / 0.04  # 0 open, 1 closed
    if as_csv:
        with (folder / 'rows' / f'{name}.csv').open('w', newline='') as file:
            table = csv.writer(file)
            table.writerow(['t', *(f'q{k}' for k in range(7)), 'grip'])
            table.writerows([[3 + k / FPS, *row] for k, row in enumerate(shown.tolist())])
    else:
        rows = {'joints': shown.tolist(), 'texts': ['lift it'], **more}
        (folder / 'rows' / f'{name}.json').write_text(json.dumps(rows))


def mapping(file, robot, columns, gripper, **more):
    joints = dict(zip(robot.joint_names[:7], columns, strict=True))
    joints[robot.joint_names[7]] = {'column': gripper, 'open': 0.0, 'closed': 1.0}
    values = {
        'robot': 'franka',
        'rows': 'rows/{name}.json',
        'views': {'front': 'videos/{name}/front.mp4'},
        'fps': FPS,
        'instruction': 'key: texts',
        'state': {'feature': 'joints', 'joints': joints},
    } | more
    file.write_text(yaml.safe_dump({k: v for k, v in values.items() if v is not None}))
    return file


def test_frame_k_belongs_to_row_k_and_the_camera_is_marked(tmp_path, franka, positions, capsys):
    write_raw(tmp_path / 'raw', 'a', positions)
    write_raw(tmp_path / 'raw', 'b', positions)
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7)
    out = tmp_path / 'data'
    assert main(['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file),
                 '--out', str(out)]) == 0  # fmt: skip
    said = capsys.readouterr()
    assert 'a: 2.2 s; frames: front 12' in said.out and '2 made' in said.out
    unknown = "a, b: view 'front': pose and intrinsics not known: mtv-world fit camera "
    assert f'{unknown}{out} --view front --click points.html' in said.err  # once for both
    episode = read_episode(out / 'b', robot=franka, unknown_mount=franka.base_link)
    assert episode.unknown == {'front': 'pose and intrinsics'}
    assert episode.info.instruction == 'lift it'
    states, track = episode.joint_states, episode.images['front']
    np.testing.assert_allclose(states.positions, positions, atol=1e-9)
    np.testing.assert_array_equal(states.stamps_ns, track.stamps_ns)
    levels = np.array([np.asarray(track.frames[k]).mean() for k in range(ROWS)])
    np.testing.assert_allclose(levels, 15 * np.arange(ROWS) + 20, atol=6)
    start, first = episode.trajectories[0]
    assert start == states.stamps_ns[0]
    np.testing.assert_allclose(first.positions[0], positions[1], atol=1e-9)
    assert main(['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file),
                 '--out', str(out)]) == 0  # fmt: skip
    assert '0 made, 2 kept' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('values', 'outcomes'),
    [
        ((1, 0), ('success', 'failure')),
        ((True, None), ('success', 'unknown')),
        (('Success', 'failed'), ('success', 'failure')),
        (([0.0] * (ROWS - 1) + [1.0], [0.0] * ROWS), ('success', 'failure')),
    ],
)
@pytest.mark.parametrize('written', ['key: success', {'key': 'success'}])
def test_each_recording_has_its_own_outcome(
    tmp_path, franka, positions, capsys, values, outcomes, written
):
    for name, value in zip('ab', values, strict=True):
        write_raw(tmp_path / 'raw', name, positions, success=value)
    more = {'outcome': written, 'instruction': {'key': 'texts'}}
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, **more)
    out = tmp_path / 'data'
    command = ['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file)]
    assert main([*command, '--out', str(out)]) == 0
    found = [read_info(out / name) for name in 'ab']
    assert tuple(info.outcome for info in found) == outcomes
    assert {info.instruction for info in found} == {'lift it'}


def test_an_outcome_that_is_none_and_one_that_is_not_there_are_named(
    tmp_path, franka, positions, capsys
):
    write_raw(tmp_path / 'raw', 'a', positions, success='perhaps')
    write_raw(tmp_path / 'raw', 'b', positions, sucess=1)
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, outcome='key: success')
    out = tmp_path / 'data'
    command = ['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file)]
    assert main([*command, '--out', str(out)]) == 1
    said = capsys.readouterr().err
    assert "a.json': outcome 'success' is 'perhaps', which is no outcome" in said
    assert "b.json' has no outcome 'success' (did you mean 'sucess'?)" in said
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, outcome='perhaps')
    assert main([*command, '--out', str(out)]) == 1
    assert "outcome 'perhaps' is not one of success" in capsys.readouterr().err


def test_a_csv_file_has_times_and_names(tmp_path, franka, positions):
    write_raw(tmp_path / 'raw', 'a', positions, as_csv=True)
    file = mapping(tmp_path / 'm.yaml', franka, [f'q{k}' for k in range(7)], 'grip', fps=None,
                   time='t', rows='rows/{name}.csv', instruction='wave')  # fmt: skip
    assert main(['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file),
                 '--out', str(tmp_path / 'data')]) == 0  # fmt: skip
    episode = read_episode(tmp_path / 'data' / 'a', with_cameras=False)
    np.testing.assert_allclose(episode.joint_states.positions, positions, atol=1e-9)
    assert np.diff(episode.joint_states.stamps_ns).tolist() == [200_000_000] * (ROWS - 1)
    assert episode.info.instruction == 'wave'


def test_tool_poses_become_joints_and_what_is_left_is_told(tmp_path, franka, positions, capsys):
    hand = franka.link_poses('panda_hand', positions)
    euler = np.array([yaw_pitch_roll(T[:3, :3]) for T in hand])
    states = np.concatenate([hand[:, :3, 3], euler, positions[:, 7:]], axis=1)
    write_raw(tmp_path / 'raw', 'a', positions, states=states.tolist())
    state = {
        'feature': 'states',
        'joints': {'panda_finger_joint1': 6},
        'tools': {'panda': {'position': [0, 1, 2], 'rotation': [3, 4, 5], 'rotation_is': 'rpy',
                            'link': 'panda_hand'}},
    }  # fmt: skip
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, state=state)
    command = ['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file)]
    assert main([*command, '--out', str(tmp_path / 'data')]) == 0
    assert '0 of 12 poses out of reach' in capsys.readouterr().err
    found = read_episode(tmp_path / 'data' / 'a', with_cameras=False).joint_states.positions
    reached = franka.link_poses('panda_hand', found)
    assert np.abs(reached[:, :3, 3] - hand[:, :3, 3]).max() < 5e-4
    assert np.abs(reached[:, :3, :3] - hand[:, :3, :3]).max() < 5e-3
    assert np.abs(np.diff(found, axis=0)).max() < 0.2  # no jump to another posture
    states[:, 0] += 2.0
    write_raw(tmp_path / 'off', 'a', positions, states=states.tolist())
    command[2] = str(tmp_path / 'off')
    assert main([*command, '--out', str(tmp_path / 'far')]) == 1
    assert 'out of reach' in capsys.readouterr().err


def yaw_pitch_roll(R):
    """Roll, pitch, yaw of Rz(yaw) Ry(pitch) Rx(roll)."""
    return (np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0]))


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'state': {'feature': 'joint', 'joints': {}}}, 'are missing'),
        ({'rows': 'rows/a.json'}, 'must have {name}'),
        ({'views': {'front': 'videos/{name}/back.mp4'}}, 'is not there'),
        ({'fps': None}, "either 'fps' or 'time'"),
        ({'rows': 'joints/{name}.json'}, "has no 'joints/{name}.json'"),
        ({'viewz': {}}, "unknown key 'viewz'"),
        ({'rows': '/rows/{name}.json'}, 'must be a path inside of the folder'),
        ({'rows': '../{name}.json'}, 'must be a path inside of the folder'),
        ({'rows': '**x/{name}.json'}, "has no '**x/{name}.json'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, franka, positions, capsys, change, said):
    write_raw(tmp_path / 'raw', 'a', positions)
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, **change)
    assert main(['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file),
                 '--out', str(tmp_path / 'data')]) == 1  # fmt: skip
    assert said in capsys.readouterr().err


def test_a_video_that_is_shorter_is_told(tmp_path, franka, positions, capsys):
    write_raw(tmp_path / 'raw', 'a', positions, frames=ROWS - 3)
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7)
    assert main(['import', 'videos', str(tmp_path / 'raw'), '--mapping', str(file),
                 '--out', str(tmp_path / 'data')]) == 0  # fmt: skip
    assert '9 frames and 12 rows' in capsys.readouterr().err
    episode = read_episode(tmp_path / 'data' / 'a', with_cameras=False)
    assert len(episode.images['front'].stamps_ns) == 9


def test_frames_that_belong_to_no_rows_name_their_recording(tmp_path, franka, positions, capsys):
    write_raw(tmp_path / 'raw', 'a', positions, frames=ROWS - 3)
    words = ['import', 'videos', str(tmp_path / 'raw'), '--out', str(tmp_path / 'data')]
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, fps=2.3 * FPS)
    assert main([*words, '--mapping', str(file)]) != 0
    error = capsys.readouterr().err
    assert "recording 'a', view 'front': 9 frames" in error and "'rows' = frame k" in error
    file = mapping(tmp_path / 'm.yaml', franka, range(7), 7, fps=2.3 * FPS, frame_times='rows')
    assert main([*words, '--mapping', str(file)]) == 0


def test_the_described_mapping_is_valid(tmp_path):
    from mtv_world_ros.core.files import share_path
    from mtv_world_ros.importing.videos import load_video_mapping

    loaded = load_video_mapping(share_path('config', 'datasets', 'videos.yaml'))
    assert set(loaded.views) == {'front', 'wrist'}
