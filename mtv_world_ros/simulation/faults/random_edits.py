"""Edits of way points that are programs: runs, visits and actions drawn at random."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mtv_world_ros.simulation.expert.way_points import WayPoint
from mtv_world_ros.simulation.faults.edited_move import EditedMove, UP

#: a way point of play: standard deviations in the plane [m], in yaw [rad]; largest height [m]
_PLAY_M, _PLAY_RAD, _PLAY_HEIGHT_M = 0.03, 0.4, 0.06
#: an odd way point: standard deviations of its place [m], yaw and lean [rad]; the longest run
_ODD_M, _ODD_YAW_RAD, _ODD_LEAN_RAD, _ODD_RUN = 0.025, 0.5, 0.35, 3
#: a visit to an object: from how far to how far past its centre it goes in the plane, how low and
#: high over it, how much it rises before and after [m]; standard deviations beside the centre [m],
#: of yaw and lean [rad]
_VISIT_FROM_M, _VISIT_TO_M = (0.0, 0.08), (-0.02, 0.06)
_VISIT_HEIGHT_M, _VISIT_RISE_M = (-0.03, 0.05), (0.03, 0.1)
_VISIT_BESIDE_M, _VISIT_YAW_RAD, _VISIT_LEAN_RAD = 0.012, 0.6, 0.35
#: one action after the other at an object: standard deviations beside its centre [m], of a lean
#: and of a turn [rad]; how far it rises or sinks [m]; time that opening or closing takes [s]
_FIDGET_BESIDE_M, _FIDGET_RAD, _FIDGET_RISE_M, _FIDGET_S = 0.03, 0.5, (-0.04, 0.06), 0.3
#: how deep what is held may be pressed on what is under it [m]; how often it comes to an object,
#: and how far it rises there [m]
_TINKER_DEPTH_M, _TINKER_OTHER, _PERCH_RISE_M = 0.025, 0.2, 0.05
#: what is carried meets an object: how high the tool is over where it grasped, how far the centres
#: pass each other [m]
_MEET_HEIGHT_M, _MEET_BESIDE_M = (0.0, 0.09), 0.03


def _above(stop: WayPoint, floor: float) -> WayPoint:
    x, y, z = stop.position
    return replace(stop, position=np.array([x, y, max(z, floor)]))


def random_way_points(move: EditedMove) -> None:
    """Way points drawn at random: before the grasp, on the way to the goal, after the release."""
    rng, floor = move.draws.play, move.floor
    begins = {'grasp': 0.6, 'carry': 0.2, 'retreat': 0.2}
    for _ in range(round(move.size)):
        at = move.index(str(rng.choice(list(begins), p=list(begins.values()))))
        where = move.stops[at if move.stops[at].phase == 'grasp' else at - 1]
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
        move.stops = [*move.stops[:at], drawn, *move.stops[at:]]


def random_runs(move: EditedMove) -> None:
    """Drawn runs of way points have another opening, place or turn, or a detour."""
    rng, floor = move.draws.play, move.floor
    for _ in range(round(move.size)):
        first = int(rng.integers(len(move.stops) - 1))
        end = min(first + int(rng.integers(1, _ODD_RUN + 1)), len(move.stops) - 1)
        way, opening = rng.normal(0.0, _ODD_M, 3), float(rng.uniform())
        yaw, lean = rng.normal(0.0, (_ODD_YAW_RAD, _ODD_LEAN_RAD))
        match str(rng.choice(['opening', 'place', 'turn', 'detour'], p=[0.4, 0.2, 0.2, 0.2])):
            case 'opening':
                run = [replace(s, opening=opening) for s in move.stops[first:end]]
            case 'place':
                run = [_above(s.moved(way), floor) for s in move.stops[first:end]]
            case 'turn':
                run = [
                    replace(s, yaw=s.yaw + yaw, lean=s.lean + lean) for s in move.stops[first:end]
                ]
            case _:
                detour = replace(move.stops[end - 1], phase='above', seconds=None).moved(way)
                run = [*move.stops[first:end], _above(detour, floor)]
        move.stops = [*move.stops[:first], *run, *move.stops[end:]]


def random_visits(move: EditedMove) -> None:
    """Before a drawn way point it goes to an object, and through it or past it."""
    rng, floor = move.draws.play, move.floor
    for _ in range(round(move.size)):
        at = int(rng.integers(len(move.stops)))
        x, y, z = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
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
            opening=float(rng.uniform()) if rng.random() < 0.5 else move.stops[at].opening,
            lean=float(rng.normal(0.0, _VISIT_LEAN_RAD)) if rng.random() < 0.5 else 0.0,
        )
        leaves = replace(arrives, position=end)
        if rng.random() < 0.5:
            leaves = replace(leaves, opening=float(rng.uniform()))
        before, after = (rng.uniform(*_VISIT_RISE_M) * UP for _ in range(2))
        visit = [arrives.moved(before), arrives, leaves, leaves.moved(after)]
        move.stops = [*move.stops[:at], *visit, *move.stops[at:]]


def random_actions_at_object(move: EditedMove) -> None:
    """At an object, over it or beside it, one thing changes after the other.

    So fingers also open where they are, and what is held is raised, leaned and let go.
    """
    rng, floor = move.draws.play, move.floor
    at = int(rng.integers(len(move.stops)))
    place = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
    here = WayPoint(
        phase='above',
        position=place + rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0),
        yaw=float(rng.normal(0.0, _VISIT_YAW_RAD)),
        opening=float(rng.choice((0.0, rng.uniform(), 1.0))),
    )
    run = [_above(here, floor)]
    for _ in range(round(move.size)):
        run.append(_varied(run[-1], floor, rng))
    before, after = (rng.uniform(*_VISIT_RISE_M) * UP for _ in range(2))
    left = replace(run[-1], seconds=None).moved(after)
    move.stops = [*move.stops[:at], run[0].moved(before), *run, left, *move.stops[at:]]


def _varied(stop: WayPoint, floor: float, rng: np.random.Generator) -> WayPoint:
    """The next way point, with another opening, height, place, lean or turn."""
    last = replace(stop, seconds=None)
    match str(rng.choice(['opening', 'height', 'place', 'lean', 'turn'], p=[0.4, *[0.15] * 4])):
        case 'opening':
            opening = float(rng.choice((0.0, rng.uniform(), 1.0)))
            return replace(last, opening=opening, seconds=_FIDGET_S)
        case 'height':
            return _above(last.moved(rng.uniform(*_FIDGET_RISE_M) * UP), floor)
        case 'place':
            return last.moved(rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0))
        case 'lean':
            return replace(last, lean=float(rng.normal(0.0, _FIDGET_RAD)))
        case _:
            return replace(last, yaw=last.yaw + float(rng.normal(0.0, _FIDGET_RAD)))


def random_actions_with_object(move: EditedMove) -> None:
    """With what the gripper holds, one thing changes after the other, on the table and on objects.

    So it is pressed down, dragged, leaned, put on what lies there, let go and taken again.
    """
    rng, lift = move.draws.play, move.index('lift')
    low = float(move.stops[lift - 1].position[2])
    floor = low - rng.uniform(0.0, _TINKER_DEPTH_M)
    at = int(rng.integers(lift, move.index('open') + 1))
    run = [replace(move.stops[at - 1], phase='carry', seconds=None)]
    for _ in range(round(move.size)):
        if rng.random() < _TINKER_OTHER:
            place = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
            # what lies on the table is twice as high as its centre
            over = place * (1, 1, rng.choice((0, 2))) + floor * UP
            over = over + rng.normal(0.0, _FIDGET_BESIDE_M, 3) * (1, 1, 0)
            there = replace(run[-1], position=over, seconds=None)
            high = max(_PERCH_RISE_M, run[-1].position[2] - over[2]) * UP
            run += [there.moved(high), there]
        else:
            run.append(_varied(run[-1], floor, rng))
    move.stops = [*move.stops[:at], *run[1:], *move.stops[at:]]


def random_carried_contacts(move: EditedMove) -> None:
    """What the gripper holds is carried low through another object's place, or past it."""
    rng = move.draws.play
    grasp = move.stop('close').position
    others = [
        place
        for place in move.draws.objects
        if np.linalg.norm((place - grasp)[:2]) > _VISIT_TO_M[1]
    ]
    for _ in range(round(move.size) if others else 0):
        at = int(rng.integers(move.index('lift') + 1, move.index('open') + 1))
        place = others[int(rng.integers(len(others)))][:2] + rng.normal(0.0, _MEET_BESIDE_M, 2)
        angle, height = rng.uniform(0.0, 2 * np.pi), grasp[2] + rng.uniform(*_MEET_HEIGHT_M)
        way = np.array([np.cos(angle), np.sin(angle)])
        begin, end = (
            np.array([*(place + far * way), height])
            for far in (-rng.uniform(0.06, 0.14), rng.uniform(*_VISIT_TO_M))
        )
        before = move.stops[at - 1]
        arrives = replace(before, phase='carry', position=begin, seconds=None)
        if rng.random() < 0.5:
            arrives = replace(arrives, yaw=before.yaw + float(rng.normal(0.0, _VISIT_YAW_RAD)))
        leaves = replace(arrives, position=end)
        over, after = (rng.uniform(*_VISIT_RISE_M) * UP for _ in range(2))
        meeting = [arrives.moved(over), arrives, leaves, leaves.moved(after)]
        move.stops = [*move.stops[:at], *meeting, *move.stops[at:]]


def way_points_left_out(move: EditedMove) -> None:
    """Way points are left out, and it goes straight to the next one.

    Where it should close or open, it has done so at the next one. Others, drawn anew, where the
    arm does not reach the way between.
    """
    gone = move.draws.play.permutation(len(move.stops) - 1)[: round(move.size)]
    for number in sorted(map(int, gone), reverse=True):
        left_out, after = move.stops[number : number + 2]
        if left_out.phase in ('close', 'open'):
            after = replace(after, phase=left_out.phase)
        move.stops = [*move.stops[:number], after, *move.stops[number + 2 :]]


def way_points_swapped(move: EditedMove) -> None:
    """Way points change places with the next one, so that it does the later thing first.

    Others, drawn anew, where the arm does not reach the way between.
    """
    for number in map(int, move.draws.play.permutation(len(move.stops) - 2)[: round(move.size)]):
        move.stops[number : number + 2] = move.stops[number + 1], move.stops[number]


RANDOM_EDITS: Mapping[str, Callable[[EditedMove], None]] = {
    edit.__name__: edit
    for edit in (
        *(random_way_points, random_runs, random_visits, random_actions_at_object),
        *(random_actions_with_object, random_carried_contacts, way_points_left_out),
        way_points_swapped,
    )
}
