"""Applies the faults of a policy variant to a move's way points and to a plan's commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.faults.catalogue import FAULTS, PolicyVariant
from mtv_world_ros.simulation.faults.fault import OtherArm
from mtv_world_ros.simulation.faults.move_plan import Draws, MovePlan
from mtv_world_ros.simulation.faults.signals import Commands
from mtv_world_ros.simulation.way_points import Stops, Visit, WayPoint

#: way points of a move at most
_MOST_STOPS = 40


class WayPointFaults:
    """The faults of a variant that change the way points of one move.

    Which move, and to which side, is drawn from a generator of its own: siblings of a scene differ
    by the kind and the size of their fault alone.

    Args:
        variant: the policy variant.
        rng: generator that draws move and side.
    """

    def __init__(self, variant: PolicyVariant, rng: np.random.Generator) -> None:
        # what a second arm does begins before all else
        kinds = [(FAULTS[kind], size) for kind, size in variant.faults]
        self._faults = sorted(kinds, key=lambda fault: bool(fault[0].second_arm))
        self._move = float(rng.uniform())
        self._drawn: dict[str, Any] = {
            'angle': float(rng.uniform(0, 2 * np.pi)),
            'sign': float(rng.choice((-1.0, 1.0))),
            'errors': rng.normal(size=(_MOST_STOPS, 3)),
            'openings': rng.normal(size=_MOST_STOPS),
            'rng': np.random.default_rng(rng.integers(2**32)),
        }

    @property
    def keeps_tempo(self) -> bool:
        """True if added way points extend the move; else they share its duration."""
        return any(fault.keeps_tempo for fault, _ in self._faults)

    def move_of(self, num_moves: int) -> int:
        """Return the number of the faulty move."""
        return int(self._move * num_moves)

    def draws(
        self, yaw: float, objects: Sequence[FloatArray], other_home: FloatArray | None = None
    ) -> Draws:
        """Return the random draws for the faulty move.

        Args:
            yaw: yaw of its grasp [rad]; the fingers travel along it.
            objects: (3,) centre of every object of the scene [m].
            other_home: (3,) rest position of another arm's tool [m].
        """
        return Draws(yaw=yaw, objects=objects, other_home=other_home, **self._drawn)

    def applied(self, stops: Stops, draws: Draws) -> Stops:
        """Return the way points of a move with all faults, in the catalogue's order."""
        plan = MovePlan(stops, draws)
        for fault, size in self._faults:
            if fault.way_points:
                plan = fault.way_points(plan, size)
        return plan.stops

    def visits(
        self, stops: Stops, draws: Draws, home: WayPoint, times: Sequence[float]
    ) -> list[Visit]:
        """Return the visits of a second arm during the move.

        Args:
            stops: way points of the move, with its faults.
            draws: random draws for the move.
            home: way point at which the second arm rests.
            times: times of the way points, before scaling [s].
        """
        plan, other = MovePlan(stops, draws), OtherArm(home, times)
        visits = (
            fault.second_arm(plan, size, other) for fault, size in self._faults if fault.second_arm
        )
        return sorted(visits, key=lambda visit: (not visit.waits, not visit.is_timed, visit.meets))


def with_faults(
    plan: JointTrajectory, variant: PolicyVariant, robot: RobotModel, rng: np.random.Generator
) -> JointTrajectory:
    """Return the plan (T, J) as a variant carries it out; joints stay within their limits.

    Args:
        plan: trajectory of equally spaced points.
        variant: variant whose faults of commands are applied.
        robot: the robot that these joints belong to.
        rng: generator that draws the noise.

    Raises:
        PolicyError: a fault of two arms, of a robot that has one, or of a gripper, of a robot
            that has none.
    """
    refuse_robot(variant, robot)
    commands = Commands(np.array(plan.positions), float(plan.times[1] - plan.times[0]), robot)
    faults = [(FAULTS[kind], size) for kind, size in variant.faults]
    for fault, size in sorted(faults, key=lambda fault: fault[0].order):
        if fault.commands:
            commands = commands.at(fault.commands(commands, size * fault.scale, rng))
    return JointTrajectory(
        joint_names=plan.joint_names,
        times=commands.times,
        positions=commands.positions,
        velocities=np.gradient(commands.positions, commands.period, axis=0),
    )


def refuse_robot(variant: PolicyVariant, robot: RobotModel) -> None:
    """Refuse faults that a robot cannot have.

    Raises:
        PolicyError: a fault of two arms, of a robot that has one, or of a gripper, of a robot
            that has none.
    """
    arms, grippers = len(robot.tools), [t.gripper_joint for t in robot.tools if t.gripper_joint]
    for need, lacks, what in (
        ('two_arms', arms < 2, f"two arms, robot '{robot.name}' has {arms}"),
        ('gripper', not grippers, f"a gripper, robot '{robot.name}' has none"),
    ):
        pairs = zip(dict(variant.sizes), variant.kinds, strict=True)
        names = [name for name, kind in pairs if need in FAULTS[kind].needs]
        if lacks and names:
            raise PolicyError(
                f"policy '{variant.name}': {', '.join(names)} takes {what}; leave it out"
            )
