"""Can contact be learnt from how executed plans ended? A trial of two rounds, with its rule.

    python experiments/learnt_contact.py --seeds 60913,28457,91736 --log out/learnt.jsonl

A robot cell in which nothing was fitted executes plans, one after the other. Each plan is
foreseen in `--draws` futures. Their contact parameters are drawn once for the cell, from the wide
prior; friction is by object, with a part that all objects share and a part of an object's own.
Each plan weighs the draws by where tracked objects end (`ends_m`); a part of the probability stays
with *none of these*. Later plans are judged by the weighed draws. No picture is imagined and no
model is asked: only the first frame is rendered, in which objects are found. Tracked objects are
the simulator's, with an error of 5 mm.

Rule, stated before the seeds were drawn: in all seven truths, over all seeds, at most .05 of the
failures are called a success after 3, 10 and 30 plans, and after 10 plans at least half of the
rollouts have a verdict. Else it is not shipped. Stopping rule: `--until` seconds of wall time; a
policy is begun in all truths or in none. The two rounds were chosen on another seed.

*Round 1*: the share is the weighed sum of the draws that succeed. Its interval is that of a share
of independent futures, their number being the effective sample size. *Round 2*: one draw is one
sample, as places and sizes differ, too. So likelihood and success are smoothed over draws of
similar contact, and the interval goes from the 2.5th to the 97.5th percentile of the weighed
draws' success rates, because this robot has one of them. At first all draws weigh the same.

A truth is a cell; its scenes are those of all seeds. Its rollouts come in random orders; after
each number of plans the rest of an order is judged. The policies of a seed meet the same scenes,
so that an object that is judged was often seen in other plans. Brackets: 95 % intervals over
scenes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
import json
from math import isfinite
from pathlib import Path
import time
from typing import Any
from zlib import crc32

import numpy as np
from page import parse_arguments, publish, table
from scipy.special import ndtri
from scipy.stats import qmc
from shifted_worlds import observed, policies_of, Scenes, TASKS

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.core.data_types import FloatArray, Observation
from mtv_world_ros.core.errors import MtvWorldError, PolicyError, SimulatorError
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.evaluation.metrics.statistics import clustered_wilson
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.contact_settings import (
    ContactDraw,
    ContactSettings,
    FACTORS,
    PRIOR_LOG_STD,
    RANGES,
)
from mtv_world_ros.physics.engine.engine import Batch, Engine
from mtv_world_ros.physics.engine.futures import Future
from mtv_world_ros.physics.foreseen_motions import foreseen_of
from mtv_world_ros.physics.mujoco_import import mujoco
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.physics.solid_foresight import SolidForesight
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed
from mtv_world_ros.simulation.collect.record import carry_out, RecordConfig, Take
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.success.doubts import Grounds
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.success.share_fit import ShareEstimate, ShareFit
from mtv_world_ros.vision.camera_check import CameraCheck

TRUTHS = (
    NOMINAL,
    'bold',
    'mass_triple',
    'dart',
    'camera_off',
    'joint_zeros_1deg',
    'objects_small',
)
#: numbers of executed plans after which the rest is judged
AFTER = (0, 3, 10, 30)
#: random orders of a cell's rollouts
ORDERS = 40
#: limits of the rule: of failures, called a success; of rollouts after `DECIDES`, with a verdict
MAX_FALSE, MIN_VERDICTS, DECIDES = 0.05, 0.5, 10
#: a robot cell in which nothing was fitted
_ELSEWHERE = 'another robot cell'
_RECORD = RecordConfig(pictures='first')
Line = dict[str, Any]
Job = tuple[str, str, int, str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Prior of the contact of a cell.

    Attributes:
        own_log_std: standard deviation of the logarithm of an object's own friction.
        log_range: range of the logarithm of friction x stiffness of fingers / density, relative to
            the fitted one, over which draws are spread evenly; their weights make up for it.
        num_candidates: draws of the prior among which the spread ones are chosen.
    """

    own_log_std: float = 0.3
    log_range: tuple[float, float] = (-5.0, 3.5)
    num_candidates: int = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class Learning:
    """How ends of plans weigh draws.

    Attributes:
        scale_m: distance of an object's end from the drawn one at which a draw is half as likely.
        tail: exponent of the likelihood's tail.
        none_share: probability of none of these at first.
        none_at_m: distance that none of these is taken to have.
        bandwidths: of the kernel, of the logarithms of friction x stiffness / density of what the
            gripper moves and of table friction; empty = draws count each for itself.
        power: exponent of each plan's likelihood; below 1, as errors of plans of one scene agree.
        is_flat: the draws count alike at first, over all of their range; else as the prior has it,
            in which 1 of 40 robots is as slippery as `bold`.
    """

    scale_m: float = 0.03
    tail: float = 1.5
    none_share: float = 0.2
    none_at_m: float = 0.09
    bandwidths: tuple[float, ...] = ()
    power: float = 1.0
    is_flat: bool = False

    def likelihood(self, away_m: FloatArray | float) -> FloatArray:
        """Return the likelihood of an end at a distance [m]."""
        return np.asarray((1 + (np.asarray(away_m) / self.scale_m) ** 2) ** -self.tail)


ROUNDS = {
    'round 1': Learning(),
    'round 2': Learning(bandwidths=(0.5, 1.5), power=0.7, is_flat=True),
}
PRIOR = Prior()
TRACKED_STD_M = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class Draws:
    """Contact of a cell in K draws.

    Attributes:
        settings: settings of contact with the draws, and one future more: the fitted parameters.
        weights: (K,) prior weights.
        holds: (K,) logarithm of friction x stiffness of fingers / density, relative.
        tables: (K,) logarithm of table friction, relative.
    """

    settings: ContactSettings
    weights: FloatArray
    holds: FloatArray
    tables: FloatArray

    @classmethod
    def of(cls, settings: ContactSettings, count: int) -> Draws:
        """Return draws of the wide prior around settings, spread evenly over what decides."""
        factors = [getattr(settings, name) if name in FACTORS else 1.0 for name in RANGES]
        low, high = np.log(np.array(list(RANGES.values())).T * factors)
        middle = np.log([getattr(settings, name) for name in RANGES])
        sobol = qmc.Sobol(len(RANGES), rng=np.random.default_rng(6))
        normal = ndtri(np.clip(sobol.random(PRIOR.num_candidates), 1e-9, 1 - 1e-9))
        logs = np.clip(middle + PRIOR_LOG_STD * normal, low, high)
        relative = dict(zip(RANGES, (logs - middle).T, strict=True))
        holds = relative['grip_friction'] + relative['finger_stiffness'] - relative['density']
        edges = np.linspace(*PRIOR.log_range, count + 1)
        edges[[0, -1]] = -np.inf, np.inf
        rng, chosen, weights = np.random.default_rng(8), [], []
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            among = np.flatnonzero((holds >= first) & (holds < last))
            if len(among):
                chosen.append(int(rng.choice(among)))
                weights.append(len(among) / len(holds))
        rows = np.exp(logs[chosen]).tolist()
        draws = [ContactDraw(**dict(zip(RANGES, row, strict=True))) for row in rows]
        kept = {'draws': tuple(draws), 'num_motions': 1 + len(draws)}
        return cls(
            settings=settings.model_copy(update=kept),
            weights=np.array(weights),
            holds=holds[chosen],
            tables=relative['table_friction'][chosen],
        )

    def own(self, names: Sequence[str]) -> FloatArray:
        """Return (K, O) logarithms of the own friction of objects; a name always has the same."""
        columns = [
            np.random.default_rng((7, crc32(name.encode()))).normal(size=len(self.weights))
            for name in names
        ]
        shape = len(self.weights), len(names)
        return PRIOR.own_log_std * np.reshape(np.transpose(columns), shape)


class ByObject(Batch):
    """Futures in which each solid has a friction of its own.

    Pads rub as the solid does that is nearest to them; a solid rubs on all else by its own number,
    that of the table being small (MuJoCo takes the larger of two).

    Args:
        engine: engine that computes them.
        futures: K.
        own: (K, O) logarithms of the own friction of the solids.
    """

    def __init__(self, engine: Engine, futures: Sequence[Future], own: FloatArray) -> None:
        super().__init__(engine, futures)
        self._own = np.exp(own)
        self._pads = np.flatnonzero(self.model.geom_priority > 0)
        bodies = [self.model.body(f'solid {n}').id for n in range(own.shape[1])]
        for number, model in enumerate(self._models):
            for item, body in enumerate(bodies):
                model.geom_friction[model.geom_bodyid == body, 0] *= self._own[number, item]
            model.geom_friction[0, 0] = 0.01

    def _compute(self, run: Any, moving: np.ndarray, controls: FloatArray) -> None:
        data, scene = self._data[0], self._scene
        for number in map(int, moving if self._own.shape[1] else ()):
            model, qpos = self._models[number], run.qpos(number)
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            centres = qpos[scene.solid_qpos[:, None] + np.arange(3)]
            away = np.linalg.norm(data.geom_xpos[self._pads][:, None] - centres, axis=-1)
            grip = self.futures[number].settings.grip_friction
            model.geom_friction[self._pads, 0] = grip * self._own[number, away.argmin(1)]
        super()._compute(run, moving, controls)


def foreseen(
    pipeline: Pipeline, first: Observation, instruction: str, seed: int, commands: FloatArray
) -> Line:
    """Return what K draws foresee of commands (C, J); see `rollout`."""
    assert isinstance(pipeline.judge, SuccessJudge)
    judging = replace(pipeline.judge, camera_checker=None, checks_place=False, grounds=Grounds())
    whole = replace(pipeline, judge=judging)
    episode = whole.begin(
        first, RolloutOptions(instruction=instruction, seed=seed, num_inference_steps=1)
    )
    model, names = whole.judge.object_motion, episode.names
    assert isinstance(model, SolidForesight)
    draws = Draws.of(model.at_place(_ELSEWHERE).settings, DRAWN[0])
    model = replace_settings(model, draws.settings)
    masks = whole.segmenter.segment(first.frames[:, None], names).masks[:, :, 0]
    poses = _poses(whole, first)
    tracked = model.find(names, masks, first.cameras, list(poses))
    known = [name for name, solid in zip(names, tracked.solids, strict=True) if solid is not None]
    own = np.concatenate([np.zeros((1, len(known))), draws.own(known)])
    batch = ByObject(model.engine, tracked.futures(), own)
    doubts = {**tracked._floating(batch, commands[0]), **tracked.doubts}
    tracked = replace(tracked, batch=batch, doubts=doubts)
    (ahead,) = FoundObjects.at(names, first.frames, masks, poses, tracked).foresee([commands])
    num_rows = len(ahead.motions[0].points)
    motions = foreseen_of(whole.robot, ahead, num_rows)
    ends = whole.judge.estimator.foresee(motions, instruction)
    each = round(whole.spec.num_frames / whole.spec.fps / motions.step_s)
    rows = np.array([*range(0, num_rows - 1, each), num_rows - 1])
    points = motions.points[:, rows]
    return {
        'names': names,
        'times': (rows * motions.step_s).tolist(),
        'ways': np.rint(1e3 * np.nan_to_num(points[:, 1:] - points[:, :1], nan=9.0)).astype(int),
        'done': None if ends is None or ahead.tracked.refusal else ends.done[1:].astype(int),
        'counts': motions.weights[1:] > 0,
    }


#: number of draws; set by the command line
DRAWN = [64]


def replace_settings(model: SolidForesight, settings: ContactSettings) -> SolidForesight:
    """Return a foresight that is not fitted here, with these settings."""
    other = SolidForesight(model.robot, model.response, settings)
    other.is_fitted, other.engine = False, model.engine
    return other


def _poses(pipeline: Pipeline, first: Observation) -> FloatArray:
    return np.stack(
        [camera_poses(c, pipeline.robot, first.positions[None])[0] for c in first.cameras]
    )


class Cells:
    """Rollouts in several truths; those with the same picture and plan are foreseen once."""

    def __init__(self, pipeline: Pipeline) -> None:
        options = argparse.Namespace(physics=NOMINAL, contact=None, pictures='', real='')
        self._pipeline, self._scenes = pipeline, Scenes({'': pipeline}, options)
        self._known: dict[tuple, Line] = {}
        self._group: tuple | None = None

    def rollout(self, job: Job) -> Line:
        """Return a line of the log.

        It has the outcome (`final`), names of objects, where the simulator moved them by the ends
        of chunks (`real`, (C, O, 3) [mm]), where the draws did (`ways`, (K, C, O, 3) [mm]), which
        draws succeed (`done`, (K,); null = not told) and which count (`counts`, (K,)).
        """
        physics, task, seed, policy, _ = job
        if self._group != job[1:]:
            self._group, self._known, self._scenes._known = job[1:], {}, {}
        plan, home = self._scenes._plan((physics, task, 0, seed, policy), self._pipeline.robot)
        sim = SimEpisode(self._pipeline.robot, home, physics=physics)
        try:
            seen = sim.reset(seed, task)
            first = observed(sim, seen)
            take = carry_out(sim, task_named(task), plan, seen, _RECORD)
        finally:
            sim.close()
        end = take.control_positions.shape[0] * CONTROL_PERIOD_S
        commands = resample(take.commands, sim.home, np.arange(0.0, end, PERIOD_S))
        cameras = [camera.T_mount_camera.tobytes() for camera in first.cameras]
        key = (first.frames.tobytes(), first.positions.tobytes(), commands.tobytes(), *cameras)
        if key not in self._known:
            check = self._check(first)
            self._known[key] = (
                {'refused': True}
                if check.refusal
                else foreseen(
                    self._pipeline,
                    check.corrected_observation(first),
                    sim.instruction,
                    seed,
                    commands,
                )
            )
        said = self._known[key]
        if 'refused' in said:
            return {'final': take.final, **said}
        real = moved(sim, take, said['names'], np.array(said['times']))
        said = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in said.items()}
        return {'final': take.final, 'real': real.tolist(), **said}

    def _check(self, first: Observation) -> CameraCheck:
        assert isinstance(self._pipeline.judge, SuccessJudge)
        checker = self._pipeline.judge.camera_checker
        return CameraCheck() if checker is None else checker.check(first)


def moved(sim: SimEpisode, take: Take, names: Sequence[str], times: FloatArray) -> FloatArray:
    """Return (C, O, 3) how far objects moved by the ends of chunks [mm]; NaN = unknown name."""
    items = {item.name: number for number, item in enumerate(sim.scene.objects)}
    frames = np.rint(times / _RECORD.frame_period_s).astype(int)
    centres = take.object_poses[..., :3, 3]
    found = np.full((len(times), len(names), 3), np.nan)
    for column, name in enumerate(names):
        if name in items:
            found[:, column] = centres[np.minimum(frames, len(centres) - 1), items[name]]
    return np.rint(1e3 * (found[1:] - found[:1]))


def jobs(options: argparse.Namespace) -> Iterator[Job]:
    """Yield jobs: truths of a rollout, scenes of all seeds, then the next policy of each scene.

    Policies take turns over scenes, so that all kinds come early.
    """
    seeds = [int(seed) for seed in options.seeds.split(',')]
    tasks: list[str] = options.tasks.split(',')
    for turn in range(options.plans):
        for number, (seed, task) in enumerate(product(seeds, tasks)):
            policies = policies_of(f'drawn:{seed}', options.size, options.policies)
            place = (turn * len(tasks) + number) % len(policies)
            for physics in options.physics.split(','):
                yield physics, task, episode_seed(seed, task, 0, 0), policies[place], str(turn)


def run(options: argparse.Namespace, pipeline: Pipeline) -> list[Line]:
    """Run what is missing in the log; return all of it that the options ask for."""
    begun, cells = time.monotonic(), Cells(pipeline)
    done = {}
    if options.log.is_file():
        done = {
            tuple(line['job']): line
            for line in map(json.loads, options.log.read_text().splitlines())
        }
    options.log.parent.mkdir(parents=True, exist_ok=True)
    found, last = [], None
    for job in jobs(options):
        line = done.get(job)
        if line is None:
            if job[1:] != last and time.monotonic() - begun > options.until:
                break
            try:
                line = {'job': job, **cells.rollout(job)}
            except (SimulatorError, PolicyError) as error:
                line = {'job': job, 'skipped': str(error)}
            with options.log.open('a') as stream:
                stream.write(json.dumps(line) + '\n')
        last = job[1:]
        if 'skipped' not in line:
            found.append(line)
    return found


class Cell:
    """Rollouts of a seed in a truth, with what a way of learning makes of them.

    Args:
        lines: N lines of the log.
        draws: the draws.
        learning: the way of learning.
    """

    def __init__(self, lines: Sequence[Line], draws: Draws, learning: Learning) -> None:
        self._lines, self._draws, self._learning = lines, draws, learning
        rng = np.random.default_rng(crc32(str(lines[0]['job']).encode()))
        self._near = [self._kernel(line) for line in lines]
        # (N, K) logarithms of the likelihood of each rollout's end
        self._logs = np.stack(
            [self._evidence(line, near, rng) for line, near in zip(lines, self._near, strict=True)]
        )
        self._none = learning.power * float(np.log(learning.likelihood(learning.none_at_m)))

    def _kernel(self, line: Line) -> FloatArray:
        """Return (K, K) weights of the draws in the smoothed one, rows sum to 1."""
        count, widths = len(self._draws.weights), self._learning.bandwidths
        if not widths or line.get('done') is None:
            return np.eye(count)
        holds = self._draws.holds + self._draws.own(line['names']).mean(1)
        apart = (holds[:, None] - holds) ** 2 / widths[0] ** 2
        tables = self._draws.tables
        apart = apart + (tables[:, None] - tables) ** 2 / widths[1] ** 2
        near = np.exp(-apart / 2) * np.array(line['counts'], float)
        return np.asarray(near / np.maximum(near.sum(1, keepdims=True), 1e-12))

    def _evidence(self, line: Line, near: FloatArray, rng: np.random.Generator) -> FloatArray:
        count = len(self._draws.weights)
        if line.get('done') is None:
            return np.zeros(count)
        away = ends_m(line, rng)
        with np.errstate(divide='ignore'):
            likely = near @ np.where(line['counts'], self._learning.likelihood(away), 0.0)
            logs = self._learning.power * np.log(np.maximum(likely, 1e-12))
        return np.asarray(logs if np.isfinite(away).any() else np.zeros(count))

    def weights(self, seen: Sequence[int]) -> tuple[FloatArray, float]:
        """Return the weights (K,) of the draws and of none of these after some rollouts."""
        share = self._learning.none_share
        first = self._draws.weights
        if self._learning.is_flat:
            first = np.full(len(first), 1 / len(first))
        logs = np.log(np.append((1 - share) * first, share))
        told = [n for n in seen if self._lines[n].get('done') is not None]
        logs += np.append(self._logs[told].sum(0), len(told) * self._none)
        found = np.exp(logs - logs.max())
        found /= found.sum()
        return found[:-1], float(found[-1])

    def estimate(self, number: int, weights: FloatArray, none: float) -> ShareEstimate:
        """Return the estimate of a rollout by weights of the draws and of none of these."""
        line = self._lines[number]
        if line.get('done') is None:
            return ShareEstimate(np.nan, np.nan, np.nan)
        done, counts = np.array(line['done'], float), np.array(line['counts'], float)
        kept = weights * counts
        lost = float((weights * (1 - counts)).sum()) + none
        total = kept.sum()
        if total <= 1e-9:
            return ShareEstimate(np.nan, np.nan, np.nan)
        kept = kept / total
        if not self._learning.bandwidths:
            share = float(np.clip(kept @ done, 0.0, 1.0))
            one = ShareFit().estimate(share, float(1 / (kept**2).sum()))
            middle, low, high = one
        else:
            near = self._near[number]
            rates, worth = near @ done, 1 / (near**2).sum(1)
            middle = float(kept @ ((rates * worth + 1) / (worth + 2)))
            low, high = spread(rates, kept)
        return ShareEstimate(
            (1 - lost) * middle + lost / 2, (1 - lost) * low, (1 - lost) * high + lost
        )


def spread(rates: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Return the lower and upper 2.5 % of success rates (K,) by their weights."""
    order = np.argsort(rates)
    sums = np.cumsum(weights[order])
    low, high = np.searchsorted(sums, (0.025, 0.975 - 1e-9))
    last = len(rates) - 1
    return float(rates[order[min(low, last)]]), float(rates[order[min(high, last)]])


def ends_m(line: Line, rng: np.random.Generator) -> FloatArray:
    """Return (K,) largest distance of tracked objects from a draw at the ends of chunks [m].

    Args:
        line: line of the log.
        rng: draws the error of the tracked places.
    """
    real = np.array(line['real'], float) * 1e-3
    real = real + TRACKED_STD_M * rng.normal(size=real.shape)
    gaps = np.linalg.norm(np.array(line['ways'], float)[1:] * 1e-3 - real, axis=-1)
    gaps = np.where(np.isfinite(gaps), gaps, 0.0)
    return np.asarray(gaps.reshape(len(gaps), -1).max(1, initial=0.0))


HEAD = ('truth', 'plans', 'judged', 'fail', 'verdicts', 'failures called a success',
        'successes called a failure', 'right, said success', 'from .9 on succeed',
        'weight of none of these', 'draws worth')  # fmt: skip


def rows_of(lines: Sequence[Line], draws: Draws, learning: Learning) -> dict[tuple, list[Any]]:
    """Return cells of `HEAD` by truth and number of executed plans, and what the rule asks for."""
    rows: dict[tuple, list[Any]] = {}
    for physics in dict.fromkeys(line['job'][0] for line in lines):
        own = [line for line in lines if line['job'][0] == physics]
        cell, rng = Cell(own, draws, learning), np.random.default_rng(9)
        tallies: dict[int, dict[tuple, FloatArray]] = {n: {} for n in AFTER if n < len(own)}
        held: dict[int, list[tuple[float, float]]] = {n: [] for n in tallies}
        for _ in range(ORDERS):
            order = rng.permutation(len(own))
            for after, tally in tallies.items():
                weights, none = cell.weights(order[:after].tolist())
                held[after].append((none, float(weights.sum() ** 2 / (weights**2).sum())))
                for number in order[after:]:
                    one = cell.estimate(number, weights, none)
                    scene = tuple(own[number]['job'][1:3])
                    counts = tally.setdefault(scene, np.zeros(9))
                    counts += _counted(one, own[number]['final'])
        for after, tally in tallies.items():
            cells = _row(physics, after, np.array(list(tally.values())), held[after])
            rows[physics, after] = cells
    return rows


def _counted(one: ShareEstimate, is_success: bool) -> FloatArray:
    """Return counts of a judged rollout, see `_row`."""
    call = verdict(one.probability, (one.low, one.high))
    sure = bool(one.probability >= 0.9)
    return np.array([
        1, not is_success, is_success, isfinite(call), call == 1 and not is_success,
        call == 0 and is_success, call == 1, sure, sure and is_success,
    ], float)  # fmt: skip


def _row(
    physics: str, after: int, tallies: FloatArray, held: Sequence[tuple[float, float]]
) -> list[Any]:
    """Return cells of `HEAD`, then shares of failures called a success and of verdicts."""
    tallies = tallies / ORDERS
    total, fail, succeed, told, false, missed, said, sure, right = tallies.T
    none, worth = np.median(held, axis=0)
    cells = [
        physics, str(after), f'{total.sum():.0f}', f'{fail.sum():.1f}', _share(told, total),
        _share(false, fail), _share(missed, succeed), _share(said - false, said),
        _share(right, sure), f'{none:.2f}', f'{worth:.1f}',
    ]  # fmt: skip
    return [*cells, false.sum() / max(fail.sum(), 1e-9), told.sum() / total.sum()]


def _share(hits: FloatArray, among: FloatArray) -> str:
    """Return a share with its interval over scenes."""
    kept = among > 0
    if among.sum() < 0.05:
        return '–'
    low, high = clustered_wilson(hits[kept], among[kept])
    interval = f' [{low:.2f}, {high:.2f}]' if isfinite(low) else ''
    return f'{hits.sum() / among.sum():.2f}{interval}'


def ruled(rows: Mapping[tuple, list[Any]]) -> list[str]:
    """Return what of the rule does not hold; empty = it holds."""
    broken = []
    for (physics, after), row in rows.items():
        false, told = row[-2:]
        if after and false > MAX_FALSE:
            broken.append(f'`{physics}`, {after} plans: {false:.2f} of failures called a success')
        if after == DECIDES and told < MIN_VERDICTS:
            broken.append(f'`{physics}`, {after} plans: verdicts in {told:.2f}')
    return broken


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('--seeds', required=True, help='comma-separated, drawn for this page')
    parser.add_argument('--physics', default=','.join(TRUTHS))
    parser.add_argument('--tasks', default=','.join(TASKS))
    parser.add_argument('--policies', type=int, default=7, help='that take turns, with the expert')
    parser.add_argument('--plans', type=int, default=2, help='of each scene')
    parser.add_argument('--size', type=float, default=1.1, help='of drawn kinds')
    parser.add_argument('--draws', type=int, default=64, help='of contact parameters')
    parser.add_argument('--log', type=Path, required=True, help='JSON lines of what was done')
    parser.add_argument('--until', type=float, default=3600.0, help='begins no policy after [s]')


def main() -> None:
    """Run what is missing, and print the tables."""
    options = parse_arguments(__doc__, 1, more)
    DRAWN[0] = options.draws
    pipeline = Pipeline.load('bundled')
    lines = run(options, pipeline)
    if not lines:
        raise MtvWorldError('no rollout was done; give more time (--until)')
    model = pipeline.judge.object_motion
    assert isinstance(model, SolidForesight)
    draws = Draws.of(model.settings, options.draws)
    parts = [(__doc__ or '').split('\n' * 2, 2)[2].strip()]
    counts = {p: sum(line['job'][0] == p for line in lines) for p in options.physics.split(',')}
    parts.append(
        f'{len(lines)} rollouts: '
        + ', '.join(f'{n} in `{p}`' for p, n in counts.items())
        + f'; {len(draws.weights)} draws. Counts are means of {ORDERS} orders.'
    )
    for title, learning in ROUNDS.items():
        rows = rows_of(lines, draws, learning)
        broken = ruled(rows)
        held = 'The rule holds.'
        if broken:
            held = 'The rule is broken:\n\n- ' + '\n- '.join(broken)
        parts += [
            f'## {title.capitalize()}',
            f'`{learning}`',
            table(HEAD, [row[: len(HEAD)] for row in rows.values()]),
            held,
        ]
    asked = ('seeds', 'physics', 'tasks', 'policies', 'plans', 'size', 'draws')
    command = ' '.join(f'--{key} {getattr(options, key)}' for key in asked)
    options.seed = int(options.seeds.split(',')[0])
    publish(
        'learnt_contact',
        'Contact learnt from how executed plans ended',
        f'python experiments/learnt_contact.py {command}',
        '\n\n'.join(parts),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
