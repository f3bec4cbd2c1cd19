"""Named pipes in place of files do not block, and links out of a folder are not walked."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path
import time

import pytest

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.files import copy_folder
from mtv_world_ros.data.episode_reader import LinkWarning, list_episodes
from robustness.folder_kinds import clean_up, FOLDERS, new_folder

#: errors that the readers raise for a user; others are defects
SLOW = ('latent cache', 'LoRA')
EXPECTED = (MtvWorldError, OSError, ValueError)


def _read_with_pipe(name: str, file: str, answers) -> None:
    make, _, read = FOLDERS[name]
    folder = new_folder()
    make(folder)
    (folder / file).unlink()
    os.mkfifo(folder / file)
    try:
        read(folder)
        answers.send('read without it')
    except EXPECTED as error:
        answers.send(str(error))
    except BaseException as error:
        answers.send(f'defect: {type(error).__name__}: {error}')


def _files(name: str) -> list[str]:
    make, _, _ = FOLDERS[name]
    folder = new_folder()
    make(folder)
    found = (path for path in folder.rglob('*') if path.is_file())
    return sorted(str(path.relative_to(folder)) for path in found)


@pytest.mark.parametrize(
    'name',
    [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in FOLDERS],
)
def test_a_pipe_in_place_of_a_file_blocks_no_reader(name):
    context = multiprocessing.get_context('fork')
    try:
        files = _files(name)
        for file in files:
            mine, theirs = context.Pipe()
            process = context.Process(target=_read_with_pipe, args=(name, file, theirs))
            process.start()
            is_answered = mine.poll(60.0)
            if not is_answered:
                process.kill()
            process.join()
            assert is_answered, f'{file} blocks'
            assert not (said := mine.recv()).startswith('defect'), (file, said)
        assert files
    finally:
        clean_up()


def _episode(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / 'metadata.yaml').write_text('')
    return folder


def test_links_out_of_a_folder_are_named_and_not_followed(tmp_path, monkeypatch):
    mine, other = tmp_path / 'mine', tmp_path / 'other'
    inside = _episode(mine / 'a')
    outside = _episode(other / 'deep' / 'b')
    (mine / 'machine').symlink_to('/')
    (mine / 'others').symlink_to(other)
    (mine / 'again').symlink_to(mine)
    (mine / 'link to one').symlink_to(outside)
    begin_s = time.process_time()
    with pytest.warns(LinkWarning) as said:
        found = list_episodes(mine)
    assert time.process_time() - begin_s < 5.0
    assert found == [inside, mine / 'link to one']
    texts = sorted(str(one.message) for one in said)
    assert len(texts) == 2
    assert f"'{mine / 'machine'}' leads out of its folder to '/' and is not followed" in texts[0]
    assert f"'{mine / 'others'}' leads out of its folder to '{other}'" in texts[1]
    (mine / 'machine').unlink()
    monkeypatch.setenv('MTV_WORLD_FOLLOW_LINKS', '1')
    assert mine / 'others' / 'deep' / 'b' in list_episodes(mine)


def test_a_command_prints_the_link_as_one_line(tmp_path, capsys):
    from mtv_world_ros.cli import main

    (tmp_path / 'bags').mkdir()
    (tmp_path / 'bags' / 'machine').symlink_to('/')
    words = ['import', 'bag', str(tmp_path / 'bags'), '--out', str(tmp_path / 'out')]
    words += ['--robot', 'yam_bimanual']
    assert main(words) == 1
    first, *rest = capsys.readouterr().err.splitlines()
    assert first.startswith(
        f"mtv-world: '{tmp_path / 'bags' / 'machine'}' leads out of its folder"
    )
    assert len(rest) == 1 and 'no bag' in rest[0]


def test_a_folder_that_is_copied_does_not_take_the_machine_along(tmp_path):
    (tmp_path / 'model').mkdir()
    (tmp_path / 'model' / 'machine').symlink_to('/')
    with pytest.raises(OSError, match="a link to the folder '/', which is outside"):
        copy_folder(tmp_path / 'model', tmp_path / 'copy')
    assert not (tmp_path / 'copy').exists()
