"""Texts of the errors on names that are not known."""

from __future__ import annotations

import pytest

from mtv_world_ros.core.errors import ConfigError, UnknownNameError

KNOWN = ('alpha', 'beta', 'gamma')


@pytest.mark.parametrize(
    ('what', 'name', 'text', 'shown'),
    [
        (
            'kind',
            'alpa',
            {},
            "kind 'alpa' is not one of alpha, beta, gamma (did you mean 'alpha'?)",
        ),
        ('kind', 'x', {}, "kind 'x' is not one of alpha, beta, gamma"),
        (
            'no task',
            'alpa',
            {'listed': '; known are', 'advice': ' (config/tasks)'},
            "no task 'alpa' (did you mean 'alpha'?); known are alpha, beta, gamma (config/tasks)",
        ),
        (
            '',
            'alpa',
            {'is_not': ' is no arm', 'listed': '; arms are', 'most': 2},
            "'alpa' is no arm (did you mean 'alpha'?); arms are alpha, beta, ...",
        ),
        ('no link is', 'alpa', {'most': 0}, "no link is 'alpa' (did you mean 'alpha'?)"),
        ('size', 3, {'listed': '; valid are'}, 'size 3; valid are alpha, beta, gamma'),
    ],
)
def test_a_name_that_is_not_known_is_shown_with_those_that_are(what, name, text, shown):
    error = ConfigError.unknown(what, name, KNOWN, **text)
    assert type(error) is ConfigError and str(error) == shown
    assert str(UnknownNameError(what, name, KNOWN, **text)) == shown


def test_where_nothing_is_valid_none_is_listed():
    assert str(UnknownNameError('it has no', 'x', [], listed='; it has')).endswith('it has none')
