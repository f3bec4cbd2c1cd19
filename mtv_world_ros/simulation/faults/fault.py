"""A fault kind: a function from a plan to a plan, with its name and its sizes.

A fault changes the way points of one move, sends a second arm on a visit during that move, or
changes the commands of the whole plan. What it draws comes from the generator of the plan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from inspect import getdoc
from typing import Any, Literal

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.commands import CommandChange, order_of
from mtv_world_ros.simulation.faults.move_plan import MovePlan, shortened
from mtv_world_ros.simulation.way_points import FLAT, Visit, WayPoint

#: parts that a robot must have for a fault
Needs = Literal['gripper', 'two_arms']
GRIPPER: tuple[Needs, ...] = ('gripper',)
TWO_ARMS: tuple[Needs, ...] = ('two_arms',)
GRIPPERS_OF_TWO: tuple[Needs, ...] = ('gripper', 'two_arms')
#: of a move's way points, by the size
MoveFault = Callable[[MovePlan, float], MovePlan]


@dataclass(frozen=True, slots=True)
class FaultSize:
    """Sizes of a fault.

    Attributes:
        typical: size at which success and failure are about as frequent.
        largest: largest size of a policy.
        ranked: sizes in the rankings of the kind's split.
        unit: unit of all sizes; empty = a share or a number.
        none: size that means no fault.
    """

    typical: float
    largest: float
    ranked: tuple[float, ...] = ()
    unit: str = ''
    none: float = 0.0


@dataclass(frozen=True, slots=True)
class OtherArm:
    """A second arm at rest while the first one moves.

    Attributes:
        home: way point at which it rests.
        times: times of the first arm's segments, before scaling [s].
    """

    home: WayPoint
    times: Sequence[float]

    def until(self, number: int) -> float:
        """Return the time until the first arm has done a number of way points [s]."""
        return sum(self.times[:number])

    def towards(self, place: FloatArray, share: float) -> WayPoint:
        """Return the way point at a share of the way to a place (3,) [m]."""
        return self._at(self.home.position + share * (place - self.home.position))

    def above(self, place: FloatArray, share: float) -> WayPoint:
        """Return the way point at the height of a place, a share of the way there in the plane."""
        return self._at(place + (1 - share) * (self.home.position - place) * FLAT)

    def homewards(self, there: WayPoint, size: float) -> FloatArray:
        """Return the way (3,) of length `size` towards its rest; shorter close to that [m]."""
        return size * shortened((self.home.position - there.position) * FLAT, size)

    def _at(self, position: FloatArray) -> WayPoint:
        return replace(self.home, phase='above', position=position)


#: the visit of a second arm during a move, by the size
VisitFault = Callable[[MovePlan, float, OtherArm], Visit]


@dataclass(frozen=True, kw_only=True)
class FaultKind:
    """One way in which a policy fails.

    Attributes:
        alias: another name, which earlier recordings have; empty for a kind without one.
        family: group of kinds, e.g. `timing` or `release`.
        split: `train`, `calibrate` or `test`.
        size: typical, largest and ranked sizes of the fault.
        text: meaning of the size, in words.
        contact: whether its failures are failures of contact, which do not show in the arm's path
            alone.
        needs: parts that a robot must have for it.
        keeps_tempo: added way points take time of their own; else they share the move's.
        way_points: changes the way points of a move.
        second_arm: gives the visit of another arm during the move.
        commands: changes the commands of the whole plan.
        order: place of its change of commands among those of a policy with several faults.
        scale: factor of the size for its change of commands.
    """

    alias: str = ''
    family: str
    split: Literal['train', 'calibrate', 'test']
    size: FaultSize
    text: str
    contact: bool = True
    needs: tuple[Needs, ...] = ()
    keeps_tempo: bool = False
    way_points: MoveFault | None = None
    second_arm: VisitFault | None = None
    commands: CommandChange | None = None
    order: int = 0
    scale: float = 1.0


class Family:
    """Fault kinds of a family, in the order in which they are entered.

    A function of way points, or of a second arm, is entered by a decorator, under its own name;
    its docstring says what the size means. Options are fields of `FaultKind`.

    Attributes:
        kinds: the kinds by name.
    """

    def __init__(self, name: str, split: str = 'train') -> None:
        self.kinds: dict[str, FaultKind] = {}
        self._defaults: dict[str, Any] = {'family': name, 'split': split}

    def way_points(
        self, alias: str, size: FaultSize, **options: Any
    ) -> Callable[[MoveFault], MoveFault]:
        """Return the decorator that enters a change of a move's way points."""

        def entered(change: MoveFault) -> MoveFault:
            given = {'text': _text_of(change), 'way_points': change, **options}
            self.enter(change.__name__, alias, size, **given)
            return change

        return entered

    def second_arm(
        self, alias: str, size: FaultSize, **options: Any
    ) -> Callable[[VisitFault], VisitFault]:
        """Return the decorator that enters a visit of another arm."""

        def entered(visit: VisitFault) -> VisitFault:
            given = {'text': _text_of(visit), 'second_arm': visit, **options}
            self.enter(visit.__name__, alias, size, **given)
            return visit

        return entered

    def commands(
        self,
        name: str,
        alias: str,
        size: FaultSize,
        change: CommandChange,
        text: str,
        **options: Any,
    ) -> None:
        """Enter a change of commands, one of `faults/commands.py` with its options."""
        given = {'text': text, 'commands': change, 'order': order_of(change), **options}
        self.enter(name, alias, size, **given)

    def enter(self, name: str, alias: str, size: FaultSize, **options: Any) -> None:
        """Enter a kind; without a function, `ScriptedPolicy` itself carries it out."""
        self.kinds[name] = FaultKind(alias=alias, size=size, **{**self._defaults, **options})


def _text_of(function: Callable[..., Any]) -> str:
    text = ' '.join((getdoc(function) or '').split())
    return text[0].lower() + text[1:].removesuffix('.')
