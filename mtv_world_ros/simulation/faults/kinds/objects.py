"""Faults of scripted policies: which object, and where it belongs."""

from __future__ import annotations

from dataclasses import replace

from mtv_world_ros.simulation.faults.actions import push, shake
from mtv_world_ros.simulation.faults.fault import (
    Family,
    FaultSize,
    GRIPPER,
    GRIPPERS_OF_TWO,
    OtherArm,
)
from mtv_world_ros.simulation.faults.move_plan import GRASP, MovePlan
from mtv_world_ros.simulation.faults.neighbours import (
    nearest_to_goal,
    next_to_goal,
    next_to_own,
    on_own,
)
from mtv_world_ros.simulation.way_points import FLAT, Stops, UP, Visit, WayPoint

fault = Family('object')


def _over_next_to_goal(move: MovePlan) -> tuple[WayPoint, WayPoint]:
    """Return the way points above the object next to the goal, and down at it."""
    way = next_to_goal(move) - move.position('retreat')
    over = move.like('retreat').moved(way * FLAT)
    return over, over.moved(way * UP)


fault.enter(
    'wrong_object',
    'wrong',
    FaultSize(1, 1, (1,)),
    text='probability that another object is taken',
    contact=False,
)


@fault.way_points('torn', FaultSize(0.1, 0.5, (0.08, 0.1)))
def grasp_between_objects(move: MovePlan, size: float) -> MovePlan:
    """Share of the way to the next object that a grasp is off."""
    return move.shift(GRASP, size * move.to_other_object)


fault.enter(
    'goal_object_moved_after',
    'meddle',
    FaultSize(0.04, 0.12, (0.04, 0.06), 'm'),
    text='once done, it takes what it has put the object on or beside, and moves it this far',
    split='calibrate',
)


@fault.way_points(
    'decoy', FaultSize(0.04, 0.12, (0.04, 0.05), 'm'), needs=GRIPPER, keeps_tempo=True
)
def other_object_taken_first(move: MovePlan, size: float) -> MovePlan:
    """It first takes the other object next to its own, moves it this far and lets it go."""
    there = move.like('grasp', position=next_to_own(move), phase='above', opening=1.0)
    seconds = move.seconds('close')
    shut = replace(there, opening=0.0, seconds=seconds)
    gone = replace(shut.moved(size * move.drawn()), seconds=None)
    let_go = replace(gone, opening=1.0, seconds=seconds)
    left = replace(let_go.moved(move.rise), seconds=None)
    return move.insert(0, [there.moved(move.rise), there, shut, gone, let_go, left])


@fault.way_points(
    'jostle', FaultSize(0.07, 0.12, (0.07, 0.08), 'm'), needs=GRIPPER, keeps_tempo=True
)
def goal_object_pushed_after(move: MovePlan, size: float) -> MovePlan:
    """Once done, shut fingers push what it has put the object on or beside, this far."""
    place = next_to_goal(move)
    stop = move.like('open', position=place, seconds=None)
    rise = -((place - move.position('retreat')) * UP)
    return move.insert(move.after('retreat'), push(stop, move.drawn(), rise, far=size))


@fault.second_arm('poach', FaultSize(0.08, 0.12, (0.06, 0.1), 'm'), needs=GRIPPERS_OF_TWO)
def second_arm_takes_after(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """Once it is done, the other arm takes what it put there, and lets it fall this far away."""

    def ways(share: float) -> Stops:
        place = other.above(move.position('open'), share).position
        there = move.like('open', position=place, seconds=None)
        shut = replace(there, opening=0.0, seconds=0.4)
        raised = replace(there.moved(0.07 * UP), opening=0.0)
        gone = raised.moved(other.homewards(there, size))
        let_go = replace(gone, opening=1.0, seconds=0.3)
        return [there.moved(0.07 * UP), there, shut, raised, gone, let_go, other.home]

    return Visit(ways=ways, meets=other.until(move.after('retreat')))


@fault.way_points('waver', FaultSize(0.9, 1, (0.75, 1)), needs=GRIPPER, keeps_tempo=True)
def towards_other_object_and_back(move: MovePlan, size: float) -> MovePlan:
    """Share of the way to the next object that it goes, down at its own, and comes back."""
    down = move.like('grasp', phase='above')
    return move.insert(move.index('close'), [down.moved(size * move.to_other_object), down])


@fault.second_arm('budge', FaultSize(0.015, 0.12, (0.01, 0.02), 'm'), needs=GRIPPERS_OF_TWO)
def second_arm_moves_goal_object(move: MovePlan, size: float, other: OtherArm) -> Visit:
    """The other arm meanwhile takes what is next to the goal, and moves it this far."""

    def ways(share: float) -> Stops:
        there = replace(other.above(nearest_to_goal(move), share), yaw=0.0, opening=1.0)
        shut = replace(there, opening=0.0, seconds=0.4)
        pulled = replace(shut.moved(other.homewards(there, size)), seconds=None)
        let_go = replace(pulled, opening=1.0, seconds=0.3)
        left = replace(let_go.moved(0.07 * UP), seconds=None)
        return [there.moved(0.07 * UP), there, shut, pulled, let_go, left, other.home]

    return Visit(ways=ways, meets=other.until(move.after('close')), done=3)


@fault.way_points(
    'rattle', FaultSize(0.08, 0.1, (0.08, 0.1), 'm'), needs=GRIPPER, keeps_tempo=True
)
def goal_object_shaken_after(move: MovePlan, size: float) -> MovePlan:
    """Once done, it closes on what it has put the object on or beside, and shakes it, this far."""
    over, down = _over_next_to_goal(move)
    shut = replace(down, opening=0.0, seconds=move.seconds('close'))
    shaken = shake(replace(shut, seconds=0.15), size * move.drawn(), times=3)
    let_go = replace(down, seconds=move.seconds('close'))
    return move.insert(move.after('retreat'), [over, down, shut, *shaken, let_go, over])


@fault.way_points(
    'yank', FaultSize(0.1, 0.15, (0.08, 0.1), 'm'), split='test', needs=GRIPPER, keeps_tempo=True
)
def goal_object_yanked_after(move: MovePlan, size: float) -> MovePlan:
    """Once done, it closes on what it has put the object on or beside, and yanks it this far."""
    over, down = _over_next_to_goal(move)
    way, seconds = size * move.drawn(), move.seconds('close')
    shut = replace(down, opening=0.0, seconds=seconds)
    yanked = replace(shut.moved(way), seconds=0.2)
    let_go = replace(yanked, opening=1.0, seconds=seconds)
    stops = [over, down, shut, yanked, let_go, over.moved(way)]
    return move.insert(move.after('retreat'), stops)


@fault.way_points(
    'heap',
    FaultSize(0.02, 0.06, (0.015, 0.03), 'm'),
    split='test',
    needs=GRIPPER,
    keeps_tempo=True,
)
def other_object_stacked_first(move: MovePlan, size: float) -> MovePlan:
    """It first puts the other object next to its own on top of that, this far off its middle."""
    other, on, raised = next_to_own(move), on_own(move), 0.03 * UP
    there = move.like('grasp', position=other, phase='above', opening=1.0)
    held = replace(there, opening=0.0)
    seconds, way = move.seconds('close'), size * move.drawn()
    put = replace(held, position=on + way)
    let_go = replace(put, opening=1.0, seconds=seconds)
    stops = [
        *(there.moved(move.rise), there, replace(held, seconds=seconds)),
        replace(held, position=other * FLAT + on * UP + raised),
        *(replace(held, position=on + (way + raised)), put, let_go),
        replace(let_go.moved(raised), seconds=None),
    ]
    return move.insert(0, stops)


fault.enter(
    'goal_position_noise',
    'place',
    FaultSize(0.03, 0.1, (0.03,), 'm'),
    text='standard deviation, in x and y, of where it is put down',
    family='place',
    contact=False,
)


@fault.way_points(
    'elsewhere', FaultSize(0.05, 0.15, (0.03, 0.06), 'm'), family='place', contact=False
)
def goal_offset(move: MovePlan, size: float) -> MovePlan:
    """It is put down this far off."""
    return move.shift(('carry', 'lower', 'open', 'retreat'), size * move.anywhere)
