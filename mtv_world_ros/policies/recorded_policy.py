"""What was commanded in a recorded episode as a policy: sent again, whatever is seen."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import JointTrajectory, Observation
from mtv_world_ros.geometry.resample import cut_off, SAME_S


class RecordedPolicy:
    """Answers with the commands that followed in the recording, by the time since the begin.

    Args:
        commands: times count from the moment that the episode begins from [s].
        hold_s: from the last command, or from the begin where that is later, to the end of the
            episode [s].
    """

    name = 'recorded'

    def __init__(self, commands: JointTrajectory, hold_s: float) -> None:
        end_s = max(float(commands.times[-1]), 0.0) + hold_s
        self._commands = cut_off(commands, commands.positions[0], end_s)
        self._first_ns: int | None = None

    def reset(self, *, seed: int) -> None:
        """Begins an episode."""
        self._first_ns = None

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Returns all commands from the observation on, or None where the episode is over.

        Args:
            observation: its stamp alone is looked at.
            instruction: not looked at.
        """
        if self._first_ns is None:
            self._first_ns = observation.stamp_ns
        commands = self._commands
        times = commands.times - (observation.stamp_ns - self._first_ns) / 1e9
        rest = np.flatnonzero(times > SAME_S)
        if not len(rest):
            return None
        return JointTrajectory(
            joint_names=commands.joint_names,
            times=times[rest],
            positions=commands.positions[rest],
            velocities=None if commands.velocities is None else commands.velocities[rest],
        )
