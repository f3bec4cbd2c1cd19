import os

import pytest

from mtv_world_ros.files import write_whole


@pytest.mark.parametrize(('content', 'data'), [('grün\n', 'grün\n'.encode()), (b'\0\1', b'\0\1')])
def test_file_has_the_content_and_nothing_lies_beside_it(tmp_path, content, data):
    path = tmp_path / 'new' / 'file'
    write_whole(path, content)
    write_whole(path, content)
    assert path.read_bytes() == data
    assert os.listdir(path.parent) == ['file']


@pytest.mark.parametrize(
    'error', [OSError(28, 'No space left on device'), KeyboardInterrupt()], ids=['full', 'Ctrl-C']
)
def test_what_was_there_stays_where_the_new_is_not_written(tmp_path, monkeypatch, error):
    path = tmp_path / 'file'
    write_whole(path, 'old')

    def half(self, data):
        with self.open('wb') as file:
            file.write(data[:2])
        raise error

    monkeypatch.setattr('pathlib.Path.write_bytes', half)
    with pytest.raises(type(error)):
        write_whole(path, 'new content')
    assert path.read_text() == 'old'
    assert os.listdir(tmp_path) == ['file']


def test_a_folder_in_place_of_the_file_is_named(tmp_path):
    (tmp_path / 'page.html').mkdir()
    with pytest.raises(IsADirectoryError, match=r"page\.html' is a folder; name a file"):
        write_whole(tmp_path / 'page.html', 'text')
    assert os.listdir(tmp_path) == ['page.html']
