"""Response of a robot's arms to commands, fitted to recordings of both.

An equation-error fit (Gautier and Khalil 1992): accelerations are taken from the joint states, so
that the numbers of each joint are a linear least-squares problem. What touches something does not
fit and is left out.

Shape letters: N rows, T steps, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import measured_positions, stitched_commands
from mtv_world_ros.physics.arms.arm_response import ArmResponse, PERIOD_S
from mtv_world_ros.physics.arms.mechanics import RobotMechanics
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import resample

#: commands and measured positions of an episode, both (T, J), `PERIOD_S` apart
Recording = tuple[FloatArray, FloatArray]

#: rounds of the fit that leave out what touches something
_ROUNDS = 5
#: a row is left out where it is further from the fit than this many median errors
_FAR = 4.0
#: smallest armature that can be integrated [s^2]
_LEAST_ARMATURE = 1e-4
#: smallest damping; what is added is compensated by the lead [s]
_LEAST_DAMPING = 0.02
#: largest compliance, armature, damping and lead
_LARGEST = np.array([10.0, 1.0, 1.0, 1.0])
#: a joint that moves in fewer rows is not fitted
_LEAST_ROWS = 100
#: speed below which a row of a joint is not used [rad/s or m/s]
_MOVES = 0.02
#: joint states further apart do not show how joints accelerate [s]
_LONGEST_PERIOD_S = 0.035
#: episodes that are read
_MOST = 100
#: height above the expected one from which a fingertip was stopped by the table [m]
_STOPPED_M = 0.005
#: percentile of the heights of stopped fingertips that is the table's height
_LOWEST_PERCENT = 5.0
#: stride of the rows of a recording that are used
_EVERY = 5
#: slower tools do not count in the error [m/s]
_TOOL_MOVES = 0.02


def joint_recording(path: Path, robot: RobotModel) -> Recording:
    """Read the commands of an episode, and its joint positions at the same times.

    Raises:
        EpisodeError: the episode lacks commands or joint states, or these are too far apart.
        TrajectoryError: either lacks joints of the robot.
    """
    episode = read_episode(path, with_cameras=False, with_masks=False)
    states = episode.joint_states
    if states is None or not episode.trajectories:
        raise EpisodeError(f"'{path}' has no joint states or commands")
    times = (states.stamps_ns - states.stamps_ns[0]) / 1e9
    period = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    if period > _LONGEST_PERIOD_S:
        raise EpisodeError(
            f"joint states of '{path}' are {period:.3f} s apart; how arms follow shows at "
            f'{_LONGEST_PERIOD_S} s or less'
        )
    wanted = np.arange(0.0, times[-1] + PERIOD_S / 2, PERIOD_S)
    start = int(states.stamps_ns[0])
    stamps = start + np.rint(wanted * 1e9).astype(np.int64)
    positions = measured_positions(episode, robot, stamps)
    return resample(stitched_commands(episode, robot, start), positions[0], wanted), positions


def found_response(paths: Sequence[Path], robot: RobotModel) -> tuple[ArmResponse | None, str]:
    """Return the fitted response of the arms in recorded episodes, and its accuracy as text.

    None if no episode can be used, or if in held-out episodes the tools are nearer to their
    commands than to the fitted response.
    """
    recordings, reason = [], ''
    for path in paths[:: max(1, len(paths) // _MOST)]:
        try:
            recordings.append(joint_recording(path, robot))
        except MtvWorldError as error:
            reason = str(error)
    if len(recordings) < 2:
        return None, f'arms are taken to follow their commands at once: {reason or "one episode"}'
    held_out = recordings[::4]
    fitted = [r for n, r in enumerate(recordings) if n % 4]
    response = with_floor(fit_response(robot, fitted), robot, fitted)
    commanded = tool_errors(robot, held_out)
    expected = tool_errors(robot, held_out, response)
    text = (
        f'tools that move are {1e3 * np.median(commanded):.1f} mm from their commands, '
        f'{1e3 * np.median(expected):.1f} mm from where they are expected (medians; means '
        f'{1e3 * np.mean(commanded):.1f} and {1e3 * np.mean(expected):.1f} mm; {len(held_out)} '
        'episodes held out); '
    )
    text += (
        'no height was found at which fingertips stop'
        if response.floor is None
        else f'fingertips stop at a height of {1e3 * response.floor:.1f} mm'
    )
    return (response if np.median(expected) < np.median(commanded) else None), text


def tool_errors(
    robot: RobotModel, recordings: Sequence[Recording], response: ArmResponse | None = None
) -> FloatArray:
    """Return the position errors (N,) of moving tools against their expected positions [m].

    Expected are the positions that the response predicts; without one, the commands themselves.
    """
    errors = []
    for commands, positions in recordings:
        given = commands if response is None else response.follow(robot, commands)[0]
        wanted, true, found = (
            robot.tool_poses(joints)[..., :3, 3] for joints in (commands, positions, given)
        )
        moving = np.linalg.norm(np.diff(wanted, axis=1), axis=-1) > _TOOL_MOVES * PERIOD_S
        errors.append(np.linalg.norm(found - true, axis=-1)[:, 1:][moving])
    return np.concatenate(errors)


def fit_response(robot: RobotModel, recordings: Sequence[Recording]) -> ArmResponse:
    """Fit the joint response to recordings."""
    parts = [_equations(robot, *recording) for recording in recordings]
    left = np.concatenate([part[0] for part in parts])  # (N, J, 4)
    right = np.concatenate([part[1] for part in parts])  # (N, J)
    found = np.array([_robust(left[:, j], right[:, j]) for j in range(right.shape[1])])
    compliance, armature, damping, lead = found.T
    added = np.maximum(_LEAST_DAMPING - damping, 0.0)
    return ArmResponse(
        joint_names=robot.joint_names,
        compliance=compliance,
        armature=np.maximum(armature, _LEAST_ARMATURE),
        damping=damping + added,
        lead=lead + added,
    )


def with_floor(
    response: ArmResponse, robot: RobotModel, recordings: Sequence[Recording]
) -> ArmResponse:
    """Return the response with a floor: the height at which fingertips stopped short.

    Unchanged where too few stopped, or where a floor does not explain them better.
    """
    mechanics, stopped = RobotMechanics(robot), []
    for commands, positions in recordings:
        expected = response.follow(robot, commands)[0]
        for wanted, true in zip(expected[::_EVERY], positions[::_EVERY], strict=True):
            heights = mechanics.fingertips(true)[:, 2]
            sinks = mechanics.fingertips(wanted)[:, 2] < heights - _STOPPED_M
            stopped += heights[sinks].tolist()
    if len(stopped) < _LEAST_ROWS:
        return response
    # objects on the table stop some fingertips above it
    floor = replace(response, floor=float(np.percentile(stopped, _LOWEST_PERCENT)))
    errors = [tool_errors(robot, recordings, one).mean() for one in (response, floor)]
    return floor if errors[1] < errors[0] else response


def _equations(
    robot: RobotModel, commands: FloatArray, positions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the regression matrix of the joint response and its right-hand side, by inner row."""
    inner = slice(1, -1)
    velocity = (positions[2:] - positions[:-2]) / (2 * PERIOD_S)
    acceleration = np.diff(positions, n=2, axis=0) / PERIOD_S**2
    # as `follow` does, where a command is that of the period before its row
    commanded = (commands[2:] - commands[:-2]) / (2 * PERIOD_S)
    driven = (commands[1:-1] + commands[2:]) / 2
    torques, mechanics = [], RobotMechanics(robot)
    for q, v, a in zip(positions[inner], velocity, acceleration, strict=True):
        mass, bias = mechanics.inertia(q, v)
        torques.append(mass @ a + bias)
    left = np.stack([np.array(torques), acceleration, velocity, -commanded], axis=-1)
    moving = (np.abs(velocity) > _MOVES)[..., None]
    return left * moving, (driven - positions[inner]) * moving[..., 0]


def _robust(left: FloatArray, right: FloatArray) -> FloatArray:
    """(4,) numbers from 0 to `_LARGEST`, without rows that are far from what the others tell."""
    kept = left.any(-1)
    scales = np.sqrt((left**2).mean(0)) + 1e-9
    found = np.zeros(left.shape[1])
    for _ in range(_ROUNDS):
        if kept.sum() < _LEAST_ROWS:
            return np.zeros(left.shape[1])
        bounds = (0.0, _LARGEST * scales)
        found = lsq_linear(left[kept] / scales, right[kept], bounds).x / scales
        error = np.abs(left @ found - right)
        kept = left.any(-1) & (error <= _FAR * np.median(error[kept]) + 1e-9)
    return found
