"""Faults of scripted policies: what is taken again."""

from __future__ import annotations

from dataclasses import replace

from mtv_world_ros.simulation.faults.actions import push
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import GRASP, GRASP_FROM_START, left_of, MovePlan
from mtv_world_ros.simulation.faults.neighbours import on_next_to_goal
from mtv_world_ros.simulation.faults.random_edits import way_points_left_out, way_points_swapped
from mtv_world_ros.simulation.way_points import FLAT, Stops, UP

fault = Family('regrasp')


@fault.way_points('retry', FaultSize(0.03, 0.08, (0.03,), 'm'))
def grasp_twice(move: MovePlan, size: float) -> MovePlan:
    """A first grasp is this far off, the second is right."""
    way = size * move.across
    over, down, shut = (move.like(name, phase='above').moved(way) for name in GRASP_FROM_START)
    raised = shut.moved(0.04 * UP)
    stops = [over, down, shut, raised, replace(raised, opening=1.0, seconds=0.3)]
    return move.insert(0, stops)


@fault.way_points('regrasp', FaultSize(0.02, 0.1, (0.01, 0.03), 'm'))
def put_aside_first(move: MovePlan, size: float) -> MovePlan:
    """It puts the object down this far off and grasps where it was."""
    over, down, shut = (move.like(name, phase='above') for name in GRASP_FROM_START)
    raised = replace(shut.moved(0.04 * UP), seconds=None)
    aside = raised.moved(size * move.anywhere)
    low = aside.moved(-0.038 * UP)
    let_go = replace(low, opening=1.0, seconds=0.3)
    left = replace(let_go.moved(0.038 * UP), seconds=None)
    return move.insert(0, [over, down, shut, raised, aside, low, let_go, left])


@fault.way_points('clutch', FaultSize(0.8, 1, (0.7, 0.95)))
def fingers_close_on_retreat(move: MovePlan, size: float) -> MovePlan:
    """Share by which the fingers close again while it retreats."""
    opening = move.opening('open') * (1 - size)
    return move.edit(('retreat',), lambda stop: replace(stop, opening=opening))


@fault.way_points('juggle', FaultSize(0.08, 0.15, (0.07, 0.1), 'm'), keeps_tempo=True)
def dropped_and_retaken(move: MovePlan, size: float) -> MovePlan:
    """Half-way it lets the object fall from this height, and takes it again."""
    half, lift = 0.5 * move.carry_way, move.like('lift', phase='carry')
    down = lift.moved(half + move.lift_down)
    high = replace(lift.moved(half + move.lift_down + size * UP), seconds=None)
    stops = [
        *(lift.moved(half), high, replace(high, opening=1.0, seconds=0.3)),
        *(replace(down, opening=1.0, seconds=None), replace(down, seconds=move.seconds('close'))),
        lift.moved(half),
    ]
    return move.insert(move.after('lift'), stops)


@fault.way_points('topple', FaultSize(1, 1.1, (0.9, 1), 'rad'), needs=GRIPPER, keeps_tempo=True)
def dropped_leaning(move: MovePlan, size: float) -> MovePlan:
    """It raises the object, lets it fall leaning by this much, and grasps where it was."""
    over, down, shut = (move.like(name, phase='above') for name in GRASP_FROM_START)
    raised = replace(shut.moved(0.04 * UP), seconds=None)
    leaning = raised.turned(lean=move.side() * size)
    let_go = replace(leaning, opening=1.0, seconds=0.3)
    left = replace(shut.moved(0.08 * UP), opening=1.0, seconds=None)
    return move.insert(0, [over, down, shut, raised, leaning, let_go, left])


@fault.way_points('undo', FaultSize(0.05, 0.15, (0.03, 0.05), 'm'), split='calibrate')
def carried_back_after(move: MovePlan, size: float) -> MovePlan:
    """It takes the object again and carries it back this far."""
    way = size * move.towards('open', 'grasp', size, lambda: move.anywhere)
    goal = move.like('open', phase='retreat')
    shut = replace(goal, opening=0.0)
    raised = replace(shut.moved(0.04 * UP), seconds=None)
    back = raised.moved(way)
    stops = [shut, raised, back, back.moved(-0.04 * UP), goal.moved(way)]
    return move.shift(('retreat',), way).insert(move.after('open'), stops)


@fault.way_points('tidy', FaultSize(0.05, 0.1, (0.04, 0.06), 'm'), keeps_tempo=True)
def pushed_after_release(move: MovePlan, size: float) -> MovePlan:
    """Once done, shut fingers push the object this far, off its middle."""
    way = move.drawn()
    stop = move.like('open').moved(move.rng.normal(0.0, 0.02) * left_of(way))
    stops = push(stop, way, move.between('open', 'retreat'), far=size)
    return move.insert(move.after('retreat'), stops)


@fault.way_points(
    'perch', FaultSize(0.05, 0.08, (0.05, 0.06), 'm'), needs=GRIPPER, keeps_tempo=True
)
def perched_on_other_object(move: MovePlan, size: float) -> MovePlan:
    """It puts the object on another one, this far off its middle, and takes it again."""
    on = move.like('close', position=on_next_to_goal(move), phase='carry', seconds=None)
    way, wide = size * move.drawn(), move.opening('grasp')
    high, low = on.moved(way + 0.052 * UP), on.moved(way + 0.002 * UP)
    stops = [
        *(high, low, replace(low, opening=move.opening('open'), seconds=move.seconds('open'))),
        *(replace(high, opening=wide), replace(low, opening=wide)),
        *(replace(low, seconds=move.seconds('close')), high),
    ]
    return move.insert(move.after('lift'), stops)


@fault.way_points(
    'nibble', FaultSize(0.06, 0.1, (0.05, 0.07), 'm'), needs=GRIPPER, keeps_tempo=True
)
def bites_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """It comes down this far off and closes three times on its way to the right place."""
    way, wide, stops = move.drawn(), move.opening('grasp'), Stops()
    for share in (1.0, 2 / 3, 1 / 3):
        off = size * share * way
        shut = move.like('close', phase='above').moved(off)
        stops += [move.like('grasp', phase='above').moved(off), shut, replace(shut, opening=wide)]
    return move.shift(('start',), size * way).insert(move.index('grasp'), stops)


@fault.way_points(
    'toss',
    FaultSize(0.035, 0.1, (0.035, 0.04), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def tossed_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """It tosses the object this far aside, and takes it from where it let go."""
    way = size * move.drawn()
    move = move.shift((*GRASP, 'lift'), way)
    over, down, shut = (move.like(name, phase='above').moved(-way) for name in GRASP_FROM_START)
    raised = replace(shut.moved(0.04 * UP), seconds=None)
    tossed = replace(raised.moved(way), opening=move.opening('grasp'), seconds=0.3)
    return move.insert(0, [over, down, shut, raised, tossed])


@fault.way_points(
    'hop', FaultSize(0.018, 0.05, (0.015, 0.018), 'm'), needs=GRIPPER, keeps_tempo=True
)
def put_down_on_the_way(move: MovePlan, size: float) -> MovePlan:
    """On its way it puts the object down twice, lets go, and takes it again this far off."""
    way, wide, seconds = (
        move.between('close', 'lower') * FLAT,
        move.opening('grasp'),
        move.seconds('close'),
    )
    held, up, stops = move.like('close', phase='carry', seconds=None), 0.04 * UP, Stops()
    for share in (0.2, 0.4):
        off, put = size * move.drawn(), held.moved(share * way)
        let_go = replace(put, opening=wide, seconds=seconds)
        left = replace(let_go.moved(up), seconds=None)
        again = replace(held.moved(share * way + off), opening=wide)
        taken = replace(again, opening=0.0, seconds=seconds)
        raised = replace(taken.moved(up), seconds=None)
        stops += [held.moved(share * way + up), put, let_go, left, left.moved(off)]
        stops += [again, taken, raised]
    return move.insert(move.after('lift'), stops)


fault.enter(
    'way_points_swapped',
    'jumble',
    FaultSize(2, 4, (1, 2)),
    text='number of way points that change places with the next one',
    way_points=way_points_swapped,
    family='any',
    split='calibrate',
    keeps_tempo=True,
)

fault.enter(
    'way_points_left_out',
    'omit',
    FaultSize(2, 4, (2, 3)),
    text='number of way points that are left out',
    way_points=way_points_left_out,
    family='any',
    keeps_tempo=True,
)
