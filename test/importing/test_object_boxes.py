"""`--objects` of imports: masks of drawn boxes, what is wrong with the file, and its page."""

import csv
import re
import shutil
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.object_boxes import load_object_boxes
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.viewing.video import encode_video
from mtv_world_ros.vision.jaccard import jaccard
from test.support.browser import Browser

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
    return main(['import', 'videos', str(folder / 'raw'), '--mapping', str(folder / 'lab.yaml'),
                 '--objects', str(folder / 'objects.yaml'),
                 '--out', str(folder / out), *more])  # fmt: skip


def j_of(path, begin):
    """(ROWS,) of the stored masks with where the mug was drawn."""
    episode = read_episode(path, with_cameras=False)
    true = np.zeros((ROWS, 120, 160), bool)
    for mask, (left, top) in zip(true, places(begin), strict=True):
        mask[top : top + SIZE[1], left : left + SIZE[0]] = True
    assert episode.info.objects == ('mug',)
    assert re.fullmatch('examples [0-9a-f]{8}', episode.info.metadata['masks_by'])
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


def test_other_boxes_leave_what_was_imported_with_the_first_ones(raw, capsys):
    """The same again continues; others neither change the examples nor half of the masks."""
    boxes(raw)
    assert import_videos(raw) == 0
    shutil.rmtree(raw / 'data' / 'b')  # stopped before it
    assert import_videos(raw) == 0
    assert '1 made, 1 kept' in capsys.readouterr().out
    learnt = (raw / 'data' / 'objects.safetensors').read_bytes()
    shutil.rmtree(raw / 'data' / 'b')
    boxes(raw, rows=((0.0, 28, 58, 56, 82), (1.0, 36, 58, 64, 82)))
    assert import_videos(raw) == 1
    assert 'learnt from other --objects' in capsys.readouterr().err
    assert (raw / 'data' / 'objects.safetensors').read_bytes() == learnt
    assert not (raw / 'data' / 'b').exists()


def test_boxes_of_recordings_that_are_not_in_the_folder_are_said_and_not_used(raw, capsys):
    """The same file serves a part of the recordings, say those that are imported again."""
    file = boxes(raw)
    values = yaml.safe_load(file.read_text())
    for name in ('gone', 'held_out'):
        values['boxes']['front'][name] = {'mug': [[0.0, 28, 58, 56, 82]]}
    file.write_text(yaml.safe_dump(values))
    assert import_videos(raw) == 0
    said = 'boxes of 2 of 3 recordings are not used, as they are not in the folder: gone, held_out'
    assert said in capsys.readouterr().err
    assert j_of(raw / 'data' / 'a', 30).min() > 0.8


def test_a_second_import_with_a_calibration_takes_the_same_boxes(raw, capsys):
    boxes(raw)
    assert import_videos(raw) == 0
    pose = {'mount_link': 'table', 'position': [0.5, 0.0, 0.8], 'quaternion_xyzw': [1, 0, 0, 0]}
    view = {'width': 160, 'height': 120, 'K': [130.0, 130.0, 79.5, 59.5], **pose}
    (raw / 'cameras.yaml').write_text(yaml.safe_dump({'views': {'front': view}}))
    shutil.move(raw / 'raw' / 'rows' / 'b.csv', raw / 'b.csv')  # of `a` alone this time
    assert import_videos(raw, 'again', '--calibration', str(raw / 'cameras.yaml')) == 0
    assert read_episode(raw / 'again' / 'a').cameras['front'].K[0, 0] == 130
    assert j_of(raw / 'again' / 'a', 30).min() > 0.8


def test_boxes_for_episodes_without_objects_leave_nothing_behind(raw, capsys):
    main(['import', 'videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml'),
          '--out', str(raw / 'data')])  # fmt: skip
    boxes(raw)
    assert import_videos(raw) == 1
    said = capsys.readouterr().err
    assert 'imported without --objects' in said and f'import bag {raw / "data"}' in said
    assert not (raw / 'data' / 'objects.safetensors').exists()


def test_imported_episodes_get_masks_by_a_second_import(raw, capsys):
    """After `fit camera --apply`, say: nothing has to be calibrated again."""
    boxes(raw)
    (raw / 'lab.yaml').write_text((raw / 'lab.yaml').read_text().replace('objects:\n- mug\n', ''))
    main(['import', 'videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml'),
          '--out', str(raw / 'data')])  # fmt: skip
    capsys.readouterr()
    robot = raw / 'data' / 'robot' / 'robot.yaml'
    assert main(['import', 'bag', str(raw / 'data'), '--robot', str(robot), '--objects',
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
        (
            {'boxes': {'front': {'a': {' ': [[0.0, 28, 58, 56, 82]]}}}},
            "' '.*name of an obj",
        ),
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


def test_masks_by_other_examples_are_told_apart_by_doctor(raw, capsys):
    """Two files of boxes: two segmenters, by name and for `doctor FOLDER`."""
    boxes(raw)
    assert import_videos(raw, 'one') == 0
    boxes(raw, rows=((0.0, 28, 58, 56, 82), (1.0, 36, 58, 64, 82)))
    assert import_videos(raw, 'two') == 0
    shutil.rmtree(raw / 'one' / 'b')
    (raw / 'two' / 'b').rename(raw / 'one' / 'b')
    capsys.readouterr()
    main(['check', str(raw / 'one'), '--robot', str(raw / 'one' / 'robot' / 'robot.yaml'),
          '--out', str(raw / 'report')])  # fmt: skip
    said = capsys.readouterr().out
    names = re.search(
        r"masks are not by one segmenter \('(examples \w+)': a; '(examples \w+)': b\)", said
    )
    assert names and names[1] != names[2], said


def test_doctor_names_an_object_that_is_hardly_seen(raw, capsys):
    """The command reads the stored masks."""
    boxes(raw, recording='b', rows=((0.0, 78, 58, 106, 82),))
    (raw / 'lab.yaml').write_text((raw / 'lab.yaml').read_text().replace('- mug', '- red thing'))
    assert import_videos(raw) == 0
    capsys.readouterr()
    main(['check', str(raw / 'data' / 'a'), '--robot', str(raw / 'data/robot/robot.yaml'),
          '--out', str(raw / 'report')])  # fmt: skip
    assert "object 'red thing' is found in 0% of the frames" in capsys.readouterr().out


#: draws a box from one pixel of the recorded image to another, as a user does, on the screen
DRAW = """
function draw(number, name, from, to, button = 0) {
  const frame = document.querySelectorAll('.frame')[number], image = frame.querySelector('img');
  const box = image.getBoundingClientRect(), scale = box.width / 160;
  document.getElementById('name').value = name;
  const send = (target, kind, [x, y]) => target.dispatchEvent(new MouseEvent(kind, {bubbles: true,
    cancelable: true, button, clientX: box.left + x * scale, clientY: box.top + y * scale}));
  if (button) { send(image, 'contextmenu', from); return; }
  send(image, 'mousedown', from); send(window, 'mousemove', to); send(window, 'mouseup', to);
}
HTMLAnchorElement.prototype.click = function() { window.saved = this.href; };
0
"""


@pytest.fixture
def page(raw, capsys):
    file = raw / 'boxes.html'
    assert main(['import', 'videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml'),
                 '--out', str(raw / 'data'), '--click', str(file)]) == 0  # fmt: skip
    said = capsys.readouterr().out
    assert f'page: {file}' in said and 'nothing was imported' in said
    assert not (raw / 'data').exists()
    return file


def test_it_has_the_first_frame_of_every_recording_and_the_known_names(page):
    text = page.read_text()
    assert text.count('data-episode="a"') == 1 and text.count('data-episode="b"') == 1
    assert '<option value="mug">' in text
    assert 'http://' not in text and 'https://' not in text


def test_what_it_saves_is_what_the_import_takes(page, raw, capsys):
    browser = Browser(raw / 'profile')
    try:
        browser.open(page.as_uri())
        browser.run(DRAW)
        browser.run("draw(0, 'mug', [40, 90], [10, 10]); 0")  # replaced by the next
        browser.run("draw(0, 'mug', [56, 82], [28, 58]); 0")  # from any corner
        browser.run("draw(1, 'towel', [10, 40], [30, 60]); 0")  # taken away again
        browser.run("draw(1, '', [12, 42], [40, 60]); 0")  # nobody said of what
        assert 'which object' in browser.run("document.getElementById('count').textContent")
        browser.run("draw(1, 'dot', [12, 42], [13, 43]); 0")  # too small
        assert 'at least 3 px' in browser.run("document.getElementById('count').textContent")
        browser.run("draw(1, '', [12, 42], null, 2); 0")
        browser.run("draw(1, 'cup', [140, 100], [900, 900]); 0")  # let go outside of the picture
        assert browser.run("document.getElementById('count').textContent") == (
            '2 boxes of 2 objects'
        )
        browser.run("document.getElementById('save').dispatchEvent(new MouseEvent('click')); 0")
        saved = browser.run('window.saved')
        browser.keep('boxes_page')
    finally:
        browser.close()
    file = raw / 'objects.yaml'
    file.write_text(unquote(saved.partition(',')[2]))
    drawn = load_object_boxes(file).boxes
    (row,) = drawn['front']['a']['mug']
    assert row == pytest.approx((0, 28, 58, 56, 82), abs=0.2)
    assert drawn['front']['b'].keys() == {'cup'}
    assert drawn['front']['b']['cup'][0][3:] == (160, 120)
    command = ['import', 'videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml')]
    assert main([*command, '--objects', str(file), '--out', str(raw / 'data')]) == 0
    assert 'object mug: found by its colours' in capsys.readouterr().out


def test_the_page_and_the_file_at_once_are_refused(raw, capsys):
    command = ['import', 'videos', str(raw / 'raw'), '--mapping', str(raw / 'lab.yaml')]
    more = ['--click', str(raw / 'p.html'), '--objects', str(raw / 'o.yaml')]
    assert main([*command, '--out', str(raw / 'data'), *more]) == 1
    assert 'give one' in capsys.readouterr().err and not (raw / 'p.html').exists()
