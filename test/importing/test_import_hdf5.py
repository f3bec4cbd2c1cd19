"""`mtv-world import videos` of HDF5 files: layouts of ALOHA, DROID and robomimic, bad files."""

from __future__ import annotations

from pathlib import Path
import shutil
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.importing.hdf5_files import Hdf5Frames
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.viewing.video import encode_video

h5py = pytest.importorskip('h5py', reason='h5py is not installed (pip install .[import])')

FPS, ROWS, WIDTH, HEIGHT = 10, 20, 64, 48
#: a reddish picture: red, green, blue
RED = (200, 60, 20)


def measured() -> np.ndarray:
    """(ROWS, 8) joints of franka; the gripper as a share of open."""
    rest = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])
    way = np.linspace(0, 1, ROWS)[:, None] * np.array([0.3, 0.2, -0.1, 0.2, 0.1, -0.2, 0.3])
    return np.concatenate([rest + way, np.linspace(1.0, 0.2, ROWS)[:, None]], axis=1)


def leader() -> np.ndarray:
    return measured() + np.array([0.01] * 7 + [0.0])


def pictures() -> np.ndarray:
    """(ROWS, H, W, 3) RGB; the green level says which one it is."""
    frames = np.empty((ROWS, HEIGHT, WIDTH, 3), np.uint8)
    frames[:] = RED
    frames[..., 1] += np.arange(ROWS, dtype=np.uint8)[:, None, None] * 5
    return frames


def padded(frames: np.ndarray, *, swapped: bool) -> np.ndarray:
    """JPEG files padded to one length with zeros, as ALOHA stores them."""
    files = [
        cv2.imencode('.jpg', f if swapped else f[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
        for f in frames
    ]
    table = np.zeros((len(files), max(map(len, files)) + 7), np.uint8)
    for row, file in zip(table, files, strict=True):
        row[: len(file)] = file.ravel()
    return table


def write_aloha(file: Path, images: Any, **options: Any) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(file, 'w') as root:
        root.attrs['sim'] = False
        root.attrs['success'] = True
        root.attrs['text'] = 'lift the lid'
        root['observations/qpos'] = measured()
        root['observations/qvel'] = np.zeros((ROWS, 8))
        root.create_dataset('observations/images/top', data=images, **options)
        root['action'] = leader()
    return file


def write_mapping(file: Path, **more: Any) -> Path:
    robot = load_robot(robot_path('franka'))
    joints: dict[str, Any] = {name: k for k, name in enumerate(robot.joint_names[:7])}
    joints[robot.joint_names[7]] = {'column': 7, 'closed': 0, 'open': 1}
    values = {
        'robot': 'franka',
        'rows': '{name}.hdf5',
        'views': {'top': '{name}.hdf5:observations/images/top'},
        'fps': FPS,
        'state': {'feature': 'observations/qpos', 'joints': joints},
        'action': {'feature': 'action', 'joints': joints},
    } | more
    file.write_text(yaml.safe_dump({k: v for k, v in values.items() if v is not None}))
    return file


def bring_in(folder: Path, mapping: Path, out: Path) -> int:
    return main(['import', 'videos', str(folder), '--mapping', str(mapping), '--out', str(out)])


def check_episode(episode: Any) -> None:
    """Check positions, commands and pictures against what was written."""
    right = measured()
    right[:, 7] *= 0.04
    states = episode.joint_states
    np.testing.assert_allclose(states.positions, right, atol=1e-9)
    np.testing.assert_allclose(np.diff(states.stamps_ns), 1e9 / FPS)
    levels = np.array([np.asarray(frame).mean((0, 1)) for frame in episode.images['top'].frames])
    np.testing.assert_allclose(levels, pictures().mean((1, 2)), atol=4)


@pytest.mark.parametrize('kind', ['pixels', 'gzip', 'jpeg', 'jpeg as OpenCV', 'vlen'])
def test_alohas_layout_is_imported(tmp_path, kind, capsys):
    frames, more = pictures(), {}
    images: Any = frames
    options: dict[str, Any] = {}
    if kind == 'gzip':
        options = {'compression': 'gzip', 'chunks': (4, HEIGHT, WIDTH, 3)}
    if 'jpeg' in kind:
        images = padded(frames, swapped='OpenCV' in kind)
        more = {'channels': 'bgr'} if 'OpenCV' in kind else {}
    file = tmp_path / 'raw/episode_0.hdf5'
    if kind == 'vlen':
        write_aloha(file, frames)
        with h5py.File(file, 'a') as root:
            del root['observations/images/top']
            data = root.create_dataset(
                'observations/images/top', (ROWS,), dtype=h5py.vlen_dtype(np.uint8)
            )
            for k, row in enumerate(padded(frames, swapped=False)):
                data[k] = row
    else:
        write_aloha(file, images, **options)
    more |= {'outcome': 'key: success', 'instruction': 'key: text'}
    out = tmp_path / 'out'
    assert bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml', **more), out) == 0
    said = capsys.readouterr().err
    assert "view 'top': pose and intrinsics not known" in said
    assert 'not used: observations/qvel (data set of no stream)' in said
    episode = read_episode(out / 'episode_0', unknown_mount='panda_link0')
    check_episode(episode)
    info = read_info(out / 'episode_0')
    assert (info.outcome, info.instruction) == ('success', 'lift the lid')
    found = {}
    for start, plan in episode.trajectories:
        for seconds, row in zip(plan.times, plan.positions, strict=True):
            found[
                round((start - episode.joint_states.stamps_ns[0]) / 1e9 * FPS + seconds * FPS)
            ] = row
    right = leader()
    right[:, 7] *= 0.04
    assert len(found) == ROWS  # action k is reached one row later
    for k, row in found.items():
        np.testing.assert_allclose(row, right[k - 1], atol=1e-9)


def test_without_action_the_measured_positions_that_follow_are_taken(tmp_path):
    write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    out = tmp_path / 'out'
    assert bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml', action=None), out) == 0
    episode = read_episode(out / 'a', unknown_mount='panda_link0')
    _, first = episode.trajectories[0]
    np.testing.assert_allclose(first.positions[0][:7], measured()[1][:7], atol=1e-9)


def test_an_outcome_that_is_not_there_is_named_with_what_there_is(tmp_path, capsys):
    write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    mapping = write_mapping(tmp_path / 'm.yaml', outcome='key: sucess')
    assert bring_in(tmp_path / 'raw', mapping, tmp_path / 'out') == 1
    assert "has no outcome 'sucess' (did you mean 'success'?)" in capsys.readouterr().err


def test_droids_layout_has_rows_in_hdf5_and_frames_in_videos(tmp_path):
    folder = tmp_path / 'raw/2023-07-07_Fri'
    (folder / 'recordings/MP4').mkdir(parents=True)
    grey = np.stack([np.full((48, 64, 3), 20 + 10 * k, np.uint8) for k in range(ROWS)])
    (folder / 'recordings/MP4/23404442.mp4').write_bytes(encode_video(grey, FPS))
    with h5py.File(folder / 'trajectory.h5', 'w') as root:
        root['observation/robot_state/joint_positions'] = measured()[:, :7]
        root['observation/robot_state/gripper_position'] = 1 - measured()[:, 7]
        root['observation/timestamp/robot_state/read_start'] = (
            1_688_000_000_000 + np.arange(ROWS) * 1000 // FPS
        )
    robot = load_robot(robot_path('franka'))
    joints: dict[str, Any] = {name: k for k, name in enumerate(robot.joint_names[:7])}
    joints[robot.joint_names[7]] = {'column': 7, 'closed': 1, 'open': 0}
    place = 'observation/robot_state'
    mapping = write_mapping(
        tmp_path / 'm.yaml',
        rows='{name}/trajectory.h5',
        views={'ext1': '{name}/recordings/MP4/23404442.mp4'},
        fps=None, time='observation/timestamp/robot_state/read_start', time_unit='ms',
        state={'feature': [f'{place}/joint_positions', f'{place}/gripper_position'],
               'joints': joints},
        action=None,
    )  # fmt: skip
    out = tmp_path / 'out'
    assert bring_in(tmp_path / 'raw', mapping, out) == 0
    states = read_episode(out / '2023-07-07_Fri', unknown_mount='panda_link0').joint_states
    right = measured()
    right[:, 7] *= 0.04
    np.testing.assert_allclose(states.positions, right, atol=1e-9)
    np.testing.assert_allclose(np.diff(states.stamps_ns), 1e9 / FPS, rtol=1e-4)


def test_robomimics_layout_has_all_recordings_in_one_file(tmp_path, capsys):
    (tmp_path / 'raw').mkdir()
    with h5py.File(tmp_path / 'raw/demo.hdf5', 'w') as root:
        for k in (0, 1, 10):
            group = root.create_group(f'data/demo_{k}')
            group['obs/qpos'] = measured()
            group['obs/agentview_image'] = pictures()
            group['actions'] = leader()
    robot = load_robot(robot_path('franka'))
    joints: dict[str, Any] = {name: k for k, name in enumerate(robot.joint_names[:7])}
    joints[robot.joint_names[7]] = {'column': 7, 'closed': 0, 'open': 1}
    mapping = write_mapping(
        tmp_path / 'm.yaml',
        rows='demo.hdf5:data/{name}',
        views={'top': 'demo.hdf5:data/{name}/obs/agentview_image'},
        state={'feature': 'obs/qpos', 'joints': joints},
        action={'feature': 'actions'},
    )
    out = tmp_path / 'out'
    assert bring_in(tmp_path / 'raw', mapping, out) == 0
    assert '3 made' in capsys.readouterr().out
    for name in ('demo_0', 'demo_1', 'demo_10'):
        check_episode(read_episode(out / name, unknown_mount='panda_link0'))


@pytest.mark.parametrize('kind', ['link', 'soft link', 'external', 'virtual'])
def test_other_files_are_not_followed(tmp_path, capsys, kind):
    file = write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    secret = tmp_path / 'secret.h5'
    with h5py.File(secret, 'w') as root:
        root['top'] = pictures()
    with h5py.File(file, 'a') as root:
        del root['observations/images/top']
        images = root['observations/images']
        if kind == 'link':
            images['top'] = h5py.ExternalLink(str(secret), '/top')
        elif kind == 'soft link':
            root['out'] = h5py.ExternalLink(str(secret), '/')
            images['top'] = h5py.SoftLink('/out/top')
        elif kind == 'external':
            raw = tmp_path / 'secret.raw'
            raw.write_bytes(pictures().tobytes())
            shape = pictures().shape
            images.create_dataset(
                'top', shape, np.uint8, external=[(str(raw), 0, int(np.prod(shape)))]
            )
        else:
            layout = h5py.VirtualLayout(pictures().shape, np.uint8)
            layout[:] = h5py.VirtualSource(str(secret), 'top', shape=pictures().shape)
            images.create_virtual_dataset('top', layout)
    status = bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml'), tmp_path / 'out')
    said = capsys.readouterr().err
    assert status == 1
    assert 'other files' in said and 'not read' in said
    assert not (tmp_path / 'out/a').exists()


def test_soft_links_within_the_file_are_followed_but_not_for_ever(tmp_path, capsys):
    file = write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    with h5py.File(file, 'a') as root:
        root.move('observations/images/top', 'moved')
        root['observations/images/top'] = h5py.SoftLink('/moved')
    mapping = write_mapping(tmp_path / 'm.yaml')
    assert bring_in(tmp_path / 'raw', mapping, tmp_path / 'out') == 0
    shutil.rmtree(tmp_path / 'out')
    with h5py.File(file, 'a') as root:
        del root['moved']
        root['moved'] = h5py.SoftLink('/observations/images/top')
    assert bring_in(tmp_path / 'raw', mapping, tmp_path / 'out') == 1
    assert 'more than 16 links' in capsys.readouterr().err


def test_sizes_are_checked_before_anything_is_read(tmp_path, capsys, monkeypatch):
    with h5py.File(tmp_path / 'huge.hdf5', 'w') as root:
        root.create_dataset(
            'top', (10, 20_000, 20_000, 3), np.uint8, chunks=(1, 100, 100, 3), compression='gzip'
        )
        root.create_dataset('chunk', (10, 2000, 2000, 3), np.uint8, chunks=(10, 2000, 2000, 3),
                            compression='gzip')  # fmt: skip
    with pytest.raises(Exception, match='400000000 pixels; at most 50000000'):
        Hdf5Frames(tmp_path / 'huge.hdf5', 'top')
    monkeypatch.setenv('MTV_WORLD_MAX_CHUNK_BYTES', '1000000')
    with pytest.raises(Exception, match='120000000 bytes; at most 1000000'):
        Hdf5Frames(tmp_path / 'huge.hdf5', 'chunk')
    monkeypatch.delenv('MTV_WORLD_MAX_CHUNK_BYTES')
    monkeypatch.setenv('MTV_WORLD_MAX_ARRAY_BYTES', '100')
    write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    assert bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml'), tmp_path / 'o') == 1
    assert 'MTV_WORLD_MAX_ARRAY_BYTES' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'state': 'observations/qpoz'}, "has no 'qpoz' in '/observations' (did you mean 'qpos'"),
        ({'state': 'observations'}, 'is no data set'),
        ({'view': '{name}.hdf5:observations/qpos'}, 'must be (frames, height, width, 3) of uint8'),
        ({'view': '{name}.hdf5:observations/images/low'}, "has no 'low'"),
    ],
)
def test_what_is_not_there_is_named(tmp_path, capsys, change, said):
    write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    mapping = write_mapping(tmp_path / 'm.yaml')
    values = yaml.safe_load(mapping.read_text())
    if 'state' in change:
        values['state']['feature'] = change['state']
    if 'view' in change:
        values['views']['top'] = change['view']
    mapping.write_text(yaml.safe_dump(values))
    assert bring_in(tmp_path / 'raw', mapping, tmp_path / 'out') == 1
    assert said in capsys.readouterr().err


@pytest.mark.parametrize('content', [b'', b'no HDF5', b'\x89HDF\r\n\x1a\n' + bytes(200)])
def test_files_that_are_no_hdf5_are_named(tmp_path, capsys, content):
    (tmp_path / 'raw').mkdir()
    (tmp_path / 'raw/a.hdf5').write_bytes(content)
    assert bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml'), tmp_path / 'out') == 1
    assert "a.hdf5' is no HDF5 file, or a damaged one" in capsys.readouterr().err


def test_a_file_that_was_cut_fails_alone(tmp_path, capsys):
    write_aloha(tmp_path / 'raw/a.hdf5', pictures())
    cut = write_aloha(tmp_path / 'raw/b.hdf5', pictures())
    cut.write_bytes(cut.read_bytes()[:5000])
    out = tmp_path / 'out'
    assert bring_in(tmp_path / 'raw', write_mapping(tmp_path / 'm.yaml'), out) == 1
    assert '1 made, 0 kept, 1 failed' in capsys.readouterr().out
    assert (out / 'a').is_dir() and not (out / 'b').exists()


# Formats that are named


@pytest.mark.parametrize('shards', ['.', '1.0.0', 'bridge_dataset/1.0.0'])
@pytest.mark.parametrize('source', ['bag', 'videos', 'lerobot'])
def test_every_import_names_rlds_where_its_shards_are(tmp_path, capsys, source, shards):
    """As the debug data set of Octo (BridgeData V2): NAME/1.0.0/NAME-train.tfrecord-..."""
    folder = tmp_path / 'raw' / shards
    folder.mkdir(parents=True)
    (folder / 'bridge_dataset-train.tfrecord-00000-of-00001').write_bytes(b'')
    words = ['import', source, str(tmp_path / 'raw'), '--out', str(tmp_path / 'out')]
    mapping = ['--robot', 'franka']
    if source == 'videos':
        mapping = ['--mapping', str(write_mapping(tmp_path / 'm.yaml'))]
    assert main([*words, *mapping]) == 1
    assert 'RLDS (TFRecord) is not read' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('make', 'said'),
    [
        (lambda f: (f / 'data.zarr').mkdir(parents=True), 'zarr is not read: LeRobot converts it'),
        (lambda f: (f / 'x.zarr.zip').write_bytes(b'PK'), 'zarr is not read: LeRobot converts it'),
        (lambda f: (f / '.zgroup').write_text('{}'), 'zarr is not read'),
        (lambda f: (f / 'a.hdf5').write_bytes(b''), 'HDF5 is read by mtv-world import videos'),
        (lambda f: (f / 'a.tfrecord-00000-of-00001').write_bytes(b''), 'RLDS (TFRecord)'),
    ],
)
def test_import_bag_names_what_reads_or_converts_other_formats(tmp_path, capsys, make, said):
    folder = tmp_path / 'raw'
    folder.mkdir()
    make(folder)
    status = main(
        ['import', 'bag', str(folder), '--robot', 'franka', '--out', str(tmp_path / 'o')]
    )
    assert status == 1
    assert said in capsys.readouterr().err


def test_the_bundled_mapping_of_aloha_has_only_known_keys(tmp_path, capsys):
    """The robot is the user's own; franka's joints stand for its."""
    from mtv_world_ros.core.files import share_path
    from mtv_world_ros.importing.videos import load_video_mapping

    values = yaml.safe_load((share_path('config', 'datasets', 'aloha.yaml')).read_text())
    robot = load_robot(robot_path('yam_bimanual'))
    for stream in ('state', 'action'):
        columns = list(values[stream]['joints'].values())
        values[stream]['joints'] = dict(zip(robot.joint_names, columns, strict=True))
    file = tmp_path / 'm.yaml'
    file.write_text(yaml.safe_dump(values | {'robot': 'yam_bimanual'}))
    mapping = load_video_mapping(file)
    assert set(mapping.views) == {'high', 'low', 'left_wrist', 'right_wrist'}
    assert mapping.action is not None
