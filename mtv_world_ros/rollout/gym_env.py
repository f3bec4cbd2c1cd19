"""A world as an environment of Gymnasium, so that any agent library can act in imagination."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import ByteArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import PlanError
from mtv_world_ros.core.extras import needs_text
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.world import World

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        needs_text('WorldEnv', 'gymnasium'),
        name=error.name,
    ) from error

#: range of joints without limits, which turn without end [rad]
ENDLESS_RAD = np.pi
#: state of an episode: camera frames by view, and `joint_positions`
State = dict[str, NDArray[Any]]


class WorldEnv(gymnasium.Env[State, NDArray[np.float32]]):
    """A world in which an agent commands joint positions.

    An action is where the robot's joints are sent within `action_s`: (J,) [rad or m], in the
    robot's joint order. An observation has the frames (H, W, 3) uint8 RGB of each view under its
    name, and the joint positions (J,) under `joint_positions`. The reward is 1 when the task is
    done, which ends the episode, else 0. The world says whether it is done: the success estimate
    in imagination, the task's predicate in the simulator.

    An action that the robot cannot execute, e.g. one that is faster than its speed limits, is not
    executed: the episode is truncated, and `info['rejected']` has the reason.

    Args:
        world: the simulator or imagination.
        robot: the robot that acts in it.
        action_s: duration of an action [s]; 0 = the world's `chunk_s`.
        max_steps: number of actions after which the episode is truncated; 0 = no limit.
        render_mode: `rgb_array`: `render` returns the views side by side; None = nothing.
    """

    metadata: dict[str, Any] = {'render_modes': ['rgb_array']}

    def __init__(
        self,
        world: World,
        robot: RobotModel,
        *,
        action_s: float = 0.0,
        max_steps: int = 0,
        render_mode: str | None = None,
    ) -> None:
        self._world, self._robot, self.render_mode = world, robot, render_mode
        self._action_s, self._max_steps = action_s or world.chunk_s, max_steps
        self._num_steps = 0
        self.metadata = {**self.metadata, 'render_fps': 1.0 / self._action_s}
        self._seen = world.reset(seed=0)
        height, width = self._seen.frames.shape[1:3]
        lower = np.where(np.isfinite(robot.lower), robot.lower, -ENDLESS_RAD)
        upper = np.where(np.isfinite(robot.upper), robot.upper, ENDLESS_RAD)
        self.action_space = gymnasium.spaces.Box(
            lower.astype(np.float32), upper.astype(np.float32), dtype=np.float32
        )
        image = gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8)
        joints = gymnasium.spaces.Box(-np.inf, np.inf, (len(robot.joint_names),), np.float64)
        seen: Any = gymnasium.spaces.Dict(
            {**dict.fromkeys(self._seen.views, image), 'joint_positions': joints}
        )
        self.observation_space = seen

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: seed of the world; None = one that is drawn.
            options: not used.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        self._seen, self._num_steps = self._world.reset(seed=drawn), 0
        return _state(self._seen), {'instruction': self._world.instruction}

    def step(self, action: NDArray[np.float32]) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Send the joints to positions (J,); return state, reward, whether it ended, and why."""
        # float32 bounds of the action space are rounded
        target = np.clip(np.asarray(action, np.float64), self._robot.lower, self._robot.upper)
        answer = JointTrajectory(
            joint_names=self._robot.joint_names,
            times=np.array([self._action_s]),
            positions=target[None],
        )
        self._num_steps += 1
        try:
            self._seen = self._world.step(answer)
        except PlanError as error:
            return _state(self._seen), 0.0, False, True, {'rejected': str(error)}
        is_done = self._world.is_done()
        is_late = 0 < self._max_steps <= self._num_steps
        reward = 1.0 if is_done else 0.0
        return _state(self._seen), reward, bool(is_done), is_late, {'is_done': is_done}

    def render(self) -> ByteArray | None:  # type: ignore[override]
        """Return the views side by side, (H, V * W, 3) uint8 RGB."""
        if self.render_mode is None:
            return None
        return np.concatenate(list(self._seen.frames), axis=1)


def _state(observation: Observation) -> State:
    frames = zip(observation.views, observation.frames, strict=True)
    return {**{view: frame.copy() for view, frame in frames},
            'joint_positions': observation.positions.copy()}  # fmt: skip
