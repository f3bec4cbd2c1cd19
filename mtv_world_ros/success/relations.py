"""Relations between objects that a task may ask for, and their margins.

The defaults are the benchmark's thresholds, and written nowhere else. Lengths in metres, x to the
right, y away from the robot, z up. A distance in the plane is that of the centres in x and y.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, Strict

from mtv_world_ros.core.config import expected, Schema
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.success.situation import Situation

#: thickness of the floor of plates and containers [m]
FLOOR_M = 0.005
#: an object in a container may lean on its wall: its centre is at most this far over the wall [m]
OVER_WALL_M = 0.03
#: amplitudes that `Shaken` distinguishes, and the softness of its margin, in shares of the
#: amplitude that the task asks for
_SWINGS = (0.25, 0.5, 0.625, 0.75, 0.875, 1.0, 1.125, 1.25, 1.5, 2.0, 3.0)
_SOFT_SWING = 0.25

#: placeholder of an object, and goal position (3,) of its centre [m]
Goal = tuple[str, FloatArray]


class Margin(NamedTuple):
    """Margin of a condition.

    Attributes:
        condition: condition in words.
        values: (T,) values of a situation's samples; positive = the condition holds.
        unit: unit of the values: `m`, or what is counted or measured.
        soft: value that counts as one; None = the task's softness [m].
        is_required: False = no part of the definition of success, but evidence against it where
            poses are estimated from pictures.
    """

    condition: str
    values: FloatArray
    unit: str = 'm'
    soft: float | None = None
    is_required: bool = True

    @property
    def end(self) -> float:
        """The value at the end."""
        return float(self.values[-1])


def plane_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the (T,) distance of centres (T, 3) or (3,) in x and y [m]."""
    return np.linalg.norm((np.asarray(a) - np.asarray(b))[..., :2], axis=-1)


#: text between a wrong value and the valid values
EXPECTED = '; expected'
_Positive = Annotated[float, Field(gt=0, lt=1e3)]
_Signed = Annotated[float, Field(gt=-1e3, lt=1e3)]
_Angle = Annotated[_Positive, expected('a positive angle in radians', EXPECTED)]
Length = Annotated[_Positive, expected('1 positive length(s) in metres', EXPECTED)]
_Lengths2 = Annotated[
    tuple[_Positive, _Positive],
    Strict(False),
    expected('2 positive length(s) in metres', EXPECTED),
]
Lengths3 = Annotated[
    tuple[_Positive, _Positive, _Positive],
    Strict(False),
    expected('3 positive length(s) in metres', EXPECTED),
]
_Heights = Annotated[
    tuple[_Signed, _Signed], Strict(False), expected('2 length(s) in metres', EXPECTED)
]
_Offset = Annotated[
    tuple[_Signed, _Signed, _Signed], Strict(False), expected('3 length(s) in metres', EXPECTED)
]


class Relation(Schema):
    """Condition on one object, or between objects, at the end of a task.

    Attributes:
        kind: name of the kind in task files, a key of `KINDS`.
        subject: placeholder of the object that moves.
        target: placeholder of the object that it is placed by, where there is one.
        is_of_course: True if it depends on the course of the episode, not on the end alone.
    """

    is_of_course: ClassVar[bool] = False
    kind: str
    subject: str

    @property
    def roles(self) -> tuple[str, ...]:
        """Placeholders of the relation; the moving object comes first."""
        return tuple(getattr(self, key) for key in ('subject', 'target') if hasattr(self, key))

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m]; None if that is not one place."""
        del at
        return None

    @abstractmethod
    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""


class Beside(Relation):
    """The subject stands on the table to the left (-x) or right (+x) of the target.

    Attributes:
        target: placeholder of the object it is placed by.
        distance_m: smallest and largest distance of the centres in the plane.
        max_across_m: largest |dy| of the centres.
        max_rise_m: largest |dz| of the centres, so that the object is not in the air. That no
            gripper holds it is checked apart, where grippers are known.
        goal_distance_m: dx at which the goal mask is drawn.
    """

    target: str
    distance_m: _Lengths2 = (0.08, 0.20)
    max_across_m: Length = 0.05
    max_rise_m: Length = 0.03
    goal_distance_m: Length = 0.13

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m]."""
        way = np.array([self._side() * self.goal_distance_m, 0.0, 0.0])
        return self.subject, at.centres(self.target)[-1] + way

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        a, b = at.centres(self.subject), at.centres(self.target)
        distance, (dx, dy, dz) = plane_distance(a, b), (a - b).T
        return [
            Margin('far enough', distance - self.distance_m[0]),
            Margin('near enough', self.distance_m[1] - distance),
            Margin('on the right side', self._side() * dx),
            Margin('in line', self.max_across_m - np.abs(dy)),
            Margin('on the table', self.max_rise_m - np.abs(dz), is_required=False),
        ]

    def _side(self) -> float:
        return -1.0 if self.kind == 'left_of' else 1.0


class OnTop(Relation):
    """The subject stands on the target, both blocks.

    Attributes:
        target: placeholder of the object below.
        max_offset_m: largest |dx|, |dy|, |dz| from the place right above the target.
    """

    target: str
    max_offset_m: Lengths3 = (0.025, 0.025, 0.012)

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m]."""
        return self.subject, at.centres(self.target)[-1] + self._rise(at)

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        offset = at.centres(self.subject) - at.centres(self.target) - self._rise(at)
        room = np.asarray(self.max_offset_m) - np.abs(offset)
        names = ('over it in x', 'over it in y', 'at its top')
        return [Margin(name, values) for name, values in zip(names, room.T, strict=True)]

    def _rise(self, at: Situation) -> FloatArray:
        rise = (at.size(self.subject)[2] + at.size(self.target)[2]) / 2
        return np.array([0.0, 0.0, rise])


class ServedOn(Relation):
    """The subject stands on the floor of a plate, near its middle.

    Attributes:
        target: placeholder of the plate.
        max_distance_m: largest distance of the centres in the plane.
        max_rise_m: largest difference in height from where it stands on the floor.
    """

    target: str
    max_distance_m: Length = 0.035
    max_rise_m: Length = 0.015

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m]."""
        rise = np.array([0.0, 0.0, self._rise(at)])
        return self.subject, at.centres(self.target)[-1] + rise

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        a, b = at.centres(self.subject), at.centres(self.target)
        rise = (a - b)[:, 2] - self._rise(at)
        return [
            Margin('near its middle', self.max_distance_m - plane_distance(a, b)),
            Margin('not below it', rise + self.max_rise_m),
            Margin('not above it', self.max_rise_m - rise),
        ]

    def _rise(self, at: Situation) -> float:
        """Return the height of the subject's centre over the target's [m]."""
        return float((at.size(self.subject)[2] - at.size(self.target)[2]) / 2 + FLOOR_M)


class RestsOn(Relation):
    """The subject rests on the target, anywhere on it, whatever the sizes of both.

    Sizes are those that the first frame shows, so that the same task is about a saucer and a
    serving plate, a block on a block and a block in a bowl.

    Attributes:
        target: placeholder of the object below.
        tolerance_m: distance in height from lying on the target's floor or on its top that is
            still resting. What rests on something hides its upper part, so that masks show the
            centre of the lower object up to a quarter of its height too low.
    """

    target: str
    tolerance_m: Length = 0.03

    def margins(self, at: Situation) -> list[Margin]:
        """Return the distance from the target's edge, and from the heights at which it rests."""
        a, b = at.centres(self.subject), at.centres(self.target)
        width, high = at.seen_size(self.target)
        own_height, rise = at.seen_size(self.subject)[1], (a - b)[:, 2]
        on_floor, on_top = (own_height - high) / 2 + FLOOR_M, (own_height + high) / 2
        return [
            Margin('over it', width / 2 - plane_distance(a, b)),
            Margin('not below it', rise - (min(on_floor, on_top) - self.tolerance_m)),
            Margin('not above it', max(on_floor, on_top) + self.tolerance_m - rise),
        ]


class NestedOn(ServedOn):
    """The subject, a plate, lies in or on the target, another plate.

    Attributes:
        max_distance_m: largest distance of the centres in the plane.
        max_rise_m: largest difference in height from halfway between lying in it and on it.
    """

    max_distance_m: Length = 0.04
    max_rise_m: Length = 0.02

    def _rise(self, at: Situation) -> float:
        return float(at.size(self.target)[2] / 2)


class Within(Relation):
    """The subject is in or on a container (basket, tray), near its middle.

    Attributes:
        target: placeholder of the container.
        max_distance_m: largest distance of the centres in the plane.
        rise_m: lowest and highest height of the subject's centre over the target's; not given =
            over the container's floor, and at most `OVER_WALL_M` over its wall.
        goal_rise_m: height over the target's centre at which the goal mask is drawn; not given =
            no goal mask, as where several things share the middle.
    """

    target: str
    max_distance_m: Length = 0.05
    rise_m: _Heights | None = None
    goal_rise_m: Length | None = None

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m], if that is one place."""
        if self.goal_rise_m is None:
            return None
        rise = np.array([0.0, 0.0, self.goal_rise_m])
        return self.subject, at.centres(self.target)[-1] + rise

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        distance = plane_distance(at.centres(self.subject), at.centres(self.target))
        return [
            Margin('near its middle', self.max_distance_m - distance),
            *_height_margins(at, self.subject, self.target, self.rise_m),
        ]


class Inside(Relation):
    """The subject is inside a container's rectangle.

    Attributes:
        target: placeholder of the container.
        half_size_m: largest distance of the subject's centre from the target's along each of the
            target's sides [m]; not given = half the target's size.
        whole: the whole subject is inside, not only its centre; without `half_size_m`.
        rise_m: height range, as in `Within`.
    """

    target: str
    half_size_m: _Lengths2 | None = None
    whole: Annotated[bool, expected('true or false', EXPECTED)] = False
    rise_m: _Heights | None = None

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        room = (self._room(at) - np.abs(at.offsets(self.subject, self.target)[:, :2])).T
        return [
            Margin('inside in x', room[0]),
            Margin('inside in y', room[1]),
            *_height_margins(at, self.subject, self.target, self.rise_m),
        ]

    def _room(self, at: Situation) -> FloatArray:
        if self.half_size_m is not None:
            return np.asarray(self.half_size_m)
        half = at.size(self.target)[:2] / 2
        return half - at.size(self.subject)[:2].max() / 2 if self.whole else half


def _height_margins(
    at: Situation, subject: str, target: str, rise_m: tuple[float, float] | None
) -> list[Margin]:
    """Return the height margins of what lies in a container."""
    if rise_m is not None:
        rise = (at.centres(subject) - at.centres(target))[:, 2]
        low, high = rise_m
    else:
        wall = at.size(target)[2]
        rise = at.offsets(subject, target)[:, 2] + wall / 2
        low, high = FLOOR_M, wall + OVER_WALL_M
    return [Margin('not below it', rise - low), Margin('not above it', high - rise)]


class Apart(Relation):
    """Two objects stand apart.

    Attributes:
        target: placeholder of the other.
        min_distance_m: min distance of their centres in the plane.
    """

    target: str
    min_distance_m: Length = 0.06

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much the condition holds."""
        distance = plane_distance(at.centres(self.subject), at.centres(self.target))
        return [Margin('apart', distance - self.min_distance_m)]


class Moved(Relation):
    """The subject is away from where it started.

    Attributes:
        min_distance_m: min distance in the plane.
    """

    min_distance_m: Length = 0.1

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much the condition holds."""
        way = plane_distance(at.centres(self.subject), at.start(self.subject))
        return [Margin('moved away', way - self.min_distance_m)]


class AtGoal(Relation):
    """The subject stands where the scene wants it.

    Attributes:
        max_distance_m: largest distance from the goal in the plane.
        max_rise_m: largest |dz| from the goal.
    """

    max_distance_m: Length = 0.03
    max_rise_m: Length = 0.03

    def goal(self, at: Situation) -> Goal | None:
        """Return where the subject's centre should be (3,) [m]."""
        return self.subject, self._goal(at)

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds."""
        centres, goal = at.centres(self.subject), self._goal(at)
        return [
            Margin('at its goal', self.max_distance_m - plane_distance(centres, goal)),
            Margin('on the table', self.max_rise_m - np.abs(centres[:, 2] - goal[2])),
        ]

    def _goal(self, at: Situation) -> FloatArray:
        return at.goal(self.subject)


class Shifted(AtGoal):
    """The subject stands at a given offset from where it started.

    Attributes:
        offset_m: x, y, z of the goal from the start.
    """

    offset_m: _Offset

    def _goal(self, at: Situation) -> FloatArray:
        return at.start(self.subject) + np.asarray(self.offset_m)


class Shaken(Relation):
    """The subject was lifted and, up there, swung to and fro; that stays true from then on.

    Attributes:
        min_lift_m: height of its lowest point over the table.
        num_reversals: turning points of the object's lean while it is lifted.
        min_swing_rad: smaller turns do not count.
    """

    is_of_course: ClassVar[bool] = True
    min_lift_m: Length = 0.06
    num_reversals: Annotated[int, Field(ge=1), expected('a count of at least 1', EXPECTED)] = 2
    min_swing_rad: _Angle = 0.15

    def margins(self, at: Situation) -> list[Margin]:
        """Return by how much each condition holds; how wide the swings were, to `_SWINGS`."""
        room = at.clearances(self.subject) - self.min_lift_m
        swings = self.min_swing_rad * np.array(_SWINGS)
        enough = np.array([self._reversed(at, swing, room > 0) for swing in swings])
        wide = _SWINGS.index(1.0)
        # those that are narrower, or wider, than wanted; a swing lies halfway to the next
        below, above = enough[:wide].sum(0), wide + enough[wide:].sum(0)
        reached = np.where(enough[wide], above, below)
        halfway = (np.append(0.0, swings) + np.append(swings, 2 * swings[-1])) / 2
        return [
            Margin('lifted', np.maximum.accumulate(room)),
            Margin(
                'swung to and fro', halfway[reached] - self.min_swing_rad, 'rad',
                _SOFT_SWING * self.min_swing_rad,
            ),
        ]  # fmt: skip

    def _reversed(self, at: Situation, swing: float, is_lifted: BoolArray) -> BoolArray:
        """Return (T,) whether there were enough reversals, each by more than a swing."""
        turns = np.diff(at.reversals(self.subject, swing), prepend=0.0)
        return np.asarray(np.cumsum(turns * is_lifted) >= self.num_reversals)


KINDS: dict[str, type[Relation]] = {
    'left_of': Beside,
    'right_of': Beside,
    'on_top_of': OnTop,
    'served_on': ServedOn,
    'nested_on': NestedOn,
    'rests_on': RestsOn,
    'within': Within,
    'inside': Inside,
    'apart': Apart,
    'moved': Moved,
    'at_goal': AtGoal,
    'shifted': Shifted,
    'shaken': Shaken,
}
