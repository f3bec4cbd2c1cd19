"""Faults of scripted policies: what touches what it should not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.actions import circle, circle_shut, push, shake
from mtv_world_ros.simulation.faults.commands import error, glitches, mirrored_arm
from mtv_world_ros.simulation.faults.fault import (
    Family,
    FaultSize,
    GRIPPER,
    GRIPPERS_OF_TWO,
    OtherArm,
    TWO_ARMS,
)
from mtv_world_ros.simulation.faults.move_plan import GRASP, left_of, MovePlan, shortened, unit
from mtv_world_ros.simulation.faults.random_edits import (
    random_actions_at_object,
    random_actions_with_object,
    random_carried_contacts,
    random_runs,
    random_visits,
    random_way_points,
)
from mtv_world_ros.simulation.way_points import FLAT, Stops, UP, Visit, WayPoint

#: minimum height of a carried tool over the grasp [m]
MIN_CARRY_HEIGHT_M = 0.004
#: maximum depth of closed fingers below the release [m]
MAX_CLOSED_DEPTH_M = 0.02
#: shortest stay of an arm in the way of the other [s]
MIN_STAY_S = 0.4
#: standard deviation of the horizontal offset of a roaming arm from an object [m]
ROAM_OFFSET_M = 0.04
#: minimum height of a roaming arm [m]
MIN_ROAM_HEIGHT_M = 0.02
#: height above a place from which a roaming arm approaches and to which it retreats [m]
ROAM_RISE_M = 0.07

fault = Family('collision')


def _coming_to(move: MovePlan, size: float, other: OtherArm, name: str) -> Visit:
    """Return the visit of an arm that is at a way point of the first arm before that one."""

    def ways(share: float) -> Stops:
        there = other.towards(move.position(name), share)
        return [there, replace(there, seconds=0.4), other.home]

    return Visit(ways=ways, share=size, meets=other.until(move.index(name)), done=1)


def _squeezing(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Return the visit of an arm that pushes the object towards the first arm."""

    def ways(share: float) -> Stops:
        place = other.above(move.position('close'), share).position
        there = move.like('close', position=place, phase='above', opening=0.0, seconds=None)
        way, rise = move.to_other_arm, 0.09 * UP
        begin, end = 0.07 * way, (0.03 - size) * way
        over, left = there.moved(begin + rise), there.moved(end + rise)
        return [over, there.moved(begin), there.moved(end), left, other.home]

    return Visit(ways=ways, meets=other.until(2), done=2, waits=True)


@fault.way_points('push', FaultSize(0.04, 0.15, (0.04,), 'm'))
def approach_from_side(move: MovePlan, size: float) -> MovePlan:
    """It comes in low from the side, from this far."""
    way = size * move.along
    return move.shift(('start',), way).insert(1, [move.like('grasp', phase='above').moved(way)])


fault.enter(
    'random_way_points',
    'play',
    FaultSize(2, 6, (2,)),
    text='number of way points drawn at random: about the object, or where the gripper is',
    way_points=random_way_points,
)

fault.enter(
    'random_runs',
    'odd',
    FaultSize(3, 8, (3,)),
    text=(
        'number of runs of one to three way points with another opening, place or turn, or a '
        'detour, drawn at random'
    ),
    way_points=random_runs,
    family='any',
)

fault.commands(
    'random_glitches',
    'glitch',
    FaultSize(3, 12, (3,)),
    glitches,
    'number of glitches of the commands drawn at random: grippers that jerk, joints that '
    'are off or swing, time that stands, jumps or runs, an arm at rest that moves along',
    family='any',
)

fault.enter(
    'random_visits',
    'visit',
    FaultSize(1, 4, (1,)),
    text=(
        'number of visits to any object of the scene, through it or past it, drawn at random: '
        'when, from where, how low, open or shut, turned and leaning'
    ),
    way_points=random_visits,
)

fault.enter(
    'random_actions_at_object',
    'fidget',
    FaultSize(5, 12, (5,)),
    text=(
        'number of things done one after the other at any object, drawn at random: open or '
        'close, rise or sink, lean, turn, go aside'
    ),
    way_points=random_actions_at_object,
    keeps_tempo=True,
)

fault.enter(
    'random_actions_with_object',
    'tinker',
    FaultSize(4, 12, (4,)),
    text=(
        'number of things done one after the other with what it holds, drawn at random: press '
        'it down, drag, lean or turn it, put it on any object or where that lies, let it go, '
        'take it'
    ),
    way_points=random_actions_with_object,
    needs=GRIPPER,
    keeps_tempo=True,
)

fault.enter(
    'random_carried_contacts',
    'meet',
    FaultSize(1, 4, (1,)),
    text=(
        'number of times that what is held is carried low through the place of another '
        'object, or past it, drawn at random: when, which, from where, how low'
    ),
    way_points=random_carried_contacts,
)


@fault.way_points('knock', FaultSize(0.02, 0.1, (0.01, 0.03), 'm'))
def goal_pushed_first(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers push what is at the goal before it."""
    height = move.between('grasp', 'lower')[2]
    goal = move.like('lower').moved(-min(MAX_CLOSED_DEPTH_M, max(height, 0.0)) * UP)
    return move.insert(0, push(goal, move.anywhere, 0.09 * UP, far=size))


@fault.way_points('brush', FaultSize(0.04, 0.1, (0.06, 0.1), 'm'))
def aside_after_release(move: MovePlan, size: float) -> MovePlan:
    """It goes this far sideways before it rises again."""
    stop = move.like('open', phase='retreat', seconds=None)
    return move.insert(move.after('open'), [stop.moved(size * move.anywhere)])


@fault.way_points('low_carry', FaultSize(0.04, 0.15, (0.04, 0.06, 0.09), 'm'), split='calibrate')
def carry_low(move: MovePlan, size: float) -> MovePlan:
    """It carries this much lower."""
    floor = move.position('close')[2] + MIN_CARRY_HEIGHT_M

    def lowered(stop: WayPoint) -> WayPoint:
        z = stop.position[2]
        return stop.moved((max(z - size, min(z, floor)) - z) * UP)

    return move.edit(('lift', 'carry'), lowered)


@fault.way_points('sweep', FaultSize(0.02, 0.1, (0.01, 0.03), 'm'))
def pushed_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers push the object before the grasp."""
    return move.insert(0, push(move.like('grasp'), move.across, move.rise, far=size))


@fault.way_points('cut', FaultSize(0.1, 0.2, (0.07, 0.1), 'm'), keeps_tempo=True)
def slid_to_goal(move: MovePlan, size: float) -> MovePlan:
    """It comes down this far before its goal, and slides in from there."""
    way = size * shortened(move.between('lower', 'grasp') * FLAT, size)
    move = move.shift(('carry_end',), way)
    return move.insert(move.index('lower'), [move.like('lower', phase='carry').moved(way)])


fault.commands(
    'idle_arm_mirrors',
    'mirror',
    FaultSize(1, 1.2, (1, 1.1)),
    partial(error, of=mirrored_arm),
    "an arm at rest mirrors this share of the other's motion",
    split='calibrate',
    needs=TWO_ARMS,
)


@fault.way_points('stir', FaultSize(0.03, 0.08, (0.028, 0.03), 'm'), split='calibrate')
def circle_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """It circles this wide before the fingers close."""
    angles = move.draws.sign * np.linspace(0.0, 2 * np.pi, 9)
    ring = circle(move, (size, size), move.draws.angle, angles, seconds=0.25)
    back = move.like('grasp', phase='above', seconds=0.25)
    return move.insert(move.index('close'), [*ring, back])


@fault.way_points('herd', FaultSize(0.06, 0.1, (0.06, 0.08), 'm'), keeps_tempo=True)
def pushed_and_grasped_there(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers push the object this far along, and it is grasped where it should be then."""
    way = move.side() * move.along
    move = move.shift((*GRASP, 'lift'), size * way)
    stop = move.like('grasp').moved(0.02 * (move.side() * move.across))
    return move.insert(0, push(stop, way, move.rise, far=0.0, before=size))


@fault.way_points('rub', FaultSize(0.09, 0.12, (0.09, 0.1), 'm'), keeps_tempo=True)
def rubbed_after_release(move: MovePlan, size: float) -> MovePlan:
    """Once done, shut fingers come back down onto the object and drag it this far."""
    shut, down = move.like('retreat', opening=0.0), -0.75 * move.between('open', 'retreat')
    way = move.anywhere
    if float((move.rest - move.position('retreat')) @ way) < 0:
        way = -way
    aside = size * way
    stops = [shut, shut.moved(down), shut.moved(down + aside), shut.moved(aside)]
    return move.insert(move.after('retreat'), stops)


@fault.second_arm('crowd', FaultSize(0.9, 1, (0.8, 0.9)), needs=TWO_ARMS)
def second_arm_at_release(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Share of the way that the other arm comes to where the object is let go."""
    return _coming_to(move, size, other, 'open')


@fault.second_arm('rival', FaultSize(0.9, 1, (0.85, 1)), split='calibrate', needs=TWO_ARMS)
def second_arm_at_grasp(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Share of the way that the other arm comes to where an object is grasped."""
    return _coming_to(move, size, other, 'close')


@fault.way_points('putt', FaultSize(0.04, 0.1, (0.04, 0.06), 'm'), needs=GRIPPER, keeps_tempo=True)
def released_short_and_pushed(move: MovePlan, size: float) -> MovePlan:
    """It lets go this far before its goal, and shut fingers push the object on."""
    way = move.to_goal(size)
    move = move.shift(move.span('carry_end', 'retreat'), -size * way)
    off = size * way + move.rng.normal(0.0, 0.025) * left_of(way)
    rise = move.between('open', 'retreat')
    stops = push(move.like('lower').moved(off), way, rise, far=0.0, before=size)
    return move.insert(move.after('retreat'), stops)


@fault.way_points(
    'grind', FaultSize(0.09, 0.12, (0.09, 0.1), 'm'), needs=GRIPPER, keeps_tempo=True
)
def rubbed_on_goal(move: MovePlan, size: float) -> MovePlan:
    """What it holds is pressed on its goal and rubbed to and fro there, this far."""
    pressed = move.like('lower', seconds=0.4).moved(-0.008 * UP)
    rubs = shake(pressed, size * move.drawn(), times=2)
    return move.insert(move.index('open'), [pressed, *rubs])


@fault.way_points('paw', FaultSize(0.05, 0.12, (0.05, 0.06), 'm'), needs=GRIPPER, keeps_tempo=True)
def dragged_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers press on the object and drag it this far; it is grasped where it was."""
    over, down = (move.like(name, phase='above', opening=0.0) for name in ('start', 'grasp'))
    way, press = size * move.drawn(), 0.01 * UP
    return move.insert(0, [over, down.moved(press), down.moved(press + way), over.moved(way)])


@fault.way_points(
    'rake', FaultSize(0.07, 0.12, (0.06, 0.07), 'm'), needs=GRIPPER, keeps_tempo=True
)
def raked_before_closing(move: MovePlan, size: float) -> MovePlan:
    """Open fingers go this far towards the goal with the object between them, then close."""
    way = size * move.to_goal(size)
    move = move.insert(move.index('close'), [move.like('grasp').moved(way)])
    return move.shift(('close', 'lift'), way)


@fault.way_points(
    'smear',
    FaultSize(0.04, 0.1, (0.04, 0.05), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def released_short_and_dragged(move: MovePlan, size: float) -> MovePlan:
    """It lets go this far before its goal; shut fingers press on the object and drag it on."""
    way, press = size * move.to_goal_or_drawn(size), 0.01 * UP
    move = move.shift(move.span('carry_end', 'retreat'), -way)
    over, down = (move.like(name, phase='retreat', opening=0.0) for name in ('retreat', 'lower'))
    stops = [over, down.moved(press), down.moved(press + way), over.moved(way)]
    return move.insert(move.after('retreat'), stops)


@fault.way_points(
    'swirl',
    FaultSize(0.045, 0.07, (0.045, 0.047), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def circled_by_shut_fingers(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers go round the object and come this much nearer to it."""
    first = move.rng.uniform(0.0, 2 * np.pi)
    angles = move.draws.sign * np.linspace(0.0, 2 * np.pi, 9)
    return move.insert(0, circle_shut(move, (0.08, 0.08 - size), first, angles, seconds=0.25))


@fault.way_points(
    'peck', FaultSize(0.025, 0.05, (0.02, 0.03), 'm'), needs=GRIPPER, keeps_tempo=True
)
def pecked_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers peck at the object from above, off its middle, this deep."""
    over = move.like('start', opening=0.0)
    down, stops = move.like('grasp', phase='above', opening=0.0), Stops()
    for _ in range(3):
        off = 0.015 * move.drawn()
        stops += [over.moved(off), down.moved(off - size * UP), over.moved(off)]
    return move.insert(0, stops)


@fault.way_points(
    'haul', FaultSize(0.04, 0.12, (0.03, 0.04), 'm'), needs=GRIPPER, keeps_tempo=True
)
def dragged_and_grasped_there(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers press on the object and drag it this far, and it is grasped there."""
    way = size * move.drawn()
    move = move.shift((*GRASP, 'lift'), way)
    over, down = (move.like(name, phase='above', opening=0.0) for name in ('start', 'grasp'))
    return move.insert(0, [over.moved(-way), down.moved(-way), down, over])


@fault.way_points('crank', FaultSize(2.2, 2.5, (2, 2.2), 'rad'), needs=GRIPPER, keeps_tempo=True)
def pressed_and_turned(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers press on the object, off its middle, and go round that by this angle."""
    first = move.rng.uniform(0.0, 2 * np.pi)
    angles = move.side() * np.linspace(-0.5 * size, 0.5 * size, 5)
    return move.insert(0, circle_shut(move, (0.02, 0.02), first, angles, seconds=0.25, turns=True))


@fault.second_arm(
    'tug', FaultSize(0.04, 0.12, (0.03, 0.06), 'm'), split='calibrate', needs=GRIPPERS_OF_TWO
)
def second_arm_tugs(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Over the goal, the other arm closes on what this one holds, and pulls it this far."""

    def ways(share: float) -> Stops:
        there = other.above(move.position('over'), share)
        shut = replace(there, opening=0.0, seconds=0.4)
        pulled = replace(shut.moved(other.homewards(there, size)), seconds=None)
        let_go = replace(pulled, opening=1.0, seconds=0.3)
        return [there, there, shut, pulled, let_go, replace(let_go, seconds=None), other.home]

    return Visit(ways=ways, meets=other.until(move.after('over')), done=3)


@fault.way_points(
    'vise',
    FaultSize(0.02, 0.06, (0.015, 0.025), 'm'),
    needs=GRIPPERS_OF_TWO,
    keeps_tempo=True,
    second_arm=_squeezing,
)
def squeezed_by_both_arms(move: MovePlan, size: float) -> MovePlan:
    """The shut hands of both arms first squeeze the object from either side, this deep."""
    object_ = move.like('close', seconds=None)
    return move.insert(0, push(object_, move.to_other_arm, 0.09 * UP, far=size))


@fault.second_arm(
    'slap', FaultSize(0.05, 0.12, (0.03, 0.07), 'm'), split='calibrate', needs=GRIPPERS_OF_TWO
)
def second_arm_strikes(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Over the goal, the other arm hits what this one holds in one quick stroke, this far."""

    def ways(share: float) -> Stops:
        place = other.above(move.position('over'), share).position
        there = move.like('over', position=place, phase='above', opening=0.0, seconds=None)
        out = unit((place - other.home.position) * FLAT)
        struck = replace(there.moved((size - 0.03) * out), seconds=0.3)
        return [there.moved(-0.07 * out), struck, other.home]

    return Visit(ways=ways, meets=other.until(move.after('over')), done=1)


@fault.second_arm('roam', FaultSize(2, 6, (2, 3)), needs=TWO_ARMS)
def second_arm_roams(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Number of places near objects that the other arm roams through meanwhile, low and open."""
    places = list[FloatArray]()
    for _ in range(round(size)):
        x, y, z = move.draws.objects[int(move.rng.integers(len(move.draws.objects)))]
        beside = move.rng.normal(0.0, ROAM_OFFSET_M, 2)
        places.append(np.array([x + beside[0], y + beside[1], max(z, MIN_ROAM_HEIGHT_M)]))

    def ways(share: float) -> Stops:
        begins = (other.home.position * FLAT + place * UP for place in places)
        low = [
            replace(other.home, phase='above', position=begin + share * (place - begin))
            for begin, place in zip(begins, places, strict=True)
        ]
        rise = ROAM_RISE_M * UP
        return [low[0].moved(rise), *low, low[-1].moved(rise), other.home]

    return Visit(ways=ways, meets=0.0, is_timed=False)


@fault.way_points(
    'dribble', FaultSize(0.04, 0.12, (0.035, 0.04), 'm'), needs=GRIPPER, keeps_tempo=True
)
def pushed_to_and_fro(move: MovePlan, size: float) -> MovePlan:
    """Before the grasp, shut fingers push the object this far, and back from its other side."""
    way, rise = move.drawn(), move.rise
    stop = move.like('grasp').moved(move.draws.sign * 0.015 * left_of(way))
    back = push(stop, -way, rise, far=0.0, before=size)
    return move.insert(0, [*push(stop, way, rise, far=size), *back])


@fault.second_arm('tail', FaultSize(0.8, 1, (0.75, 0.8)), split='calibrate', needs=GRIPPERS_OF_TWO)
def second_arm_follows(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Share of its way to the same places by which the other arm follows this one."""

    def ways(share: float) -> Stops:
        home, times = other.home, other.times
        same = [replace(s, seconds=time) for s, time in zip(move.stops, times, strict=True)]
        moved = [s.moved((1 - share) * (home.position - s.position) * FLAT) for s in same[:-1]]
        return [*moved, replace(home, seconds=times[-1])]

    return Visit(ways=ways, share=size, meets=0.4, is_timed=False)


@fault.second_arm('hinder', FaultSize(0.85, 1, (0.85, 0.9)), split='test', needs=GRIPPERS_OF_TWO)
def second_arm_in_the_way(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Share of its way to half-way of this arm's by which the other arm stands in its way."""
    closed = move.index('close')
    over = max(move.index('over'), closed)
    stays = max(sum(other.times[closed + 1 : over + 1]), MIN_STAY_S)
    half_way = (move.position('close') + move.position('over')) / 2

    def ways(share: float) -> Stops:
        there = replace(other.towards(half_way, share), opening=0.0)
        return [there, replace(there, seconds=stays), other.home]

    return Visit(ways=ways, share=size, meets=other.until(closed + 1), done=1)
