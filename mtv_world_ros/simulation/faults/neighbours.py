"""Places (3,) [m] of objects next to the grasped one and next to its goal."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.move_plan import MovePlan, OWN_M
from mtv_world_ros.simulation.way_points import FLAT, UP

#: maximum distance of a neighbour from the goal [m]
_MAX_GOAL_DISTANCE_M = 0.2
#: maximum distance of a neighbour from the rest position of the arm [m]
_MAX_REACH_M = 0.27
#: a neighbour of the goal may be this much farther from the rest position than the goal [m]
_EXTRA_REACH_M = 0.03
#: gap between an object and the object that it is put on [m]
_STACKING_GAP_M = 0.005


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm((a - b)[:2]))


def _others(move: MovePlan, own: FloatArray) -> list[FloatArray]:
    return [place for place in move.draws.objects if _distance(place, own) > OWN_M]


def next_to_goal(move: MovePlan) -> FloatArray:
    """Return the position of the object next to the goal, else the goal."""
    return _object_by_goal(move, move.position('open'))


def _object_by_goal(move: MovePlan, otherwise: FloatArray) -> FloatArray:
    own, goal = move.position('close'), move.position('open')
    farthest = max(_MAX_REACH_M, _EXTRA_REACH_M + _distance(goal, move.rest))
    nears = [
        place
        for place in _others(move, own)
        if _distance(place, goal) < _MAX_GOAL_DISTANCE_M and _distance(place, move.rest) < farthest
    ]
    return min(nears, key=lambda place: _distance(place, goal), default=otherwise)


def on_next_to_goal(move: MovePlan) -> FloatArray:
    """Return the place of the tool with the held object on the object next to the goal.

    What lies on the table is twice as high as its centre.
    """
    at = _object_by_goal(move, move.position('open') * FLAT)
    return at * (1, 1, 2) + move.position('close')[2] * UP


def nearest_to_goal(move: MovePlan) -> FloatArray:
    """Return the position of the object nearest to the goal, else the grasped one's."""
    own, goal = move.position('close'), move.position('open')
    return min(_others(move, own), key=lambda place: _distance(place, goal), default=own)


def next_to_own(move: MovePlan) -> FloatArray:
    """Return the position of the object next to the grasped one, else the grasp."""
    own = move.position('close')
    others = [place for place in _others(move, own) if _distance(place, move.rest) < _MAX_REACH_M]
    grasp = move.position('grasp')
    return min(others, key=lambda place: _distance(place, own), default=grasp)


def on_own(move: MovePlan) -> FloatArray:
    """Return the place of the tool with the object next to the grasped one on top of that."""
    grasp = move.position('grasp')
    own = min(move.draws.objects, key=lambda place: _distance(place, grasp))
    return own * (1, 1, 2) + (next_to_own(move)[2] + _STACKING_GAP_M) * UP
