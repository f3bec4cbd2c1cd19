"""What are verdicts worth where the truth is another physics, and who earns them?

    python experiments/shifted_worlds.py --faults drawn:4 --log out/shifted.jsonl
    python experiments/shifted_worlds.py --physics nominal,bold --contact out/fitted --log out/fitted.jsonl

In each physics of `config/physics.yaml` the expert and faulty policies act in the same scenes of the
simulator; kinds of faults have the size `--size`, a factor of what was drawn. Each plan is foreseen
from the pictures of the first frame alone, as the node does: cameras are checked against the arm's
outline, objects are found by the segmenter. Judges: *foreseen motions alone*, the estimate without
frames: contact parameters were fitted in `nominal`, and futures of every other physics are drawn from
the wide prior of a robot cell in which nothing was fitted; *foreseen motions, as if fitted here*: with
the parameters of `nominal` all the same; where `--pictures` says so, *pictures alone* (no motion
foreseen) and *both* (the estimate, which frames make less sure where they contradict the drawn motion);
where `--real` says so, *real frames*, the estimate on the simulator's; where `--contact FOLDER` has a
folder `FOLDER/PHYSICS` that `fit contact` wrote in that physics, *foreseen motions, fitted there*; the
*no-picture rule*: an object sticks to a gripper that closes near it. From .75 on it is called a success,
below .5 a failure, unless the interval reaches the opposite verdict.
*Right* is the share of what was said that is true, success and failure apart. AUROC is of rollouts with
an estimate, and of all with .5 where there is no verdict. Intervals over scenes: AUROC jackknife, shares
clustered Wilson. The log keeps what was done, and the same command
goes on; physics that show the same first picture share what is imagined. `--no-camera-check` leaves
cameras as they are told. Flips of contact, as `mtv-world rank` has them: of rollouts whose true outcome
is another than the expert's in the same scene, the share in which the last imagined frame is nearer to
what really happened than to what the expert's commands make happen, where objects are. The last table is
of the node's watch, which compares the end of every executed chunk (here where objects truly are) with
the futures of the fitted parameters: how many rollouts it takes to say that the physics is another one,
over random orders. The same ends may confirm the fitted parameters in a cell in which nothing was fitted
(`ContactConfirmation`): the page has how many rollouts that takes, over random orders in which tasks are
mixed or come one after the other, and what verdicts are worth from the first rollout on, by the wide prior
until then. Shares are means over the orders. *False success* is there of all failures.
"""  # noqa: E501

from __future__ import annotations

import argparse
import base64
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import json
from math import isfinite, nan
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
from page import parse_arguments, publish, table
from plan_pairs import BEST, best_cells, NUM_PLANS, outcomes_of, pair_cells, PAIRS

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    FloatArray,
    JointTrajectory,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.core.errors import MtvWorldError, PolicyError, SimulatorError
from mtv_world_ros.core.images import encode_png, resize_frames
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.evaluation.metrics.statistics import clustered_wilson
from mtv_world_ros.evaluation.metrics.success_agreement import expected_calibration_error
from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.checkpoint_files import load_foresight
from mtv_world_ros.physics.foreseen_motions import foreseen_of
from mtv_world_ros.physics.object_motion import FoundObjects, ObjectMotionModel
from mtv_world_ros.ranking.flips import is_nearer, objects_png
from mtv_world_ros.ranking.judges import area_interval
from mtv_world_ros.ranking.no_picture_rule import judge_without_pictures
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed
from mtv_world_ros.simulation.collect.record import carry_out, RecordConfig, Take
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.faults.catalogue import EXPERT, FAULTS, kinds_of, PolicyVariant
from mtv_world_ros.simulation.faults.drawn import is_drawn
from mtv_world_ros.simulation.physics import catalogue, physics_named
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.success.comparison import RULE as RULE_OF_PAIRS
from mtv_world_ros.success.confirmation import ContactConfirmation, seen_end
from mtv_world_ros.success.doubts import (
    Grounds,
    NEAR_M,
    PhysicsWatch,
    shrunk,
    unforeseen,
)
from mtv_world_ros.success.estimator import (
    capped,
    estimate_of_futures,
    stated_probability,
    verdict,
)
from mtv_world_ros.success.foreseen import foreseen_feature, ForeseenEnds
from mtv_world_ros.success.share_fit import ShareEstimate, ShareFit
from mtv_world_ros.success.situation import CannotTell
from mtv_world_ros.vision.camera_check import CameraCheck

#: how rollouts are recorded
_RECORD = RecordConfig()
TASKS = (
    'place_block_a2b_left', 'stack_blocks_two', 'place_cup_plate', 'collect_toy',
    'place_bread_plate', 'move_object_two',
)  # fmt: skip
HEAD = (
    'truth', 'judged by', 'n', 'succeed', 'verdicts', 'right, said success', 'right, said failure',
    'AUROC', 'AUROC, no verdict .5', 'from .9 on succeed', 'ECE',
)  # fmt: skip
ACROSS = ('judged by', 'truths', 'verdicts', 'right, said success', 'right, said failure',
          'AUROC, mean (worst)', 'AUROC, no verdict .5, mean (worst)', 'from .9 on succeed',
          'ECE, mean')  # fmt: skip
WATCHED = (
    'truth', 'foreseen by', 'chunks that ended unforeseen',
    'says so after rollouts: median [5 %, 95 %]', 'orders in which it never does',
)  # fmt: skip
CONFIRMED = ('truth', 'tasks', 'orders that confirm', 'after rollouts: median [5 %, 95 %]',
             'no verdict', 'false success', 'from .9 on succeed', 'ECE')  # fmt: skip
FLIPPED = ('truth', 'imagined by', 'flips of contact that are imagined')
FORESEEN, PICTURES, BOTH = 'foreseen motions alone', 'pictures alone', 'both'
REAL, RULE, FITTED = 'real frames', 'no-picture rule', 'foreseen motions, fitted there'
AS_FITTED = 'foreseen motions, as if fitted here'
#: truths in which everything looks as in `nominal` before it moves
SAME_PICTURE = ('bold', 'mass_triple', 'dart')
#: judges that rest on futures alone
OF_FUTURES = (FORESEEN, AS_FITTED, FITTED)
#: a robot cell in which nothing was fitted
_ELSEWHERE = 'another robot cell'
#: random orders of rollouts in which the watch sees them
_ORDERS = 100
#: random orders of rollouts in which fitted parameters are confirmed
CONFIRMING_ORDERS = 200
#: what pictures are made for
IMAGINED = (PICTURES, BOTH)
Job = tuple[str, str, int, int, str]
Said = dict[str, Any]


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('--physics', default=','.join(catalogue()))
    parser.add_argument('--pictures', default='', metavar='PHYSICS', help='of these, or all')
    parser.add_argument('--real', default='', metavar='PHYSICS', help='of these, or all')
    parser.add_argument('--checkpoints', default='bundled', help='each sees the same rollouts')
    parser.add_argument('--contact', type=Path, help='FOLDER/PHYSICS, which fit contact wrote')
    parser.add_argument('--faults', default='drawn:0', help='a split, or drawn:SEED')
    parser.add_argument('--size', type=float, default=1.1, help='of drawn kinds')
    parser.add_argument('--tasks', default=','.join(TASKS))
    parser.add_argument('--scenes', type=int, default=1, help='of each task')
    parser.add_argument('--policies', type=int, default=13, help='in each scene, with the expert')
    parser.add_argument('--log', type=Path, required=True, help='JSON lines of what was done')
    parser.add_argument('--no-camera-check', action='store_true')
    parser.add_argument(
        '--until', type=float, default=1e9, help='begins no policy after so long; 0 = read the log'
    )


def policies_of(faults: str, size: float, count: int) -> list[str]:
    """Return the expert and a policy of each kind of fault; known ones in their usual size."""
    kinds = kinds_of(faults)
    sizes = {kind: size if is_drawn(kind) else FAULTS[kind].size.typical for kind in kinds}
    return [EXPERT, *(PolicyVariant.of({k: v}).name for k, v in sizes.items())][:count]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ahead:
    """What is foreseen of a rollout.

    Attributes:
        ends: outcomes of the futures; None = they do not tell.
        names: of the O objects.
        points: (K, 1 + C, O, 3) centres at first and at the ends of chunks [m].
        times: (1 + C,) [s].
    """

    ends: ForeseenEnds | None
    names: tuple[str, ...]
    points: FloatArray
    times: FloatArray

    def said(self, sim: SimEpisode, take: Take) -> Said:
        """Return the features, and how far each chunk's end truly was from all futures [m]."""
        items = {item.name: number for number, item in enumerate(sim.scene.objects)}
        known = [number for number, name in enumerate(self.names) if name in items]
        frames = np.rint(self.times / _RECORD.frame_period_s).astype(int)
        centres = take.object_poses[..., :3, 3]
        columns = [items[self.names[number]] for number in known]
        real = centres[np.minimum(frames, len(centres) - 1)][:, columns]
        points = self.points[:, :, known]
        chunks = [slice(chunk, chunk + 2) for chunk in range(len(self.times) - 1)]
        apart = [unforeseen(points[:, chunk], real[chunk]) for chunk in chunks]
        if self.ends is None:
            return {'features': None, 'apart': apart}
        number = self.ends.num_effective
        return {
            'features': {'foreseen': foreseen_feature(self.ends), 'futures': number},
            'apart': apart,
            'done': self.ends.done.tolist(),
            'weights': self.ends.weights.tolist(),
        }


def foreseen_by(
    pipeline: Pipeline, episode: Rollout, observation: Observation, commands: FloatArray
) -> Ahead:
    """Return what is foreseen of commands (C, J)."""
    model, names = pipeline.judge.object_motion, episode.names
    assert model is not None  # `Scenes._ask` asks only pipelines that foresee
    masks = pipeline.segmenter.segment(observation.frames[:, None], names).masks[:, :, 0]
    poses = np.stack(
        [
            camera_poses(camera, pipeline.robot, observation.positions[None])[0]
            for camera in observation.cameras
        ]
    )
    tracked = model.find(names, masks, observation.cameras, list(poses))
    objects = FoundObjects.at(names, observation.frames, masks, poses, tracked)
    (ahead,) = objects.foresee([commands])
    num_rows = len(ahead.motions[0].points)
    motions = foreseen_of(pipeline.robot, ahead, num_rows)
    ends = pipeline.judge.estimator.foresee(motions, episode.options.instruction)
    each = round(pipeline.spec.num_frames / pipeline.spec.fps / motions.step_s)
    rows = np.array([*range(0, num_rows - 1, each), num_rows - 1])
    return Ahead(
        ends=None if ahead.tracked.refusal else ends,
        names=names,
        points=motions.points[:, rows],
        times=rows * motions.step_s,
    )


def features_of(estimate: SuccessEstimate) -> dict[str, float] | None:
    """Return the features of an estimate, calibrated or not; None = it abstains."""
    return dict(estimate.features) if isfinite(estimate.probability) else None


def imagined(pipeline: Pipeline, episode: Rollout, commands: FloatArray) -> Said:
    """Return what the estimate rests on after commands (C, J) are imagined."""
    times = PERIOD_S * np.arange(1, len(commands), dtype=np.float64)
    plan = JointTrajectory(
        joint_names=pipeline.robot.joint_names, times=times, positions=commands[1:]
    )
    *_, last = episode.extend(plan)
    return {
        'features': features_of(last.success),
        'interval': list(last.success.interval),
        'reasons': list(last.success.reasons),
        'ends': packed(episode.observation.frames),
    }


def packed(frames: ByteArray) -> str:
    """Return frames (V, H, W, 3) uint8 RGB, views in a row, as text."""
    return base64.b64encode(encode_png(np.concatenate(list(frames), axis=1))).decode()


def unpacked(text: str) -> ByteArray:
    """Return what `packed` was given, (H, V * W, 3)."""
    data = np.frombuffer(base64.b64decode(text), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def ends_of(pipeline: Pipeline, sim: SimEpisode, names: tuple[str, ...]) -> dict[str, str]:
    """Return the picture that a rollout ends with, and where objects are in it, as text."""
    last = observed(sim, sim.observe())
    size = pipeline.spec.width, pipeline.spec.height
    frames = np.stack([resize_frames(frame[None], *size)[0] for frame in last.frames])
    masks = pipeline.segmenter.segment(frames[:, None], names).masks[:, :, 0]
    objects = base64.b64encode(objects_png(masks)).decode()
    return {'ends': packed(frames), 'objects': objects}


def observed(sim: SimEpisode, seen: Any) -> Observation:
    """Return what a policy sees, with the cameras as they are told."""
    cameras = sim.calibrated_cameras
    frames = np.stack([seen.images[camera.view] for camera in cameras])
    return Observation(cameras=cameras, frames=frames, positions=seen.positions, stamp_ns=1)


def frames_judged(pipeline: Pipeline, episode: Rollout, take: Take) -> Said:
    """Return what the estimate rests on at the end of the simulator's own frames."""
    each = round(1 / (pipeline.spec.fps * _RECORD.frame_period_s))
    kept = take.observations[::each]
    positions = np.stack([seen.positions for seen in kept])
    num, success = pipeline.spec.num_frames, None
    for first in range(0, len(kept) - 1, num):
        chunk = kept[first + 1 : first + 1 + num]
        frames = np.stack(
            [[seen.images[c.view] for seen in chunk] for c in episode.observation.cameras]
        )
        success = episode.observe(frames, positions[first : first + 1 + len(chunk)]).success
    assert success is not None
    return {'features': features_of(success)}


class Scenes:
    """What several physics share: expert's plans are of one table, imagination of one picture."""

    def __init__(self, pipelines: dict[str, Pipeline], options: argparse.Namespace) -> None:
        self._pipelines, self._known = pipelines, dict[tuple, Any]()
        self._fitted = dict[str, ObjectMotionModel]()
        #: foresight of a robot cell in which nothing was fitted, by checkpoint
        self._unfitted = {
            name: pipeline.judge.object_motion
            and pipeline.judge.object_motion.at_place(_ELSEWHERE)
            for name, pipeline in pipelines.items()
        }
        for physics in options.physics.split(',') if options.contact else ():
            folder = options.contact / physics / OBJECT_MOTION_FOLDER
            robot = next(iter(pipelines.values())).robot
            if folder.is_dir() and (motion := load_foresight(folder, robot)) is not None:
                self._fitted[physics] = motion
        self._of = {
            key: set(catalogue()) if names == 'all' else set(names.split(','))
            for key, names in (('pictures', options.pictures), ('real', options.real))
        }
        self._group: tuple | None = None

    def wanted(self, physics: str) -> list[str]:
        """Return the judges of a physics."""
        more = [] if physics == NOMINAL else [AS_FITTED]
        more += [FITTED] if physics in self._fitted else []
        more += IMAGINED if physics in self._of['pictures'] else ()
        return [FORESEEN, *more, *([REAL] if physics in self._of['real'] else ())]

    def rollout(self, job: Job) -> dict[str, Any]:
        """Return what really happens, and what each checkpoint and the rule say."""
        physics, task, _, seed, policy = job
        if self._group != job[1:]:
            self._group, self._known = job[1:], {}
        robot = next(iter(self._pipelines.values())).robot
        plan, home = self._plan(job, robot)
        sim = SimEpisode(robot, home, physics=physics)
        is_real = physics in self._of['real']
        record = replace(_RECORD, pictures='all' if is_real else 'first')
        try:
            seen = sim.reset(seed, task)
            first = observed(sim, seen)
            take = carry_out(sim, task_named(task), plan, seen, record)
            ends: dict[str, str] = {}
            if physics in self._of['pictures']:
                names = tuple(item.name for item in sim.scene.objects)
                ends = ends_of(next(iter(self._pipelines.values())), sim, names)
        finally:
            sim.close()
        end = take.control_positions.shape[0] * CONTROL_PERIOD_S
        commands = resample(take.commands, sim.home, np.arange(0.0, end, PERIOD_S))
        said: dict[str, Any] = {}
        for name, pipeline in self._pipelines.items():
            judges = [judge for judge in self.wanted(physics) if judge != REAL]
            found = {
                judge: self._once(
                    name, judge, first, sim.instruction, commands, seed,
                    self._motion(name, judge, physics),
                )
                for judge in judges[::-1]
            }  # fmt: skip
            said[name] = {
                judge: one.said(sim, take) if isinstance(one, Ahead) else one
                for judge, one in found.items()
            }
            if is_real:
                begun = pipeline.begin(
                    first, RolloutOptions(instruction=sim.instruction, seed=seed)
                )
                said[name][REAL] = frames_judged(pipeline, begun, take)
        rule = self._once(name, RULE, first, sim.instruction, commands, seed)
        return {'final': take.final, 'said': said, 'rule': rule, **ends}

    def _plan(self, job: Job, robot: RobotModel) -> tuple[JointTrajectory, FloatArray]:
        """The policy's plan, and where it begins; one a table and size of objects."""
        physics, task, _, seed, policy = job
        truth = physics_named(physics)
        key = (truth.table_m, truth.object_size)
        if key not in self._known:
            expert = Expert(robot, physics=physics)
            acting = scripted_policy(policy, task, seed, expert)
            acting.reset(seed=seed)
            self._known[key] = acting.plan, expert.home
        return self._known[key]

    def _motion(self, name: str, judge: str, physics: str) -> ObjectMotionModel | None:
        """Return the foresight that a judge uses in a physics."""
        if judge == FITTED:
            return self._fitted[physics]
        if judge == AS_FITTED or physics == NOMINAL:
            return self._pipelines[name].judge.object_motion
        return self._unfitted[name]

    def _once(
        self,
        name: str,
        judge: str,
        first: Observation,
        instruction: str,
        commands: FloatArray,
        seed: int,
        motion: ObjectMotionModel | None = None,
    ) -> Said | Ahead:
        """What a judge says, who is asked once for all physics that look the same.

        The rule is asked without a motion.
        """
        cameras = [camera.T_mount_camera.tobytes() for camera in first.cameras]
        same = (first.frames.tobytes(), first.positions.tobytes(), commands.tobytes(), *cameras)
        key = (name, FORESEEN if judge in OF_FUTURES else judge, motion, *same)
        if key not in self._known:
            whole = self._pipelines[name]
            check = self._check(whole, (name, *same), first)
            if check.refusal and judge != RULE:
                return {'refused': True}
            assert isinstance(whole.judge, SuccessJudge)
            judging = replace(
                whole.judge,
                camera_checker=None,
                object_motion=motion or whole.judge.object_motion,
                checks_place=False,
            )
            if judge == PICTURES:
                judging = judging.without_foresight()
            # features are logged whether or not weights were ever fitted to them
            pipeline = replace(whole, judge=replace(judging, grounds=Grounds()))
            first = check.corrected_observation(first)
            begun = pipeline.begin(
                first, RolloutOptions(instruction=instruction, seed=seed, num_inference_steps=1)
            )
            self._known[key] = self._ask(judge, pipeline, begun, first, commands)
        return self._known[key]

    def _check(self, pipeline: Pipeline, key: tuple, first: Observation) -> CameraCheck:
        """What the first picture says about the cameras."""
        assert isinstance(pipeline.judge, SuccessJudge)
        checker = pipeline.judge.camera_checker
        if checker is None:
            return CameraCheck()
        if key not in self._known:
            self._known[key] = checker.check(first)
        return self._known[key]

    @staticmethod
    def _ask(
        judge: str,
        pipeline: Pipeline,
        episode: Rollout,
        first: Observation,
        commands: FloatArray,
    ) -> Said | Ahead:
        if judge == RULE:
            try:
                return {'value': float(judge_without_pictures(pipeline, episode, commands))}
            except CannotTell:
                return {'value': None}
        if judge in IMAGINED:
            return imagined(pipeline, episode, commands)
        if pipeline.judge.object_motion is None:  # nothing is foreseen: no verdict
            return {'value': None}
        return foreseen_by(pipeline, episode, first, commands)


def jobs(options: argparse.Namespace) -> Iterator[Job]:
    """Yield physics, task, number of the scene, its seed, policy: all physics take turns."""
    policies = policies_of(options.faults, options.size, options.policies)
    for index in range(options.scenes):
        for policy in policies:
            for task in options.tasks.split(','):
                seed = episode_seed(options.seed, task, index, 0)
                for physics in options.physics.split(','):
                    yield physics, task, index, seed, policy


def run(options: argparse.Namespace, pipelines: dict[str, Pipeline]) -> list[dict[str, Any]]:
    """Run what is missing in the log; return all of it that the options ask for."""
    begun, scenes = time.monotonic(), Scenes(pipelines, options)
    done: dict[Job, dict[str, Any]] = {}
    if options.log.is_file():
        lines = [json.loads(line) for line in options.log.read_text().splitlines()]
        done = {tuple(line['job']): line for line in lines}
    options.log.parent.mkdir(parents=True, exist_ok=True)
    found, last = [], None
    for job in jobs(options):
        known = done.get(job)
        is_missing = known is None or not is_whole(known, scenes.wanted(job[0]), pipelines)
        if is_missing and options.until <= 0:
            if known is None:
                continue
        elif is_missing:
            # all physics of a policy or none, so that they are comparable
            if time.monotonic() - begun > options.until and job[1:] != last:
                break
            try:
                known = {'job': job, **scenes.rollout(job)}
            except (SimulatorError, PolicyError) as error:
                known = {'job': job, 'skipped': str(error)}
            with options.log.open('a') as stream:
                stream.write(json.dumps(known) + '\n')
        last = job[1:]
        assert known is not None
        if 'skipped' not in known:
            found.append(known)
    return found


def is_whole(known: dict[str, Any], judges: Sequence[str], names: Iterable[str]) -> bool:
    """Tell whether a line of the log has all that is asked for."""
    if 'skipped' in known:
        return True
    return all(set(judges) <= set(known['said'].get(name, ())) for name in names)


def estimated(pipeline: Pipeline, judge: str, said: Said, physics: str) -> ShareEstimate:
    """Return the probability of success that a judge gives, with its interval; NaN = it abstains.

    Estimates are those of the checkpoint as it is calibrated now; of one that is not calibrated
    for rollouts of this kind, those of the stated weights. An interval of frames alone is that
    of the run.
    """
    if said.get('value') is not None:
        return ShareEstimate(float(said['value']), nan, nan)
    features, judging = said.get('features'), pipeline
    if features is None:
        return ShareEstimate(nan, nan, nan)
    features = {key: nan if value is None else value for key, value in features.items()}
    if judge == PICTURES:
        judging = pipeline.without_foresight()
    calibration = judging.judge.estimator.calibration
    if isfinite(features.get('foreseen', nan)):
        is_fitted = physics == NOMINAL or judge in (AS_FITTED, FITTED)
        fit = None if calibration is None else calibration.futures
        fit = fit or ShareFit()
        if not is_fitted:
            fit = ShareFit(max_picture_gap_m=fit.max_picture_gap_m)
        return estimate_of_futures(fit, features, is_fitted=is_fitted)
    interval = tuple(nan if end is None else end for end in said.get('interval', (nan, nan)))
    if calibration is None:
        return ShareEstimate(capped(stated_probability(features), features), *interval)
    weights = calibration.given(judge == REAL)
    return ShareEstimate(capped(weights.probability(features), features), *interval)


@dataclass(frozen=True, slots=True)
class Row:
    """What a judge reached in a physics; areas and errors are NaN where not defined.

    Attributes:
        physics: name of the truth.
        judge: name of the judge.
        cells: cells of `HEAD`.
        counts: rollouts; verdicts; success said, right of these; failure said, right of these;
            estimates from .9 on, successes of these.
        auroc: area under the ROC of rollouts with an estimate.
        auroc_all: area under the ROC of all rollouts, .5 where there is no verdict.
        calibration_error: expected calibration error.
    """

    physics: str
    judge: str
    cells: list[str]
    counts: tuple[int, ...]
    auroc: float
    auroc_all: float
    calibration_error: float


def row(
    physics: str, judge: str, rows: Sequence[dict[str, Any]], estimates: Sequence[ShareEstimate]
) -> Row:
    """Return a row of the table, of N estimates."""
    said = np.array([one.probability for one in estimates])
    real = np.array([r['final'] for r in rows], np.bool_)
    scenes = [(r['job'][1], r['job'][3]) for r in rows]
    calls = np.array([verdict(one.probability, one[1:]) for one in estimates])
    known, is_open, sure = np.isfinite(said), ~np.isfinite(calls), said >= 0.9
    success, failure = calls == 1, calls == 0
    area, text = _area(said, real, known, scenes)
    area_all, text_all = _area(
        np.where(is_open, 0.5, said), real, np.ones(len(said), np.bool_), scenes
    )
    error = expected_calibration_error(said[known], real[known]) if known.any() else nan
    counts = (
        len(rows), int((~is_open).sum()), int(success.sum()), int((success & real).sum()),
        int(failure.sum()), int((failure & ~real).sum()), int(sure.sum()),
        int((sure & real).sum()),
    )  # fmt: skip
    cells = [
        physics, judge, str(len(rows)), str(int(real.sum())), f'{counts[1]} of {len(rows)}',
        _share(real, success, scenes), _share(~real, failure, scenes), text, text_all,
        f'{counts[7]} of {counts[6]}', f'{error:.2f}' if known.any() else '–',
    ]  # fmt: skip
    return Row(physics, judge, cells, counts, area, area_all, error)


def _area(
    said: FloatArray, real: BoolArray, known: BoolArray, scenes: Sequence[tuple[str, int]]
) -> tuple[float, str]:
    """Return the area under the ROC of the known estimates (N,), and its text with an interval."""
    if not known.any() or len(set(real[known])) < 2:
        return nan, '–'
    chosen = [scene for scene, is_known in zip(scenes, known, strict=True) if is_known]
    area, (low, high) = area_interval([said[known]], real[known], chosen)
    return area, f'{area:.2f}' + (f' [{low:.2f}, {high:.2f}]' if isfinite(low) else '')


def across(rows: Sequence[Row]) -> list[list[str]]:
    """Return a line of `ACROSS` for each judge, over all truths but the nominal one."""
    lines = []
    for judge in dict.fromkeys(r.judge for r in rows):
        of = [r for r in rows if r.judge == judge and r.physics != NOMINAL]
        if of:
            lines.append([judge, str(len(of)), *over_truths(of)])
    return lines


def over_truths(rows: Sequence[Row]) -> list[str]:
    """Return the cells of `ACROSS` after the first two, over the rows of several truths."""
    total = np.sum([r.counts for r in rows], axis=0)
    return [
        f'{total[1]} of {total[0]}',
        f'{total[3]} of {total[2]}',
        f'{total[5]} of {total[4]}',
        _mean_and_worst([(r.auroc, r.physics) for r in rows]),
        _mean_and_worst([(r.auroc_all, r.physics) for r in rows]),
        f'{total[7]} of {total[6]}',
        f'{_mean([r.calibration_error for r in rows]):.2f}',
    ]


def _mean_and_worst(areas: Sequence[tuple[float, str]]) -> str:
    """Return the mean of the known areas, and the least one with the name of its truth."""
    known = [area for area in areas if isfinite(area[0])]
    if not known:
        return '–'
    least, where = min(known)
    return f'{np.mean([area for area, _ in known]):.2f} ({least:.2f}, `{where}`)'


def _mean(values: Sequence[float]) -> float:
    """Mean of those that are known; NaN = none is."""
    known = [value for value in values if isfinite(value)]
    return float(np.mean(known)) if known else nan


def _share(hits: np.ndarray, among: np.ndarray, scenes: Sequence[tuple[str, int]]) -> str:
    if not among.any():
        return '–'
    names = list(dict.fromkeys(scenes))
    number = np.array([names.index(scene) for scene in scenes])
    counts = [np.bincount(number[among & h], minlength=len(names)) for h in (hits, among)]
    low, high = clustered_wilson(*(c[counts[1] > 0].astype(np.float64) for c in counts))
    interval = f' [{low:.2f}, {high:.2f}]' if isfinite(low) else ''
    return f'{int(counts[0].sum())} of {int(counts[1].sum())}{interval}'


def rows_of(
    options: argparse.Namespace, pipelines: dict[str, Pipeline], found: Sequence[dict[str, Any]]
) -> list[Row]:
    """Return a row for each physics and judge."""
    rows, scenes = [], Scenes(pipelines, options)
    for physics in options.physics.split(','):
        chosen = [r for r in found if r['job'][0] == physics]
        if not chosen:
            continue
        for name, pipeline in pipelines.items():
            for judge in scenes.wanted(physics):
                asked = [r for r in chosen if judge in r['said'][name]]
                said = [estimated(pipeline, judge, r['said'][name][judge], physics) for r in asked]
                title = judge if len(pipelines) == 1 else f'{judge}, {name}'
                if asked:
                    rows.append(row(physics, title, asked, said))
        rows.append(row(physics, RULE, chosen, [ruled(r) for r in chosen]))
    return rows


def compared_rows(
    options: argparse.Namespace, pipelines: dict[str, Pipeline], found: Sequence[dict[str, Any]]
) -> tuple[list[list[str]], list[list[str]]]:
    """Return rows of `PAIRS` and of `BEST`: plans of one scene under common futures."""
    (name, pipeline), *_ = pipelines.items()
    pairs, best = [], []
    for physics in options.physics.split(','):
        lines = [r for r in found if r['job'][0] == physics]
        for judge in (FORESEEN, AS_FITTED):
            said = [r['said'][name][judge] for r in lines if judge in r['said'][name]]
            if not said or len(said) < len(lines):
                continue
            outcomes = [outcomes_of(one) for one in said]
            judged = [estimated(pipeline, judge, one, physics) for one in said]
            is_fitted = physics == NOMINAL or judge == AS_FITTED
            title = 'the fit in `nominal`' if is_fitted else 'the prior'
            pairs.append([physics, title, *pair_cells(lines, outcomes, judged)])
            for num in NUM_PLANS:
                cells = best_cells(lines, outcomes, num)
                if cells is not None:
                    best.append([physics, title, str(num), *cells])
    return pairs, best


def ruled(line: dict[str, Any]) -> ShareEstimate:
    """Return what the no-picture rule says of a rollout of the log."""
    value = line['rule']['value']
    return ShareEstimate(nan if value is None else float(value), nan, nan)


def flip_rows(
    options: argparse.Namespace, found: Sequence[dict[str, Any]], names: Iterable[str]
) -> list[list[str]]:
    """Return how many flips of contact each way of imagining shows, in each physics."""
    rows, names = [], list(names)
    for physics in options.physics.split(','):
        chosen = [r for r in found if r['job'][0] == physics and 'ends' in r]
        experts = {tuple(r['job'][1:3]): r for r in chosen if r['job'][4] == EXPERT}
        pairs = [(r, experts.get(tuple(r['job'][1:3]))) for r in chosen]
        flips = [(r, e) for r, e in pairs if e is not None and e['final'] != r['final']]
        for name in names:
            for judge in IMAGINED:
                known = [(r, e) for r, e in flips if 'ends' in r['said'][name].get(judge, {})]
                hits = np.array([is_flip(r, e, r['said'][name][judge]['ends']) for r, e in known])
                scenes = [(r['job'][1], r['job'][3]) for r, _ in known]
                if known:
                    title = judge if len(names) == 1 else f'{judge}, {name}'
                    share = _share(hits, np.ones(len(known), np.bool_), scenes)
                    rows.append([physics, title, share])
    return rows


def is_flip(faulty: dict[str, Any], expert: dict[str, Any], imagined_ends: str) -> bool:
    """Return whether an imagined end is nearer to the faulty rollout's than to the expert's."""
    own, other, imagined_end = map(unpacked, (faulty['ends'], expert['ends'], imagined_ends))
    objects = (unpacked(faulty['objects']) > 127) | (unpacked(expert['objects']) > 127)
    return is_nearer(imagined_end, own, other, np.asarray(objects.any(-1)))


def watch_rows(
    options: argparse.Namespace, found: Sequence[dict[str, Any]], names: Iterable[str]
) -> list[list[str]]:
    """Return what the watch makes of executed chunks, in each physics."""
    rows = []
    for physics in options.physics.split(','):
        for name in names:
            # those of a wide prior foresee nearly everything
            fitted = FORESEEN if physics == NOMINAL else AS_FITTED
            for judge in (fitted, FITTED):
                said = [r['said'][name].get(judge, {}) for r in found if r['job'][0] == physics]
                apart = [one['apart'] for one in said if 'apart' in one]
                if any(np.isfinite(one).any() for one in apart):
                    title = judge if len(list(names)) == 1 else f'{judge}, {name}'
                    rows.append([physics, title, *watch_cells(apart)])
    return rows


def watch_cells(apart: Sequence[Sequence[float]]) -> list[str]:
    """Return the rest of a row, of how far the chunks of each rollout ended from all futures."""
    told = np.concatenate([np.array(one) for one in apart])
    told = told[np.isfinite(told)]
    rng = np.random.default_rng(0)
    counts = np.array([needed(apart, rng.permutation(len(apart))) for _ in range(_ORDERS)])
    said = counts[counts > 0]
    after = '–'
    if len(said):
        low, middle, high = np.percentile(said, (5, 50, 95))
        after = f'{middle:.0f} [{low:.0f}, {high:.0f}]'
    unlike = int((told > NEAR_M).sum())
    return [f'{unlike} of {len(told)}', after, f'{(counts == 0).sum()} of {_ORDERS}']


def needed(apart: Sequence[Sequence[float]], order: Iterable[int]) -> int:
    """Return after how many rollouts the watch says that the physics is another; 0 = never."""
    watch = PhysicsWatch()
    for count, number in enumerate(order, 1):
        for away in apart[number]:
            watch.take(away, count)
        if watch.doubt:
            return count
    return 0


def confirmed_rows(
    options: argparse.Namespace, pipelines: dict[str, Pipeline], found: Sequence[dict[str, Any]]
) -> list[list[str]]:
    """Return what becomes of a robot cell in which nothing was fitted, in each physics."""
    (name, pipeline), *_ = pipelines.items()
    # the wide prior foresees the same wherever the first picture is the same
    twins = {tuple(r['job'][1:]): r for r in found if r['job'][0] in SAME_PICTURE}
    rows = []
    for physics in options.physics.split(','):
        is_nominal = physics == NOMINAL
        lines = [r for r in found if r['job'][0] == physics]
        unfitted = [twins.get(tuple(r['job'][1:])) if is_nominal else r for r in lines]
        lines = [r for r, other in zip(lines, unfitted, strict=True) if other is not None]
        judge = FORESEEN if is_nominal else AS_FITTED
        said = [r['said'][name].get(judge, {}) for r in lines]
        if not lines or not all('apart' in one for one in said):
            continue
        fitted = [estimated(pipeline, judge, one, physics) for one in said]
        prior = [
            estimated(pipeline, FORESEEN, r['said'][name][FORESEEN], r['job'][0])
            for r in unfitted
            if r is not None
        ]
        apart = [one['apart'] for one in said]
        for title, is_mixed in (('mixed', True), ('one after the other', False)):
            cells = confirmed_cells(lines, apart, fitted, prior, is_mixed=is_mixed)
            rows.append([physics, title, *cells])
    return rows


def confirmed_cells(
    lines: Sequence[dict[str, Any]],
    apart: Sequence[Sequence[float]],
    fitted: Sequence[ShareEstimate],
    prior: Sequence[ShareEstimate],
    *,
    is_mixed: bool,
) -> list[str]:
    """Return the rest of a row of N rollouts.

    Args:
        lines: lines of the log.
        apart: distances of the chunks' ends from the futures of the fitted parameters [m].
        fitted: estimates with these parameters.
        prior: estimates with the wide prior.
        is_mixed: whether tasks take turns; else one comes after the other.
    """
    rng, real = np.random.default_rng(0), np.array([r['final'] for r in lines], np.bool_)
    tasks = [r['job'][1] for r in lines]
    names = sorted(set(tasks))
    first, said, true = [], [], []
    for _ in range(CONFIRMING_ORDERS):
        order = rng.permutation(len(lines))
        if not is_mixed:
            rank = dict(zip(rng.permutation(names), range(len(names)), strict=True))
            order = np.array(sorted(order, key=lambda number: rank[tasks[number]]))
        watch, test, confirmed = PhysicsWatch(), ContactConfirmation(), 0
        for count, number in enumerate(order, 1):
            trust = test.trust(tasks[number]).is_confirmed and not watch.doubt
            one = fitted[number] if trust else prior[number]
            confirmed = confirmed or count * trust
            if watch.doubt and isfinite(one.probability):
                middle, interval = shrunk(one.probability, one[1:])
                one = ShareEstimate(middle, *interval)
            said.append(one)
            for chunk, away in enumerate(apart[number], 1):
                away_m = nan if away is None else away
                watch.take(away_m, count)
                is_last = chunk == len(apart[number])
                test.take(seen_end(away_m), count, tasks[number], is_last=is_last)
        first.append(confirmed)
        true.append(real[order])
    return _over_orders(np.array(first), np.array(said), np.concatenate(true))


def _over_orders(first: np.ndarray, said: np.ndarray, real: np.ndarray) -> list[str]:
    """Return cells.

    Args:
        first: (K,) rollout from which on parameters were confirmed in each order; 0 = never.
        said: (K * N, 3) probabilities and intervals.
        real: (K * N,) whether the rollouts succeed.
    """
    calls = np.array([verdict(one[0], tuple(one[1:])) for one in said])
    known, sure, after = np.isfinite(said[:, 0]), said[:, 0] >= 0.9, '–'
    if first.any():
        low, middle, high = np.percentile(first[first > 0] - 1, (5, 50, 95))
        after = f'{middle:.0f} [{low:.0f}, {high:.0f}]'
    wrong = f'{(calls[~real] == 1).mean():.3f}' if (~real).any() else '–'
    held = f'{real[sure].mean():.2f}' if sure.any() else '–'
    error = expected_calibration_error(said[known, 0], real[known])
    return [f'{(first > 0).sum()} of {len(first)}', after, f'{np.isnan(calls).mean():.2f}',
            wrong, held, f'{error:.2f}']  # fmt: skip


def compared_text(
    options: argparse.Namespace, pipelines: dict[str, Pipeline], found: Sequence[dict[str, Any]]
) -> list[str]:
    """Return the parts of the page on plans of one scene."""
    pairs, best = compared_rows(options, pipelines, found)
    choice = (
        'The best of N plans of one scene, drawn in random order: the first that no other one is '
        'better than. The share of the gain is of what the true best would gain over the first:'
    )
    return [
        f'Pairs of plans of one scene. {RULE_OF_PAIRS.text}:',
        table(PAIRS, pairs),
        choice,
        table(BEST, best),
    ]


def main() -> None:
    """Print a row for each physics and judge, and write them as a page."""
    options = parse_arguments(__doc__, 1, more)
    names = options.checkpoints.split(',')
    pipelines = {
        name: Pipeline.load(name, camera_check=not options.no_camera_check) for name in names
    }
    found = run(options, pipelines)
    if not found:
        raise MtvWorldError('no rollout was done; give more time (--until)')
    rows = rows_of(options, pipelines, found)
    asked = ('faults', 'size', 'physics', 'pictures', 'real', 'contact', 'tasks', 'scenes',
             'policies', 'seed', 'checkpoints')  # fmt: skip
    command = ' '.join(
        f'--{key} {getattr(options, key)}' for key in asked if getattr(options, key)
    )
    publish(
        'shifted_worlds',
        'Verdicts where the truth is another physics',
        f'python experiments/shifted_worlds.py {command}',
        '\n\n'.join(
            [
                (__doc__ or '').split('\n' * 2)[-1].strip(),
                f'{len(found)} rollouts.',
                table(HEAD, [r.cells for r in rows]),
                'Over all truths but the nominal one:',
                table(ACROSS, across(rows)),
                *compared_text(options, pipelines, found),
                'Flips of contact:',
                table(FLIPPED, flip_rows(options, found, list(pipelines))),
                'Executed chunks against the futures:',
                table(WATCHED, watch_rows(options, found, list(pipelines))),
                'Confirmed by how rollouts end:',
                table(CONFIRMED, confirmed_rows(options, pipelines, found)),
            ]
        ),
        options,
        'one process',
    )


if __name__ == '__main__':
    main()
