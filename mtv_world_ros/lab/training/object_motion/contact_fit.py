"""Friction, weight and the grip of fingers, from recordings of what commands did to objects.

Settings of rigid bodies are tried on recorded episodes: those whose objects keep nearest to where
they really were are kept. Nothing is taken from a simulator, and a robot's own recordings do.

Shape letters: T steps, O objects, J joints, N settings, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.foresight.arm_response import ArmResponse
from mtv_world_ros.foresight.arms import Arms
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.foresight.engine import Engine
from mtv_world_ros.foresight.futures import draw_futures
from mtv_world_ros.foresight.solid_foresight import COMMANDS_A_STEP
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.solids import fit_solid, is_vessel, Solid
from mtv_world_ros.lab.training.object_motion.finger_fit import fit_fingers, FreeGrippers
from mtv_world_ros.lab.training.object_motion.tracks import (
    fine_commands,
    first_frame,
    FirstFrame,
    object_ways,
    read_each,
    recorded_positions,
)
from mtv_world_ros.parallel import run_all

#: what is tried: each number by these factors, round by round
_FITTED = (
    'finger_stiffness',
    'finger_damping',
    'grip_friction',
    'table_friction',
    'density',
    'tray_kg',
    'rim_m',
    'wall_m',
)
_FACTORS = (1.6, 1.6, 1.3, 1.3, 1.15)
#: of these what grippers report says more, where fingers swing
_OF_FINGERS = ('finger_stiffness', 'finger_damping', 'finger_mass_kg')
#: standard errors by which a change must help: one in twenty that does nothing is taken
_SURE = 1.64
#: errors below the first are as good, above the second as bad [m]
_LEAST_M, _MOST_M = 0.003, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactRecording:
    """What an episode says about contact.

    Attributes:
        frame: the first.
        solids: O, as it shows them.
        positions: (1 + T * n, J) commanded, `PERIOD_S` apart [rad or m].
        grippers: before they close.
        ways: (1 + T, O, 3) since the first step, as recorded; NaN = not known [m].
    """

    frame: FirstFrame
    solids: tuple[Solid | None, ...]
    positions: FloatArray
    grippers: FreeGrippers
    ways: FloatArray

    def errors(self, engine: Engine, settings: ContactSettings) -> FloatArray:
        """Returns (1 + T, O) how far objects are from where they were [m], NaN = not known."""
        known = [number for number, solid in enumerate(self.solids) if solid is not None]
        solids = [solid for solid in self.solids if solid is not None]
        alone = settings.model_copy(update={'num_motions': 1})
        batch = engine.begin(draw_futures(alone, solids, engine.arms.drives))
        motion, state = batch.advance(self.positions, COMMANDS_A_STEP)
        points = np.full(self.ways.shape, np.nan)
        if not state.lost:
            points[:, known] = motion.points[0]
        return np.linalg.norm(points - points[0] - self.ways, axis=-1)


def read_contact(path: Path, robot: RobotModel, views: Sequence[str]) -> ContactRecording:
    """Reads what an episode says about contact.

    Raises:
        EpisodeError: see `object_ways`.
    """
    episode = read_episode(path, views=tuple(views))
    ways = object_ways(episode, robot, views)
    frame = first_frame(episode, robot, views)
    times, positions = fine_commands(episode, robot, views)
    assert episode.masks is not None and episode.joint_states is not None
    stamps = episode.masks[views[0]].stamps_ns[0] + times * 1e9
    recorded = recorded_positions(episode.joint_states, robot, stamps)
    return ContactRecording(
        frame=frame,
        solids=tuple(
            fit_solid(
                frame.masks[:, item], point, frame.cameras, frame.poses, is_open=is_vessel(name)
            )
            for item, (name, point) in enumerate(
                zip(episode.info.objects, frame.points(), strict=True)
            )
        ),
        positions=positions,
        grippers=FreeGrippers.of(robot, positions, recorded),
        ways=ways,
    )


def read_recordings(
    paths: Sequence[Path], robot: RobotModel, views: Sequence[str]
) -> tuple[list[ContactRecording], dict[str, str]]:
    """Returns what episodes say about contact, and why others say nothing, by path."""
    return read_each(paths, lambda path: read_contact(path, robot, views))


def first_settings(arms: Arms) -> ContactSettings:
    """Returns what a search begins with: fingers as their joints follow, objects of plastic."""
    drives = arms.drives
    stiffness, damping, mass = 200.0, 10.0, 0.05
    if drives.fingers.any():
        way = drives.travels[drives.fingers] ** 2
        numbers = (drives.stiffness, drives.damping, drives.armature)
        found = [float(np.mean(one[drives.fingers] / way)) for one in numbers]
        stiffness, damping, mass = (max(one, 1e-6) for one in found)
    return ContactSettings(
        finger_stiffness=stiffness,
        finger_damping=damping,
        finger_mass_kg=mass,
        grip_friction=1.0,
        table_friction=0.5,
        density=300.0,
        tray_kg=0.4,
        num_motions=16,
    )


def fit_contact(
    recordings: Sequence[ContactRecording],
    robot_file: Path,
    response: ArmResponse | None,
    first: ContactSettings,
    workers: int = 1,
    report: Callable[[str], None] = lambda line: None,
) -> ContactSettings:
    """Returns the settings with which solids keep nearest to where objects were.

    Fingers come first, see `fit_fingers`. Then, in each round, every other number is tried larger
    and smaller; those that help by more than chance are changed, together if that is better still,
    or else the one that helps most. The factors get smaller.

    Args:
        recordings: E.
        robot_file: of the robot.
        response: of the arms to their commands.
        first: start of the search.
        workers: processes.
        report: is told how each round went.

    Raises:
        TrainingError: no recording says where an object went.
        RobotError: see `Arms`.
    """
    if not any(np.isfinite(recording.ways).any() for recording in recordings):
        raise TrainingError('no episode says where an object went; contact cannot be fitted')

    def losses(settings: Sequence[ContactSettings]) -> FloatArray:
        """(N, E)."""
        jobs = [(n, e, one) for e in range(len(recordings)) for n, one in enumerate(settings)]
        make_run = partial(_Trial, robot_file, response, recordings)
        found = np.full((len(settings), len(recordings)), np.nan)
        for (number, episode, _), loss in run_all(jobs, make_run, workers):
            found[number, episode] = loss
        return found

    arms = Arms(load_robot(robot_file), response)
    best = fit_fingers([recording.grippers for recording in recordings], arms, first)
    swing = 'swing' if best.fingers_swing else 'do not swing'
    report(f'fingers {swing}: {best.model_dump(mode="json", include=set(_OF_FINGERS))}')
    fitted = [name for name in _FITTED if not (best.fingers_swing and name in _OF_FINGERS)]
    (loss,) = losses([best])
    report(f'begins at {np.nanmean(loss):.3f}')
    for factor in _FACTORS:
        tried = [
            best.model_copy(update={name: getattr(best, name) * by})
            for name in fitted
            for by in (factor, 1 / factor)
        ]
        found = losses(tried)
        gains = np.array([_sure_gain(loss - one) for one in found])
        changes = {}
        for number, name in enumerate(fitted):
            better = 2 * number + int(gains[2 * number + 1] > gains[2 * number])
            if gains[better] > 0:
                changes[name] = getattr(tried[better], name)
        if changes:
            together = best.model_copy(update=changes)
            (of_all,), alone = losses([together]), int(np.argmax(gains))
            best, loss = (
                (together, of_all)
                if np.nanmean(of_all) <= np.nanmean(found[alone])
                else (tried[alone], found[alone])
            )
        report(f'by {factor}: {np.nanmean(loss):.3f} with {best.model_dump(mode="json")}')
    return best


def _sure_gain(gains: FloatArray) -> float:
    """The lower end of the mean of what episodes (E,) gain; a few of them may gain a lot."""
    known = gains[np.isfinite(gains)]
    return float(known.mean() - _SURE * known.std() / np.sqrt(len(known)))


class _Trial:
    """Tries settings on recordings, in a process of its own."""

    def __init__(
        self,
        robot_file: Path,
        response: ArmResponse | None,
        recordings: Sequence[ContactRecording],
    ) -> None:
        self._engine = Engine(Arms(load_robot(robot_file), response))
        self._recordings = recordings

    def __call__(self, job: tuple[int, int, ContactSettings]) -> float:
        """Returns the mean logarithm of errors, between the bounds [log m]; NaN = not known."""
        _, episode, settings = job
        errors = self._recordings[episode].errors(self._engine, settings)
        errors = errors[np.isfinite(errors)]
        return float(np.log(np.clip(errors, _LEAST_M, _MOST_M)).mean()) if len(errors) else np.nan
