"""The page on which points are clicked, in a browser: what it saves is where the clicks were."""

import json
from urllib.parse import unquote

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode import Episode, EpisodeInfo, JointStates, Track
from mtv_world_ros.inspection.cameras.finger_tips import tip_middles
from mtv_world_ros.inspection.cameras.points_page import points_page
from mtv_world_ros.inspection.cameras.seen_points import load_points, seen_points
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from test.support.browser import Browser
from test.support.crane import load, make_cameras, make_positions, write_episode

#: of frame f, number k of all, `at` clicks a pixel of the recorded image (320 px wide)
CLICK = (
    "const all = [...document.querySelectorAll('.frame')];"
    'for (const [k, f] of all.entries()) {'
    "const i = f.querySelector('img'), b = i.getBoundingClientRect(), s = b.width / 320;"
    "const at = (x, y) => i.dispatchEvent(new MouseEvent('click', {bubbles: true,"
    'clientX: b.left + (x + .5) * s, clientY: b.top + (y + .5) * s}));'
)


@pytest.fixture
def page(tmp_path, capsys):
    """A page of two recordings."""
    robot = load(tmp_path)
    for number in (0, 1):
        write_episode(tmp_path / 'data' / f'e{number}', robot, {'door': make_cameras()['door']},
                      make_positions(2.0, seed=number))  # fmt: skip
    file = tmp_path / 'points.html'
    command = ['fit', 'camera', str(tmp_path / 'data'), '--view', 'door']
    assert main([*command, '--robot', str(robot.file), '--click', str(file)]) == 0
    assert f'page: {file}' in capsys.readouterr().out
    return file


def test_it_has_frames_of_every_recording_far_apart(page):
    text = page.read_text()
    assert text.count('data-episode="e0"') >= 2 and text.count('data-episode="e1"') >= 2
    assert 'data-seconds="0.0"' in text and 'http://' not in text and 'https://' not in text


def test_what_it_saves_is_where_the_clicks_were(page, tmp_path):
    browser = Browser(tmp_path / 'profile')
    try:
        browser.open(page.as_uri())
        # both finger tips at known pixels, as a user clicks: on the screen, at another scale
        browser.run(CLICK + 'at(90 + k, 55 + 2 * k); at(110 + k, 65 + 2 * k)}; 0')
        frames = browser.run(
            "[...document.querySelectorAll('.frame')].map(f => [f.dataset.episode,"
            'Number(f.dataset.seconds)])'
        )
        browser.run(
            'HTMLAnchorElement.prototype.click = function() {window.saved = this.href}; '
            "document.getElementById('save').dispatchEvent(new MouseEvent('click')); 0"
        )
        saved = browser.run('window.saved')
    finally:
        browser.close()
    file = tmp_path / 'points.yaml'
    file.write_text(unquote(saved.partition(',')[2]))
    assert json.loads(file.read_text()).keys() == {'door'}
    rows = [(name, row) for name, rows in load_points(file, 'door').items() for row in rows]
    assert len(rows) == len(frames) >= 4
    for k, ((name, row), (episode, seconds)) in enumerate(zip(rows, frames, strict=True)):
        assert name == episode
        np.testing.assert_allclose(
            row, [seconds, 100 + k, 60 + 2 * k], atol=0.6
        )  # whole pixels of the screen


@pytest.mark.slow
def test_a_click_is_corrected_and_a_frame_that_lacks_a_finger_tip_is_not_saved(page, tmp_path):
    browser = Browser(tmp_path / 'profile')
    try:
        browser.open(page.as_uri())
        # both tips of all frames but the last, and the second one corrected by a third click
        browser.run(CLICK + 'at(100, 60); if (k + 1 < all.length) {at(140, 90); at(120, 80)}}; 0')
        count, told, marks = browser.run(
            "[document.querySelectorAll('.frame').length,"
            "document.getElementById('count').textContent, document.querySelectorAll('i').length]"
        )
        saved = browser.run('saved()')
        browser.keep('points_page')
    finally:
        browser.close()
    assert told == f'{count - 1} points, 1 frames lack a finger tip' and marks == 2 * count - 1
    rows = [row for rows in saved['door'].values() for row in rows]
    assert len(rows) == count - 1
    np.testing.assert_allclose(np.array(rows)[:, 1:], [[110, 70]] * (count - 1), atol=0.6)


def test_each_arm_that_moves_has_frames_and_its_points_name_it(tmp_path):
    """The second arm of two is the one that moves; a row without an arm is of the first."""
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    arms = [tool.arm for tool in robot.tools]
    count, right = 40, [n for n, name in enumerate(robot.joint_names) if name.startswith('right')]
    positions = np.tile(np.clip(0.0, robot.lower, robot.upper), (count, 1))
    positions[:, right[0]] += np.linspace(0, 0.6, count)
    stamps = np.arange(1, count + 1) * 100_000_000
    episode = Episode(
        info=EpisodeInfo(path=tmp_path / 'e0'),
        views=('door',),
        images={'door': Track(stamps, np.zeros((count, 24, 32, 3), np.uint8))},
        cameras={},
        joint_states=JointStates(
            stamps_ns=stamps, joint_names=robot.joint_names, positions=positions
        ),
        trajectories=[],
        masks=None,
        instructions=[],
    )
    page = points_page([episode], ['door'], robot, [2, 1])
    assert page.count('data-arm="right"') >= 2 and 'data-arm="left"' not in page
    assert page.count('data-tips="1"') == page.count('<figure')
    file = tmp_path / 'points.yaml'
    file.write_text('door: {e0: [[0.0, 10, 5, right], [1.0, 11, 5], [2, 9, 5, right], [3, 1, 1]]}')
    rows = load_points(file, 'door', arms)['e0']
    parts = load_shape(robot).parts
    seen = seen_points({'e0': rows}, [episode], [JointTrack(episode.joint_states, robot)], robot,
                       parts)  # fmt: skip
    for point, row, arm in zip(seen, (0, 10, 20, 30), (1, 0, 1, 0), strict=True):
        wanted = tip_middles(robot, parts, positions[row : row + 1], arm)[0]
        np.testing.assert_allclose(point.position, wanted, atol=1e-6)
    file.write_text('door: {e0: [[0.0, 10, 5, rihgt], [1, 1, 1], [2, 2, 2], [3, 3, 3]]}')
    with pytest.raises(ConfigError, match="'rihgt' is no arm .did you mean 'right'"):
        load_points(file, 'door', arms)
