"""Faults of scripted policies: how high the tool is."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mtv_world_ros.simulation.faults.commands import heave, sink_once
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import UP, WayPoint

fault = Family('height')


@fault.way_points('high', FaultSize(0.02, 0.1, (0.015, 0.03), 'm'))
def grasp_height(move: MovePlan, size: float) -> MovePlan:
    """A grasp closes this much too high."""
    return move.shift(('grasp', 'close'), size * UP)


@fault.way_points('dive', FaultSize(1, 1, (0.9, 1)))
def low_approach(move: MovePlan, size: float) -> MovePlan:
    """Share that lacks of its height before it goes down."""
    return move.shift(('start',), size * move.between('start', 'grasp'))


@fault.way_points('drop_high', FaultSize(0.04, 0.15, (0.04, 0.07), 'm'), split='calibrate')
def release_height(move: MovePlan, size: float) -> MovePlan:
    """It lets go this much too high."""
    return move.shift(('carry', 'lower', 'open', 'retreat'), size * UP)


@fault.way_points('drag', FaultSize(0.75, 1, (0.75, 0.85)), needs=GRIPPER, keeps_tempo=True)
def dragged_before_lift(move: MovePlan, size: float) -> MovePlan:
    """Share of the way to its goal over which it drags the object before it lifts it."""
    way, low = (
        size * move.carry_way,
        move.like('close', phase='lift', seconds=None).moved(-0.02 * UP),
    )
    return move.shift(('lift',), way).insert(move.index('lift'), [low, low.moved(way)])


@fault.way_points(
    'thump',
    FaultSize(0.035, 0.06, (0.035, 0.04), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def thumped_on_goal(move: MovePlan, size: float) -> MovePlan:
    """What it holds is thumped on its goal, three times, this deep."""
    goal = move.like('lower', seconds=0.12)
    return move.insert(move.index('open'), [goal.moved(0.05 * UP), goal.moved(-size * UP)] * 3)


@fault.way_points(
    'dip',
    FaultSize(0.02, 0.08, (0.02, 0.03), 'm'),
    split='calibrate',
    needs=GRIPPER,
    keeps_tempo=True,
)
def dipped_on_the_way(move: MovePlan, size: float) -> MovePlan:
    """Half-way to its goal, what it holds is dipped on the table, this deep."""
    way = 0.5 * move.carry_way + move.lift_down - size * UP
    return move.insert(move.after('lift'), [move.like('lift', phase='carry').moved(way)])


@fault.way_points('sag', FaultSize(0.35, 0.5, (0.3, 0.4)), split='calibrate')
def sag_with_reach(move: MovePlan, size: float) -> MovePlan:
    """Share of how far it reaches out by which the arm hangs too low."""
    return move.edit(('all',), lambda stop: stop.moved(-size * move.reach(stop) * UP))


@fault.way_points('droop', FaultSize(0.45, 1, (0.4, 0.5)), needs=GRIPPER)
def sag_while_carrying(move: MovePlan, size: float) -> MovePlan:
    """Share of how far it has carried the object by which the arm hangs too low."""
    first = move.index('lift') - 1

    def lowered(stop: WayPoint) -> WayPoint:
        carried = pairwise(move.stops[first : move.number_of(stop) + 1])
        far = sum(float(np.linalg.norm((b.position - a.position)[:2])) for a, b in carried)
        return stop.moved(-size * far * UP)

    return move.edit(move.span('lift', 'open'), lowered)


fault.commands(
    'arms_sink_once',
    'slump',
    FaultSize(0.1, 0.3, (0.06, 0.15), 'm'),
    sink_once,
    'once, the arms give way under their weight, sink this far, and rise again',
)

fault.commands(
    'arms_heave',
    'heave',
    FaultSize(0.04, 0.1, (0.04, 0.05), 'm'),
    heave,
    'both arms go up and down in waves, this far',
    split='calibrate',
)
