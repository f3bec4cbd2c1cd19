from mtv_world_ros.documents import number, Table, with_interval

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
