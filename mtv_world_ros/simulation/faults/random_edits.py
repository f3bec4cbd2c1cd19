"""Changes of way points that are drawn at random: runs, visits, actions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import UP, WayPoint


@dataclass(frozen=True, slots=True)
class RandomEditSettings:
    """Settings of random edits of way points.

    Attributes:
        play_m: standard deviation of a way point of play in the plane [m].
        play_yaw_rad: standard deviation of its yaw [rad].
        play_height_m: largest change of its height [m].
        odd_m: standard deviation of the position of an odd way point [m].
        odd_yaw_rad: standard deviation of its yaw [rad].
        odd_lean_rad: standard deviation of its lean [rad].
        max_odd_run: largest number of consecutive odd way points.
        visit_from_m: range of the start of a visit, before the object's centre [m].
        visit_to_m: range of the end of a visit, past the object's centre [m].
        visit_height_m: range of the height of a visit over the object [m].
        visit_rise_m: range of the rise before and after a visit [m].
        visit_offset_m: standard deviation of a visit's offset from the centre [m].
        visit_yaw_rad: standard deviation of the yaw in a visit [rad].
        visit_lean_rad: standard deviation of the lean in a visit [rad].
        action_offset_m: standard deviation of the offset of actions at an object [m].
        action_angle_rad: standard deviation of a lean or a turn in an action [rad].
        action_rise_m: range of the rise in an action [m].
        action_gripper_s: duration of opening or closing in an action [s].
        max_press_depth_m: largest depth of a held object pressed on the one below [m].
        other_object_fraction: probability that a held object is moved to another object.
        perch_rise_m: rise of a held object over another object [m].
        meet_height_m: range of the tool height over its grasp at a meeting [m].
        meet_offset_m: standard deviation of the path from the centre of the other object [m].
    """

    play_m: float = 0.03
    play_yaw_rad: float = 0.4
    play_height_m: float = 0.06
    odd_m: float = 0.025
    odd_yaw_rad: float = 0.5
    odd_lean_rad: float = 0.35
    max_odd_run: int = 3
    visit_from_m: tuple[float, float] = (0.0, 0.08)
    visit_to_m: tuple[float, float] = (-0.02, 0.06)
    visit_height_m: tuple[float, float] = (-0.03, 0.05)
    visit_rise_m: tuple[float, float] = (0.03, 0.1)
    visit_offset_m: float = 0.012
    visit_yaw_rad: float = 0.6
    visit_lean_rad: float = 0.35
    action_offset_m: float = 0.03
    action_angle_rad: float = 0.5
    action_rise_m: tuple[float, float] = (-0.04, 0.06)
    action_gripper_s: float = 0.3
    max_press_depth_m: float = 0.025
    other_object_fraction: float = 0.2
    perch_rise_m: float = 0.05
    meet_height_m: tuple[float, float] = (0.0, 0.09)
    meet_offset_m: float = 0.03


_EDITS = RandomEditSettings()


def _above(stop: WayPoint, floor: float) -> WayPoint:
    x, y, z = stop.position
    return replace(stop, position=np.array([x, y, max(z, floor)]))


def random_way_points(move: MovePlan, size: float) -> MovePlan:
    """Insert random way points: before the grasp, on the path to the goal, after the release."""
    rng, floor = move.rng, move.floor
    begins = {'grasp': 0.6, 'carry': 0.2, 'retreat': 0.2}
    for _ in range(round(size)):
        at = move.index(str(rng.choice(list(begins), p=list(begins.values()))))
        where = move.stops[at if move.stops[at].phase == 'grasp' else at - 1]
        x, y = where.position[:2] + rng.normal(0.0, _EDITS.play_m, 2)
        # half of the way points are at the lowest allowed height, where objects are
        z = max(
            floor, where.position[2] + rng.uniform(-_EDITS.play_height_m, _EDITS.play_height_m)
        )
        drawn = replace(
            where,
            phase='above',
            position=np.array([x, y, z]),
            yaw=where.yaw + float(rng.normal(0.0, _EDITS.play_yaw_rad)),
            opening=float(rng.uniform()),
            seconds=None,
        )
        move = move.insert(at, [drawn])
    return move


def random_runs(move: MovePlan, size: float) -> MovePlan:
    """Change the opening, position or rotation of random runs of way points, or add a detour."""
    rng, floor = move.rng, move.floor
    for _ in range(round(size)):
        first = int(rng.integers(len(move.stops) - 1))
        end = min(first + int(rng.integers(1, _EDITS.max_odd_run + 1)), len(move.stops) - 1)
        way, opening = rng.normal(0.0, _EDITS.odd_m, 3), float(rng.uniform())
        yaw, lean = rng.normal(0.0, (_EDITS.odd_yaw_rad, _EDITS.odd_lean_rad))
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
        move = move.insert(first, run, drop=end - first)
    return move


def random_visits(move: MovePlan, size: float) -> MovePlan:
    """Insert a visit before a random way point: to an object, and through it or past it."""
    rng, floor = move.rng, move.floor
    for _ in range(round(size)):
        at = int(rng.integers(len(move.stops)))
        x, y, z = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
        angle = rng.uniform(0.0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        past = np.array([x, y]) + rng.normal(0.0, _EDITS.visit_offset_m, 2)
        height = max(floor, z + rng.uniform(*_EDITS.visit_height_m))
        begin = np.array([*(past - rng.uniform(*_EDITS.visit_from_m) * way), height])
        end = np.array([*(past + rng.uniform(*_EDITS.visit_to_m) * way), height])
        arrives = WayPoint(
            phase='above',
            position=begin,
            yaw=float(rng.normal(0.0, _EDITS.visit_yaw_rad)),
            # half of the visits keep the opening of the gripper
            opening=float(rng.uniform()) if rng.random() < 0.5 else move.stops[at].opening,
            lean=float(rng.normal(0.0, _EDITS.visit_lean_rad)) if rng.random() < 0.5 else 0.0,
        )
        leaves = replace(arrives, position=end)
        if rng.random() < 0.5:
            leaves = replace(leaves, opening=float(rng.uniform()))
        before, after = (rng.uniform(*_EDITS.visit_rise_m) * UP for _ in range(2))
        visit = [arrives.moved(before), arrives, leaves, leaves.moved(after)]
        move = move.insert(at, visit)
    return move


def random_actions_at_object(move: MovePlan, size: float) -> MovePlan:
    """Insert a sequence of random actions at an object: each changes one quantity.

    The actions include opening the fingers in place, and raising, leaning and releasing the held
    object.
    """
    rng, floor = move.rng, move.floor
    at = int(rng.integers(len(move.stops)))
    place = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
    here = WayPoint(
        phase='above',
        position=place + rng.normal(0.0, _EDITS.action_offset_m, 3) * (1, 1, 0),
        yaw=float(rng.normal(0.0, _EDITS.visit_yaw_rad)),
        opening=float(rng.choice((0.0, rng.uniform(), 1.0))),
    )
    run = [_above(here, floor)]
    for _ in range(round(size)):
        run.append(_varied(run[-1], floor, rng))
    before, after = (rng.uniform(*_EDITS.visit_rise_m) * UP for _ in range(2))
    left = replace(run[-1], seconds=None).moved(after)
    move = move.insert(at, [run[0].moved(before), *run, left])
    return move


def _varied(stop: WayPoint, floor: float, rng: np.random.Generator) -> WayPoint:
    """Return the next way point, with another opening, height, position, lean or yaw."""
    last = replace(stop, seconds=None)
    match str(rng.choice(['opening', 'height', 'place', 'lean', 'turn'], p=[0.4, *[0.15] * 4])):
        case 'opening':
            opening = float(rng.choice((0.0, rng.uniform(), 1.0)))
            return replace(last, opening=opening, seconds=_EDITS.action_gripper_s)
        case 'height':
            return _above(last.moved(rng.uniform(*_EDITS.action_rise_m) * UP), floor)
        case 'place':
            return last.moved(rng.normal(0.0, _EDITS.action_offset_m, 3) * (1, 1, 0))
        case 'lean':
            return replace(last, lean=float(rng.normal(0.0, _EDITS.action_angle_rad)))
        case _:
            return replace(last, yaw=last.yaw + float(rng.normal(0.0, _EDITS.action_angle_rad)))


def random_actions_with_object(move: MovePlan, size: float) -> MovePlan:
    """Insert random actions with the held object, on the table and on other objects.

    So it is pressed down, dragged, leaned, put on what lies there, let go and taken again.
    """
    rng, lift = move.rng, move.index('lift')
    low = float(move.stops[lift - 1].position[2])
    floor = low - rng.uniform(0.0, _EDITS.max_press_depth_m)
    at = int(rng.integers(lift, move.index('open') + 1))
    run = [replace(move.stops[at - 1], phase='carry', seconds=None)]
    for _ in range(round(size)):
        if rng.random() < _EDITS.other_object_fraction:
            place = move.draws.objects[int(rng.integers(len(move.draws.objects)))]
            # what lies on the table is twice as high as its centre
            over = place * (1, 1, rng.choice((0, 2))) + floor * UP
            over = over + rng.normal(0.0, _EDITS.action_offset_m, 3) * (1, 1, 0)
            there = replace(run[-1], position=over, seconds=None)
            high = max(_EDITS.perch_rise_m, run[-1].position[2] - over[2]) * UP
            run += [there.moved(high), there]
        else:
            run.append(_varied(run[-1], floor, rng))
    move = move.insert(at, run[1:])
    return move


def random_carried_contacts(move: MovePlan, size: float) -> MovePlan:
    """Carry the held object at a low height through, or past, the position of another object."""
    rng = move.rng
    grasp = move.position('close')
    others = [
        place
        for place in move.draws.objects
        if np.linalg.norm((place - grasp)[:2]) > _EDITS.visit_to_m[1]
    ]
    for _ in range(round(size) if others else 0):
        at = int(rng.integers(move.index('lift') + 1, move.index('open') + 1))
        place = others[int(rng.integers(len(others)))][:2] + rng.normal(
            0.0, _EDITS.meet_offset_m, 2
        )
        angle, height = rng.uniform(0.0, 2 * np.pi), grasp[2] + rng.uniform(*_EDITS.meet_height_m)
        way = np.array([np.cos(angle), np.sin(angle)])
        begin, end = (
            np.array([*(place + far * way), height])
            for far in (-rng.uniform(0.06, 0.14), rng.uniform(*_EDITS.visit_to_m))
        )
        before = move.stops[at - 1]
        arrives = replace(before, phase='carry', position=begin, seconds=None)
        if rng.random() < 0.5:
            arrives = replace(
                arrives, yaw=before.yaw + float(rng.normal(0.0, _EDITS.visit_yaw_rad))
            )
        leaves = replace(arrives, position=end)
        over, after = (rng.uniform(*_EDITS.visit_rise_m) * UP for _ in range(2))
        meeting = [arrives.moved(over), arrives, leaves, leaves.moved(after)]
        move = move.insert(at, meeting)
    return move


def way_points_left_out(move: MovePlan, size: float) -> MovePlan:
    """Remove random way points, so that the arm moves straight to the next one.

    Where it should close or open, it has done so at the next one. Others, drawn anew, where the
    arm does not reach the way between.
    """
    gone = move.rng.permutation(len(move.stops) - 1)[: round(size)]
    for number in sorted(map(int, gone), reverse=True):
        left_out, after = move.stops[number : number + 2]
        if left_out.phase in ('close', 'open'):
            after = replace(after, phase=left_out.phase)
        move = move.insert(number, [after], drop=2)
    return move


def way_points_swapped(move: MovePlan, size: float) -> MovePlan:
    """Exchange random way points with the next one, so that the later action comes first.

    Others, drawn anew, where the arm does not reach the way between.
    """
    for number in map(int, move.rng.permutation(len(move.stops) - 2)[: round(size)]):
        move = move.insert(number, move.stops[number : number + 2][::-1], drop=2)
    return move
