"""Texts from outside are cut and escaped before they are shown."""

import pytest

from mtv_world_ros.core.documents import Table
from mtv_world_ros.core.errors import masked, MtvWorldError, PolicyError
from mtv_world_ros.core.shown_text import markdown_cell, MOST_CHARACTERS, MOST_OF_ERROR, shown
from mtv_world_ros.policies.server_mapping import find


def test_control_characters_are_shown_as_escapes():
    assert shown('a\x1b[31m\r\n\x00b\u202e') == 'a\\x1b[31m\\r\\n\\x00b\\u202e'
    assert shown('grün \udcff', kept='\n') == 'grün \\udcff'


@pytest.mark.parametrize('length', [MOST_CHARACTERS, MOST_CHARACTERS + 1, 50_000_000])
def test_long_texts_are_cut_and_say_by_how_much(length):
    text = shown('x' * length)
    assert len(text) < MOST_CHARACTERS + 50
    assert text.endswith(f' ... ({length - MOST_CHARACTERS} more characters)') == (
        length > MOST_CHARACTERS
    )


def test_every_error_of_a_user_is_cut_and_escaped_but_keeps_its_lines():
    error = MtvWorldError('first\nsecond\x1b]0;title\x07' + 'x' * 50_000_000)
    assert str(error).startswith('first\nsecond\\x1b]0;title\\x07xxx')
    assert len(str(error)) < MOST_OF_ERROR + 100


def test_a_key_is_masked_before_a_text_is_cut():
    text = 'x' * (MOST_CHARACTERS - 3) + 'secret-key'
    assert 'sec' not in masked(text, 'secret-key')


def test_an_answer_of_many_keys_is_not_listed_whole():
    answer = {f'\x1b{at}' * 100: 0 for at in range(100_000)}
    with pytest.raises(PolicyError) as error:
        find(answer, ('actions',))
    assert len(str(error.value)) < 3_000 and '\x1b' not in str(error.value)


def test_labels_in_tables_are_no_html_and_no_cells():
    label = '<img src=x onerror=alert(1)>|a\nb'
    assert markdown_cell(label) == '&lt;img src=x onerror=alert(1)>\\|a b'
    text = Table(head=['label', 'J'], rows=[[label, '1']]).text()
    assert '<img' not in text and len(text.splitlines()) == 3
