"""The scripts of examples/ with hostile paths: an error of the package says why they end.

A script has no command around it that would print one line; the last line of its traceback is
that line. An error of any other kind tells a reader nothing.
"""

from __future__ import annotations

import os
from pathlib import Path
import runpy

import pytest

from mtv_world_ros.core.errors import MtvWorldError
from test.robustness.test_commands import PLACES

EXAMPLES = Path(__file__).parents[2] / 'examples'
#: scripts whose first argument is a path that is read
READERS = sorted(file.name for file in EXAMPLES.glob('*.py') if "nargs='?'" in file.read_text())
#: scripts that are given a place where something lies already
WRITERS = {
    'episode_on_disk.py': 'episode',
    'calibrate_camera.py': 'camera.yaml',
    'own_robot.py': 'robot',
}
#: every fourth, as of the commands
PAIRS = [
    (name, place)
    for i, name in enumerate(READERS)
    for j, place in enumerate(PLACES)
    if (os.environ.get('MTV_WORLD_ATTACKS') == 'all' or (i + j) % 4 == 0)
]


def run(name: str, words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the script in a folder."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr('sys.argv', [name, *words])
    runpy.run_path(str(EXAMPLES / name), run_name='__main__')


def refused(name: str, words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """What the script says as it refuses: an error of the package, or of the system."""
    with pytest.raises((MtvWorldError, OSError)) as error:
        run(name, words, folder, monkeypatch)
    return str(error.value)


def test_the_scripts_are_found() -> None:
    assert len(READERS) >= 9


@pytest.mark.parametrize(('name', 'place'), PAIRS)
def test_a_path_that_is_none_is_refused(
    name: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside, folder = tmp_path / 'in', tmp_path / 'work'
    inside.mkdir()
    folder.mkdir()
    assert len(refused(name, [str(PLACES[place](inside))], folder, monkeypatch)) > 20
    assert not [path for path in folder.rglob('*') if path.is_file() and path.name != '.lock']


@pytest.mark.parametrize('name', WRITERS)
def test_what_lies_where_a_script_writes_stays(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / WRITERS[name]
    kept = out if out.suffix else out / 'robot.yaml'
    kept.parent.mkdir(exist_ok=True)
    kept.write_text('mine')
    said = refused(name, ['--out', str(out)], tmp_path, monkeypatch)
    assert 'exists' in said and ('overwrite' in said or 'choose another name' in said)
    assert kept.read_text() == 'mine'


def test_a_view_that_the_recording_lacks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = refused('calibrate_camera.py', ['--view', 'nowhere'], tmp_path, monkeypatch)
    assert "'nowhere'" in said and 'low' in said
