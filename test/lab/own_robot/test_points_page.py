"""The page on which points are clicked, in a browser: what it saves is where the clicks were."""

import json
from urllib.parse import unquote

from browser import Browser
from crane import load, make_cameras, make_positions, write_episode
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.lab.camera_calibration.shared_camera import load_points


@pytest.fixture
def page(tmp_path, capsys):
    """A page of two recordings."""
    robot = load(tmp_path)
    for number in (0, 1):
        write_episode(tmp_path / 'data' / f'e{number}', robot, {'door': make_cameras()['door']},
                      make_positions(2.0, seed=number))  # fmt: skip
    file = tmp_path / 'points.html'
    command = ['calibrate-camera', str(tmp_path / 'data'), '--view', 'door']
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
        # a click at known pixels of each frame, as a user's: on the screen, at another scale
        browser.run(
            "for (const [k, f] of [...document.querySelectorAll('.frame')].entries()) {"
            "const i = f.querySelector('img'), b = i.getBoundingClientRect(), s = b.width / 320;"
            "i.dispatchEvent(new MouseEvent('click', {bubbles: true,"
            'clientX: b.left + (100.5 + k) * s, clientY: b.top + (60.5 + 2 * k) * s}))}; 0'
        )
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
