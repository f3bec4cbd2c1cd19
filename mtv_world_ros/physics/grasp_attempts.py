"""Attempts to grasp in a foreseen plan: how sure is each that an object goes along?

A plan of half a minute may close its grippers several times. Each attempt is judged as it ends,
by the futures in which an object goes along with the tool meanwhile.

K futures, N steps, O objects, A arms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.vision.held_objects import attempts

#: shortest way of a tool on which an object shows that it goes along [m]
_MIN_TRAVEL_M = 0.03
#: largest distance of an object from where the tool would carry it [fraction of the tool's way]
_ALONG = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenAttempt:
    """A gripper that closes and opens again, or is closed at the end of what was foreseen.

    Attributes:
        arm: index of the tool.
        closed_s: time at which it has closed, since the objects were found [s].
        opened_s: time at which it opens; None = it has not.
        name: object that goes along in most futures.
        share: weighted share of the futures in which it does.
    """

    arm: int
    closed_s: float
    opened_s: float | None
    name: str
    share: float


def foreseen_attempts(motions: ForeseenMotions) -> tuple[ForeseenAttempt, ...]:
    """Return the attempts in which the tool moves far enough to tell, in order of time.

    Args:
        motions: foreseen motions since the objects were found; there are no attempts where the
            simulation of every future was lost.
    """
    if motions.tools is None or not motions.names or not motions.weights.any():
        return ()
    found, weights = [], motions.weights / motions.weights.sum()
    for arm, way in enumerate(motions.tools):
        for closed, opened in attempts(motions.openings[motions.shown, arm]):
            lengths = np.linalg.norm(way[closed:opened] - way[closed], axis=-1)
            last = closed + int(lengths.argmax())
            if lengths.max() < _MIN_TRAVEL_M:
                continue
            ways = motions.points[:, last] - motions.points[:, closed]
            off = np.linalg.norm(ways - (way[last] - way[closed]), axis=-1)
            goes = np.nan_to_num(off, nan=np.inf) < _ALONG * lengths.max()
            shares = weights @ goes
            item = int(np.argmax(shares))
            found.append(
                ForeseenAttempt(
                    arm=arm,
                    closed_s=closed * motions.step_s,
                    opened_s=None if opened >= way.shape[0] else opened * motions.step_s,
                    name=motions.names[item],
                    share=float(shares[item]),
                )
            )
    return tuple(sorted(found, key=lambda attempt: attempt.closed_s))


def attempts_line(found: Sequence[ForeseenAttempt]) -> str:
    """Return how many attempts a plan chains, and how sure each is; empty for one or none."""
    if len(found) < 2:
        return ''
    each = [
        f"at {one.closed_s:.1f} s '{one.name}' goes along in {one.share:.0%} of the futures"
        + ('' if one.opened_s is None else f', until {one.opened_s:.1f} s')
        for one in found
    ]
    return f'{len(found)} attempts to grasp in a row: {"; ".join(each)}'
