"""Plans of one scene to compare: checks, and their outcomes in common futures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mtv_world_ros.core.data_types import JointTrajectory, ObjectMasks, Observation, WorldModelSpec
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.physics.episode_objects import ObjectForesight
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import Plan, PlanLimits
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.success.comparison import Outcomes
from mtv_world_ros.success.estimator import SuccessEstimator

#: largest difference of joint positions of one start [rad or m]
_SAME_START = 1e-6


def plans_to_compare(
    plans: Sequence[JointTrajectory | Plan],
    robot: RobotModel,
    observation: Observation,
    limits: PlanLimits,
    fps: float,
) -> list[Plan]:
    """Return plans that can be compared, checked.

    Args:
        plans: trajectories whose times count from the observation, or checked plans.
        robot: robot that executes them.
        observation: observation that they start from.
        limits: limits that the plans are held to.
        fps: frame rate of the model [Hz].

    Raises:
        ConfigError: there are fewer than two plans, or a plan is of another robot, start or
            length.
        PlanError: a trajectory does not fit the robot.
    """
    if len(plans) < 2:
        raise ConfigError(f'compare() takes two plans or more; {len(plans)} given')
    found = [
        _of_robot(plan, number, robot, observation)
        if isinstance(plan, Plan)
        else Plan.of(plan, robot, observation, limits)
        for number, plan in enumerate(plans, 1)
    ]
    lengths = [float(plan.trajectory.times[-1]) for plan in found]
    odd = next((k for k, s in enumerate(lengths) if abs(s - lengths[0]) > 0.5 / fps), None)
    if odd is not None:
        raise ConfigError(
            f'plan 1 lasts {lengths[0]:.2f} s and plan {odd + 1} {lengths[odd]:.2f} s; plans to '
            'compare have one length: cut the longer one, or hold the last positions of the '
            'shorter one (held_until)'
        )
    return found


def _of_robot(plan: Plan, number: int, robot: RobotModel, observation: Observation) -> Plan:
    """Return a checked plan, if it is one of a robot and starts at an observation."""
    if plan.robot.joint_names != robot.joint_names:
        raise ConfigError(
            f"plan {number} is of the robot '{plan.robot.name}' with other joints; the pipeline "
            f"has '{robot.name}': plan with `Plan.of(trajectory, pipeline.robot, observation)`"
        )
    apart = np.abs(plan.start_positions - observation.positions)
    if plan.stamp_ns != observation.stamp_ns or apart.max(initial=0.0) > _SAME_START:
        joint = robot.joint_names[int(apart.argmax())]
        raise ConfigError(
            f'plan {number} starts elsewhere: from an observation stamped {plan.stamp_ns} ns, not '
            f"{observation.stamp_ns} ns, with joint '{joint}' {apart.max(initial=0.0):.3g} away; "
            'plans to compare start from the observation that is given'
        )
    return plan


def held_until(trajectory: JointTrajectory, seconds: float) -> JointTrajectory:
    """Return a trajectory that holds its last positions until a time [s]."""
    if trajectory.times[-1] >= seconds:
        return trajectory
    speeds = trajectory.velocities
    return replace(
        trajectory,
        times=np.append(trajectory.times, seconds),
        positions=np.concatenate([trajectory.positions, trajectory.positions[-1:]]),
        velocities=None if speeds is None else np.concatenate([speeds, np.zeros_like(speeds[:1])]),
    )


def foreseen_outcomes(
    objects: ObjectForesight,
    plan: Plan,
    start: Observation,
    masks: ObjectMasks,
    spec: WorldModelSpec,
    estimator: SuccessEstimator,
    options: RolloutOptions,
) -> tuple[Outcomes, str, bool]:
    """Return the outcomes of a plan, the digest of its futures, and whether contact was fitted.

    Nothing is denoised: futures of the objects alone are simulated.

    Args:
        objects: objects at the start.
        plan: the plan.
        start: observation that it starts from, at the model's size.
        masks: masks of the objects in `start`.
        spec: clock of the model.
        estimator: judges the ends.
        options: names of the objects, and the instruction.

    Raises:
        RolloutPreempted: `should_stop` of the options said so.
    """
    motions = None
    for chunk in plan.chunks(spec):
        objects = objects.foresee(
            chunk, start, options.objects, masks, lambda _: None, True, options.should_stop
        )
        motions = objects.motions(chunk, True)
    assert objects.found is not None  # a plan has a chunk
    ends = None if motions is None else estimator.foresee(motions, options.instruction)
    found, is_fitted = objects.found, objects.found.tracked.is_fitted
    if ends is None or objects.refusal:
        return (), found.futures_key, is_fitted
    return ends.outcomes, found.futures_key, is_fitted
