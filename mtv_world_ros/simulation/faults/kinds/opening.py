"""Faults of scripted policies: how far the gripper is open."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from mtv_world_ros.simulation.faults.commands import (
    flicker,
    give_way,
    haste,
    opening_noise,
    pause_half_way,
    reach,
    time_shut,
    twitches,
)
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import WayPoint

fault = Family('opening')


@fault.way_points('loose', FaultSize(0.4, 1, (0.4,)))
def grip_loose(move: MovePlan, size: float) -> MovePlan:
    """Share of its range that the gripper stays open."""
    return move.edit(('close', 'lift', 'carry', 'lower'), lambda stop: stop.opened(size))


fault.commands(
    'opening_noise',
    'fumble',
    FaultSize(0.3, 1, (0.4,)),
    opening_noise,
    'standard deviation of a slow error of how far the grippers open, as a share',
)


@fault.way_points('grip', FaultSize(0.6, 1, (0.6,)))
def way_point_opening_noise(move: MovePlan, size: float) -> MovePlan:
    """Standard deviation of how far the gripper is open at every way point, as a share."""

    def noisy(stop: WayPoint) -> WayPoint:
        error = size * move.draws.openings[move.number_of(stop)]
        return replace(stop, opening=float(np.clip(stop.opening + error, 0.0, 1.0)))

    return move.edit(('moving',), noisy)


@fault.way_points('narrow', FaultSize(0.5, 1, (0.4, 0.6)))
def approach_opening_narrow(move: MovePlan, size: float) -> MovePlan:
    """Share of its opening that lacks before a grasp; 1 = shut."""
    return move.edit(('above', 'grasp'), lambda s: replace(s, opening=s.opening * (1 - size)))


fault.commands(
    'gripper_jerks',
    'twitch',
    FaultSize(0.3, 1, (0.3, 0.35)),
    partial(give_way, by=twitches),
    'again and again the gripper jerks open, to this share',
    split='calibrate',
)

fault.commands(
    'opens_with_speed',
    'starve',
    FaultSize(0.5, 1, (0.45, 0.5)),
    partial(give_way, by=haste),
    'the gripper gives way as its arm moves, by up to this share of its range',
    needs=GRIPPER,
)


@fault.way_points('splay', FaultSize(0.8, 1, (0.7, 0.85)), needs=GRIPPER, keeps_tempo=True)
def opens_beside_object(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers come down beside the object and open there, to this share."""
    aside = move.side() * move.along
    over, down = (move.like(name, phase='above', opening=0.0) for name in ('start', 'grasp'))
    near = down.moved(0.04 * aside)
    stops = [
        *(over.moved(0.06 * aside), down.moved(0.06 * aside), near),
        replace(near, opening=size, seconds=move.seconds('close')),
        replace(over.moved(0.04 * aside), opening=size),
    ]
    return move.insert(0, stops)


fault.commands(
    'gripper_flickers',
    'chatter',
    FaultSize(0.45, 2, (0.45, 0.5), 's'),
    flicker,
    'whenever a gripper opens or closes, it flickers to and fro for this long',
    needs=GRIPPER,
)

fault.commands(
    'gripper_pauses_halfway',
    'falter',
    FaultSize(0.9, 2, (0.9, 1), 's'),
    pause_half_way,
    'whenever a gripper opens or closes, it stands still half-way for this long',
    split='calibrate',
    needs=GRIPPER,
)

fault.commands(
    'gripper_leaks',
    'leak',
    FaultSize(0.4, 1, (0.4, 0.42), '1/s'),
    partial(give_way, by=time_shut),
    'share of its range by which a shut gripper opens a second',
    split='calibrate',
    needs=GRIPPER,
)

fault.commands(
    'opens_with_reach',
    'taut',
    FaultSize(0.58, 1, (0.57, 0.6)),
    partial(give_way, by=reach),
    'the gripper gives way as its arm reaches out, by up to this share of its range',
    needs=GRIPPER,
)


@fault.way_points(
    'yawn', FaultSize(0.45, 1, (0.4, 0.55)), split='calibrate', needs=GRIPPER, keeps_tempo=True
)
def opens_late_on_descent(move: MovePlan, size: float) -> MovePlan:
    """Share of its way down that it comes shut; the fingers open over the rest."""
    shut, down = move.like('start', opening=0.0), size * move.between('start', 'grasp')
    move = move.edit(('start',), lambda stop: shut)
    return move.insert(move.index('grasp'), [shut.moved(down)])
