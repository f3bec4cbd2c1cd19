"""How far an estimate is to be trusted: fitted here, not fitted here, or cannot tell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import nan

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, SuccessEstimate
from mtv_world_ros.core.estimate_words import (
    BECAUSE,
    cannot_tell,
    FITTED_HERE,
    is_trust,
    NOT_FITTED_HERE,
    without_state,
)

#: largest difference of an object's mean extent from its usual one [fraction]
_SIZE_TOLERANCE = 0.1
_FIT_CONTACT = 'run mtv-world fit contact on recordings of this robot cell'
#: sentence about a robot cell in which contact was not fitted, without an estimate
OTHER_CELL = (
    f'{NOT_FITTED_HERE}: contact was fitted in another robot cell, so futures are drawn from a '
    f'wide prior ({_FIT_CONTACT})'
)


def fitted_here(text: str) -> str:
    """Return the sentence for an estimate with weights of a fit that holds here."""
    return f'{FITTED_HERE}: {text}'


def not_fitted_here(why: str) -> str:
    """Return the sentence for an estimate whose numbers were not fitted here."""
    return f'{NOT_FITTED_HERE}: {why}'


def with_trust(reasons: Iterable[str], sentence: str) -> tuple[str, ...]:
    """Return reasons with another sentence about the trust, which stands last."""
    return (*(reason for reason in reasons if not is_trust(reason)), sentence)


def with_notes(estimate: SuccessEstimate, notes: Iterable[str]) -> SuccessEstimate:
    """Return an estimate with more remarks, one line each; the sentence about trust stays last."""
    notes, reasons = tuple(notes), estimate.reasons
    if not notes:
        return estimate
    if not reasons or not is_trust(reasons[-1]) or reasons[-1].startswith(BECAUSE):
        return replace(estimate, reasons=(*reasons, *notes))
    return replace(estimate, reasons=(*reasons[:-1], *notes, reasons[-1]))


def without_verdict(estimate: SuccessEstimate, why: str) -> SuccessEstimate:
    """Return an estimate that cannot tell.

    Args:
        estimate: estimate without this doubt.
        why: reason why there is no verdict; empty = there may be one.
    """
    if not why:
        return estimate
    known = (without_state(reason) for reason in estimate.reasons)
    reasons = (cannot_tell(why), *(reason for reason in known if not is_trust(reason)))
    return replace(estimate, probability=nan, interval=(nan, nan), reasons=reasons)


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherCell:
    """Robot cell in which contact was not fitted.

    Attributes:
        here: name of the robot cell; empty = not stated.
        fitted: name of the robot cell of the fit; empty = there is none.
        doubt: reason why contact parameters hold in no robot cell; empty = they hold in one.
        sizes: how the objects' sizes differ from usual ones; empty = they do not.
    """

    here: str = ''
    fitted: str = ''
    doubt: str = ''
    sizes: str = ''

    def sentence(self, difference: str | None) -> str:
        """Return the sentence about an estimate in this robot cell.

        Args:
            difference: how robot, objects or cameras differ from those of the fit; empty = they
                are those of the fit, None = there is no fit to compare with.
        """
        prior = 'so futures are drawn from a wide prior'
        if self.doubt or not self.fitted:
            why = self.doubt or 'contact was fitted in another robot cell'
            return not_fitted_here(f'{why}, {prior} ({_FIT_CONTACT})')
        if self.here:
            return not_fitted_here(
                f"contact was fitted in '{self.fitted}', not in '{self.here}', {prior} "
                f'({_FIT_CONTACT})'
            )
        if difference == '':
            return not_fitted_here(
                'the place is not stated; robot, objects and cameras are those of a fit in '
                f"'{self.fitted}', {prior} (state the place if it is that one, else "
                f'{_FIT_CONTACT})'
            )
        other = f', the estimate was {difference}' if difference else ''
        return not_fitted_here(
            f"the place is not stated, and contact was fitted in '{self.fitted}'{other}, {prior} "
            f'({_FIT_CONTACT})'
        )


def odd_sizes(
    sizes: FloatArray, items: Mapping[str, int], usual: Mapping[str, tuple[float, float, float]]
) -> str:
    """Return which object is larger or smaller than usual; empty = none whose size is known.

    Args:
        sizes: (K, O, 3) extents in each future [m].
        items: placeholder -> index of its object.
        usual: placeholder -> its usual extents [m]; a task need not state one.
    """
    for role, item in items.items():
        if role not in usual:
            continue
        found = np.exp(np.log(np.maximum(np.median(sizes[:, item], axis=0), 1e-6)).mean())
        ratio = float(found / np.exp(np.log(usual[role]).mean()))
        if not abs(ratio - 1) <= _SIZE_TOLERANCE:  # NaN is not known
            return f'fitted with another size of {{{role}}} ({ratio:.2f} of the usual one here)'
    return ''
