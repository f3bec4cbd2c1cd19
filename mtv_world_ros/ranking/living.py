"""A policy lives an episode: it sees, answers, sees what its answer led to, and so on."""

from __future__ import annotations

from dataclasses import dataclass
import time
from typing import Protocol

from mtv_world_ros.data_types import JointTrajectory, Observation
from mtv_world_ros.policies.execution import first_part
from mtv_world_ros.policies.policy import Policy


class World(Protocol):
    """Where a policy's commands are executed."""

    def execute(self, observation: Observation, answer: JointTrajectory) -> Observation:
        """Returns what is seen once the answer is executed.

        Args:
            observation: the one that the policy answered.
            answer: no longer than a chunk of the world model.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Life:
    """How an episode went.

    Attributes:
        num_chunks: answers that were executed.
        is_over: the policy ended it, not the limit.
        policy_s: time that the policy took [s].
    """

    num_chunks: int
    is_over: bool
    policy_s: float


def live(
    policy: Policy,
    world: World,
    start: Observation,
    instruction: str,
    *,
    chunk_s: float,
    max_chunks: int,
) -> Life:
    """Runs a policy that was reset until it ends the episode, or up to a limit of answers.

    Args:
        policy: decides.
        world: where its answers are executed.
        start: first observation.
        instruction: what the robot is told.
        chunk_s: the policy is asked again after this time, or where its answer ends [s].
        max_chunks: answers at most.

    Raises:
        PolicyError: the policy cannot answer.
        TrajectoryError: its answer does not fit the robot.
    """
    observation, policy_s = start, 0.0
    for number in range(max_chunks):
        begun = time.perf_counter()
        answer = policy.act(observation, instruction)
        policy_s += time.perf_counter() - begun
        if answer is None:
            return Life(num_chunks=number, is_over=True, policy_s=policy_s)
        observation = world.execute(
            observation, first_part(answer, observation.positions, chunk_s)
        )
    return Life(num_chunks=max_chunks, is_over=False, policy_s=policy_s)
