"""Drop-downs that hide the cards of a page which they do not fit, without a script."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """Drop-down filter; its style rules hide cards without the class of the selected option.

    Attributes:
        key: part of its id and of the classes; letters only.
        label: heading of the filter.
        options: choices in addition to `all`.
        within: another filter; its selected option limits the cards that this filter compares.
    """

    key: str
    label: str
    options: tuple[str, ...]
    within: Filter | None = None

    def classes(self, *values: str, of: str = '') -> str:
        """Return the classes of a card to which options apply; other values are left out.

        `of` is the option of `within` for which they do; empty = for `all` of it.
        """
        return ' '.join(self._class(value, of) for value in values if value in self.options)

    def _class(self, value: str, of: str) -> str:
        where = '' if self.within is None or not of else f'{self.within.options.index(of)}-'
        return f'{self.key}-{where}{self.options.index(value)}'

    def rules(self) -> Markup:
        """Return the style rules."""
        outer = ('', *self.within.options) if self.within else ('',)
        lines = [
            f'main:has({self._chosen(value)}){self._outer(of)} '
            f'.card:not(.{self._class(value, of)}) {{ display: none; }}'
            for of in outer
            for value in self.options
        ]
        return Markup('\n'.join(lines))

    def _chosen(self, value: str) -> str:
        number = self.options.index(value) if value else 'all'
        return f'#{self.key} option[value="{number}"]:checked'

    def _outer(self, of: str) -> str:
        return f':has({self.within._chosen(of)})' if self.within else ''


def filters(*found: Filter) -> Sequence[Filter]:
    """Return those that have a choice."""
    return [one for one in found if len(one.options) > 1]
