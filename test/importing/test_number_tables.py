"""Tables as spreadsheet programs and other tools write them."""

import codecs
import json

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.importing.number_tables import read_table

NUMBERS = np.array([[0.0, -0.5, 1.25], [0.1, 2e-5, 1.5], [0.2, 0.75, -1200.125]])
HEAD = ('t', 'q1', 'grip')


def text(separator=',', mark='.', end='\n', head=HEAD, number=str):
    rows = [head, *([number(value).replace('.', mark) for value in row] for row in NUMBERS)]
    return end.join(separator.join(row) for row in rows) + end


@pytest.mark.parametrize(
    ('data', 'said'),
    [
        (text().encode(), ''),
        (codecs.BOM_UTF8 + text().encode(), ''),
        (text(end='\r\n').encode(), ''),
        (codecs.BOM_UTF16_LE + text('\t').encode('utf-16-le'), 'separated by a tab'),
        (text(';').encode(), 'columns are separated by a semicolon'),
        (text(';', ',').encode(), 'a semicolon and numbers have a decimal comma'),
        (text('\t', ',').encode(), 'a tab and numbers have a decimal comma'),
        (codecs.BOM_UTF8 + b'sep=;\r\n' + text(';', ',', '\r\n').encode(), 'decimal comma'),
        (text(number=lambda value: f'"{value}"').replace('.', ',').encode(), 'decimal comma'),
        (text(head=('# t', ' q1 ', ' grip')).encode(), ''),
        (text(end=',\n').encode(), ''),
        (text(end=';\n', separator=';').encode() + b'\n\n;;;\n', 'semicolon'),
        (text().replace('-', '\N{MINUS SIGN}').encode(), ''),
    ],
    ids=['plain', 'mark', 'windows', 'utf16_tabs', 'semicolons', 'german', 'tabs', 'excel',
         'quoted_commas', 'hash', 'trailing_comma', 'empty_lines', 'minus_sign'],
)  # fmt: skip
def test_a_table_is_read_however_it_was_written_and_what_is_unusual_is_said(tmp_path, data, said):
    (tmp_path / 'a.csv').write_bytes(data)
    table = read_table(tmp_path / 'a.csv', [''])
    np.testing.assert_allclose(table.values, NUMBERS)
    assert table.names == HEAD
    np.testing.assert_allclose(table.keys['grip'], NUMBERS[:, 2])
    assert len(table.notes) == bool(said) and said in ''.join(table.notes)


@pytest.mark.parametrize(
    ('content', 'said'),
    [
        (text(mark=','), 'cells and the head 3, separated by a comma. If numbers have a decimal'),
        (text().replace('0.75', '0.75,1'), 'line 4 has 4 cells and the head 3'),
        ('t,q1\n', 'has 0 rows'),
        ('', 'is empty'),
    ],
    ids=['commas_everywhere', 'more_cells', 'no_rows', 'empty'],
)
def test_a_table_that_cannot_be_read_is_named(tmp_path, content, said):
    (tmp_path / 'a.csv').write_text(content)
    with pytest.raises(EpisodeError, match=said):
        read_table(tmp_path / 'a.csv', [''])


@pytest.mark.parametrize('cell', ['n/a', '', 'nan', '1.200,125', '12:30:01'])
def test_a_cell_that_is_no_number_matters_only_where_its_column_is_used(tmp_path, cell):
    (tmp_path / 'a.csv').write_text(text(';').replace('-1200.125', cell))
    table = read_table(tmp_path / 'a.csv', [''])
    table.check_numbers([0, 1])
    np.testing.assert_allclose(table.values[:, :2], NUMBERS[:, :2])
    with pytest.raises(EpisodeError, match=f"row 3 of column 'grip' is '{cell}'"):
        table.check_numbers([0, 2])


def test_a_json_file_has_a_byte_order_mark_and_columns_under_several_keys(tmp_path):
    rows = {'arm': [[0.1, 0.2], [0.3, 0.4]], 'gripper': [5, 6], 'text': 'lift it'}
    (tmp_path / 'a.json').write_bytes(codecs.BOM_UTF8 + json.dumps(rows).encode())
    table = read_table(tmp_path / 'a.json', ['arm', 'gripper'])
    np.testing.assert_allclose(table.values, [[0.1, 0.2, 5], [0.3, 0.4, 6]])
    assert table.keys['text'] == 'lift it' and table.names == ()
    with pytest.raises(EpisodeError, match=r"has no 'griper' \(did you mean 'gripper'"):
        read_table(tmp_path / 'a.json', ['arm', 'griper'])
    (tmp_path / 'b.json').write_text(json.dumps({**rows, 'gripper': [5, 6, 7]}))
    with pytest.raises(EpisodeError, match="rows by key are {'arm': 2, 'gripper': 3}"):
        read_table(tmp_path / 'b.json', ['arm', 'gripper'])
    (tmp_path / 'c.json').write_text('[1, 2]')
    with pytest.raises(EpisodeError, match='it holds a list, must be keys with lists'):
        read_table(tmp_path / 'c.json', ['arm'])


def test_columns_of_one_name_matter_only_where_they_are_used(tmp_path):
    (tmp_path / 'a.csv').write_text(text(head=('note', 'q1', 'note')))
    table = read_table(tmp_path / 'a.csv', [''])
    table.check_numbers([1])
    with pytest.raises(EpisodeError, match="several columns 'note'"):
        table.check_numbers([1, 2])


def test_windows_text_is_read_and_a_spreadsheet_is_named(tmp_path):
    head = ('t', 'q1 [\N{DEGREE SIGN}]', 'Greifer \N{LATIN CAPITAL LETTER O WITH DIAERESIS}ffnung')
    (tmp_path / 'a.csv').write_bytes(text(';', ',', head=head).encode('cp1252'))
    table = read_table(tmp_path / 'a.csv', [''])
    assert table.names == head and 'its text is in Windows-1252 and columns' in table.notes[0]
    np.testing.assert_allclose(table.values, NUMBERS)
    (tmp_path / 'a.xlsx').write_bytes(b'PK\x03\x04' + bytes(range(256)))
    with pytest.raises(EpisodeError, match='export the spreadsheet as CSV'):
        read_table(tmp_path / 'a.xlsx', [''])
