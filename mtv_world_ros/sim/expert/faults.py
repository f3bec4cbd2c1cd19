"""What is wrong with a scripted policy: names that say so, and what they do to its plan."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import isfinite
import re

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.errors import nearest, PolicyError
from mtv_world_ros.geometry.robot import RobotModel

EXPERT = 'expert'
#: largest size of each fault
_LARGEST = {
    'noise': 0.5,
    'miss': 1.0,
    'shift': 0.1,
    'place': 0.1,
    'wrong': 1.0,
    'late': 3.0,
    'stop': 1.0,
}
#: between the draws that a slow error of the joints is interpolated from [s]
_NOISE_KNOT_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyVariant:
    """The expert's faults; all at their defaults is the expert.

    Attributes:
        noise: standard deviation of a slow error of every arm joint [rad].
        miss: probability that an episode's plan has one grasp that closes beside its object.
        shift: standard deviation, in x and in y, of where objects to be grasped are thought to
            be [m]; small ones are taken off centre, large ones missed.
        place: standard deviation, in x and in y, of where they are put down [m].
        wrong: probability that an episode's plan takes another object than the one named.
        late: the grippers follow this much later [s].
        stop: share of the plan after which the arms stand still; 0 = they never move.
    """

    noise: float = 0.0
    miss: float = 0.0
    shift: float = 0.0
    place: float = 0.0
    wrong: float = 0.0
    late: float = 0.0
    stop: float = 1.0

    def __post_init__(self) -> None:
        for fault, largest in _LARGEST.items():
            value = getattr(self, fault)
            if not (isfinite(value) and 0 <= value <= largest):
                raise PolicyError(
                    f"policy fault '{fault}' is {value}; it must be 0 to {largest:g}"
                )

    @property
    def name(self) -> str:
        """The name that `parse_variant` reads."""
        faults = [
            f'{item.name}-{getattr(self, item.name):g}'
            for item in fields(self)
            if getattr(self, item.name) != item.default
        ]
        return '-'.join([EXPERT, *faults])


def parse_variant(text: str) -> PolicyVariant:
    """Returns the variant of a name: `expert`, then any of its faults, each with its size.

    Raises:
        PolicyError: no such name, a fault twice or without a size, a size out of range.
    """
    name = text.strip()
    if not re.fullmatch(rf'{EXPERT}(-[a-z]+-\d*\.?\d+)*', name):
        raise PolicyError(
            f"'{text}' is no scripted policy{_near(name)}; they are called '{EXPERT}', followed "
            f"by faults with their sizes, like '{EXPERT}-noise-0.02' or "
            f"'{EXPERT}-late-0.3-miss-0.5'; faults are {', '.join(_LARGEST)}"
        )
    sizes: dict[str, float] = {}
    for fault, size in re.findall(r'-([a-z]+)-([\d.]+)', name):
        if fault not in _LARGEST:
            raise PolicyError(
                f"policy '{text}': unknown fault '{fault}'{nearest(fault, _LARGEST)}; known are "
                f'{", ".join(_LARGEST)}'
            )
        if fault in sizes:
            raise PolicyError(f"policy '{text}': fault '{fault}' is given twice")
        sizes[fault] = float(size)
    return PolicyVariant(**sizes)


def _near(name: str) -> str:
    """Of the first word alone: what follows may be right."""
    first = name.split('-')[0]
    return '' if first == EXPERT else nearest(first, [EXPERT])


def with_faults(
    plan: JointTrajectory, variant: PolicyVariant, robot: RobotModel, rng: np.random.Generator
) -> JointTrajectory:
    """Returns the plan (T, J) as a variant carries it out; joints stay within their limits.

    Args:
        plan: equally spaced.
        variant: its `late`, `noise` and `stop` are applied.
        robot: whose joints they are.
        rng: draws the noise.
    """
    period = float(plan.times[1] - plan.times[0])
    grippers = [
        robot.joint_names.index(tool.gripper_joint)
        for tool in robot.tools
        if tool.gripper_joint is not None
    ]
    positions = _late(np.array(plan.positions), grippers, round(variant.late / period))
    times = np.arange(len(positions), dtype=np.float64) * period
    if variant.noise:
        error = _slow_noise(times, len(robot.joint_names), variant.noise, rng)
        error[:, grippers] = 0.0
        positions = np.clip(positions + error, robot.lower, robot.upper)
    if variant.stop < 1:
        last = int(variant.stop * (len(positions) - 1))
        positions[last:] = positions[last]
    return JointTrajectory(
        joint_names=plan.joint_names,
        times=times,
        positions=positions,
        velocities=np.gradient(positions, period, axis=0),
    )


def _late(positions: FloatArray, grippers: list[int], num: int) -> FloatArray:
    """(T + num, J): the grippers follow `num` samples later, the arms wait for them at the end."""
    whole = np.concatenate([positions, np.repeat(positions[-1:], num, axis=0)])
    delayed = np.concatenate([np.repeat(positions[:1], num, axis=0), positions])
    whole[:, grippers] = delayed[:, grippers]
    return whole


def _slow_noise(
    times: FloatArray, num_joints: int, deviation: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors, none at first, drawn anew every half second and linear in between."""
    knots = np.arange(0.0, times[-1] + 2 * _NOISE_KNOT_S, _NOISE_KNOT_S)
    drawn = rng.normal(0.0, deviation, (len(knots), num_joints))
    drawn[0] = 0.0
    return np.stack([np.interp(times, knots, column) for column in drawn.T], axis=1)
