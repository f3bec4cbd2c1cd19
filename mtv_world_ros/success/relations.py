"""Relations between objects that a task may ask for, and by how much each of them holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.success.pictured import AsPictured, InRegion
from mtv_world_ros.success.situation import Goal, Margin, Situation


@dataclass(frozen=True, slots=True, kw_only=True)
class Beside:
    """The subject stands on the table to the left (-x) or right (+x) of the target.

    Attributes:
        kind: `left_of` or `right_of`.
        subject: placeholder of the object that moves.
        target: placeholder of the object it is placed by.
        distance_m: smallest and largest distance of the centres in the table plane.
        max_across_m: largest |dy|.
        max_rise_m: largest |dz|.
        goal_distance_m: dx at which the goal mask is drawn.
    """

    kind: str
    subject: str
    target: str
    distance_m: tuple[float, float] = (0.08, 0.20)
    max_across_m: float = 0.05
    max_rise_m: float = 0.03
    goal_distance_m: float = 0.13

    def goal(self, at: Situation) -> Goal | None:
        """Returns where the subject's centre should be (3,) [m]."""
        way = np.array([self._side() * self.goal_distance_m, 0.0, 0.0])
        return self.subject, at.end(self.target) + way

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds."""
        dx, dy, dz = (at.end(self.subject) - at.end(self.target)).tolist()
        distance = float(np.hypot(dx, dy))
        return [
            Margin('far enough', distance - self.distance_m[0]),
            Margin('near enough', self.distance_m[1] - distance),
            Margin('on the right side', self._side() * dx),
            Margin('in line', self.max_across_m - abs(dy)),
            Margin('on the table', self.max_rise_m - abs(dz)),
        ]

    def _side(self) -> float:
        return -1.0 if self.kind == 'left_of' else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OnTop:
    """The subject stands on the target, both blocks.

    Attributes:
        kind: `on_top_of` (plain `on` is a truth value in YAML).
        subject: placeholder of the object that moves.
        target: placeholder of the object below.
        max_offset_m: largest |dx|, |dy|, |dz| from the place right above the target.
    """

    kind: str
    subject: str
    target: str
    max_offset_m: tuple[float, float, float] = (0.025, 0.025, 0.012)

    def goal(self, at: Situation) -> Goal | None:
        """Returns where the subject's centre should be (3,) [m]."""
        rise = np.array([0.0, 0.0, at.stack_height(self.subject, self.target)])
        return self.subject, at.end(self.target) + rise

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds."""
        goal = self.goal(at)
        assert goal is not None
        room = np.asarray(self.max_offset_m) - np.abs(at.end(self.subject) - goal[1])
        names = ('over it in x', 'over it in y', 'at its top')
        return [Margin(name, value) for name, value in zip(names, room.tolist(), strict=True)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Within:
    """The subject is in or on the target, near its middle: a basket, a tray, a plate.

    Attributes:
        kind: `within`.
        subject: placeholder of the object that moves.
        target: placeholder of what it is put into or onto.
        max_distance_m: largest distance of the centres in the table plane.
        rise_m: lowest and highest height of the subject's centre over the target's.
        goal_rise_m: height over the target's centre at which the goal mask is drawn; not given =
            no goal mask, as where several things share the middle.
    """

    kind: str
    subject: str
    target: str
    max_distance_m: float
    rise_m: tuple[float, float]
    goal_rise_m: float | None = None

    def goal(self, at: Situation) -> Goal | None:
        """Returns where the subject's centre should be (3,) [m], if that is one place."""
        if self.goal_rise_m is None:
            return None
        rise = np.array([0.0, 0.0, self.goal_rise_m])
        return self.subject, at.end(self.target) + rise

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds."""
        dx, dy, dz = (at.end(self.subject) - at.end(self.target)).tolist()
        return [
            Margin('near its middle', self.max_distance_m - float(np.hypot(dx, dy))),
            Margin('not below it', dz - self.rise_m[0]),
            Margin('not above it', self.rise_m[1] - dz),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inside:
    """The subject is inside the target's rectangle, whose sides lie along x and y.

    Attributes:
        kind: `inside`.
        subject: placeholder of the object that moves.
        target: placeholder of the container.
        half_size_m: how far the subject's centre may be from the target's in x and y.
        rise_m: lowest and highest height of the subject's centre over the target's.
    """

    kind: str
    subject: str
    target: str
    half_size_m: tuple[float, float]
    rise_m: tuple[float, float]

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: it may be anywhere inside."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds."""
        dx, dy, dz = (at.end(self.subject) - at.end(self.target)).tolist()
        return [
            Margin('inside in x', self.half_size_m[0] - abs(dx)),
            Margin('inside in y', self.half_size_m[1] - abs(dy)),
            Margin('not below it', dz - self.rise_m[0]),
            Margin('not above it', self.rise_m[1] - dz),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Apart:
    """Two objects stand apart in the table plane.

    Attributes:
        kind: `apart`.
        subject: placeholder of the one.
        target: placeholder of the other.
        min_distance_m: of their centres.
    """

    kind: str
    subject: str
    target: str
    min_distance_m: float

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: there is no one place for it."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much the condition holds."""
        offset = at.end(self.subject) - at.end(self.target)
        return [Margin('apart', float(np.hypot(*offset[:2])) - self.min_distance_m)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """The subject is away from where it started.

    Attributes:
        kind: `moved`.
        subject: placeholder of the object that moves.
        min_distance_m: in the table plane.
    """

    kind: str
    subject: str
    min_distance_m: float

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: there is no one place for it."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much the condition holds."""
        way = at.end(self.subject) - at.start(self.subject)
        return [Margin('moved away', float(np.hypot(*way[:2])) - self.min_distance_m)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shifted:
    """The subject stands at a given offset from where it started.

    Attributes:
        kind: `shifted`.
        subject: placeholder of the object that moves.
        offset_m: x, y, z of the goal from the start.
        max_distance_m: largest distance from the goal in the table plane.
        max_rise_m: largest |dz| from the goal.
    """

    kind: str
    subject: str
    offset_m: tuple[float, float, float]
    max_distance_m: float
    max_rise_m: float

    def goal(self, at: Situation) -> Goal | None:
        """Returns where the subject's centre should be (3,) [m]."""
        return self.subject, at.start(self.subject) + np.asarray(self.offset_m)

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds."""
        way = at.end(self.subject) - at.start(self.subject) - np.asarray(self.offset_m)
        return [
            Margin('at its goal', self.max_distance_m - float(np.hypot(*way[:2]))),
            Margin('on the table', self.max_rise_m - abs(float(way[2]))),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shaken:
    """The subject was lifted and swung to and fro at some time.

    Attributes:
        kind: `shaken`.
        subject: placeholder of the object that is shaken.
        min_lift_m: how far its centre rises over its start.
        num_reversals: how often its lean turns back.
        min_swing_rad: smaller turns do not count.
    """

    kind: str
    subject: str
    min_lift_m: float
    num_reversals: int = 2
    min_swing_rad: float = 0.15

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: where it ends does not matter."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much each condition holds; a reversal more or less counts as two."""
        counted = at.swings(self.subject, self.min_swing_rad) - self.num_reversals + 0.5
        return [
            Margin('lifted', at.lift(self.subject) - self.min_lift_m),
            Margin('swung to and fro', counted, 'reversals', 0.5),
        ]


Relation = (
    Beside | OnTop | Within | Inside | Apart | Moved | Shifted | Shaken | AsPictured | InRegion
)
KINDS: dict[str, type[Relation]] = {
    'left_of': Beside,
    'right_of': Beside,
    'on_top_of': OnTop,
    'within': Within,
    'inside': Inside,
    'apart': Apart,
    'moved': Moved,
    'shifted': Shifted,
    'shaken': Shaken,
    'as_pictured': AsPictured,
    'in_region': InRegion,
}


def roles_of(relation: Relation) -> tuple[str, ...]:
    """Returns the placeholders that a relation is about, the one that moves first."""
    target = getattr(relation, 'target', None)
    return (relation.subject,) if target is None else (relation.subject, target)
