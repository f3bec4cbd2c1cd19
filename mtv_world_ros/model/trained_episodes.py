"""Episodes that a checkpoint was trained on, by the digests of their motion."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

#: key of `trained_on` in the card: digests of the episodes
DIGESTS = 'digests'
#: key of `trained_on` in the card: false if earlier weights do not name their episodes
IS_COMPLETE = 'digests_complete'


@dataclass(frozen=True, slots=True)
class TrainedEpisodes:
    """Digests of the episodes that weights were trained on.

    Attributes:
        digests: `Recording.digest` of each.
        is_complete: False if other episodes may have been trained on, too, because a checkpoint
            of an earlier version, or weights to start from, do not name theirs.
    """

    digests: frozenset[str] = frozenset()
    is_complete: bool = False

    @classmethod
    def of_card(cls, trained_on: Mapping[str, Any]) -> Self:
        """Read the entry `trained_on` of a checkpoint's card."""
        digests = trained_on.get(DIGESTS)
        if not isinstance(digests, list) or not digests:
            return cls()
        return cls(frozenset(map(str, digests)), trained_on.get(IS_COMPLETE) is True)

    def __or__(self, other: TrainedEpisodes) -> TrainedEpisodes:
        """Return the episodes of both trainings."""
        return TrainedEpisodes(
            self.digests | other.digests, self.is_complete and other.is_complete
        )

    def as_card(self) -> dict[str, Any]:
        """Return the keys of `trained_on` in the card."""
        return {DIGESTS: sorted(self.digests), IS_COMPLETE: self.is_complete}

    def holds(self, digest: str) -> bool | None:
        """Return whether an episode was trained on; None = not known."""
        if digest and digest in self.digests:
            return True
        return False if digest and self.is_complete else None

    def sentence(self, digests: Sequence[str]) -> str:
        """Return how many episodes of some were trained on.

        Args:
            digests: `Recording.digest` of each episode that is scored.
        """
        found = [self.holds(digest) for digest in digests]
        seen, unknown, count = found.count(True), found.count(None), len(found)
        if not self.digests or (unknown == count and not self._are_known(digests)):
            return (
                f'not known whether it was trained on any of these {count}: '
                f'{self._reason(digests)}'
            )
        said = (
            f'trained on {seen} of these {count}' if seen else f'trained on none of these {count}'
        )
        return f'{said}; {self._reason(digests)}' if unknown else said

    @staticmethod
    def _are_known(digests: Collection[str]) -> bool:
        return any(digests)

    def _reason(self, digests: Collection[str]) -> str:
        """Return why it is not known of some episodes whether they were trained on."""
        if not all(digests):
            return 'results of an earlier version do not hold what an episode is known by'
        if not self.digests:
            return 'the checkpoint does not name its episodes'
        return 'the weights that it began with do not name theirs'
