from mtv_world_ros.core.documents import number, Table, with_interval

NAN = float('nan')


def test_columns_are_as_wide_as_their_widest_cell():
    table = Table(head=['a', 'long head'], rows=[['wide cell', 1], ['x', 2]])
    assert table.markdown() == (
        '| a         | long head |\n| --------- | --------- |\n'
        '| wide cell | 1         |\n| x         | 2         |'
    )


def test_what_is_not_known_is_a_dash_and_has_no_brackets():
    assert number(None) == number(NAN) == with_interval(NAN, (0.0, 1.0)) == '–'
    assert with_interval(0.5, (NAN, NAN)) == with_interval(0.5, None) == '0.500'
    assert with_interval(0.5, (0.25, 1.0), 2) == '0.50 [0.25, 1.00]'


def test_a_wide_table_is_broken_into_parts_that_fit_a_console():
    head = ['view', *(f'column {k}' for k in range(12))]
    table = Table(head=head, rows=[['low', *['0.123 [0.1, 0.2]'] * 12], ['high', *['–'] * 12]])
    text = table.text()
    assert max(map(len, text.splitlines())) <= 100
    parts = text.split('\n\n')
    assert len(parts) == 3
    assert all(part.startswith('| view |') and '| high |' in part for part in parts)
    heads = [cell.strip() for part in parts for cell in part.splitlines()[0].split('|')[2:-1]]
    assert heads == head[1:]


def test_a_column_without_a_value_is_left_out():
    rows = [['low', '1', '–', ''], ['high', '–', '–', '']]
    (part,) = Table(head=['view', 'J', 'FID', 'FVD'], rows=rows).narrow()
    assert part.head == ['view', 'J'] and [tuple(row) for row in part.rows] == [
        ('low', '1'), ('high', '–')
    ]  # fmt: skip
    assert len(Table(head=['view', 'FID'], rows=[['low', '–']]).narrow()) == 1
