"""Faults of scripted policies: how an object is let go."""

from __future__ import annotations

from dataclasses import replace

from mtv_world_ros.simulation.faults.actions import shake
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import Stops, UP

fault = Family('release')


@fault.way_points('drops', FaultSize(0.5, 1, (0.5,)))
def dropped_on_the_way(move: MovePlan, size: float) -> MovePlan:
    """Share of the way to the goal that it is dropped before."""
    begin, end = move.index('lift'), move.index('lower')
    at = begin + (1 - size) * (end - begin)
    number = min(int(at), end - 1)
    share = at - number
    here, after = move.stops[number : number + 2]
    place = here.position + share * (after.position - here.position)
    point = replace(after, position=place, yaw=here.yaw + share * (after.yaw - here.yaw))
    let_go = [point, replace(point, opening=1.0, seconds=0.3)]
    held = ('lift', 'carry', 'lower', 'open')
    rest = (replace(s, opening=1.0) if s.phase in held else s for s in move.stops[number + 1 :])
    return replace(move, stops=[*move.stops[: number + 1], *let_go, *rest])


@fault.way_points('slack', FaultSize(0.4, 1, (0.6, 0.7, 0.9)), split='calibrate')
def opens_while_carrying(move: MovePlan, size: float) -> MovePlan:
    """Share of its range that the gripper opens on the way."""
    return move.edit(('carry', 'lower'), lambda stop: stop.opened(size))


@fault.way_points('snag', FaultSize(0.8, 1, (0.5, 0.7)))
def release_incomplete(move: MovePlan, size: float) -> MovePlan:
    """Share that lacks of how far it lets go."""
    return move.edit(('open', 'retreat'), lambda s: replace(s, opening=s.opening * (1 - size)))


@fault.way_points('flick', FaultSize(0.08, 0.15, (0.06, 0.1), 'm'))
def aside_while_opening(move: MovePlan, size: float) -> MovePlan:
    """It goes this far sideways while the fingers open."""
    return move.shift(('open', 'retreat'), size * move.anywhere)


@fault.way_points('blink', FaultSize(0.2, 3, (0.06, 0.2), 's'), split='calibrate')
def opens_after_lift(move: MovePlan, size: float) -> MovePlan:
    """The gripper opens and closes again, once lifted."""
    opened = move.like('lift', seconds=0.5 * size, opening=1.0)
    return move.insert(move.after('lift'), [opened, replace(opened, opening=0.0)])


@fault.way_points(
    'jiggle', FaultSize(0.04, 0.1, (0.04, 0.05), 'm'), needs=GRIPPER, keeps_tempo=True
)
def shaken_after_release(move: MovePlan, size: float) -> MovePlan:
    """Having let go, it shakes its fingers to and fro, this far."""
    stop = move.like('open', phase='retreat', seconds=0.15)
    return move.insert(move.after('open'), shake(stop, size * move.drawn(), times=3))


@fault.way_points(
    'gnaw', FaultSize(0.06, 0.12, (0.06, 0.08), 'm'), needs=GRIPPER, keeps_tempo=True
)
def bites_after_release(move: MovePlan, size: float) -> MovePlan:
    """Having let go, it closes three times on its way aside, this far."""
    way, stops = move.drawn(), Stops()
    for share in (1 / 3, 2 / 3, 1.0):
        there = move.like('open', phase='retreat').moved(size * share * way)
        stops += [replace(there, seconds=None), replace(there, opening=0.0), there]
    return move.shift(('retreat',), size * way).insert(move.after('open'), stops)


@fault.way_points(
    'lob',
    FaultSize(0.05, 0.2, (0.05, 0.07), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def released_in_swing(move: MovePlan, size: float) -> MovePlan:
    """It swings what it holds this far, over its goal, and lets go in full swing."""
    before = move.like('carry_end').moved(-size * move.to_goal_or_drawn(size))
    goal = move.like('open', position=move.position('carry_end'))
    stops = [before, replace(goal, phase='lower', seconds=0.3), goal]
    return move.insert(move.index('carry_end'), stops, drop=3)


@fault.way_points(
    'bowl',
    FaultSize(0.06, 0.15, (0.06, 0.12), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def released_while_sliding(move: MovePlan, size: float) -> MovePlan:
    """What it holds slides this far to its goal, in one stroke, while the fingers open."""
    move = move.shift(('carry_end', 'lower'), -size * move.to_goal_or_drawn(size))
    return move.insert(move.index('open'), [move.like('open', phase='lower', seconds=0.3)])


@fault.way_points(
    'shed',
    FaultSize(0.03, 0.12, (0.03, 0.035), 'm'),
    split='test',
    needs=GRIPPER,
    keeps_tempo=True,
)
def shaken_off_over_goal(move: MovePlan, size: float) -> MovePlan:
    """It rises with what it holds, and opens as it shakes it off, this far to either side."""
    raised, way = move.like('open', seconds=0.15).moved(0.03 * UP), size * move.drawn()
    swings = ((1, 0.2), (-1, 0.4), (1, 0.6), (-1, 0.8))
    stops = [
        move.like('lower', seconds=None).moved(0.03 * UP),
        *(replace(raised.moved(s * way), opening=raised.opening * share) for s, share in swings),
        raised,
    ]
    return move.insert(move.index('open'), stops, drop=1)
