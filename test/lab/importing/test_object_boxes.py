"""`--objects` of imports: masks of drawn boxes, and what is wrong with the file."""

import csv
import re

import numpy as np
import pytest
import yaml

from mtv_world_ros.assembly import robot_path
from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.rendering.video import encode_video
from mtv_world_ros.vision.jaccard import jaccard

FPS, ROWS = 5, 10
MUG, SIZE = (120, 75, 45), (24, 20)


def places(begin):
    """(ROWS, 2) left and top of the mug, which waits and then moves."""
    return [(begin + 4 * max(0, k - 3), 60) for k in range(ROWS)]


def write_recording(folder, name, begin, size=(160, 120)):
    """A video of a brown mug on a white table, and rows of joints that stand still."""
    frames = np.full((ROWS, size[1], size[0], 3), 205, np.uint8)
    frames[:, :30] = (90, 95, 100)
    for frame, (left, top) in zip(frames, places(begin), strict=True):
        frame[top : top + SIZE[1], left : left + SIZE[0]] = MUG
    (folder / 'videos').mkdir(parents=True, exist_ok=True)
    (folder / 'videos' / f'{name}.mp4').write_bytes(encode_video(frames, FPS))
    (folder / 'rows').mkdir(exist_ok=True)
    with (folder / 'rows' / f'{name}.csv').open('w', newline='') as file:
        table = csv.writer(file)
        table.writerow([*(f'q{k}' for k in range(7)), 'grip'])
        table.writerows([[0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8, 0.0]] * ROWS)


@pytest.fixture
def raw(tmp_path):
    """The folder of two recordings; boxes are drawn in `a` alone."""
    write_recording(tmp_path / 'raw', 'a', 30)
    write_recording(tmp_path / 'raw', 'b', 80)
    robot = load_robot(robot_path('franka'))
    joints = {name: f'q{k}' for k, name in enumerate(robot.joint_names[:7])}
    joints[robot.joint_names[7]] = {'column': 'grip', 'open': 0.0, 'closed': 1.0}
    values = {
        'robot': 'franka',
        'rows': 'rows/{name}.csv',
        'views': {'front': 'videos/{name}.mp4'},
        'fps': FPS,
        'objects': ['mug'],
        'state': {'feature': '', 'joints': joints},
    }
    (tmp_path / 'lab.yaml').write_text(yaml.safe_dump(values))
    return tmp_path


def boxes(folder, rows=((0.0, 28, 58, 56, 82),), *, view='front', recording='a', **more):
    values = {'boxes': {view: {recording: {'mug': [list(row) for row in rows]}}}, **more}
    (folder / 'objects.yaml').write_text(yaml.safe_dump(values))
    return folder / 'objects.yaml'


def import_videos(folder, out='data', *more):
    return main(['import-videos', str(folder / 'raw'), '--mapping', str(folder / 'lab.yaml'),
                 '--objects', str(folder / 'objects.yaml'),
                 '--out', str(folder / out), *more])  # fmt: skip


def j_of(path, begin):
    """(ROWS,) of the stored masks with where the mug was drawn."""
    episode = read_episode(path, with_cameras=False)
    true = np.zeros((ROWS, 120, 160), bool)
    for mask, (left, top) in zip(true, places(begin), strict=True):
        mask[top : top + SIZE[1], left : left + SIZE[0]] = True
    assert episode.info.objects == ('mug',)
    assert episode.info.metadata['masks_by'] == 'examples'
    return jaccard(np.asarray(episode.masks['front'].frames[:]) == 1, true)


def test_a_box_in_one_recording_gives_masks_in_all(raw, capsys):
    boxes(raw)
    assert import_videos(raw) == 0
    said = capsys.readouterr().out
    assert 'object mug: found by its colours' in said
    assert 'b: 1.8 s' in said and said.count('seen: mug in front 100%') == 2
    assert j_of(raw / 'data' / 'a', 30).min() > 0.8
    assert j_of(raw / 'data' / 'b', 80).min() > 0.8
    assert (raw / 'data' / 'objects.safetensors').is_file()


def test_imported_episodes_get_masks_by_a_second_import(raw, capsys):
    """After `calibrate-camera --apply`, say: nothing has to be calibrated again."""
    boxes(raw)
    (raw / 'lab.yaml').write_text((raw / 'lab.yaml').read_text().replace('objects:\n- mug\n', ''))
    main(['import-videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml'),
          '--out', str(raw / 'data')])  # fmt: skip
    capsys.readouterr()
    robot = raw / 'data' / 'robot' / 'robot.yaml'
    assert main(['import-bag', str(raw / 'data'), '--robot', str(robot), '--objects',
                 str(raw / 'objects.yaml'), '--out', str(raw / 'named')]) == 0  # fmt: skip
    said = capsys.readouterr().out
    assert 'seen: mug in front 100%' in said
    assert j_of(raw / 'named' / 'a', 30).min() > 0.8
    assert read_episode(raw / 'named' / 'b', with_cameras=False).info.objects == ()


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        ({'recording': 'c'}, "no recording 'c'.*there are a, b"),
        ({'view': 'fornt'}, "no view 'fornt'.*did you mean.*front"),
        ({'rows': [(9.0, 28, 58, 56, 82)]}, 'no frame at 9 s.*1.8 s'),
        ({'rows': [(0.0, 28, 58, 170, 82)]}, r'\[28, 58, 170, 82\] is not inside.*160 x 120'),
        ({'rows': [(0.0, 0, 0, 159, 110)]}, 'more than half'),
        ({'rows': [(0.0, 56, 58, 28, 82)]}, 'left, top, right, bottom'),
        ({'rows': [(0.0, 28, 58, 56)]}, '5 numbers'),
        ({'rows': ()}, "'boxes' is empty|draw one"),
        ({'boxs': {}}, "'boxs'.*boxes"),
    ],
)
def test_what_is_wrong_with_the_file_is_said_and_nothing_is_imported(raw, capsys, change, says):
    boxes(raw, **change)
    assert import_videos(raw) == 1
    assert re.search(says, ' '.join(capsys.readouterr().err.split())), says
    assert not (raw / 'data' / 'a').exists()


def test_boxes_beside_another_segmenter_are_refused(raw, capsys):
    boxes(raw)
    assert import_videos(raw, 'data', '--segmenter', 'colour') == 1
    assert '--objects' in capsys.readouterr().err
