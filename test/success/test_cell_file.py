"""Evidence of a robot cell survives restarts; damaged and foreign files are named."""

import errno
import json
import os
from threading import Thread

import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.success.cell_file import CellFile
from mtv_world_ros.success.confirmation import ContactConfirmation, seen_end


def cell(folder, **more):
    return CellFile(**{'place': 'cell 3', 'robot': 'arm', 'fit': 'f1', 'folder': folder, **more})


def filled(number=4):
    found = ContactConfirmation()
    for rollout in range(number):
        found.take(seen_end(0.0), rollout, 'stack')
    return found


def test_evidence_goes_on_over_restarts(tmp_path):
    file = cell(tmp_path)
    assert file.load()[0].tasks == {}
    file.store(filled())
    found, remark = file.load()
    assert remark == '' and found.trust('stack').text.endswith('4 of 10 ends as foreseen')
    for rollout in range(6):
        found.take(seen_end(0.0), rollout, 'stack')
    assert found.trust('stack').is_confirmed
    file.store(found)
    assert file.load()[0].trust('stack').is_confirmed


def test_two_nodes_of_a_cell_share_its_evidence(tmp_path):
    """Each adds ends to what the other wrote meanwhile; none is lost."""
    file = cell(tmp_path)
    nodes = [file.load()[0], file.load()[0]]

    def follow(node):
        for rollout in range(25):
            file.update(node, lambda found, r=rollout: found.take(seen_end(0.0), r, 'stack'))

    threads = [Thread(target=follow, args=(node,)) for node in nodes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert file.load()[0].tasks['stack'].num_foreseen == 50


def test_a_file_system_without_locks_keeps_the_evidence(tmp_path, monkeypatch):
    def no_locks(descriptor, what):
        raise OSError(errno.ENOLCK, 'no locks available')

    monkeypatch.setattr('fcntl.flock', no_locks)
    file, found = cell(tmp_path), ContactConfirmation()
    file.update(found, lambda c: c.take(seen_end(0.0), 0, 'stack'))
    assert file.load()[0].tasks['stack'].num_foreseen == 1


def test_evidence_is_changed_in_memory_where_it_cannot_be_written(tmp_path):
    tmp_path.joinpath('folder').write_text('a file')
    found = ContactConfirmation()
    with pytest.raises(OSError):
        cell(tmp_path / 'folder').update(found, lambda c: c.take(seen_end(0.0), 0, 'stack'))
    assert found.tasks['stack'].num_foreseen == 1


@pytest.mark.parametrize(
    'content', [b'{"place": "cell', b'', b'\xff\xfe', b'[1]', b'{"place": 3}', b'{}', b'null']
)
def test_a_damaged_file_is_kept_and_named_and_the_evidence_begins_anew(tmp_path, content):
    file = cell(tmp_path)
    for number in (1, 2):
        file.path.parent.mkdir(parents=True, exist_ok=True)
        file.path.write_bytes(content)
        found, remark = file.load()
        assert found.tasks == {} and not file.path.exists()
        aside = file.path.with_suffix(f'.damaged{number}')
        assert aside.read_bytes() == content
        assert str(file.path) in remark and aside.name in remark and "'cell 3'" in remark
    assert file.load()[1] == ''


@pytest.mark.parametrize(('what', 'other'), [('place', 'b'), ('robot', 'b'), ('fit', 'b')])
def test_evidence_of_another_cell_robot_or_fit_is_refused_by_name(tmp_path, what, other):
    file = cell(tmp_path)
    file.store(filled())
    elsewhere = cell(tmp_path, **{what: other})
    # usually it has a file of its own
    assert elsewhere.path != file.path and elsewhere.load()[0].tasks == {}
    os.rename(file.path, elsewhere.path)
    with pytest.raises(ConfigError, match=f"evidence on the {what} '.*', and this is 'b'"):
        elsewhere.load()
    assert json.loads(elsewhere.path.read_text())[what] != 'b'


def test_names_of_cells_make_plain_file_names(tmp_path):
    names = [cell(tmp_path, place=p).path for p in ('../x', 'a/b', 'a_b', '..', 'ü' * 300, 'x\n')]
    assert len(set(names)) == len(names)
    assert all(path.parent == tmp_path and len(path.name) < 90 for path in names)


def test_the_file_lies_in_ros_home_and_an_unknown_cell_has_none(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    found = CellFile.at_home(place='cell 3', robot='arm', fit='f1')
    assert found.path.parent == tmp_path / 'mtv_world' / 'cells'
    assert CellFile.at_home(place='', robot='arm', fit='f1') is None
    assert CellFile.at_home(place='cell 3', robot='arm', fit='') is None


def test_a_file_that_cannot_be_read_or_written_is_named(tmp_path):
    file = cell(tmp_path)
    file.path.mkdir()
    with pytest.raises(ConfigError, match='cannot be read'):
        file.load()
    with pytest.raises(OSError):
        file.store(filled())
