"""Confirmation of contact parameters in a robot cell by how executed plans end, task by task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, log
from typing import Annotated

import numpy as np
from pydantic import Field

from mtv_world_ros.core.config import Number, Schema
from mtv_world_ros.core.data_types import BoolArray
from mtv_world_ros.success.doubts import ChunkEnd, ContactTrust, NEAR_M


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfirmationSettings:
    """Settings of the sequential test that confirms fitted parameters in another robot cell.

    Attributes:
        unforeseen_fraction: probability of an unforeseen end of a rollout if the parameters hold,
            for which the test is fastest.
        other_unforeseen_fraction: least such probability of every single rollout if the parameters
            do not hold: the null hypothesis.
        false_acceptance: largest probability that a task whose every rollout is of the null
            hypothesis is ever confirmed.
        max_unseen_fraction: largest fraction of a task's rollouts whose end was not seen; above it
            the task is not confirmed, as ends that go wrong may be those that are not seen.
    """

    unforeseen_fraction: float = 0.05
    other_unforeseen_fraction: float = 0.3
    false_acceptance: float = 0.05
    max_unseen_fraction: float = 0.2

    @property
    def foreseen_log_ratio(self) -> float:
        """Evidence of a rollout that ended as foreseen: logarithm of a likelihood ratio."""
        return log((1 - self.unforeseen_fraction) / (1 - self.other_unforeseen_fraction))

    @property
    def unforeseen_log_ratio(self) -> float:
        """Evidence of a rollout with an unforeseen end."""
        return log(self.unforeseen_fraction / self.other_unforeseen_fraction)

    @property
    def log_evidence(self) -> float:
        """Log evidence at which a task is confirmed, by Ville's inequality.

        Under the null hypothesis the product of likelihood ratios has a mean of at most 1, however
        many rollouts there are, and so reaches 1 / `false_acceptance` with that probability at
        most.
        """
        return -log(self.false_acceptance)


CONFIRMATION = ConfirmationSettings()
#: error of the number of missing ends: files keep six digits of the evidence
_ROUNDING = 1e-3


Count = Annotated[int, Field(ge=0)]


class TaskEvidence(Schema):
    """Evidence on contact parameters from the executed rollouts of one task.

    Attributes:
        log_evidence: logarithm of the product of likelihood ratios.
        num_foreseen: number of rollouts that ended as foreseen.
        num_unforeseen: number of rollouts with an unforeseen end.
        num_unseen: number of rollouts whose end was not seen: given up, or an object was lost.
    """

    log_evidence: Number = 0.0
    num_foreseen: Count = 0
    num_unforeseen: Count = 0
    num_unseen: Count = 0

    def after(self, is_foreseen: bool | None) -> TaskEvidence:
        """Return the evidence after one more rollout; None = its end was not seen.

        Evidence beyond what confirms is not kept, so that unforeseen ends soon withdraw it.
        """
        if is_foreseen is None:
            return self.model_copy(update={'num_unseen': self.num_unseen + 1})
        ratio = (
            CONFIRMATION.foreseen_log_ratio if is_foreseen else CONFIRMATION.unforeseen_log_ratio
        )
        changed = {
            'log_evidence': min(self.log_evidence + ratio, CONFIRMATION.log_evidence),
            'num_foreseen': self.num_foreseen + is_foreseen,
            'num_unforeseen': self.num_unforeseen + (not is_foreseen),
        }
        return self.model_copy(update=changed)

    @property
    def num_missing(self) -> int:
        """Number of rollouts in a row that must yet end as foreseen."""
        missing = CONFIRMATION.log_evidence - self.log_evidence
        return max(ceil(missing / CONFIRMATION.foreseen_log_ratio - _ROUNDING), 0)

    @property
    def has_too_many_unseen(self) -> bool:
        """True if too many ends were not seen for a confirmation."""
        total = self.num_foreseen + self.num_unforeseen + self.num_unseen
        return self.num_unseen > CONFIRMATION.max_unseen_fraction * total

    @property
    def is_confirmed(self) -> bool:
        """True if the parameters are taken as fitted here for this task."""
        return not self.num_missing and not self.has_too_many_unseen

    @property
    def counts(self) -> str:
        """Counts of foreseen, unforeseen and unseen ends, in words."""
        seen = self.num_foreseen + self.num_unforeseen
        of = seen if not self.num_missing else self.num_foreseen + self.num_missing
        text = f'{self.num_foreseen} of {of} ends as foreseen'
        if self.has_too_many_unseen:
            most = f'{CONFIRMATION.max_unseen_fraction:.0%}'
            total = seen + self.num_unseen
            text += f', {self.num_unseen} of {total} ends were not seen and {most} may be'
        return text

    @property
    def text(self) -> str:
        """The evidence and, of a confirmation, its null hypothesis, in words."""
        if not self.is_confirmed:
            return f'contact of this cell is not confirmed for this task: {self.counts}'
        return (
            f'contact of this cell is confirmed for this task: {self.counts}; if every single '
            'rollout of it ended unforeseen with a probability of '
            f'{CONFIRMATION.other_unforeseen_fraction:.0%} or more, this would ever be said in '
            f'{CONFIRMATION.false_acceptance:.0%} of such cells at most'
        )


@dataclass(slots=True)
class _Followed:
    """The present rollout.

    Attributes:
        number: number of the rollout.
        task: name of its task.
        moved: (O,) objects that moved so far, in a future or in the masks.
        lost: (O,) objects that moved in a chunk whose end does not show where.
        is_whole: whether the end of every chunk so far was compared.
        is_counted: whether it was counted already.
    """

    number: int
    task: str
    moved: BoolArray | None = None
    lost: BoolArray | None = None
    is_whole: bool = True
    is_counted: bool = False


class ContactConfirmation:
    """Sequential test of each task whether contact parameters from elsewhere hold in a robot cell.

    The null hypothesis of a task is that every single one of its rollouts ends where none of its
    futures does with a probability of `other_unforeseen_fraction` or more, whatever happened
    before. Each rollout whose end was seen multiplies the evidence by a likelihood ratio. Rollouts
    that were given up, and those that lost a moving object, do not count as evidence; they are
    counted apart, and too many of them stop a confirmation.

    Attributes:
        tasks: evidence by name of the task.

    Args:
        tasks: evidence of before; default: none.
    """

    def __init__(self, tasks: Mapping[str, TaskEvidence] | None = None) -> None:
        self.tasks = dict(tasks or {})
        self._rollout: _Followed | None = None

    def take(self, end: ChunkEnd, rollout: int, task: str, *, is_last: bool = True) -> None:
        """Add the end of a chunk; a rollout counts once, when it ends or with an unforeseen end.

        Args:
            end: the end of the chunk.
            rollout: number of the rollout.
            task: name of its task.
            is_last: whether the chunk is the last of its rollout.
        """
        followed = self._follow(rollout, task)
        if followed.moved is None or followed.lost is None:
            followed.moved, followed.lost = end.moved.copy(), end.lost.copy()
        elif len(end.moved) == len(followed.moved):
            followed.moved |= end.moved
            followed.lost |= end.lost
        else:  # other objects are looked at from here on
            followed.is_whole = False
        if end.away_m > NEAR_M:
            self._count(followed, is_foreseen=False)
        elif is_last:
            is_seen = followed.is_whole and not (followed.lost | followed.moved & end.hidden).any()
            if followed.moved.any() or not is_seen:
                self._count(followed, is_foreseen=True if is_seen else None)
            followed.is_counted = True  # nothing moved: no evidence

    def miss(self, rollout: int, task: str) -> None:
        """Note a chunk whose end was not seen: frames are missing, or the plan was given up."""
        self._follow(rollout, task).is_whole = False

    def finish(self) -> None:
        """Count the present rollout as ended."""
        if self._rollout is not None:
            self._count(self._rollout, is_foreseen=None)

    def _follow(self, rollout: int, task: str) -> _Followed:
        """Return the rollout; one before it that did not end was given up: it was not seen."""
        if self._rollout is None or (self._rollout.number, self._rollout.task) != (rollout, task):
            self.finish()
            self._rollout = _Followed(rollout, task)
        return self._rollout

    def _count(self, followed: _Followed, *, is_foreseen: bool | None) -> None:
        if followed.is_counted:
            return
        followed.is_counted = True
        before = self.tasks.get(followed.task, TaskEvidence())
        self.tasks[followed.task] = before.after(is_foreseen)

    def trust(self, task: str) -> ContactTrust:
        """Return whether the parameters are taken as fitted here, for a task.

        Args:
            task: name of the task.
        """
        evidence = self.tasks.get(task, TaskEvidence())
        return ContactTrust(is_confirmed=evidence.is_confirmed, text=evidence.text)

    @property
    def text(self) -> str:
        """Evidence on all tasks, in words."""
        if not self.tasks:
            return 'contact of this cell is not confirmed for any task: no end was seen yet'
        words = {True: 'confirmed', False: 'not confirmed'}
        found = [
            f'{words[evidence.is_confirmed]} for {name} ({evidence.counts})'
            for name, evidence in self.tasks.items()
        ]
        return f'contact of this cell is {"; ".join(found)}'

    @property
    def is_complete(self) -> bool:
        """True if every task that was tried is confirmed."""
        return bool(self.tasks) and all(one.is_confirmed for one in self.tasks.values())


def seen_end(away_m: float) -> ChunkEnd:
    """Return the end of a chunk with one object, for evidence that is a distance alone.

    Args:
        away_m: distance from the nearest future [m]; NaN = nothing moved.
    """
    moved = np.array([np.isfinite(away_m)])
    nothing = np.zeros(1, np.bool_)
    return ChunkEnd(away_m=away_m, moved=moved, lost=nothing, hidden=nothing)
