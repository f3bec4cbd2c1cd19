"""Friction, weight, grip, delay and table, from masks and joint states of what commands did.

Settings are drawn, and the objects are simulated with each draw. A draw is likelier the nearer its
objects are to the later masks. New draws are made around likely ones (population Monte Carlo,
Cappe et al. 2004), so that every number has an interval, which becomes its spread in futures.
Object poses come from the masks alone, never from a simulator.

Shape letters: T steps, O objects, J joints, N draws, P numbers, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta, multivariate_normal, qmc

from mtv_world_ros.cameras.mask_geometry import block_size, CENTROID_NOISE_PX, centroids, locate
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.executor import started
from mtv_world_ros.core.workers import IN_PROCESS, RunJobs, Workers
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.contact_settings import (
    ContactDraw,
    ContactOrigin,
    ContactSettings,
    FACTORS,
    hold_line,
    MAX_MOTIONS,
    PRIOR_LOG_STD,
    RANGES,
)
from mtv_world_ros.physics.engine.contact_scene import CompiledScene
from mtv_world_ros.physics.engine.drive_inputs import CoursePlanner, SUBSTEPS
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.engine.futures import Future, shifted
from mtv_world_ros.physics.fitting.finger_depths import depth_lines, find_finger_depth
from mtv_world_ros.physics.fitting.stop_trials import observed_stops, ObservedStop, StopTrial
from mtv_world_ros.physics.fitting.tracks import (
    fine_commands,
    first_frame,
    FirstFrame,
    object_displacements,
    read_each,
    recorded_positions,
)
from mtv_world_ros.physics.solid_foresight import COMMANDS_A_STEP, STEP_S, table_in
from mtv_world_ros.physics.solids import bottom_of, fit_solid, is_box, is_vessel, Solid
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import nearest_rows


@dataclass(frozen=True, slots=True)
class FingerFitSettings:
    """Settings of the fit of finger drives to grippers that touch nothing.

    Attributes:
        min_closing_fraction: a gripper that closes by a larger fraction of its travel may touch.
        max_error_fraction: errors beyond this fraction of the travel count the same: contact.
        num_candidates: candidates drawn in each round.
        search_factors: range of each round, as a factor around the best value before it.
        max_episodes: number of episodes that are used, spread evenly.
        min_periods: shortest usable part of an episode [control periods].
        min_explained_fraction: smallest explained fraction of the errors at which fingers swing.
    """

    min_closing_fraction: float = 0.02
    max_error_fraction: float = 0.15
    num_candidates: int = 48
    search_factors: tuple[float, ...] = (10.0, 3.0, 1.5, 1.2)
    max_episodes: int = 12
    min_periods: int = 10
    min_explained_fraction: float = 0.25


_FINGERS = FingerFitSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeGrippers:
    """Grippers of an episode before they close.

    Attributes:
        positions: (1 + T, J) commanded positions, `PERIOD_S` apart [rad or m].
        recorded: (1 + T, J) recorded positions at the same times; NaN = no gripper, or contact is
            possible.
    """

    positions: FloatArray
    recorded: FloatArray

    @classmethod
    def of(cls, robot: RobotModel, positions: FloatArray, recorded: FloatArray) -> FreeGrippers:
        """Return the gripper motion of commands and recorded positions (1 + T, J)."""
        known = np.full_like(recorded, np.nan)
        last = 1
        for tool in robot.tools:
            if tool.gripper_joint is None:
                continue
            column = robot.joint_names.index(tool.gripper_joint)
            travel = abs(tool.gripper_open - tool.gripper_closed)
            moved = (
                np.abs(positions[:, column] - positions[0, column])
                > _FINGERS.min_closing_fraction * travel
            )
            count = int(moved.argmax()) if moved.any() else len(moved)
            known[:count, column] = recorded[:count, column]
            last = max(last, count)
        return cls(positions=positions[:last], recorded=known[:last])


def fit_fingers(
    grippers: Sequence[FreeGrippers], arms: Arms, settings: ContactSettings
) -> ContactSettings:
    """Fit the parameters of the finger drives to measured gripper positions.

    The search begins at the settings. Where swinging fingers explain little, they are returned as
    they were, and fingers do not swing.
    """
    known = [one for one in grippers if len(one.positions) >= _FINGERS.min_periods]
    known = [one for one in known if np.isfinite(one.recorded).any()]
    known = known[:: max(1, len(known) // _FINGERS.max_episodes)][: _FINGERS.max_episodes]
    if not known:
        return settings
    scene = CompiledScene.compiled(arms, ())
    swinging = settings.model_copy(update={'fingers_swing': True})
    rng = np.random.default_rng(3)
    names = ('finger_stiffness', 'finger_damping', 'finger_mass_kg')
    best, least = swinging, np.inf
    for factor in _FINGERS.search_factors:
        drawn = rng.uniform(-1, 1, size=(_FINGERS.num_candidates, 3))
        drawn[0] = 0.0
        middle = np.array([getattr(best, name) for name in names])
        for numbers in (middle * factor**drawn).tolist():
            tried = swinging.model_copy(update=dict(zip(names, numbers, strict=True)))
            loss = _loss(scene, tried, known, least)
            if loss < least:
                best, least = tried, loss
    geared = settings.model_copy(update={'fingers_swing': False})
    return (
        best
        if least < (1 - _FINGERS.min_explained_fraction) * _loss(scene, geared, known)
        else settings
    )


def _loss(
    scene: CompiledScene,
    settings: ContactSettings,
    grippers: Sequence[FreeGrippers],
    most: float = np.inf,
) -> float:
    """Return the mean gripper position error, as a fraction of the gripper's travel.

    Recordings after those that make it more than `most` are not looked at.
    """
    planner, arms = CoursePlanner(scene, settings), scene.arms
    names, loss = arms.robot.joint_names, 0.0
    for one in grippers:
        if loss > most:
            break
        course, _ = planner.plan(one.positions, planner.begin(one.positions[0]))
        expected = arms.drives.joints(course.positions[::SUBSTEPS], len(names))
        for tool in arms.robot.tools:
            if tool.gripper_joint is not None:
                column = names.index(tool.gripper_joint)
                travel = abs(tool.gripper_open - tool.gripper_closed)
                off = np.abs(expected[:, column] - one.recorded[:, column]) / travel
                loss += float(np.nansum(np.minimum(off, _FINGERS.max_error_fraction)))
    return loss


#: names of parameters in messages
_WORDS = {
    'grip_friction': 'friction of fingers',
    'table_friction': 'friction of all else',
    'density': 'density [kg/m^3]',
    'finger_stiffness': 'stiffness of fingers [N/m]',
    'delay_s': 'commands arrive late by [s]',
    'table_m': 'height of the table [m]',
    'camera_m': 'cameras see objects elsewhere by [m]',
    'stop_holds': 'share of stops of fingers that hold something',
    'hold': 'friction x stiffness of fingers / density: whether things slip [N m^2/kg]',
}
#: exponents of the product that decides whether an object slips
_HOLD = {'grip_friction': 1, 'finger_stiffness': 1, 'density': -1}
#: delays of commands that are tried [s]
_DELAYS = np.arange(0.0, 0.31, PERIOD_S)


@dataclass(frozen=True, slots=True)
class ContactFitSettings:
    """Settings of the importance sampling of contact parameters.

    Attributes:
        num_draws: draws of a round.
        num_rounds: rounds; each draws around the posterior of the one before.
        proposal_scale: width of the next round's draws as a multiple of the posterior's.
        proposal_min_log_std: smallest standard deviation of the next round's draws.
        min_effective_draws: effective draws below which an interval is not stated.
        enough_effective_draws: effective draws below which the likelihood is tempered.
        enough_fraction: effective draws below which the likelihood is tempered, as a fraction of
            all draws.
        min_temper: smallest exponent of the tempered likelihood.
        max_width_ratio: a parameter whose interval is wider by this factor than with the others
            known is not told apart from them.
        position_scale_m: scale of the heavy-tailed distribution of position errors [m].
        lost_distance_m: larger errors count the same, because masks may have lost the object [m].
        min_log_likelihood_gap: smallest difference between low and high values of a parameter at
            which a recording informs it.
        max_small_size_m: largest object whose masks have a common middle in two views [m].
        outline_error_m: error of outlines that does not shrink with their number [m].
        max_table_spread_m: largest difference of heights of one table [m].
        max_tables: number of recordings whose table is searched.
        same_command_tolerance: commands that differ less from the measured positions are taken
            for a copy of them [rad or m].
        squeeze_fraction: extra closing of fingers where commands are measured positions, as a
            fraction of their travel.
        min_visible_fraction: smallest shown area of an unhidden object, relative to frame 0.
        min_joint_speed: slowest joint that shows a delay [rad/s or m/s].
        num_resamples: bootstrap samples of intervals over recordings.
        seed: seed of draws and resamples.
        min_spread: smallest spread of a parameter over futures: other scenes differ [log].
        max_spread: largest spread of a parameter over futures [log].
    """

    num_draws: int = 64
    num_rounds: int = 3
    proposal_scale: float = 1.3
    proposal_min_log_std: float = 0.08
    min_effective_draws: float = 5.0
    enough_effective_draws: float = 16.0
    enough_fraction: float = 1 / 8
    min_temper: float = 0.01
    max_width_ratio: float = 2.0
    position_scale_m: float = 0.008
    lost_distance_m: float = 0.1
    min_log_likelihood_gap: float = 0.5
    max_small_size_m: float = 0.1
    outline_error_m: float = 0.0005
    max_table_spread_m: float = 0.03
    max_tables: int = 8
    same_command_tolerance: float = 1e-6
    squeeze_fraction: float = 0.1
    min_visible_fraction: float = 0.85
    min_joint_speed: float = 0.1
    num_resamples: int = 400
    seed: int = 5
    min_spread: float = 0.1
    max_spread: float = 0.8


_FIT = ContactFitSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactRecording:
    """Motion of objects in an episode, and the commands that caused it.

    Attributes:
        name: name of the recording.
        names: names of O objects.
        frame: first frame of the recording, with its masks.
        positions: (1 + T * n, J) commanded joint positions, `PERIOD_S` apart [rad or m].
        recorded: (1 + T * n, J) joint positions measured at these times [rad or m].
        displacements: (1 + T, O, 3) displacements of the objects since the first step, by their
            masks; NaN = not known [m].
        grippers: motion of the grippers before they close.
        stops: stops of fingers that masks call held or not held; of recordings whose commands are
            measured positions.
    """

    name: str
    names: tuple[str, ...]
    frame: FirstFrame
    positions: FloatArray
    recorded: FloatArray
    displacements: FloatArray
    grippers: FreeGrippers
    stops: tuple[ObservedStop, ...] = ()

    @property
    def is_measured(self) -> bool:
        """True if the commands are the measured positions."""
        return np.allclose(self.positions, self.recorded, atol=_FIT.same_command_tolerance)

    def table(self) -> float:
        """Return the height of the table of this recording [m]; NaN = not known."""
        frame = self.frame
        return table_in(self.names, frame.masks, frame.cameras, frame.poses)


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedNumber:
    """Fitted parameter with its interval.

    Attributes:
        name: name of the setting, or of a product of settings.
        value: the mean of what is likely.
        low: lower end of its 90 % interval, whatever the other numbers are.
        high: upper end of that interval.
        spread: standard deviation if the other numbers are as found, of factors that of the
            logarithm.
        count: recordings, or objects, that say something of it.
        of: number of recordings that were looked at.
        counted: word for what `count` and `of` count: recordings or objects.
        apart: whether the interval is hardly wider than with the other numbers known.
    """

    name: str
    value: float
    low: float
    high: float
    spread: float
    count: int
    of: int
    counted: str = 'recordings'
    apart: bool = True

    def __str__(self) -> str:
        rests = f'rests on {self.count} of {self.of} {self.counted}'
        if self.name == 'stop_holds':
            rests = f'{self.count} of {self.of} stops that masks call held or not held are held'
        elif not self.count:
            rests = f'none of {self.of} {self.counted} tells: this is what was thought before'
        elif not self.apart:
            rests += '; not told apart from the other numbers by these'
        return f'{_WORDS[self.name]}: {self.value:.3g} [{self.low:.3g}, {self.high:.3g}] ({rests})'


def read_contact(path: Path, robot: RobotModel, views: Sequence[str]) -> ContactRecording:
    """Return the masks, commands and joint states of an episode, for the contact fit.

    Raises:
        EpisodeError: see `object_displacements`.
    """
    # poses of objects that a simulator recorded are not looked at
    episode = replace(read_episode(path, views=tuple(views)), object_poses=None)
    displacements = object_displacements(episode, robot, views)
    times, positions = fine_commands(episode, robot, views)
    assert episode.masks is not None and episode.joint_states is not None
    stamps_ns = episode.masks[views[0]].stamps_ns[0] + times * 1e9
    shown = _unhidden(episode, views, len(displacements))
    recorded = recorded_positions(episode.joint_states, robot, stamps_ns)
    found = ContactRecording(
        name=path.name,
        names=tuple(episode.info.objects),
        frame=first_frame(episode, robot, views),
        positions=positions,
        recorded=recorded,
        displacements=np.where(shown[..., None], displacements, np.nan),
        grippers=FreeGrippers.of(robot, positions, recorded),
    )
    if not found.is_measured:
        return found
    return replace(found, stops=observed_stops(episode, robot, views))


def _unhidden(episode: Episode, views: Sequence[str], num_rows: int) -> BoolArray:
    """Return (1 + T, O) whether all views show about as much of an object as at first."""
    assert episode.masks is not None
    count = len(episode.info.objects)
    areas = []
    for view in views:
        track = episode.masks[view]
        wanted = track.stamps_ns[0] + np.arange(num_rows) * STEP_S * 1e9
        each = np.stack(
            [
                np.bincount(np.asarray(track.frames[k]).ravel(), minlength=1 + count)[1:]
                for k in range(len(track.stamps_ns))
            ]
        )
        areas.append(each[nearest_rows(track.stamps_ns, wanted)][:, :count])
    shown = np.stack(areas)
    return np.asarray((shown >= _FIT.min_visible_fraction * shown[:, :1]).all(axis=0))


def read_recordings(
    paths: Sequence[Path], robot: RobotModel, views: Sequence[str]
) -> tuple[list[ContactRecording], dict[str, str]]:
    """Read the recordings for the contact fit, and the reasons for unused ones, by path."""
    return read_each(paths, lambda path: read_contact(path, robot, views))


def first_settings(arms: Arms) -> ContactSettings:
    """Return the initial settings: fitted finger drives, objects of plastic."""
    drives = arms.drives
    stiffness, damping, mass = 200.0, 10.0, 0.05
    if drives.fingers.any():
        squared_travel = drives.travels[drives.fingers] ** 2
        numbers = (drives.stiffness, drives.damping, drives.armature)
        found = [float(np.mean(one[drives.fingers] / squared_travel)) for one in numbers]
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
    arms: Arms,
    first: ContactSettings | None = None,
    workers: Workers = IN_PROCESS,
    report: Callable[[str], None] = lambda line: None,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
    place: str = '',
) -> tuple[ContactSettings, list[FittedNumber]]:
    """Fit the contact parameters; return the settings, and each parameter with its interval.

    Args:
        recordings: the E recorded episodes.
        arms: response of the recorded robot to its commands.
        first: numbers that were found before, where the search begins; None = it begins with
            `first_settings`, and with fingers as `fit_fingers` finds them.
        workers: where objects are foreseen.
        report: takes a line about each number and round.
        progress: wraps the numbers of what is foreseen, e.g. in a progress bar.
        place: robot cell of the recordings; empty = not stated.

    Raises:
        TrainingError: no recording says where an object went.
        RobotError: see `Arms`.
    """
    samples, common = sample_contact(recordings, arms, first, workers, report, progress)
    settings, found = samples.fit(report, place)
    return settings, [*common, *found]


def sample_contact(
    recordings: Sequence[ContactRecording],
    arms: Arms,
    first: ContactSettings | None = None,
    workers: Workers = IN_PROCESS,
    report: Callable[[str], None] = lambda line: None,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> tuple[ContactSamples, list[FittedNumber]]:
    """Simulate recordings under drawn contact parameters; see `fit_contact` for the arguments.

    Returns:
        The draws with their likelihoods; table, delay and error of the cameras with intervals.

    Raises:
        TrainingError: no recording says where an object went.
        RobotError: see `Arms`.
    """
    if not any(np.isfinite(recording.displacements).any() for recording in recordings):
        raise TrainingError('no episode says where an object went; contact cannot be fitted')
    if first is None:
        # fingers whose commands are what they measured show no swing
        commanded = [one.grippers for one in recordings if not one.is_measured]
        first = fit_fingers(commanded, arms, first_settings(arms))
    table, delay = find_table(recordings), find_delay(recordings, arms)
    cameras = find_cameras(recordings)
    for one in (table, delay, cameras):
        report(str(one))
    spread = first.spread.model_copy(
        update={
            'camera_m': cameras.value if cameras.count else first.spread.camera_m,
            'delay_s': max(delay.spread, first.spread.delay_s),
        }
    )
    first = first.model_copy(
        update={
            'table_m': table.value,
            'delay_s': delay.value,
            'spread': spread,
            'grips_hold': False,
        }
    )
    first = settings_of_place(first, recordings, report)
    report_depths(recordings, arms, cameras.value, report)
    trials = [_Trial.of(one, first, arms.robot) for one in recordings]
    if first.squeeze:
        told = [len(trial.stops) for trial in trials]
        report(str(find_holds([stop for one in recordings for stop in one.stops])))
        report(
            f'{sum(told)} of these stops, in {np.count_nonzero(told)} of {len(trials)} '
            'recordings, are simulated one by one; the rest of measured motion is not'
        )
    make_run = partial(_TrialRunner, arms, trials, workers.num_threads)
    with started(make_run, workers, len(trials)) as run:
        logs, likelihoods, others = _populations(run, len(trials), first, report, progress)
    samples = ContactSamples(
        first=first,
        logs=logs,
        likelihoods=likelihoods,
        others=others,
        stops=tuple(one.stops for one in recordings),
    )
    return samples, [table, delay, cameras]


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactSamples:
    """Draws of contact parameters, and how likely each makes what E recordings show.

    Attributes:
        first: settings that the draws are factors of, or replace.
        logs: (N, P) logarithms of the drawn parameters, in the order of `RANGES`.
        likelihoods: (N, E) log likelihoods.
        others: (N,) logarithm of the prior of each draw over the density it was drawn with.
        stops: stops of fingers of each recording.
    """

    first: ContactSettings
    logs: FloatArray
    likelihoods: FloatArray
    others: FloatArray
    stops: tuple[tuple[ObservedStop, ...], ...]

    def without(self, number: int) -> ContactSamples:
        """Return the samples as if a recording did not exist; nothing is simulated again."""
        return replace(
            self,
            likelihoods=np.delete(self.likelihoods, number, axis=1),
            stops=self.stops[:number] + self.stops[number + 1 :],
        )

    def fit(
        self, report: Callable[[str], None] = lambda line: None, place: str = ''
    ) -> tuple[ContactSettings, list[FittedNumber]]:
        """Return the fitted settings, and each parameter with its interval.

        Args:
            report: takes a line about each number.
            place: robot cell of the recordings; empty = not stated.
        """
        first, likelihoods = self.first, self.likelihoods
        weights, _ = _weights(likelihoods.sum(-1), self.others)
        logs = self.logs + np.log([_scales(first)[name] for name in RANGES])
        known = _conditional(logs, weights).tolist()
        found = [
            _finding(name, values, likelihoods, weights, spread)
            for name, values, spread in zip(RANGES, logs.T, known, strict=True)
        ]
        products = logs @ [_HOLD.get(name, 0) for name in RANGES]
        hold = _finding('hold', products, likelihoods, weights)
        values = {one.name: one.value for one in found}
        heavier = values['density'] / first.density
        stiffer = values['finger_stiffness'] / first.finger_stiffness
        values |= {
            'tray_kg': float(np.clip(first.tray_kg * heavier, 1e-3, 100)),
            'finger_damping': first.finger_damping * stiffer,
        }
        spreads = {
            key: float(np.clip(one.spread, _FIT.min_spread, _FIT.max_spread))
            for key, one in zip(('grip', 'friction', 'weight', 'force'), found, strict=True)
        }
        spread = first.spread.model_copy(update=spreads)
        for one in (*found, hold):
            report(str(one))
        report(hold_line(hold.low, hold.high))
        deciding = _effective_draws(weights)
        if deciding < _FIT.min_effective_draws:
            report(
                f'{deciding:.1f} draws decide: these numbers are likely together, but their '
                'intervals are too narrow'
            )
        origin = ContactOrigin(
            by='mtv-world fit contact',
            recordings=likelihoods.shape[1],
            telling=hold.count,
            place=place,
            hold=(hold.low, hold.high),
        )
        draws = _joint_draws(first, self.logs, weights)
        update = {**values, 'spread': spread, 'fitted': origin, 'draws': draws}
        # measured fingers show what they hold; slipping was fitted without that, as only slips
        # tell it
        update['grips_hold'] = first.squeeze > 0
        stops = [stop for of_recording in self.stops for stop in of_recording]
        update['stop_holds'] = find_holds(stops).value if stops else 1.0
        return first.model_copy(update=update), [*found, hold]


def settings_of_place(
    first: ContactSettings,
    recordings: Sequence[ContactRecording],
    report: Callable[[str], None],
) -> ContactSettings:
    """Return settings for recordings on several tables, or without commands of their own.

    Args:
        first: settings that are adapted to the recordings.
        recordings: the E recordings.
        report: callback that gets a line of text for each difference.
    """
    changed: dict[str, bool | float] = {}
    each = recordings[:: max(1, len(recordings) // _FIT.max_tables)]
    heights = np.array([recording.table() for recording in each])
    heights = heights[np.isfinite(heights)]
    if len(heights) and np.ptp(heights) > _FIT.max_table_spread_m:
        changed['table_varies'] = True
        report(
            f'tables are between {heights.min():.3f} and {heights.max():.3f} m high: each is '
            'looked for in the first frame'
        )
    if all(recording.is_measured for recording in recordings):
        changed['squeeze'] = _FIT.squeeze_fraction
        report(
            'commands are measured positions, which stop at what is held: grippers close further '
            f'by {_FIT.squeeze_fraction:.0%} of their travel'
        )
    return first.model_copy(update=changed)


def report_depths(
    recordings: Sequence[ContactRecording],
    arms: Arms,
    camera_m: float,
    report: Callable[[str], None],
) -> None:
    """Report how far measured fingers get below the tables of recordings.

    Args:
        recordings: the E recordings.
        arms: arms of the robot.
        camera_m: error of the cameras [m].
        report: callback that gets a line of text for each finding.
    """
    scene, found = CompiledScene.compiled(arms, ()), []
    for one in recordings:
        positions = one.recorded[::COMMANDS_A_STEP]
        depth = find_finger_depth(one.name, scene, positions, STEP_S, one.table())
        found += [] if depth is None else [depth]
    for line in depth_lines(found, camera_m):
        report(line)


def _scales(first: ContactSettings) -> dict[str, float]:
    """Return the scale factor of each sampled parameter."""
    return {name: getattr(first, name) if name in FACTORS else 1.0 for name in RANGES}


def _populations(
    run: RunJobs,
    num_trials: int,
    first: ContactSettings,
    report: Callable[[str], None],
    progress: Callable[[Sequence[int]], Iterable[int]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return draws (N, P), log likelihoods (N, E), log prior over proposal density (N,).

    Args:
        run: runs a `_TrialRunner`.
        num_trials: the E trials.
        first: settings that the search begins with.
        report: takes a line about each round.
        progress: wraps the numbers of what is foreseen.
    """
    low, high = np.log(np.array(list(RANGES.values())).T)
    uniform = -float(np.log(high - low).sum())
    middle = np.log([1.0 if n in FACTORS else getattr(first, n) for n in RANGES])
    drawn = qmc.scale(
        qmc.Sobol(len(RANGES), rng=np.random.default_rng(_FIT.seed)).random(_FIT.num_draws),
        low,
        high,
    )
    draws, likelihoods = np.zeros((0, len(RANGES))), np.zeros((0, num_trials))
    proposals: list[tuple[FloatArray, FloatArray] | None] = [None]
    others, steps = np.zeros(0), iter(progress(range(_FIT.num_rounds * num_trials)))
    for number in range(_FIT.num_rounds):
        draws = np.concatenate([draws, drawn])
        settings = [_settings(first, one) for one in drawn]
        rows = np.zeros((len(settings), num_trials))
        jobs = [(trial, settings) for trial in range(num_trials)]
        for ((trial, _), found), _ in zip(run(jobs), steps, strict=False):
            rows[:, trial] = found
        likelihoods = np.concatenate([likelihoods, rows])
        densities = [
            np.full(len(draws), uniform)
            if one is None
            else multivariate_normal.logpdf(draws, one[0], one[1])  # type: ignore[arg-type]
            for one in proposals
        ]
        mixture = np.logaddexp.reduce(densities, axis=0) - np.log(len(proposals))
        usual = -(((draws - middle) / PRIOR_LOG_STD) ** 2).sum(-1) / 2
        others = usual - mixture
        weights, counts = _weights(likelihoods.sum(-1), others)
        mean, wide = weights @ draws, _FIT.proposal_scale**2 * _covariance(draws, weights)
        wide += _FIT.proposal_min_log_std**2 * np.eye(len(mean))
        tempered = '' if counts == 1 else f', {counts:.2g} of the likelihood counted'
        worth = f'worth {_effective_draws(weights):.1f} alike'
        report(f'round {number + 1}: {len(draws)} draws, {worth}{tempered}')
        proposals.append((mean, wide))
        rng = np.random.default_rng((_FIT.seed, number))
        drawn = np.clip(rng.multivariate_normal(mean, wide, _FIT.num_draws), low, high)
    return draws, likelihoods, others


def _weights(likelihoods: FloatArray, others: FloatArray) -> tuple[FloatArray, float]:
    """Return weights (N,) of draws, which sum to 1, and the share of the likelihood that counts.

    Foresight is rough whatever the settings, which a likelihood of many recordings does not know:
    few draws would decide. So as much of it counts as leaves enough draws (tempering).
    `likelihoods` and `others`, all that weighs besides, are logarithms (N,).
    """
    enough = min(_FIT.enough_effective_draws, _FIT.enough_fraction * len(likelihoods))
    weights, share = np.zeros(0), 1.0
    for share in np.geomspace(1, _FIT.min_temper, 40):
        logs = share * likelihoods + others
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        if _effective_draws(weights) >= enough:
            break
    return weights, float(share)


def _covariance(draws: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (P, P) of draws (N, P) with weights (N,)."""
    off = draws - weights @ draws
    return (weights * off.T) @ off


def _conditional(draws: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (P,) standard deviations of numbers if the others are known, of draws (N, P)."""
    covariance = _covariance(draws, weights)
    floor = 1e-9 * np.eye(len(covariance))
    return np.asarray(np.diag(np.linalg.inv(covariance + floor)) ** -0.5, np.float64)


def _effective_draws(weights: FloatArray) -> float:
    """Number of draws of one weight that would tell as much as these (N,), which sum to 1."""
    return float(1 / (weights**2).sum())


def _settings(first: ContactSettings, logs: FloatArray) -> ContactSettings:
    """Return the settings of a draw (P,)."""
    numbers = dict(zip(RANGES, np.exp(logs).tolist(), strict=True))
    values = {name: numbers[name] * scale for name, scale in _scales(first).items()}
    heavier, stiffer = values['density'] / first.density, numbers['finger_stiffness']
    return first.model_copy(
        update={
            **values,
            'tray_kg': first.tray_kg * heavier,
            'finger_damping': first.finger_damping * stiffer,
        }
    )


def _joint_draws(
    first: ContactSettings, logs: FloatArray, weights: FloatArray
) -> tuple[ContactDraw, ...]:
    """Return `MAX_MOTIONS` equally likely joint samples of draws (N, P) with weights (N,).

    Their order is that of a van der Corput sequence along `_HOLD`, so that the first few
    are spread evenly over what decides whether things slip.
    """
    order = np.argsort(logs @ [_HOLD.get(name, 0) for name in RANGES], kind='stable')
    levels = np.cumsum(weights[order])
    # 1/2, 1/4, 3/4, 1/8, ...: the sequence begins with 0, the draw that slips most of all, with
    # which few futures would lean to slipping
    sequence = qmc.Halton(d=1, scramble=False).random(1 + MAX_MOTIONS)[1:, 0]
    at = sequence * levels[-1]
    chosen = order[np.minimum(np.searchsorted(levels, at), len(order) - 1)]
    settings = [_settings(first, row) for row in logs[chosen]]
    return tuple(
        ContactDraw(**{name: float(getattr(one, name)) for name in RANGES}) for one in settings
    )


def _finding(
    name: str,
    values: FloatArray,
    likelihoods: FloatArray,
    weights: FloatArray,
    conditional: float | None = None,
) -> FittedNumber:
    """Return the posterior of a parameter from its draws.

    Args:
        name: name of the number.
        values: (N,) logarithms of the drawn values.
        likelihoods: (N, E) likelihoods of the draws, by recording.
        weights: (N,) weights of the draws, which sum to 1.
        conditional: standard deviation if the other numbers are known; None = it stands alone.
    """
    order = np.argsort(values)
    shares = np.cumsum(weights[order]) - weights[order] / 2
    middle = weights @ values
    low, high = np.interp((0.05, 0.95), shares, values[order])
    spread = float(np.sqrt(weights @ (values - middle) ** 2))
    first = values[: _FIT.num_draws]
    thirds = np.quantile(first, (1 / 3, 2 / 3))
    parts = (first <= thirds[0], first >= thirds[1])
    ends = [likelihoods[: _FIT.num_draws][part].mean(0) for part in parts]
    count = int((np.abs(ends[0] - ends[1]) > _FIT.min_log_likelihood_gap).sum())
    low, middle, high = np.exp([low, middle, high]).tolist()
    return FittedNumber(
        name=name,
        value=middle,
        low=low,
        high=high,
        spread=spread if conditional is None else conditional,
        count=count,
        of=likelihoods.shape[1],
        apart=conditional is None or bool(spread < _FIT.max_width_ratio * conditional),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Trial:
    """An episode whose objects are foreseen under several settings.

    Attributes:
        solids: solids of the O objects that two views see at first; none where stops of fingers
            are simulated in place of the whole episode.
        positions: (1 + T * n, J) commanded.
        displacements: (1 + T, O, 3) since the first step, as masks show them; NaN = not known [m].
        table_m: height of its table.
        stops: stops of fingers that are simulated one by one.
    """

    solids: tuple[Solid, ...]
    positions: FloatArray
    displacements: FloatArray
    table_m: float
    stops: tuple[StopTrial, ...] = ()

    @classmethod
    def of(
        cls,
        recording: ContactRecording,
        settings: ContactSettings,
        robot: RobotModel,
    ) -> _Trial:
        """Return the trial of a recording on a table as high as the settings say.

        Args:
            recording: the recording.
            settings: settings that say how high the table is, and whether commands are measured
                positions (`squeeze`).
            robot: robot of the recording.
        """
        frame, points, table = recording.frame, recording.frame.points(), settings.table_m
        if settings.table_varies and np.isfinite(own := recording.table()):
            table = own
        found = [
            fit_solid(
                frame.masks[:, item], points[item], frame.cameras, frame.poses, table,
                is_vessel(name), is_box(name),
            )
            for item, name in enumerate(recording.names)
        ]  # fmt: skip
        # measured fingers press as lightly as cameras are off: whatever the settings, what they
        # hold is lost within seconds, and the rest of a recording says nothing. Its stops do
        known = {
            item: solid
            for item, solid in enumerate(found)
            if solid is not None and not settings.squeeze
        }
        return cls(
            solids=tuple(known.values()),
            positions=recording.positions,
            # one memory layout: sums of a pickled copy, in a worker, round alike
            displacements=np.ascontiguousarray(recording.displacements[:, list(known)]),
            table_m=table,
            stops=_stop_trials(recording, found, robot, table) if settings.squeeze else (),
        )

    def likelihoods(self, engine: Engine, settings: Sequence[ContactSettings]) -> FloatArray:
        """Return (N,) log likelihoods of where masks show the objects."""
        # where the cameras see all of it is not known: each draw has a shift of its own
        drawn = np.random.default_rng(_FIT.seed).normal(size=(len(settings), 3))
        shifts = drawn * np.array([[one.spread.camera_m] for one in settings])
        found = np.zeros(len(settings))
        if self.solids:
            found += self._whole(engine, settings, shifts)
        for stop in self.stops:
            found += stop.likelihoods(engine, settings, shifts)
        return found

    def _whole(
        self, engine: Engine, settings: Sequence[ContactSettings], shifts: FloatArray
    ) -> FloatArray:
        """Return (N,) log likelihoods of where masks show the objects of the whole episode."""
        still = np.zeros(len(engine.arms.drives.names))
        futures = []
        for one, shift in zip(settings, shifts, strict=True):
            seen = shift * [1, 1, one.table_varies]
            changed = one.model_copy(update={'table_m': self.table_m + seen[2]})
            solids = tuple(shifted(solid, seen) for solid in self.solids)
            futures.append(
                Future(settings=changed, solids=solids, zeros=still, delay_s=one.delay_s)
            )
        motion, state = engine.begin(futures).advance(self.positions, COMMANDS_A_STEP)
        rows = min(motion.points.shape[1], len(self.displacements))
        # how it ends counts: at first nothing has moved whatever the settings
        late = slice(rows // 2, rows)
        foreseen = motion.points[:, late] - motion.points[:, :1]
        away = np.linalg.norm(foreseen - self.displacements[late], axis=-1)
        away = np.minimum(away, _FIT.lost_distance_m)
        unlikely = np.log1p((away / _FIT.position_scale_m) ** 2)
        known = np.isfinite(self.displacements[late]).all(-1)
        counted = np.where(known, np.nan_to_num(unlikely), 0.0).sum(1)
        found = -(counted / np.maximum(known.sum(0), 1)).sum(-1)
        found[list(state.lost)] = -np.log1p(
            (_FIT.lost_distance_m / _FIT.position_scale_m) ** 2
        ) * len(self.solids)
        return np.asarray(found, np.float64)


def _stop_trials(
    recording: ContactRecording,
    solids: Sequence[Solid | None],
    robot: RobotModel,
    table_m: float,
) -> tuple[StopTrial, ...]:
    """Return the stops of a recording that can be simulated."""
    found = []
    for stop in recording.stops:
        solid = solids[stop.item]
        if solid is not None:
            ways = recording.displacements[:, stop.item]
            found.append(StopTrial.of(stop, robot, recording.recorded, ways, solid, table_m))
    return tuple(trial for trial in found if trial is not None)


class _TrialRunner:
    """Foresees trials in a worker; a job is the number of a trial and settings.

    Args:
        arms: arms of the robot.
        trials: the E trials.
        threads: CPU threads of the engine.
    """

    def __init__(self, arms: Arms, trials: Sequence[_Trial], threads: int) -> None:
        self._engine, self._trials = Engine(arms, threads), trials

    def __call__(self, job: tuple[int, Sequence[ContactSettings]]) -> FloatArray:
        number, settings = job
        return self._trials[number].likelihoods(self._engine, settings)


def find_delay(recordings: Sequence[ContactRecording], arms: Arms) -> FittedNumber:
    """Return the delay of the measured joints against their modelled response [s]."""
    errors = np.stack([_delay_errors(one, arms) for one in recordings])
    known = errors[np.isfinite(errors).all(-1)]
    return _resampled(
        'delay_s', known, len(errors), 'recordings', lambda rows: _lowest(rows.mean(0), _DELAYS)
    )


def _delay_errors(recording: ContactRecording, arms: Arms) -> FloatArray:
    """Return the error of the joints by delay; NaN = they do not move."""
    expected = recording.positions
    if arms.response is not None:
        free = replace(arms.response, floor=None)
        expected = free.follow(arms.robot, recording.positions)[0]
    speeds = np.abs(np.gradient(expected, PERIOD_S, axis=0))
    moving = speeds > _FIT.min_joint_speed
    errors = []
    for delay in np.rint(_DELAYS / PERIOD_S).astype(int):
        late = np.concatenate([np.repeat(expected[:1], delay, 0), expected])[: len(expected)]
        off = np.abs(late - recording.recorded)[moving]
        errors.append(float(np.mean(off)) if len(off) else np.nan)
    return np.array(errors)


def find_cameras(recordings: Sequence[ContactRecording]) -> FittedNumber:
    """Return the common position error of all objects that the cameras cause [m].

    Errors of cameras let the rays of two views pass each other: where each ray is off by a
    deviation, they pass by that times the square root of two. Large objects are left out, whose
    masks in two views have no common middle.
    """
    found = [gap for recording in recordings for gap in _ray_gaps(recording.frame)]
    known = np.array([gap for gap in found if np.isfinite(gap)])
    return _resampled(
        'camera_m', known, len(found), 'objects', lambda gaps: np.sqrt((gaps**2).mean() / 2)
    )


def _ray_gaps(frame: FirstFrame) -> list[float]:
    """Return the gaps between the views' rays to each object [m]; NaN = not known.

    What the middle of a mask is uncertain by is left out, so that it is 0 where cameras are right.
    """
    gaps, pixels = [], centroids(frame.masks)
    for item in range(frame.masks.shape[1]):
        place = locate(frame.cameras, frame.poses, pixels[:, item])
        if place is None or not np.isfinite(place.point).all():
            gaps.append(np.nan)
            continue
        areas = frame.masks[:, item].sum((-2, -1)).astype(np.float64)
        edge = block_size(frame.cameras, frame.poses, areas, place.point)
        # each ray passes the point between them at half the gap
        beyond_px = np.sqrt(max(place.residual_px**2 - CENTROID_NOISE_PX**2, 0.0))
        gap = 2 * place.pixel_m * beyond_px
        gaps.append(gap if edge < _FIT.max_small_size_m else np.nan)
    return gaps


def find_holds(stops: Sequence[ObservedStop]) -> FittedNumber:
    """Return the share of stops of fingers that hold what they stop at; Laplace's rule."""
    held = sum(stop.is_held for stop in stops)
    posterior = beta(1 + held, 1 + len(stops) - held)
    return FittedNumber(
        name='stop_holds',
        value=float(posterior.mean()),
        low=float(posterior.ppf(0.05)),
        high=float(posterior.ppf(0.95)),
        spread=float(posterior.std()),
        count=held,
        of=len(stops),
        counted='stops',
    )


def find_table(recordings: Sequence[ContactRecording]) -> FittedNumber:
    """Return the height of the table, from the lower ends of objects that stand on it [m]."""
    bottoms = []
    for recording in recordings[:: max(1, len(recordings) // _FIT.max_tables)]:
        frame, points = recording.frame, recording.frame.points()
        for item, name in enumerate(recording.names):
            seen = frame.masks[:, item], points[item], frame.cameras, frame.poses
            bottoms.append(bottom_of(*seen, name))
    known = np.array(bottoms)[np.isfinite(bottoms)]
    # the middle one: some stand in others
    found = _resampled('table_m', known, len(bottoms), 'objects', np.median)
    return replace(
        found, low=found.low - _FIT.outline_error_m, high=found.high + _FIT.outline_error_m
    )


def _resampled(
    name: str,
    known: FloatArray,
    of: int,
    counted: str,
    middle: Callable[..., Any],
) -> FittedNumber:
    """Return the `middle` of (E, ...) known rows, with an interval from resampled ones.

    `of` rows were looked at; `counted` is what they are.
    """
    if not len(known):
        nothing = dict.fromkeys(('value', 'low', 'high', 'spread'), 0.0)
        return FittedNumber(name=name, count=0, of=of, counted=counted, **nothing)
    rng = np.random.default_rng(_FIT.seed)
    rows = rng.integers(0, len(known), (_FIT.num_resamples, len(known)))
    found = np.array([middle(known[row]) for row in rows])
    low, high = np.quantile(found, (0.05, 0.95))
    return FittedNumber(
        name=name,
        value=float(middle(known)),
        low=float(low),
        high=float(high),
        spread=float(found.std()),
        count=len(known),
        of=of,
        counted=counted,
    )


def _lowest(errors: FloatArray, values: FloatArray) -> float:
    """Return the minimum of a sampled error curve (N,), refined by a parabola."""
    at = int(errors.argmin())
    if not 0 < at < len(values) - 1:
        return float(values[at])
    before, least, after = errors[at - 1 : at + 2]
    bend = before - 2 * least + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(values[at] + shift * (values[1] - values[0]))
