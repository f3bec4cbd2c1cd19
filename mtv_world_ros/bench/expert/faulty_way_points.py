"""What faults of a policy make of the way points of the expert."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mtv_world_ros.bench.expert.faults import PolicyVariant
from mtv_world_ros.bench.expert.way_points import Pull, Stops, WayPoint
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.transforms import rotation

_GRASP = ('above', 'grasp', 'close')
_HELD = ('lift', 'carry', 'lower')
_PLACE = ('carry', 'lower', 'open', 'retreat')
#: the lowest that a tool is carried over where it grasped [m]
_LOWEST_M = 0.004
#: how far a first grasp is raised before it lets go again [m]
_TRY_LIFT_M = 0.04
#: way points of a move at most
_MOST_STOPS = 40
#: a way point of play: standard deviations in the plane [m], in yaw [rad]; largest height [m]
_PLAY_M, _PLAY_RAD, _PLAY_HEIGHT_M = 0.03, 0.4, 0.06
#: an odd way point: standard deviations of its place [m], yaw and lean [rad]; the longest run
_ODD_M, _ODD_YAW_RAD, _ODD_LEAN_RAD, _ODD_RUN = 0.025, 0.5, 0.35, 3
#: way points of a circle, and time from one to the next [s]
_NUM_CIRCLE, _CIRCLE_S = 8, 0.25
#: how far off its middle shut fingers push an object along [m]
_HERD_BESIDE_M = 0.02
#: shut fingers press on what was put down: share of the way down to where they let go
_RUB_DEPTH = 0.75
#: standard deviation of how far off its middle shut fingers push what was put down [m]
_TIDY_BESIDE_M = 0.02
#: shut fingers open beside an object: how far off they come down, and where they open [m]
_SPLAY_FROM_M, _SPLAY_AT_M = 0.06, 0.04
#: standard deviation of how far off its middle shut fingers push an object to its goal [m]
_PUTT_BESIDE_M = 0.025
#: kinds whose added way points leave the others their time
_KEEP_TEMPO = frozenset(
    (
        'herd',
        'rub',
        'juggle',
        'cut',
        'tidy',
        'splay',
        'putt',
        'topple',
        'fidget',
        'tinker',
        'drag',
        'grind',
        'perch',
        'paw',
        'waggle',
        'nibble',
        'rake',
        'decoy',
        'omit',
        'jiggle',
        'jumble',
        'lob',
        'thump',
        'smear',
        'gnaw',
        'dip',
        'swat',
        'swirl',
        'jostle',
        'toss',
        'nod',
        'peck',
        'haul',
        'crank',
        'hop',
        'hunt',
        'yawn',
        'waver',
        'vise',
        'dribble',
        'rattle',
        'bowl',
        'shed',
        'yank',
        'flap',
        'heap',
    )
)
#: phases in which another arm comes where this one is, and the kind of fault that it is
_CROWDED = {'close': 'rival', 'open': 'crowd'}
#: a visit to an object: from how far to how far past its centre it goes in the plane, how low and
#: high over it, how much it rises before and after [m]; standard deviations beside the centre [m],
#: of yaw and lean [rad]
_VISIT_FROM_M, _VISIT_TO_M = (0.0, 0.08), (-0.02, 0.06)
_VISIT_HEIGHT_M, _VISIT_RISE_M = (-0.03, 0.05), (0.03, 0.1)
_VISIT_BESIDE_M, _VISIT_YAW_RAD, _VISIT_LEAN_RAD = 0.012, 0.6, 0.35
#: one thing after the other at an object: standard deviations beside its centre [m], of a lean and
#: of a turn [rad]; how far it rises or sinks [m]; the time that opening or closing takes [s]
_FIDGET_BESIDE_M, _FIDGET_RAD, _FIDGET_RISE_M, _FIDGET_S = 0.03, 0.5, (-0.04, 0.06), 0.3
#: how deep what is held may be pressed on what is under it [m]; how often it comes to an object
_TINKER_DEPTH_M, _TINKER_OTHER = 0.025, 0.2
#: what is carried meets an object: how high the tool is over where it grasped, how far the centres
#: pass each other [m]
_MEET_HEIGHT_M, _MEET_BESIDE_M = (0.0, 0.09), 0.03
#: how deep what is held is pressed on the table as it is dragged [m]
_DRAG_DEPTH_M = 0.02
#: what is held is rubbed on its goal: how deep it is pressed [m], how often, time of a stroke [s]
_GRIND_DEPTH_M, _NUM_GRINDS, _GRIND_S = 0.008, 2, 0.4
#: what it is put down on is at most this far from its goal, and from where its arm rests, or this
#: much farther from there than its goal; how far it rises there [m]
_PERCH_GOAL_M, _PERCH_ARM_M, _PERCH_MORE_M, _PERCH_RISE_M = 0.2, 0.27, 0.03, 0.05
#: how high over its grasp shut fingers press on an object that they drag away [m]
_PAW_HEIGHT_M = 0.01
#: what is held is waved to and fro: how often, and time of a stroke [s]
_NUM_WAGGLES, _WAGGLE_S = 4, 0.2
#: how often fingers close on their way to the right place
_NUM_NIBBLES = 3
#: another object that it takes first is at most this far from where its arm rests [m]
_DECOY_ARM_M = 0.27
#: having let go, it shakes its fingers: how often, and time of a stroke [s]
_NUM_JIGGLES, _JIGGLE_S = 3, 0.15

#: how often fingers close on their way aside, once they have let go
_NUM_GNAWS = 3
#: time in which what it holds is swung over its goal [s]
_LOB_S = 0.3
#: what is held is thumped on its goal: how far it is raised [m], how often, time of a stroke [s]
_THUMP_M, _NUM_THUMPS, _THUMP_S = 0.05, 3, 0.12
#: time in which shut fingers hit an object [s]
_SWAT_S = 0.3
#: shut fingers go round an object: how far off its middle they come down [m]
_SWIRL_M = 0.08
#: down at the object, or with it at its goal, it leans to and fro: how often, time from one side
#: to the other [s], and how far at least, as a share
_NUM_NODS, _NOD_S, _LEAST_NOD = 3, 0.2, 0.6
#: shut fingers peck at an object from above: how often, how far off its middle [m]
_NUM_PECKS, _PECK_BESIDE_M = 3, 0.015
#: shut fingers press on an object and go round its middle: how far off it [m], way points
_CRANK_M, _NUM_CRANK = 0.02, 5
#: where on its way to the goal it puts the object down and takes it again, as shares of the way,
#: and how far it rises there [m]
_HOPS, _HOP_RISE_M = (0.2, 0.4), 0.04
#: on its way down it swings from side to side: how often, and time of a stroke [s]
_NUM_HUNTS, _HUNT_S = 5, 0.25
#: from how high above another arm comes for what is next to the goal [m]
_BUDGE_RISE_M = 0.07
#: another arm roams: standard deviation of how far off objects [m], and how low at least [m]
_ROAM_BESIDE_M, _ROAM_LEAST_M = 0.04, 0.02
#: shut fingers push an object to and fro: how far off its middle [m]
_DRIBBLE_BESIDE_M = 0.015
#: another object is shaken: how often, and time of a stroke [s]
_NUM_RATTLES, _RATTLE_S = 3, 0.15
#: what does not come off is shaken off: how high [m], how often, time of a stroke [s]
_SHED_RISE_M, _NUM_SHEDS, _SHED_S = 0.03, 2, 0.15
#: having let go, it leans to and fro: how often, and how far at least, as a share
_NUM_FLAPS, _LEAST_FLAP = 4, 0.3
#: time in which another object is pulled away [s]
_YANK_S = 0.2
#: another object is put on its own: from how high above it falls, how far it rises there [m]
_HEAP_GAP_M, _HEAP_RISE_M = 0.005, 0.03


class WayPointFaults:
    """The faults of a variant that change the way points of one move.

    Which move, and to which side, is drawn from a generator of its own: siblings of a scene differ
    by the kind and the size of their fault alone.

    Args:
        variant: whose faults.
        rng: draws move and side.
    """

    def __init__(self, variant: PolicyVariant, rng: np.random.Generator) -> None:
        self._variant = variant
        self._move, self._angle = float(rng.uniform()), float(rng.uniform(0, 2 * np.pi))
        self._sign = float(rng.choice((-1.0, 1.0)))
        self._draws = rng.normal(size=(_MOST_STOPS, 3))
        self._openings = rng.normal(size=_MOST_STOPS)
        self._play = np.random.default_rng(rng.integers(2**32))

    @property
    def keeps_tempo(self) -> bool:
        """Whether added way points take time of their own; else they share the move's."""
        return not _KEEP_TEMPO.isdisjoint(self._variant.kinds)

    @property
    def crowds(self) -> dict[str, float]:
        """Phases in which another arm comes where this one is, by which share of its way."""
        sizes = {phase: self._variant.size(kind) for phase, kind in _CROWDED.items()}
        return {phase: size for phase, size in sizes.items() if size}

    @property
    def poached(self) -> float:
        """How far another arm carries away what this one has let go [m]; 0 = it does not."""
        return self._variant.size('poach')

    @property
    def squeezed(self) -> float:
        """How deep the hands of two arms squeeze the object first [m]; 0 = they do not."""
        return self._variant.size('vise')

    @property
    def slapped(self) -> float:
        """How far another arm strikes what this one carries [m]; 0 = it does not."""
        return self._variant.size('slap')

    @property
    def tailed(self) -> float:
        """By which share of its way another arm follows this one; 0 = it does not."""
        return self._variant.size('tail')

    @property
    def hindered(self) -> float:
        """By which share of its way another arm stands in this one's way; 0 = it does not."""
        return self._variant.size('hinder')

    def roams(self, objects: Sequence[FloatArray]) -> list[FloatArray]:
        """Returns the places (3,) that another arm roams through meanwhile [m], drawn.

        Args:
            objects: (3,) centre of every object of the scene [m].
        """
        places, rng = list[FloatArray](), self._play
        for _ in range(round(self._variant.size('roam'))):
            x, y, z = objects[int(rng.integers(len(objects)))]
            beside = rng.normal(0.0, _ROAM_BESIDE_M, 2)
            places.append(np.array([x + beside[0], y + beside[1], max(z, _ROAM_LEAST_M)]))
        return places

    def pulls(self, stops: Stops, objects: Sequence[FloatArray]) -> list[Pull]:
        """Returns what another arm pulls at meanwhile.

        Args:
            stops: way points of the move, with its faults.
            objects: (3,) centre of every object of the scene [m].
        """
        closed, opened = _first(stops, 'close'), _first(stops, 'open')
        own, goal = stops[closed].position, stops[opened].position
        others = [p for p in objects if np.linalg.norm((p - own)[:2]) > _VISIT_TO_M[1]]
        near = min(others, key=lambda p: np.linalg.norm((p - goal)[:2]), default=own)
        # the way point before the last way down
        over = max(opened - 2, 0)
        pulls = [
            Pull(near, _BUDGE_RISE_M, closed + 1, self._variant.size('budge')),
            Pull(stops[over].position, 0.0, over + 1, self._variant.size('tug')),
        ]
        return [pull for pull in pulls if pull.size]

    def move_of(self, num_moves: int) -> int:
        """Returns the number of the move that goes wrong."""
        return int(self._move * num_moves)

    def applied(self, stops: Stops, yaw: float, objects: Sequence[FloatArray]) -> Stops:
        """Returns the way points of a move with all faults, in the catalogue's order.

        Args:
            stops: of the expert.
            yaw: of its grasp [rad]; the fingers travel along it.
            objects: (3,) centre of every object of the scene [m].
        """
        for kind, size in self._variant.sizes:
            edit = _EDITS.get(kind)
            if edit is not None:
                side = _Side(
                    yaw=yaw,
                    sign=self._sign,
                    angle=self._angle,
                    draws=self._draws,
                    openings=self._openings,
                    play=self._play,
                    objects=objects,
                )
                stops = edit(stops, size, side)
        return stops


@dataclass(frozen=True, slots=True, kw_only=True)
class _Side:
    """To which side a fault goes."""

    yaw: float
    sign: float
    angle: float
    draws: FloatArray
    openings: FloatArray
    play: np.random.Generator
    objects: Sequence[FloatArray]

    @property
    def along(self) -> FloatArray:
        """Unit vector (3,) along the fingers' travel."""
        return self.sign * np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0])

    @property
    def across(self) -> FloatArray:
        """Unit vector (3,) across it."""
        return self.sign * np.array([-np.sin(self.yaw), np.cos(self.yaw), 0.0])

    @property
    def anywhere(self) -> FloatArray:
        """Unit vector (3,) in any direction of the plane."""
        return np.array([np.cos(self.angle), np.sin(self.angle), 0.0])


def _up(height: float) -> FloatArray:
    return np.array([0.0, 0.0, height])


def _changed(stops: Stops, phases: Sequence[str], change: Callable[[WayPoint], WayPoint]) -> Stops:
    return [change(stop) if stop.phase in phases else stop for stop in stops]


def _first(stops: Stops, phase: str) -> int:
    return next(i for i, stop in enumerate(stops) if stop.phase == phase)


def _high(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('grasp', 'close'), lambda stop: stop.moved(_up(size)))


def _drop_high(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('carry', 'lower', 'open', 'retreat'), lambda s: s.moved(_up(size)))


def _aside(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, _GRASP, lambda stop: stop.moved(size * side.across))


def _along(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, _GRASP, lambda stop: stop.moved(size * side.along))


def _slide(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('above', 'grasp'), lambda stop: stop.moved(size * side.along))


def _torn(stops: Stops, size: float, side: _Side) -> Stops:
    """It grasps between its object and the nearest other one."""
    way = size * _way_to_other(stops, side)
    return _changed(stops, _GRASP, lambda stop: stop.moved(way))


def _way_to_other(stops: Stops, side: _Side) -> FloatArray:
    """(3,) in the plane from its grasp to the nearest other object; none where there is none."""
    grasp = stops[_first(stops, 'close')].position
    ways = [(place - grasp) * (1, 1, 0) for place in side.objects]
    others = [way for way in ways if np.linalg.norm(way) > _VISIT_TO_M[1]]
    return min(others, key=np.linalg.norm, default=np.zeros(3))


def _turn(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, _GRASP, lambda s: replace(s, yaw=s.yaw + side.sign * size))


def _lean(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, _GRASP, lambda s: replace(s, lean=s.lean + side.sign * size))


def _loose(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('close', *_HELD), lambda s: replace(s, opening=max(s.opening, size)))


def _slack(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('carry', 'lower'), lambda s: replace(s, opening=max(s.opening, size)))


def _grip(stops: Stops, size: float, side: _Side) -> Stops:
    drawn = [
        replace(stop, opening=float(np.clip(stop.opening + size * error, 0.0, 1.0)))
        for stop, error in zip(stops[:-1], side.openings, strict=False)
    ]
    return [*drawn, stops[-1]]


def _narrow(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(
        stops, ('above', 'grasp'), lambda s: replace(s, opening=s.opening * (1 - size))
    )


def _hasty(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('close',), lambda stop: stop.moved(_up(size)))


def _snap(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('grasp',), lambda stop: stop.moved(_up(size)))


def _flick(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, ('open', 'retreat'), lambda stop: stop.moved(size * side.anywhere))


def _clutch(stops: Stops, size: float, side: _Side) -> Stops:
    released = stops[_first(stops, 'open')].opening
    return _changed(stops, ('retreat',), lambda s: replace(s, opening=released * (1 - size)))


def _snag(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(
        stops, ('open', 'retreat'), lambda s: replace(s, opening=s.opening * (1 - size))
    )


def _drops(stops: Stops, size: float, side: _Side) -> Stops:
    """The gripper opens before the last `size` of the way from the lift to the place."""
    begin, end = _first(stops, 'lift'), _first(stops, 'lower')
    at = begin + (1 - size) * (end - begin)
    number = min(int(at), end - 1)
    share = at - number
    here, after = stops[number], stops[number + 1]
    place = here.position + share * (after.position - here.position)
    point = replace(after, position=place, yaw=here.yaw + share * (after.yaw - here.yaw))
    let_go = [point, replace(point, opening=1.0, seconds=0.3)]
    rest = _changed(stops[number + 1 :], _HELD, lambda s: replace(s, opening=1.0))
    rest = _changed(rest, ('open',), lambda s: replace(s, opening=1.0))
    return [*stops[: number + 1], *let_go, *rest]


def _blink(stops: Stops, size: float, side: _Side) -> Stops:
    lifted = _first(stops, 'lift')
    opened = replace(stops[lifted], opening=1.0, seconds=size / 2)
    return [
        *stops[: lifted + 1],
        opened,
        replace(opened, opening=0.0),
        *stops[lifted + 1 :],
    ]


def _low_carry(stops: Stops, size: float, side: _Side) -> Stops:
    floor = stops[_first(stops, 'close')].position[2] + _LOWEST_M

    def lowered(stop: WayPoint) -> WayPoint:
        x, y, z = stop.position
        return replace(stop, position=np.array([x, y, max(z - size, min(z, floor))]))

    return _changed(stops, ('lift', 'carry'), lowered)


def _cut(stops: Stops, size: float, side: _Side) -> Stops:
    """It is as low as its goal before it is there, and slides in from where it comes from."""
    lower = _first(stops, 'lower')
    back = (stops[_first(stops, 'grasp')].position - stops[lower].position) * (1, 1, 0)
    way = size * back / max(float(np.linalg.norm(back)), size)
    low = replace(stops[lower], phase='carry').moved(way)
    return [*stops[: lower - 1], stops[lower - 1].moved(way), low, *stops[lower:]]


def _push(stops: Stops, size: float, side: _Side) -> Stops:
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    way = size * side.along
    return [above.moved(way), replace(grasp, phase='above').moved(way), *stops[1:]]


def _dive(stops: Stops, size: float, side: _Side) -> Stops:
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    return [above.moved(size * (grasp.position - above.position)), *stops[1:]]


def _sweep(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers come down beside the object and push it across the fingers."""
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    return [*pushed(grasp, size, above.position - grasp.position, side.across), *stops]


def _stir(stops: Stops, size: float, side: _Side) -> Stops:
    """Down at the object, it circles about it as if it looked for it."""
    first = _first(stops, 'close')
    grasp = replace(stops[first - 1], phase='above', seconds=_CIRCLE_S)
    angles = side.angle + side.sign * np.linspace(0.0, 2 * np.pi, _NUM_CIRCLE + 1)
    ways = (size * np.array([np.cos(angle), np.sin(angle), 0.0]) for angle in angles)
    return [*stops[:first], *(grasp.moved(way) for way in ways), grasp, *stops[first:]]


def _knock(stops: Stops, size: float, side: _Side) -> Stops:
    """The same at the goal, lower than where the object is let go."""
    lower = stops[_first(stops, 'lower')]
    floor = stops[_first(stops, 'grasp')].position[2]
    place = lower.position - _up(min(0.02, max(lower.position[2] - floor, 0.0)))
    there = replace(lower, position=place)
    return [*pushed(there, size, _up(0.09), side.anywhere), *stops]


def pushed(
    at: WayPoint, size: float, rise: FloatArray, to: FloatArray, before: float = 0.0
) -> Stops:
    """Returns four way points of shut fingers that push what is at another one.

    Args:
        at: where they push.
        size: how far behind it they come [m].
        rise: (3,) from which they come down, and to which they rise again [m].
        to: unit vector (3,) in which they push.
        before: how much farther off they come down [m].
    """
    shut = replace(at, phase='above', opening=0.0)
    # half a finger and half a small object lie between the tool and the object's centre
    away, end = -(before + 0.07) * to, (size - 0.03) * to
    return [shut.moved(away + rise), shut.moved(away), shut.moved(end), shut.moved(end + rise)]


def _herd(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers push the object along their travel; it is grasped where it should be then.

    Drawn anew where the arm does not reach so far.
    """
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    along, across = (float(side.play.choice((-1.0, 1.0))) * to for to in (side.along, side.across))
    there = grasp.moved(size * along + _HERD_BESIDE_M * across)
    push = pushed(there, 0.0, above.position - grasp.position, along, size)
    return [*push, *_changed(stops, (*_GRASP, 'lift'), lambda stop: stop.moved(size * along))]


def _rub(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers come back down onto what they put there, and drag it to their side."""
    end = _first(stops, 'retreat') + 1
    opened, retreat = stops[end - 2 : end]
    above = replace(retreat, opening=0.0)
    down = above.moved(_RUB_DEPTH * (opened.position - retreat.position))
    is_away = float((stops[-1].position - retreat.position) @ side.anywhere) < 0
    way = (-size if is_away else size) * side.anywhere
    return [*stops[:end], above, down, down.moved(way), above.moved(way), *stops[end:]]


def _splay(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers come down beside the object and open there; it is grasped where it was.

    On the other side, drawn anew, where the arm does not reach so far.
    """
    above, grasp, close = stops[: _first(stops, 'close') + 1][-3:]
    to = float(side.play.choice((-1.0, 1.0))) * side.along
    far, near = _SPLAY_FROM_M * to, _SPLAY_AT_M * to
    down = replace(grasp.moved(far), phase='above', opening=0.0)
    shut = replace(down, position=grasp.position + near)
    opened = replace(shut, opening=size, seconds=close.seconds)
    over = replace(above.moved(near), opening=size)
    return [replace(above.moved(far), opening=0.0), down, shut, opened, over, *stops]


def _putt(stops: Stops, size: float, side: _Side) -> Stops:
    """It lets go on the way to its goal, and shut fingers push the object on, off its middle.

    Drawn anew where the arm does not reach so far.
    """
    lower, end = _first(stops, 'lower'), _first(stops, 'retreat') + 1
    goal, rise = stops[lower], stops[end - 1].position - stops[end - 2].position
    on = _direction(stops[_first(stops, 'grasp')], goal, size, lambda: side.anywhere)
    short = [stop.moved(-size * on) for stop in stops[lower - 1 : end]]
    beside = side.play.normal(0.0, _PUTT_BESIDE_M) * np.array([-on[1], on[0], 0.0])
    push = pushed(goal.moved(beside), 0.0, rise, on, size)
    return [*stops[: lower - 1], *short, *push, *stops[end:]]


def _odd(stops: Stops, size: float, side: _Side) -> Stops:
    """Runs of way points drawn at random, each with one thing that is not the expert's."""
    rng, floor = side.play, min(stop.position[2] for stop in stops)
    for _ in range(round(size)):
        first = int(rng.integers(len(stops) - 1))
        end = min(first + int(rng.integers(1, _ODD_RUN + 1)), len(stops) - 1)
        way, opening = rng.normal(0.0, _ODD_M, 3), float(rng.uniform())
        yaw, lean = rng.normal(0.0, (_ODD_YAW_RAD, _ODD_LEAN_RAD))
        match str(rng.choice(['opening', 'place', 'turn', 'detour'], p=[0.4, 0.2, 0.2, 0.2])):
            case 'opening':
                run = [replace(s, opening=opening) for s in stops[first:end]]
            case 'place':
                run = [_above(s.moved(way), floor) for s in stops[first:end]]
            case 'turn':
                run = [replace(s, yaw=s.yaw + yaw, lean=s.lean + lean) for s in stops[first:end]]
            case _:
                detour = replace(stops[end - 1], phase='above', seconds=None).moved(way)
                run = [*stops[first:end], _above(detour, floor)]
        stops = [*stops[:first], *run, *stops[end:]]
    return stops


def _above(stop: WayPoint, floor: float) -> WayPoint:
    x, y, z = stop.position
    return replace(stop, position=np.array([x, y, max(z, floor)]))


def _brush(stops: Stops, size: float, side: _Side) -> Stops:
    opened = _first(stops, 'open')
    aside = replace(stops[opened], phase='retreat', seconds=None).moved(size * side.anywhere)
    return [*stops[: opened + 1], aside, *stops[opened + 1 :]]


def _play(stops: Stops, size: float, side: _Side) -> Stops:
    """Way points drawn at random: before the grasp, on the way to the goal, after the release."""
    rng, floor = side.play, min(stop.position[2] for stop in stops)
    begins = {'grasp': 0.6, 'carry': 0.2, 'retreat': 0.2}
    for _ in range(round(size)):
        at = _first(stops, str(rng.choice(list(begins), p=list(begins.values()))))
        where = stops[_first(stops, 'grasp')] if stops[at].phase == 'grasp' else stops[at - 1]
        x, y = where.position[:2] + rng.normal(0.0, _PLAY_M, 2)
        # half of them as low as they may be, where things are
        z = max(floor, where.position[2] + rng.uniform(-_PLAY_HEIGHT_M, _PLAY_HEIGHT_M))
        drawn = replace(
            where,
            phase='above',
            position=np.array([x, y, z]),
            yaw=where.yaw + float(rng.normal(0.0, _PLAY_RAD)),
            opening=float(rng.uniform()),
            seconds=None,
        )
        stops = [*stops[:at], drawn, *stops[at:]]
    return stops


def _visit(stops: Stops, size: float, side: _Side) -> Stops:
    """Whatever the arm is about, it goes to an object first and through it or past it."""
    rng, floor = side.play, min(stop.position[2] for stop in stops)
    for _ in range(round(size)):
        at = int(rng.integers(len(stops)))
        x, y, z = side.objects[int(rng.integers(len(side.objects)))]
        angle = rng.uniform(0.0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        past = np.array([x, y]) + rng.normal(0.0, _VISIT_BESIDE_M, 2)
        height = max(floor, z + rng.uniform(*_VISIT_HEIGHT_M))
        begin = np.array([*(past - rng.uniform(*_VISIT_FROM_M) * way), height])
        end = np.array([*(past + rng.uniform(*_VISIT_TO_M) * way), height])
        arrives = WayPoint(
            phase='above',
            position=begin,
            yaw=float(rng.normal(0.0, _VISIT_YAW_RAD)),
            # half of them with the opening that the gripper has
            opening=float(rng.uniform()) if rng.random() < 0.5 else stops[at].opening,
            lean=float(rng.normal(0.0, _VISIT_LEAN_RAD)) if rng.random() < 0.5 else 0.0,
        )
        leaves = replace(arrives, position=end)
        if rng.random() < 0.5:
            leaves = replace(leaves, opening=float(rng.uniform()))
        before, after = (_up(rng.uniform(*_VISIT_RISE_M)) for _ in range(2))
        visit = [arrives.moved(before), arrives, leaves, leaves.moved(after)]
        stops = [*stops[:at], *visit, *stops[at:]]
    return stops


def _fidget(stops: Stops, size: float, side: _Side) -> Stops:
    """At an object, over it or beside it, one thing changes after the other.

    So fingers also open where they are, and what is held is raised, leaned and let go.
    """
    rng, floor = side.play, min(stop.position[2] for stop in stops)
    at = int(rng.integers(len(stops)))
    place = side.objects[int(rng.integers(len(side.objects)))]
    here = WayPoint(
        phase='above',
        position=place + rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0),
        yaw=float(rng.normal(0.0, _VISIT_YAW_RAD)),
        opening=float(rng.choice((0.0, rng.uniform(), 1.0))),
    )
    run = [_above(here, floor)]
    for _ in range(round(size)):
        run.append(_varied(run[-1], floor, rng))
    before, after = (_up(rng.uniform(*_VISIT_RISE_M)) for _ in range(2))
    left = replace(run[-1], seconds=None).moved(after)
    return [*stops[:at], run[0].moved(before), *run, left, *stops[at:]]


def _varied(stop: WayPoint, floor: float, rng: np.random.Generator) -> WayPoint:
    """What comes after a way point if one thing changes: opening, height, place, lean or turn."""
    last = replace(stop, seconds=None)
    match str(rng.choice(['opening', 'height', 'place', 'lean', 'turn'], p=[0.4, *[0.15] * 4])):
        case 'opening':
            opening = float(rng.choice((0.0, rng.uniform(), 1.0)))
            return replace(last, opening=opening, seconds=_FIDGET_S)
        case 'height':
            return _above(last.moved(_up(rng.uniform(*_FIDGET_RISE_M))), floor)
        case 'place':
            return last.moved(rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0))
        case 'lean':
            return replace(last, lean=float(rng.normal(0.0, _FIDGET_RAD)))
        case _:
            return replace(last, yaw=last.yaw + float(rng.normal(0.0, _FIDGET_RAD)))


def _tinker(stops: Stops, size: float, side: _Side) -> Stops:
    """With what the gripper holds, one thing changes after the other, on the table and on objects.

    So it is pressed down, dragged, leaned, put on what lies there, let go and taken again.
    """
    rng, lift = side.play, _first(stops, 'lift')
    low = float(stops[lift - 1].position[2])
    floor = low - rng.uniform(0.0, _TINKER_DEPTH_M)
    at = int(rng.integers(lift, _first(stops, 'open') + 1))
    run = [replace(stops[at - 1], phase='carry', seconds=None)]
    for _ in range(round(size)):
        if rng.random() < _TINKER_OTHER:
            place = side.objects[int(rng.integers(len(side.objects)))]
            # what lies on the table is twice as high as its centre
            over = place * (1, 1, rng.choice((0, 2))) + _up(floor)
            over = over + rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0)
            there = replace(run[-1], position=over, seconds=None)
            high = _up(max(_PERCH_RISE_M, run[-1].position[2] - over[2]))
            run += [there.moved(high), there]
        else:
            run.append(_varied(run[-1], floor, rng))
    return [*stops[:at], *run[1:], *stops[at:]]


def _meet(stops: Stops, size: float, side: _Side) -> Stops:
    """What the gripper holds is carried low through another object's place, or past it."""
    rng = side.play
    grasp = stops[_first(stops, 'close')].position
    others = [
        place for place in side.objects if np.linalg.norm((place - grasp)[:2]) > _VISIT_TO_M[1]
    ]
    for _ in range(round(size) if others else 0):
        at = int(rng.integers(_first(stops, 'lift') + 1, _first(stops, 'open') + 1))
        place = others[int(rng.integers(len(others)))][:2] + rng.normal(0.0, _MEET_BESIDE_M, 2)
        angle, height = rng.uniform(0.0, 2 * np.pi), grasp[2] + rng.uniform(*_MEET_HEIGHT_M)
        way = np.array([np.cos(angle), np.sin(angle)])
        begin, end = (
            np.array([*(place + far * way), height])
            for far in (-rng.uniform(0.06, 0.14), rng.uniform(*_VISIT_TO_M))
        )
        before = stops[at - 1]
        arrives = replace(before, phase='carry', position=begin, seconds=None)
        if rng.random() < 0.5:
            arrives = replace(arrives, yaw=before.yaw + float(rng.normal(0.0, _VISIT_YAW_RAD)))
        leaves = replace(arrives, position=end)
        over, after = (_up(rng.uniform(*_VISIT_RISE_M)) for _ in range(2))
        meeting = [arrives.moved(over), arrives, leaves, leaves.moved(after)]
        stops = [*stops[:at], *meeting, *stops[at:]]
    return stops


def _elsewhere(stops: Stops, size: float, side: _Side) -> Stops:
    return _changed(stops, _PLACE, lambda stop: stop.moved(size * side.anywhere))


def _retry(stops: Stops, size: float, side: _Side) -> Stops:
    begin = [stop.moved(size * side.across) for stop in stops[: _first(stops, 'lift')]]
    begin = [replace(stop, phase='above') for stop in begin]
    raised = begin[-1].moved(_up(_TRY_LIFT_M))
    return [*begin, raised, replace(raised, opening=1.0, seconds=0.3), *stops]


def _regrasp(stops: Stops, size: float, side: _Side) -> Stops:
    first = stops[: _first(stops, 'lift')]
    closed = replace(first[-1], seconds=None)
    way, rise = size * side.anywhere, _up(_TRY_LIFT_M)
    begin = [
        *first,
        closed.moved(rise),
        closed.moved(way + rise),
        closed.moved(way + _up(0.002)),
        replace(closed.moved(way + _up(0.002)), opening=1.0, seconds=0.3),
        replace(closed.moved(way + rise), opening=1.0),
    ]
    return [*(replace(stop, phase='above') for stop in begin), *stops]


def _juggle(stops: Stops, size: float, side: _Side) -> Stops:
    """Half-way it lets the object fall, and takes it again from where it should lie then."""
    lift = _first(stops, 'lift')
    closed, lifted, lower = stops[lift - 1], stops[lift], stops[_first(stops, 'lower')]
    x, y, _ = (lifted.position + lower.position) / 2
    low = replace(closed, phase='carry', position=np.array([x, y, closed.position[2]]))
    over = replace(lifted, phase='carry', position=np.array([x, y, lifted.position[2]]))
    held = replace(low.moved(_up(size)), seconds=None)
    let_go = replace(held, opening=1.0, seconds=0.3)
    again = replace(low, opening=1.0, seconds=None)
    return [*stops[: lift + 1], over, held, let_go, again, low, over, *stops[lift + 1 :]]


def _topple(stops: Stops, size: float, side: _Side) -> Stops:
    """It raises the object, leans and lets it fall; then it grasps where the object was.

    To the other side, drawn anew, where the wrist does not lean so far.
    """
    first = stops[: _first(stops, 'lift')]
    raised = replace(first[-1].moved(_up(_TRY_LIFT_M)), seconds=None)
    lean = float(side.play.choice((-1.0, 1.0))) * size
    leaning = replace(raised, lean=raised.lean + lean)
    let_go = replace(leaning, opening=1.0, seconds=0.3)
    upright = replace(raised, opening=1.0).moved(_up(_TRY_LIFT_M))
    begin = [*first, raised, leaning, let_go, upright]
    return [*(replace(stop, phase='above') for stop in begin), *stops]


def _undo(stops: Stops, size: float, side: _Side) -> Stops:
    """Once it has let go, it closes, carries what it holds back, and lets go again."""
    opened, rise = _first(stops, 'open'), _up(_TRY_LIFT_M)
    released = stops[opened]
    grasp = stops[_first(stops, 'grasp')]
    way = size * _direction(released, grasp, size, lambda: side.anywhere)
    closed = replace(released, opening=0.0)
    held = replace(closed, seconds=None)
    again = [
        closed,
        held.moved(rise),
        held.moved(way + rise),
        held.moved(way),
        released.moved(way),
    ]
    rest = _changed(stops[opened + 1 :], ('retreat',), lambda stop: stop.moved(way))
    return [*stops[: opened + 1], *(replace(stop, phase='retreat') for stop in again), *rest]


def _tidy(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers come back down beside what they put there, and push it off its middle.

    From another side, drawn anew, where the arm does not reach so far.
    """
    end, angle = _first(stops, 'retreat') + 1, side.play.uniform(0.0, 2 * np.pi)
    opened, retreat = stops[end - 2 : end]
    cos, sin = np.cos(angle), np.sin(angle)
    beside = side.play.normal(0.0, _TIDY_BESIDE_M) * np.array([-sin, cos, 0.0])
    rise = retreat.position - opened.position
    push = pushed(opened.moved(beside), size, rise, np.array([cos, sin, 0.0]))
    return [*stops[:end], *push, *stops[end:]]


def _drag(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds is pressed on the table and dragged towards its goal before it is lifted."""
    lift, lower = _first(stops, 'lift'), _first(stops, 'lower')
    way = size * (stops[lower].position - stops[lift].position) * (1, 1, 0)
    closed = replace(stops[lift - 1], phase='lift', seconds=None)
    pressed = closed.moved(_up(-_DRAG_DEPTH_M))
    return [*stops[:lift], pressed, pressed.moved(way), stops[lift].moved(way), *stops[lift + 1 :]]


def _askew(stops: Stops, size: float, side: _Side) -> Stops:
    """All places are turned about where the arm rests."""
    home, angle = stops[-1].position, side.sign * size
    turn = rotation((0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
    turned = [
        replace(s, position=home + turn @ (s.position - home), yaw=s.yaw + angle)
        for s in stops[:-1]
    ]
    return [*turned, stops[-1]]


def _grind(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds is pressed on its goal and rubbed to and fro there, before it is let go.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    opened, way = _first(stops, 'open'), size * _drawn_way(side)
    pressed = replace(stops[opened - 1], seconds=_GRIND_S).moved(_up(-_GRIND_DEPTH_M))
    return [*stops[:opened], pressed, *_to_and_fro(pressed, way, _NUM_GRINDS), *stops[opened:]]


def _perch(stops: Stops, size: float, side: _Side) -> Stops:
    """It puts the object on the other one next to its goal, off its middle, and takes it again.

    To another side, drawn anew, where the arm does not reach so far; where no other object is
    near its goal and its arm, on the table.
    """
    lift, opened = _first(stops, 'lift'), _first(stops, 'open')
    closed, let_go, way = stops[lift - 1], stops[opened], size * _drawn_way(side)
    at = _next_to_goal(stops, side, let_go.position * (1, 1, 0))
    # what lies on the table is twice as high as its centre
    over = at * (1, 1, 2) + way
    low = replace(
        closed, phase='carry', position=over + _up(closed.position[2] + 0.002), seconds=None
    )
    raised, wide = low.moved(_up(_PERCH_RISE_M)), stops[lift - 2].opening
    perched = [
        raised,
        low,
        replace(low, opening=let_go.opening, seconds=let_go.seconds),
        replace(raised, opening=wide),
        replace(low, opening=wide),
        replace(low, seconds=closed.seconds),
        raised,
    ]
    return [*stops[: lift + 1], *perched, *stops[lift + 1 :]]


def _next_to_goal(stops: Stops, side: _Side, other: FloatArray) -> FloatArray:
    """Centre (3,) of the other object next to the goal; `other` where the arm is near none."""
    own, goal = (stops[_first(stops, phase)].position for phase in ('close', 'open'))
    home = stops[-1].position
    farthest = max(_PERCH_ARM_M, _PERCH_MORE_M + float(np.linalg.norm((goal - home)[:2])))
    nears = [
        place
        for place in side.objects
        if np.linalg.norm((place - own)[:2]) > _VISIT_TO_M[1]
        and np.linalg.norm((place - goal)[:2]) < _PERCH_GOAL_M
        and np.linalg.norm((place - home)[:2]) < farthest
    ]
    return min(nears, key=lambda p: np.linalg.norm((p - goal)[:2]), default=other)


def _scoop(stops: Stops, size: float, side: _Side) -> Stops:
    """It comes down leaning and is upright only as the fingers close.

    To the other side, drawn anew, where the wrist does not lean so far.
    """
    lean = float(side.play.choice((-1.0, 1.0))) * size
    return _changed(stops, ('above', 'grasp'), lambda s: replace(s, lean=s.lean + lean))


def _paw(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers press on the object and drag it away; it is grasped where it was.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    grasp, way = stops[_first(stops, 'grasp')], size * _drawn_way(side)
    above = replace(stops[0], opening=0.0)
    down = replace(grasp, phase='above', opening=0.0).moved(_up(_PAW_HEIGHT_M))
    return [above, down, down.moved(way), above.moved(way), *stops]


def _waggle(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds is waved to and fro, once lifted, and may slip out of the fingers.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    lift, way = _first(stops, 'lift'), size * _drawn_way(side)
    lifted = replace(stops[lift], phase='carry', seconds=_WAGGLE_S)
    return [*stops[: lift + 1], *_to_and_fro(lifted, way, _NUM_WAGGLES), *stops[lift + 1 :]]


def _nibble(stops: Stops, size: float, side: _Side) -> Stops:
    """It comes down beside the object, and closes again and again on its way to the right place.

    From another side, drawn anew, where the arm does not reach so far.
    """
    first, way = _first(stops, 'close'), size * _drawn_way(side)
    grasp, close = (replace(stop, phase='above') for stop in stops[first - 1 : first + 1])
    bite = [grasp, close, replace(close, opening=grasp.opening)]
    shares = np.arange(_NUM_NIBBLES, 0, -1) / _NUM_NIBBLES
    bites = [stop.moved(share * way) for share in shares for stop in bite]
    return [stops[0].moved(way), *bites, *stops[first - 1 :]]


def _rake(stops: Stops, size: float, side: _Side) -> Stops:
    """Open fingers go towards the goal with the object between them, and close there.

    To any side where the goal is nearer than that.
    """
    first = _first(stops, 'close')
    lower = stops[_first(stops, 'lower')]
    on = size * _direction(stops[first], lower, size, lambda: side.anywhere)
    rest = _changed(stops[first:], ('close', 'lift'), lambda stop: stop.moved(on))
    return [*stops[:first], stops[first - 1].moved(on), *rest]


def _decoy(stops: Stops, size: float, side: _Side) -> Stops:
    """It first takes the other object next to its own, moves it over the table and lets it go.

    In another direction, drawn anew, where the arm does not reach so far; its own object where
    its arm is near no other.
    """
    above, grasp, close = stops[: _first(stops, 'close') + 1][-3:]
    at = _next_to_own(stops, side)
    down = replace(grasp, phase='above', position=at, opening=1.0)
    shut = replace(down, opening=0.0, seconds=close.seconds)
    moved = replace(shut, seconds=None).moved(size * _drawn_way(side))
    let_go = replace(moved, opening=1.0, seconds=close.seconds)
    rise = above.position - grasp.position
    left = replace(let_go, seconds=None).moved(rise)
    return [down.moved(rise), down, shut, moved, let_go, left, *stops]


def _next_to_own(stops: Stops, side: _Side) -> FloatArray:
    """Centre (3,) of the other object next to its own; where it grasps if its arm is near none."""
    grasp, close = stops[: _first(stops, 'close') + 1][-2:]
    own, home = close.position[:2], stops[-1].position[:2]
    others = [
        place
        for place in side.objects
        if np.linalg.norm(place[:2] - own) > _VISIT_TO_M[1]
        and np.linalg.norm(place[:2] - home) < _DECOY_ARM_M
    ]
    return min(others, key=lambda p: np.linalg.norm(p[:2] - own), default=grasp.position)


def _omit(stops: Stops, size: float, side: _Side) -> Stops:
    """Way points are left out, and it goes straight to the next one.

    Where it should close or open, it has done so at the next one. Others, drawn anew, where the
    arm does not reach the way between.
    """
    gone = side.play.permutation(len(stops) - 1)[: round(size)]
    for number in sorted(map(int, gone), reverse=True):
        left_out, after = stops[number : number + 2]
        if left_out.phase in _CROWDED:
            after = replace(after, phase=left_out.phase)
        stops = [*stops[:number], after, *stops[number + 2 :]]
    return stops


def _fence(stops: Stops, size: float, side: _Side) -> Stops:
    """What is farthest from where the arm rests is out of reach, and it stops before."""
    home = stops[-1].position
    ways = [(stop.position - home) * (1, 1, 0) for stop in stops]
    most = (1 - size) * max(map(np.linalg.norm, ways))
    short = [max(1 - most / max(float(np.linalg.norm(way)), most), 0.0) * way for way in ways]
    return [stop.moved(-lacks) for stop, lacks in zip(stops, short, strict=True)]


def _jiggle(stops: Stops, size: float, side: _Side) -> Stops:
    """Having let go, it shakes its fingers to and fro, as if something stuck to them.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    end, way = _first(stops, 'open') + 1, size * _drawn_way(side)
    opened = replace(stops[end - 1], phase='retreat', seconds=_JIGGLE_S)
    return [*stops[:end], *_to_and_fro(opened, way, _NUM_JIGGLES), *stops[end:]]


def _jumble(stops: Stops, size: float, side: _Side) -> Stops:
    """Way points change places with the next one, so that it does the later thing first.

    Others, drawn anew, where the arm does not reach the way between.
    """
    stops = [*stops]
    for number in map(int, side.play.permutation(len(stops) - 2)[: round(size)]):
        stops[number : number + 2] = stops[number + 1], stops[number]
    return stops


def _gnaw(stops: Stops, size: float, side: _Side) -> Stops:
    """Having let go, it closes and opens again and again on its way aside, and rises there.

    To another side, drawn anew, where the arm does not reach so far.
    """
    end, way = _first(stops, 'open') + 1, size * _drawn_way(side)
    opened = replace(stops[end - 1], phase='retreat')
    bite = [replace(opened, seconds=None), replace(opened, opening=0.0), opened]
    shares = np.arange(1, _NUM_GNAWS + 1) / _NUM_GNAWS
    bites = [stop.moved(share * way) for share in shares for stop in bite]
    rest = _changed(stops[end:], ('retreat',), lambda stop: stop.moved(way))
    return [*stops[:end], *bites, *rest]


def _lob(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds is swung over its goal, and the fingers open in full swing.

    From any side, drawn anew, where it comes from nearer than that.
    """
    lower = _first(stops, 'lower')
    grasp = stops[_first(stops, 'grasp')]
    on = size * _direction(grasp, stops[lower], size, lambda: _drawn_way(side))
    carry, opened = stops[lower - 1 : lower + 2 : 2]
    let_go = replace(opened, position=carry.position)
    swung = replace(let_go, phase='lower', seconds=_LOB_S)
    return [*stops[: lower - 1], carry.moved(-on), swung, let_go, *stops[lower + 2 :]]


def _thump(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds is thumped on its goal, again and again, before it is let go."""
    opened = _first(stops, 'open')
    raised, low = (
        replace(stops[opened - 1], seconds=_THUMP_S).moved(_up(to)) for to in (_THUMP_M, -size)
    )
    return [*stops[:opened], *[raised, low] * _NUM_THUMPS, *stops[opened:]]


def _smear(stops: Stops, size: float, side: _Side) -> Stops:
    """It lets go on the way to its goal, and shut fingers press on the object and drag it on.

    From any side, drawn anew, where it comes from nearer than that.
    """
    lower, end = _first(stops, 'lower'), _first(stops, 'retreat') + 1
    grasp = stops[_first(stops, 'grasp')]
    on = size * _direction(grasp, stops[lower], size, lambda: _drawn_way(side))
    short = [stop.moved(-on) for stop in stops[lower - 1 : end]]
    above = replace(short[-1], opening=0.0)
    down = replace(short[1], phase='retreat', opening=0.0).moved(_up(_PAW_HEIGHT_M))
    dragged = [above, down, down.moved(on), above.moved(on)]
    return [*stops[: lower - 1], *short, *dragged, *stops[end:]]


def _swoop(stops: Stops, size: float, side: _Side) -> Stops:
    """Open fingers pass along both sides of the object, and close as they go.

    How far and from which end is drawn, anew where the arm does not reach so far.
    """
    first, way = _first(stops, 'close'), size * side.play.uniform(-0.5, 0.5) * side.across
    comes = [stop.moved(-way) for stop in stops[:first]]
    goes = [stop.moved(way) for stop in stops[first : first + 2]]
    return [*comes, *goes, *stops[first + 2 :]]


def _slope(stops: Stops, size: float, side: _Side) -> Stops:
    """What is higher than the grasp is off to one side, by a share, so that it comes on a slant.

    To another side, drawn anew, where the arm does not reach so far.
    """
    low, way = stops[_first(stops, 'grasp')].position[2], size * _drawn_way(side)
    return [*(stop.moved((stop.position[2] - low) * way) for stop in stops[:-1]), stops[-1]]


def _dip(stops: Stops, size: float, side: _Side) -> Stops:
    """Half-way to its goal, what it holds is dipped on the table, and carried on."""
    lift = _first(stops, 'lift')
    closed, lifted, lower = stops[lift - 1], stops[lift], stops[_first(stops, 'lower')]
    x, y, _ = (lifted.position + lower.position) / 2
    low = np.array([x, y, closed.position[2] - size])
    dipped = replace(lifted, phase='carry', position=low)
    return [*stops[: lift + 1], dipped, *stops[lift + 1 :]]


def _swat(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers hit the object in one quick stroke, and it is grasped where it was.

    From another side, drawn anew, where the arm does not reach so far.
    """
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    rise = above.position - grasp.position
    over, down, hit, left = pushed(grasp, size, rise, _drawn_way(side))
    return [over, down, replace(hit, seconds=_SWAT_S), left, *stops]


def _swirl(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers go once round the object, ever nearer to it; it is grasped where it was.

    From another side, drawn anew, where the arm does not reach so far.
    """
    above, grasp = stops[0], stops[_first(stops, 'grasp')]
    shares = np.linspace(0.0, 1.0, _NUM_CIRCLE + 1)
    angles = side.play.uniform(0.0, 2 * np.pi) + side.sign * 2 * np.pi * shares
    ways = (_SWIRL_M - size * shares) * np.array([np.cos(angles), np.sin(angles), 0 * angles])
    down, *ring = (replace(grasp, phase='above', opening=0.0).moved(way) for way in ways.T)
    rise = above.position - grasp.position
    round_it = [replace(stop, seconds=_CIRCLE_S) for stop in ring]
    return [down.moved(rise), down, *round_it, ring[-1].moved(rise), *stops]


def _jostle(stops: Stops, size: float, side: _Side) -> Stops:
    """Once done, shut fingers push the other object next to its goal, or what it put there.

    From another side, drawn anew, where the arm does not reach so far.
    """
    end = _first(stops, 'retreat') + 1
    opened, retreat = stops[end - 2 : end]
    at = _next_to_goal(stops, side, opened.position)
    there = replace(opened, phase='retreat', position=at, seconds=None)
    rise = _up(retreat.position[2] - at[2])
    return [*stops[:end], *pushed(there, size, rise, _drawn_way(side)), *stops[end:]]


def _toss(stops: Stops, size: float, side: _Side) -> Stops:
    """It tosses the object this far aside, and takes it from where it let go.

    To another side, drawn anew, where the arm does not reach so far.
    """
    first, way = stops[: _first(stops, 'lift')], size * _drawn_way(side)
    raised = replace(first[-1], seconds=None).moved(_up(_TRY_LIFT_M))
    swung = replace(raised, opening=first[-2].opening, seconds=_LOB_S).moved(way)
    begin = [replace(stop, phase='above') for stop in (*first, raised, swung)]
    return [*begin, *_changed(stops, (*_GRASP, 'lift'), lambda stop: stop.moved(way))]


def _sag(stops: Stops, size: float, side: _Side) -> Stops:
    """The farther the arm reaches out from where it rests, the lower it hangs."""
    home = stops[-1].position
    reaches = (float(np.linalg.norm((stop.position - home)[:2])) for stop in stops)
    return [stop.moved(_up(-size * far)) for stop, far in zip(stops, reaches, strict=True)]


def _nod(stops: Stops, size: float, side: _Side) -> Stops:
    """Down at the object, it leans to and fro with open fingers before they close.

    To either side by an angle up to this, drawn anew where the wrist does not lean so far.
    """
    first = _first(stops, 'close')
    grasp = replace(stops[first - 1], phase='above')
    return [*stops[:first], *_nods(grasp, size, side), *stops[first:]]


def _nods(
    stop: WayPoint, size: float, side: _Side, num: int = _NUM_NODS, least: float = _LEAST_NOD
) -> Stops:
    """Leaning to either side of a way point, by angles up to this, drawn, and back to it."""
    left, right = size * side.play.uniform(least, 1.0, 2)
    leans = (stop.lean + lean for lean in (*(left, -right) * num, 0.0))
    return [replace(stop, lean=lean, seconds=_NOD_S) for lean in leans]


def _peck(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers peck at the object from above, off its middle; it is grasped where it was.

    At other places, drawn anew, where the arm does not reach so far.
    """
    above = replace(stops[0], opening=0.0)
    down = replace(stops[_first(stops, 'grasp')], phase='above', opening=0.0).moved(_up(-size))
    ways = (_PECK_BESIDE_M * _drawn_way(side) for _ in range(_NUM_PECKS))
    return [*(stop.moved(way) for way in ways for stop in (above, down, above)), *stops]


def _haul(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers press on the object and drag it away; it is grasped where it should be then.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    grasp, way = stops[_first(stops, 'grasp')], size * _drawn_way(side)
    above = replace(stops[0], opening=0.0)
    down = replace(grasp, phase='above', opening=0.0)
    dragged = [above, down, down.moved(way), above.moved(way)]
    return [*dragged, *_changed(stops, (*_GRASP, 'lift'), lambda stop: stop.moved(way))]


def _crank(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers press on the object off its middle, go round that and turn as they go.

    It is grasped where it was. From another side, drawn anew, where the arm does not reach so far.
    """
    begin, sense = side.play.uniform(0.0, 2 * np.pi), float(side.play.choice((-1.0, 1.0)))
    turns = sense * size * np.linspace(-0.5, 0.5, _NUM_CRANK)

    def round_it(stop: WayPoint) -> Stops:
        angles = begin + turns
        ways = _CRANK_M * np.array([np.cos(angles), np.sin(angles), 0 * angles])
        pairs = zip(turns, ways.T, strict=True)
        return [replace(stop, yaw=stop.yaw + turn).moved(way) for turn, way in pairs]

    above = replace(stops[0], opening=0.0)
    down = replace(stops[_first(stops, 'grasp')], phase='above', opening=0.0, seconds=_CIRCLE_S)
    over, *_, left = round_it(above)
    first, *ring = round_it(down)
    return [over, replace(first, seconds=None), *ring, left, *stops]


def _hop(stops: Stops, size: float, side: _Side) -> Stops:
    """On its way it puts the object down, lets go, and takes it again where it is not; twice.

    To other sides, drawn anew, where the arm does not reach so far.
    """
    lift, lower = _first(stops, 'lift'), _first(stops, 'lower')
    closed, wide = stops[lift - 1], stops[lift - 2].opening
    way, rise = (stops[lower].position - closed.position) * (1, 1, 0), _up(_HOP_RISE_M)
    hops: Stops = []
    for share in _HOPS:
        down = replace(closed, phase='carry', seconds=None).moved(share * way)
        opened = replace(down, opening=wide)
        again = opened.moved(size * _drawn_way(side))
        shut = replace(again, opening=0.0, seconds=closed.seconds)
        hops += [down.moved(rise), down, replace(opened, seconds=closed.seconds)]
        hops += [opened.moved(rise), again.moved(rise), again, shut]
        hops.append(replace(shut, seconds=None).moved(rise))
    return [*stops[: lift + 1], *hops, *stops[lift + 1 :]]


def _hunt(stops: Stops, size: float, side: _Side) -> Stops:
    """On its way down, it swings from side to side, as if it kept correcting its aim.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    first, way = _first(stops, 'grasp'), size * _drawn_way(side)
    above, grasp = stops[first - 1 : first + 1]
    down, swing = grasp.position - above.position, replace(above, seconds=_HUNT_S)
    swings = [
        swing.moved(number / _NUM_HUNTS * down + (-1) ** number * way)
        for number in range(1, _NUM_HUNTS + 1)
    ]
    return [*stops[:first], *swings, *stops[first:]]


def _stretch(stops: Stops, size: float, side: _Side) -> Stops:
    """All places are farther from where the arm rests, or nearer to there, by a share.

    Drawn anew where the arm does not reach so far.
    """
    home, share = stops[-1].position, size * float(side.play.choice((-1.0, 1.0)))
    return [stop.moved(share * (stop.position - home) * (1, 1, 0)) for stop in stops]


def _rock(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds leans to and fro on its goal before it is let go.

    To either side by an angle up to this, drawn anew where the wrist does not lean so far.
    """
    opened = _first(stops, 'open')
    return [*stops[:opened], *_nods(stops[opened - 1], size, side), *stops[opened:]]


def _yawn(stops: Stops, size: float, side: _Side) -> Stops:
    """It comes down shut, and the fingers open only over the rest of the way, onto the object."""
    first = _first(stops, 'grasp')
    above = replace(stops[first - 1], opening=0.0)
    shut = above.moved(size * (stops[first].position - above.position))
    return [*stops[: first - 1], above, shut, *stops[first:]]


def _waver(stops: Stops, size: float, side: _Side) -> Stops:
    """Down at the object, it goes towards the nearest other one with open fingers, and back."""
    first = _first(stops, 'close')
    grasp = replace(stops[first - 1], phase='above')
    away = grasp.moved(size * _way_to_other(stops, side))
    return [*stops[:first], away, grasp, *stops[first:]]


def _droop(stops: Stops, size: float, side: _Side) -> Stops:
    """The farther it has carried the object, the lower it hangs, until it has let go."""
    lift, end = _first(stops, 'lift'), _first(stops, 'open') + 1
    gone = 0.0
    held: Stops = []
    for before, stop in pairwise(stops[lift - 1 : end]):
        gone += float(np.linalg.norm((stop.position - before.position)[:2]))
        held.append(stop.moved(_up(-size * gone)))
    return [*stops[:lift], *held, *stops[end:]]


def _grid(stops: Stops, size: float, side: _Side) -> Stops:
    """All places are the next ones of a grid."""
    nexts = (size * np.rint(stop.position / size) - stop.position for stop in stops[:-1])
    return [*(s.moved(way * (1, 1, 0)) for s, way in zip(stops, nexts, strict=False)), stops[-1]]


def _dribble(stops: Stops, size: float, side: _Side) -> Stops:
    """Shut fingers push the object this far, and back from its other side, off its middle.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    above, grasp, to = stops[0], stops[_first(stops, 'grasp')], _drawn_way(side)
    rise = above.position - grasp.position
    beside = side.sign * _DRIBBLE_BESIDE_M * np.array([-to[1], to[0], 0.0])
    there = grasp.moved(beside)
    return [*pushed(there, size, rise, to), *pushed(there, 0.0, rise, -to, size), *stops]


def _bowl(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds slides to its goal in one quick stroke, and the fingers open meanwhile.

    From any side, drawn anew, where it comes from nearer than that.
    """
    lower, grasp = _first(stops, 'lower'), stops[_first(stops, 'grasp')]
    on = size * _direction(grasp, stops[lower], size, lambda: _drawn_way(side))
    short = [stop.moved(-on) for stop in stops[lower - 1 : lower + 1]]
    slid = replace(stops[lower + 1], phase='lower', seconds=_LOB_S)
    return [*stops[: lower - 1], *short, slid, *stops[lower + 1 :]]


def _list(stops: Stops, size: float, side: _Side) -> Stops:
    """The farther the arm reaches out from where it rests, the more its wrist leans.

    To the other side, drawn anew, where the wrist does not lean so far.
    """
    home, share = stops[-1].position, size * float(side.play.choice((-1.0, 1.0)))
    reaches = [float(np.linalg.norm((stop.position - home)[:2])) for stop in stops]
    pairs = zip(stops, reaches, strict=True)
    return [replace(s, lean=s.lean + share * far / max(reaches)) for s, far in pairs]


def _rattle(stops: Stops, size: float, side: _Side) -> Stops:
    """Once done, it closes on the other object next to its goal, and shakes it to and fro.

    In another direction, drawn anew, where the arm does not reach so far; what it put there where
    its arm is near no other.
    """
    end, over, down, shut = _closed_next_to_goal(stops, side)
    shakes = _to_and_fro(replace(shut, seconds=_RATTLE_S), size * _drawn_way(side), _NUM_RATTLES)
    opened = replace(down, seconds=shut.seconds)
    return [*stops[:end], over, down, shut, *shakes, opened, over, *stops[end:]]


def _flap(stops: Stops, size: float, side: _Side) -> Stops:
    """Having let go, it leans to and fro where it is before it rises.

    To either side by an angle up to this, drawn anew where the wrist does not lean so far.
    """
    end = _first(stops, 'open') + 1
    upright = replace(stops[end - 1], phase='retreat')
    leans = _nods(upright, size, side, _NUM_FLAPS, _LEAST_FLAP)
    return [*stops[:end], *leans, *stops[end:]]


def _shed(stops: Stops, size: float, side: _Side) -> Stops:
    """What it holds does not come off: it rises with it, and opens as it shakes it off.

    In another direction, drawn anew, where the arm does not reach so far.
    """
    at, rise = _first(stops, 'open'), _up(_SHED_RISE_M)
    raised = replace(stops[at - 1], seconds=None).moved(rise)
    opened = replace(stops[at], seconds=_SHED_S).moved(rise)
    shakes = _to_and_fro(opened, size * _drawn_way(side), _NUM_SHEDS)
    shares = np.arange(1, len(shakes) + 1) / len(shakes)
    pairs = zip(shakes, shares, strict=True)
    opens = [replace(s, opening=float(share) * s.opening) for s, share in pairs]
    return [*stops[:at], raised, *opens, *stops[at + 1 :]]


def _yank(stops: Stops, size: float, side: _Side) -> Stops:
    """Once done, it closes on the other object next to its goal, and pulls it away in one stroke.

    In another direction, drawn anew, where the arm does not reach so far; what it put there where
    its arm is near no other.
    """
    end, over, down, shut = _closed_next_to_goal(stops, side)
    way = size * _drawn_way(side)
    pulled = replace(shut, seconds=_YANK_S).moved(way)
    opened = replace(pulled, opening=1.0, seconds=shut.seconds)
    return [*stops[:end], over, down, shut, pulled, opened, over.moved(way), *stops[end:]]


def _closed_next_to_goal(stops: Stops, side: _Side) -> tuple[int, WayPoint, WayPoint, WayPoint]:
    """How many way points are done by then, and those over, at and closed on `_next_to_goal`."""
    end, close = _first(stops, 'retreat') + 1, stops[_first(stops, 'close')]
    retreat = stops[end - 1]
    at = _next_to_goal(stops, side, stops[end - 2].position)
    over = replace(retreat, position=np.array([*at[:2], retreat.position[2]]))
    down = replace(over, position=at)
    return end, over, down, replace(down, opening=0.0, seconds=close.seconds)


def _heap(stops: Stops, size: float, side: _Side) -> Stops:
    """It first puts the other object next to its own on top of that, off its middle.

    To another side, drawn anew, where the arm does not reach so far; its own object where its arm
    is near no other.
    """
    above, grasp, close = stops[: _first(stops, 'close') + 1][-3:]
    at = _next_to_own(stops, side)
    own = min(side.objects, key=lambda p: np.linalg.norm((p - grasp.position)[:2]))
    down = replace(grasp, phase='above', position=at, opening=1.0)
    shut = replace(down, opening=0.0, seconds=close.seconds)
    # what lies on the table is twice as high as its centre
    top = own * (1, 1, 2) + _up(at[2] + _HEAP_GAP_M) + size * _drawn_way(side)
    rise = _up(_HEAP_RISE_M)
    put = replace(shut, position=top, seconds=None)
    raised = replace(put, position=np.array([*at[:2], top[2]])).moved(rise)
    let_go = replace(put, opening=1.0, seconds=close.seconds)
    left = replace(let_go, seconds=None).moved(rise)
    down_from = down.moved(above.position - grasp.position)
    return [down_from, down, shut, raised, put.moved(rise), put, let_go, left, *stops]


def _to_and_fro(stop: WayPoint, way: FloatArray, num: int) -> Stops:
    """From a way point to either side of it, `num` times, and back to it."""
    return [*(stop.moved(to * way) for to in (1, -1) * num), stop]


def _direction(
    begin: WayPoint, end: WayPoint, least: float, other: Callable[[], FloatArray]
) -> FloatArray:
    """Unit vector (3,) in the plane towards another way point; `other` where that is too near."""
    way = (end.position - begin.position) * (1, 1, 0)
    distance = float(np.linalg.norm(way))
    return way / distance if distance > least else other()


def _drawn_way(side: _Side) -> FloatArray:
    """Unit vector (3,) in a direction of the plane that every draw of a plan has anew."""
    angle = side.play.uniform(0.0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _wander(stops: Stops, size: float, side: _Side) -> Stops:
    floor = min(stop.position[2] for stop in stops)

    draws = zip(stops[:-1], side.draws, strict=False)
    return [*(_above(stop.moved(size * way), floor) for stop, way in draws), stops[-1]]


_EDITS: dict[str, Callable[[Stops, float, _Side], Stops]] = {
    'high': _high,
    'hasty': _hasty,
    'dive': _dive,
    'drop_high': _drop_high,
    'aside': _aside,
    'along': _along,
    'slide': _slide,
    'torn': _torn,
    'turn': _turn,
    'lean': _lean,
    'loose': _loose,
    'slack': _slack,
    'grip': _grip,
    'narrow': _narrow,
    'drops': _drops,
    'snag': _snag,
    'clutch': _clutch,
    'snap': _snap,
    'flick': _flick,
    'blink': _blink,
    'play': _play,
    'odd': _odd,
    'visit': _visit,
    'fidget': _fidget,
    'tinker': _tinker,
    'meet': _meet,
    'knock': _knock,
    'brush': _brush,
    'low_carry': _low_carry,
    'cut': _cut,
    'push': _push,
    'sweep': _sweep,
    'stir': _stir,
    'herd': _herd,
    'rub': _rub,
    'splay': _splay,
    'putt': _putt,
    'elsewhere': _elsewhere,
    'retry': _retry,
    'regrasp': _regrasp,
    'juggle': _juggle,
    'topple': _topple,
    'undo': _undo,
    'tidy': _tidy,
    'wander': _wander,
    'drag': _drag,
    'askew': _askew,
    'grind': _grind,
    'perch': _perch,
    'scoop': _scoop,
    'paw': _paw,
    'waggle': _waggle,
    'nibble': _nibble,
    'rake': _rake,
    'decoy': _decoy,
    'omit': _omit,
    'fence': _fence,
    'jiggle': _jiggle,
    'jumble': _jumble,
    'gnaw': _gnaw,
    'lob': _lob,
    'thump': _thump,
    'smear': _smear,
    'swoop': _swoop,
    'slope': _slope,
    'dip': _dip,
    'swat': _swat,
    'swirl': _swirl,
    'jostle': _jostle,
    'toss': _toss,
    'sag': _sag,
    'nod': _nod,
    'peck': _peck,
    'haul': _haul,
    'crank': _crank,
    'hop': _hop,
    'hunt': _hunt,
    'stretch': _stretch,
    'rock': _rock,
    'yawn': _yawn,
    'waver': _waver,
    'droop': _droop,
    'grid': _grid,
    'dribble': _dribble,
    'bowl': _bowl,
    'list': _list,
    'rattle': _rattle,
    'flap': _flap,
    'shed': _shed,
    'yank': _yank,
    'heap': _heap,
}
