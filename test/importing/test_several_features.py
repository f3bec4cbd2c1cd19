"""Data sets whose state and action are split into features, and whose images are files."""

import io
import json
from pathlib import Path
import resource
import shutil

import cv2
import numpy as np
from PIL import Image
import pyarrow
from pyarrow import parquet
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing import parquet_tables
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.lerobot_episodes import import_dataset

ARM, GRIPPER = ['shoulder', 'elbow'], ['gripper']
TABLE = 'data/chunk-000/episode_{:06d}.parquet'


def split(root, parts, columns=lambda name, table: table):
    """Rewrite `observation.state` and `action` as several features.

    Args:
        root: data set of format v2.1 with states and actions of shoulder, elbow, gripper, force.
        parts: slice of the columns and their names by the end of a feature's name.
        columns: changes the values (T, C) of a feature, by its name.
    """
    info = json.loads((root / 'meta/info.json').read_text())
    for stem in ('observation.state', 'action'):
        del info['features'][stem]
        for end, (part, names) in parts.items():
            count = part.stop - part.start
            info['features'][f'{stem}.{end}'] = {
                'dtype': 'float32', 'shape': [count], 'names': names}  # fmt: skip
    (root / 'meta/info.json').write_text(json.dumps(info))
    for episode in range(2):
        file = root / TABLE.format(episode)
        table = parquet.read_table(file)
        for stem in ('observation.state', 'action'):
            values = np.array(table.column(stem).to_pylist())
            values[:, 0] = np.radians(values[:, 0])  # the joints' own units
            values[:, 2] = 0.0004 * (100 - values[:, 2])
            table = table.drop_columns([stem])
            for end, (part, _) in parts.items():
                found = columns(f'{stem}.{end}', values[:, part])
                cells = found[:, 0].tolist() if found.shape[1] == 1 else found.tolist()
                table = table.append_column(f'{stem}.{end}', pyarrow.array(cells))
        parquet.write_table(table, file)
    return root


def expected(episode, rows, ahead=0):
    """(rows, 3) positions, as `conftest.state` has them, in rad and m."""
    k = np.arange(rows) + ahead
    return np.stack([np.radians(3.0 * k + episode), 0.1 * k - 0.2, 0.0004 * 5 * k], axis=1)


def check(episode_folder, number, rows):
    episode = read_episode(episode_folder, with_cameras=False)
    np.testing.assert_allclose(episode.joint_states.positions, expected(number, rows), atol=1e-6)
    found = np.concatenate([t.positions for _, t in episode.trajectories])
    np.testing.assert_allclose(found, expected(number, rows, 1), atol=1e-6)


@pytest.fixture
def copy(datasets, tmp_path):
    return lambda: shutil.copytree(datasets('v2.1'), tmp_path / 'set')


BY_NAME = {'arm.position': (slice(0, 2), ARM), 'effector.position': (slice(2, 3), GRIPPER)}
WITHOUT = {'arm': (slice(0, 2), None), 'force': (slice(3, 4), None), 'grip': (slice(2, 3), None)}


def streams(ends, joints, columns=None):
    return {
        key: {'feature': [f'{stem}.{end}' for end in ends],
              **({'joints': dict(zip(('shoulder', 'elbow', 'gripper'), joints, strict=True))}
                 if joints else {})}
        for key, stem in (('state', 'observation.state'), ('action', 'action'))
    }  # fmt: skip


@pytest.mark.parametrize(
    ('parts', 'ends', 'joints'),
    [
        (BY_NAME, list(BY_NAME), None),  # named like the robot's joints
        (BY_NAME, list(BY_NAME), [0, 1, 2]),
        (BY_NAME, ['effector.position', 'arm.position'], [1, 2, 0]),  # in the order of the list
        (WITHOUT, ['arm', 'force', 'grip'], [0, 1, 3]),
    ],
    ids=['names', 'numbers', 'another_order', 'without_names'],
)
def test_state_and_action_are_joined_from_several_features(
    copy, make_mapping, tmp_path, parts, ends, joints
):
    root, file = split(copy(), parts), make_mapping()
    values = yaml.safe_load(file.read_text()) | streams(ends, joints)
    file.write_text(yaml.safe_dump(values))
    summary = import_dataset(root, file, tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    check(tmp_path / 'out/episode_000000', 0, 12)
    check(tmp_path / 'out/episode_000001', 1, 9)


def test_columns_without_a_name_of_their_own_are_called_by_their_feature(
    copy, make_mapping, tmp_path
):
    root, file = split(copy(), WITHOUT), make_mapping()
    values = yaml.safe_load(file.read_text())
    for key, stem in (('state', 'observation.state'), ('action', 'action')):
        names = [f'{stem}.arm/0', f'{stem}.arm/1', f'{stem}.grip']
        values[key] = streams(WITHOUT, names)[key]
    file.write_text(yaml.safe_dump(values))
    assert import_dataset(root, file, tmp_path / 'out').made == [0, 1]
    check(tmp_path / 'out/episode_000000', 0, 12)
    values['state']['joints']['gripper'] = 'grip'
    file.write_text(yaml.safe_dump(values))
    failed = import_dataset(root, file, tmp_path / 'other').failed[0]
    assert "no column 'grip'" in failed and 'observation.state.grip' in failed


def test_two_features_may_name_their_columns_alike(copy, make_mapping, tmp_path):
    same = {'arm.position': (slice(0, 2), ARM), 'arm.velocity': (slice(1, 3), ARM),
            'effector.position': (slice(2, 3), GRIPPER)}  # fmt: skip
    root, file = split(copy(), same), make_mapping()
    values = yaml.safe_load(file.read_text())
    for key, stem in (('state', 'observation.state'), ('action', 'action')):
        names = [f'{stem}.arm.position/shoulder', f'{stem}.arm.position/elbow', 'gripper']
        values[key] = streams(same, names)[key]
    file.write_text(yaml.safe_dump(values))
    assert import_dataset(root, file, tmp_path / 'out').made == [0, 1]
    check(tmp_path / 'out/episode_000001', 1, 9)


@pytest.mark.parametrize('velocities', [False, True])
def test_split_features_need_no_mapping_where_columns_are_named_like_joints(
    copy, make_mapping, tmp_path, velocities
):
    parts = {**BY_NAME, **({'arm.velocity': (slice(1, 3), ARM)} if velocities else {})}
    root, folder = split(copy(), parts), make_mapping().parent
    files = ['--robot', str(folder / 'robot.yaml'), '--calibration',
             str(folder / 'calibration.yaml'), '--out', str(tmp_path / 'out')]  # fmt: skip
    assert main(['import', 'lerobot', str(root), *files]) == 0
    check(tmp_path / 'out/episode_000000', 0, 12)


def test_a_feature_of_the_list_that_is_not_there_is_named(copy, make_mapping, tmp_path):
    root, file = split(copy(), BY_NAME), make_mapping()
    values = yaml.safe_load(file.read_text()) | streams(['arm.position', 'efector.position'], None)
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=r"efector.position' \(did you mean"):
        import_dataset(root, file, tmp_path / 'out')


def with_image_files(root, cell, place):
    """Write the images of the front view as files; cells are made from their paths."""
    for episode in range(2):
        file = root / TABLE.format(episode)
        table = parquet.read_table(file)
        cells = table.column('observation.images.front').to_pylist()
        made = []
        for k, found in enumerate(cells):
            path = place.format(episode, k)
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_bytes(found['bytes'])
            made.append(cell(path, found['bytes']))
        at = table.column_names.index('observation.images.front')
        parquet.write_table(
            table.set_column(at, 'observation.images.front', pyarrow.array(made)), file
        )
    return root


PLACE = 'images/observation.images.front/episode_{:06d}/frame_{:06d}.png'


def levels(folder):
    track = read_episode(folder, with_cameras=False).images['front']
    return [float(np.asarray(frame).mean()) for frame in track.frames]


@pytest.mark.parametrize(
    ('cell', 'place'),
    [
        (lambda path, data: {'bytes': None, 'path': path}, PLACE),
        (lambda path, data: path, PLACE),
        (lambda path, data: {'bytes': None, 'path': f'/mnt/someone/cache/name/{path}'}, PLACE),
        (lambda path, data: {'bytes': None, 'path': Path(path).name}, PLACE),
        (lambda path, data: {'bytes': None, 'path': 'C:\\sets\\' + path.replace('/', '\\')},
         PLACE),
        (lambda path, data: path.removeprefix('data/chunk-000/'),
         'data/chunk-000/pictures/{}_{}.png'),
        (lambda path, data: data, PLACE),
        (lambda path, data: list(data), PLACE),
    ],
    ids=['path', 'text', 'another_machine', 'name', 'windows', 'beside_the_table', 'bytes',
         'numbers'],
)  # fmt: skip
def test_images_are_read_from_the_files_that_the_table_names(
    datasets, make_mapping, tmp_path, cell, place
):
    root = with_image_files(shutil.copytree(datasets('images'), tmp_path / 'set'), cell, place)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    np.testing.assert_allclose(
        levels(tmp_path / 'out/episode_000001'), 20 + 16 * np.arange(9) + 3, atol=2
    )


@pytest.mark.parametrize(
    ('cell', 'said'),
    [
        ({'bytes': None, 'path': 'images/none.png'}, "is 'images/none.png', which is not there"),
        ({'bytes': None, 'path': '../secret.png'}, 'outside the dataset'),
        ({'bytes': None, 'path': None}, r"holds keys \['bytes', 'path'\], must be an encoded"),
        ([1000, 2], 'holds list, must be an encoded image'),
    ],
    ids=['missing', 'outside', 'nothing', 'numbers'],
)
def test_an_image_that_is_nowhere_is_named(datasets, make_mapping, tmp_path, cell, said):
    root = shutil.copytree(datasets('images'), tmp_path / 'set')
    (tmp_path / 'secret.png').write_bytes(
        cv2.imencode('.png', np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    )
    root = with_image_files(root, lambda path, data: cell, PLACE)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert set(summary.failed) == {0, 1}
    with pytest.raises(AssertionError, match=said):
        raise AssertionError(summary.failed[0])


@pytest.mark.parametrize(
    'names',
    [
        {'shoulder.pos': 0, 'elbow.pos': 1, 'gripper.pos': 2, 'force': 3},
        {'elbow.pos': 1, 'force': 3, 'gripper.pos': 2, 'shoulder.pos': 0},
        {'arm': ['shoulder.pos', 'elbow.pos'], 'hand': ['gripper.pos', 'force']},
        {'motors': [['shoulder.pos', 'elbow.pos'], ['gripper.pos', 'force']]},
        {'motors': {'arm': ['shoulder.pos', 'elbow.pos'], 'hand': ['gripper.pos', 'force']}},
    ],
    ids=['numbers', 'numbers_in_another_order', 'parts', 'nested_lists', 'nested_keys'],
)
def test_columns_have_names_however_a_data_set_writes_them(copy, make_mapping, tmp_path, names):
    root = copy()
    info = json.loads((root / 'meta/info.json').read_text())
    for key in ('observation.state', 'action'):
        info['features'][key]['names'] = names
    (root / 'meta/info.json').write_text(json.dumps(info))
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    states = read_episode(tmp_path / 'out/episode_000000', with_cameras=False).joint_states
    assert states.positions[3] == pytest.approx([np.radians(9.0), 0.4, 0.0004 * 15], abs=1e-6)


def test_images_with_an_exif_orientation_are_turned_upright_and_it_is_said(
    datasets, make_mapping, tmp_path
):
    """As Hugging Face's `datasets` turns them, by which LeRobot reads images."""

    def lying(path, data):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        image[:10] = 250  # the upper edge
        exif, file = Image.Exif(), io.BytesIO()
        exif[0x0112] = 6  # to be turned by 90 degrees clockwise
        stored = cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE)
        Image.fromarray(stored).save(file, 'jpeg', quality=95, exif=exif)
        return {'bytes': file.getvalue(), 'path': None}

    root = with_image_files(shutil.copytree(datasets('images'), tmp_path / 'set'), lying, PLACE)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1] and not summary.failed
    notes = ' '.join(summary.warnings[0])
    assert "view 'front': images are turned upright (EXIF orientation 6)" in notes
    frame = read_episode(tmp_path / 'out/episode_000000', with_cameras=False)
    first = np.asarray(frame.images['front'].frames[0])
    assert first.shape == (48, 64, 3)
    assert first[:8].mean() > 230 > 200 > first[20:].mean()


def repeated_text(file, text, count, column='task'):
    """A table of one text that is stored once and repeated."""
    places = pyarrow.array(np.zeros(count, np.int32))
    texts = pyarrow.DictionaryArray.from_arrays(places, pyarrow.array([text]))
    table = pyarrow.table({column: texts, 'task_index': pyarrow.array(range(count))})
    parquet.write_table(table, file, store_schema=False, dictionary_pagesize_limit=2**26)


def test_a_text_that_is_repeated_does_not_fill_the_memory(datasets, tmp_path):
    """Two megabytes, 20,000 times: a file of .3 MB that would be 40 GB."""
    root = shutil.copytree(datasets('v3.0'), tmp_path / 'set')
    repeated_text(root / 'meta/tasks.parquet', 'x' * 2_000_000, 20_000)
    assert (root / 'meta/tasks.parquet').stat().st_size < 1e6
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(EpisodeError, match=r'tasks.parquet.*table_bytes|40000000000'):
        LeRobotDataset(root)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used < 300_000  # kB


def test_short_texts_that_are_repeated_are_read(datasets, tmp_path):
    file = tmp_path / 'tasks.parquet'
    repeated_text(file, 'stack the red block', 200_000)
    assert parquet_tables.text_bytes(file, ['task']) == 200_000 * len('stack the red block')


def test_a_column_with_dots_in_its_name_does_not_fill_the_memory(tmp_path):
    """LeRobot's names have them; a column that is not read does not count."""
    file = tmp_path / 'rows.parquet'
    repeated_text(file, 'x' * 2_000_000, 20_000, column='observation.images.top')
    with pytest.raises(EpisodeError, match=r'rows.parquet.* 40000000000 bytes'):
        parquet_tables.read_table(file, columns=['observation.images.top', 'task_index'])
    assert parquet_tables.read_table(file, columns=['task_index']).num_rows == 20_000
