from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.physics.foreseen_motions import foreseen_of, ForeseenMotions
from mtv_world_ros.physics.object_motion import FoundObjects, ObjectMotion
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.success.calibration import Calibration, load_fit
from mtv_world_ros.success.estimator import (
    load_tasks,
    SUCCESS_FROM,
    SuccessEstimator,
    verdict_word,
)
from mtv_world_ros.success.foreseen import foreseen_ends, foreseen_feature
from mtv_world_ros.success.task import match_task
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from test.support.drawn_blocks import BLUE, footage, LEFT, masks, NAMES, path, RED

TASKS = load_tasks(share_path('config', 'tasks'))
CALIBRATION = load_fit(share_path('resource', 'checkpoint'), Calibration)
COLOUR = choose_segmenter('colour')
GOAL = (BLUE[0] - 0.13, BLUE[1], 0.025)
OPEN = np.ones(2)


def matched():
    found = match_task(TASKS, LEFT)
    assert found is not None
    return found


def foreseen(*ends):
    """Motions of 9 steps in which the red block ends at each of `ends`, the gripper open."""
    points = np.array([[[red, BLUE] for red in path(RED, end)] for end in ends], float)
    turns = np.broadcast_to(np.eye(3), (*points.shape, 3))
    sizes = np.broadcast_to([[0.05] * 3, [0.04] * 3], (len(points), 2, 3))
    openings = np.ones((len(points), 2, points.shape[1]))
    return ForeseenMotions(
        names=NAMES,
        points=points,
        rotations=turns,
        sizes=sizes,
        openings=openings,
        weights=np.ones(len(points)),
    )


def held(*ends):
    """The same, at rest at the end for a second."""
    moving = foreseen(*ends)

    def longer(values, axis):
        last = np.take(values, [-1] * 10, axis=axis)
        return np.concatenate([values, last], axis=axis)

    return replace(
        moving,
        points=longer(moving.points, 1),
        rotations=longer(moving.rotations, 1),
        openings=longer(moving.openings, 2),
    )


def test_the_share_of_motions_that_end_at_the_goal_is_told():
    task, bound = matched()
    unknown = np.full((2, 3), np.nan)
    ends = foreseen_ends(held(GOAL, RED, GOAL, BLUE), task, bound, unknown)
    np.testing.assert_array_equal(ends.done, [True, False, True, False])
    assert foreseen_feature(ends) == 0.0
    assert foreseen_feature(foreseen_ends(held(GOAL), task, bound, unknown)) == 1.0


def test_motions_count_by_weight():
    task, bound = matched()
    motions = replace(held(GOAL, RED, BLUE), weights=np.array([3.0, 1.0, 1.0]))
    ends = foreseen_ends(motions, task, bound, np.full((2, 3), np.nan))
    assert ends.share == pytest.approx(0.6)
    np.testing.assert_array_equal(ends.is_majority, [True, False, False])
    assert foreseen_feature(ends) == pytest.approx(0.2)


@pytest.mark.parametrize(('end', 'low', 'high'), [(GOAL, 0.6, 1.0), (RED, 0.0, 0.4)])
def test_where_pictures_do_not_tell_the_motions_do(end, low, high):
    """An object that one of two views loses is not known; what is foreseen of it is."""
    status = (('absent', 'ok'), ('ok', 'ok'))
    lost = masks(path(RED, GOAL), [BLUE] * 9, status)
    shown = footage(lost, masks([RED], [BLUE]))
    estimator = SuccessEstimator(TASKS)
    assert np.isnan(estimator.estimate(shown, LEFT).estimate.probability)
    found = estimator.estimate(shown, LEFT, foreseen=held(end)).estimate
    assert low <= found.probability <= high
    assert found.interval[0] < found.probability < found.interval[1]
    assert "pictures do not tell: 'red block'" in found.reasons[1]
    assert np.isnan(found.features['margin']) and np.isfinite(found.features['foreseen'])


def motion(share=None):
    """Of nothing, in 3 steps, with grippers that end open by this share; None = not foreseen."""
    openings = None if share is None else np.array([[1, 1], [1, 1], [1, share]], float)
    nothing = np.zeros((3, 0, 3))
    turns = np.zeros((3, 0, 3, 3))
    return ObjectMotion(reference=nothing[0], points=nothing, rotations=turns, openings=openings)


@pytest.mark.parametrize(
    ('shares', 'expected'),
    [
        ((None, None), [0.5, 0.5]),  # as commanded
        ((None, 0.7, 0.8), [0.5, 0.7, 0.8]),
    ],
)
def test_grippers_open_as_foreseen_and_else_as_commanded(shares, expected):
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    tool = robot.tools[1]
    positions = np.tile((robot.lower + robot.upper) / 2, (3, 1))
    half = (tool.gripper_closed + tool.gripper_open) / 2
    positions[-1, robot.joint_names.index(tool.gripper_joint)] = half

    found = FoundObjects(
        names=(),
        cuts=np.zeros((2, 0, 4, 4, 4), np.uint8),
        poses=np.zeros((2, 0, 4, 4)),
        tracked=SimpleNamespace(sizes=np.zeros((len(shares), 0, 3)), step_s=0.1, is_fitted=True),
        motions=tuple(map(motion, shares)),
        positions=positions,
    )
    np.testing.assert_allclose(foreseen_of(robot, found, 3).openings[:, 1, -1], expected)
    assert foreseen_of(robot, found, 2).openings.shape == (len(shares), 2, 2)


def test_fingers_that_are_stopped_are_not_open():
    task, bound = matched()
    moved = held(GOAL, GOAL)
    openings = moved.openings.copy()
    openings[1, 0, -3:] = 0.7
    ends = foreseen_ends(replace(moved, openings=openings), task, bound, np.full((2, 3), np.nan))
    np.testing.assert_array_equal(ends.done, [True, False])


def test_what_was_shaken_before_is_not_told_by_motions_that_begin_later():
    matches = match_task(TASKS, 'shake the green bottle')
    assert matches is not None
    task, bound = matches
    moved = replace(held(GOAL), names=('green bottle', 'blue block'))
    assert foreseen_ends(moved, task, bound, np.full((2, 3), np.nan)) is not None
    later = replace(moved, is_begun=False)
    assert foreseen_ends(later, task, bound, np.full((2, 3), np.nan)) is None
    stays = replace(held(GOAL), is_begun=False)
    assert foreseen_ends(stays, *matched(), np.full((2, 3), np.nan)).done.all()


def test_objects_that_were_not_found_leave_it_open():
    task, bound = matched()
    seen = held(GOAL)
    lost = replace(seen, points=np.where(np.array([True, False])[:, None], np.nan, seen.points))
    for motions in (lost, replace(seen, names=('green cup', 'bowl'))):
        assert np.isnan(foreseen_feature(foreseen_ends(motions, task, bound, np.zeros((2, 3)))))


def test_the_share_of_futures_decides_whatever_frames_show():
    """Frames that show the motion that was drawn count for nothing more."""
    estimator = SuccessEstimator(TASKS)
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    found = {
        name: estimator.estimate(shown, LEFT, None, motions).estimate
        for name, motions in {
            'good': held(GOAL, GOAL, GOAL),
            'doubtful': held(GOAL, RED, RED),
        }.items()
    }
    assert '1 of 3 foreseen motions succeed, 33% by weight' in found['doubtful'].reasons
    # the rule of succession
    assert found['doubtful'].probability == pytest.approx(2 / 5)
    assert found['good'].probability == pytest.approx(4 / 5)
    assert found['good'].features['foreseen'] == pytest.approx(1.0)
    assert found['good'].features['futures'] == pytest.approx(3.0)
    assert found['good'].features['picture_gap'] < 0.01


def test_nine_of_sixteen_futures_are_an_open_verdict():
    """The frames show the majority, which succeeds: that is no further evidence."""
    motions = held(*[GOAL] * 9, *[RED] * 7)
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    for calibration in (None, CALIBRATION):
        estimator = SuccessEstimator(TASKS, calibration=calibration, segmenter=COLOUR)
        found = estimator.estimate(shown, LEFT, foreseen=motions).estimate
        assert 0.3 < found.probability < SUCCESS_FROM
        low, high = found.interval
        assert low < 9 / 16 < high and high - low > 0.3
        assert verdict_word(found.probability, found.interval) == 'open'


def test_frames_that_contradict_the_drawn_motion_are_named_and_open_the_verdict():
    estimator = SuccessEstimator(TASKS)
    drawn = held(*[GOAL] * 16)
    said = {}
    for name, end in (('as drawn', GOAL), ('otherwise', RED)):
        frames = footage(masks(path(RED, end), [BLUE] * 9), masks([RED], [BLUE]), OPEN)
        said[name] = estimator.estimate(frames, LEFT, foreseen=drawn).estimate
    away = np.linalg.norm(np.array(GOAL) - RED)
    assert said['otherwise'].features['picture_gap'] == pytest.approx(away, abs=0.005)
    (text,) = [r for r in said['otherwise'].reasons if r.startswith('imagined frames contradict')]
    assert "'red block'" in text
    assert not any('contradict' in reason for reason in said['as drawn'].reasons)
    words = [verdict_word(e.probability, e.interval) for e in said.values()]
    assert words == ['success', 'open']


def test_calibrations_that_count_frames_twice_are_not_used_for_futures():
    old = CALIBRATION.replace(futures=None)
    estimator = SuccessEstimator(TASKS, calibration=old, segmenter=COLOUR)
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    found = estimator.estimate(shown, LEFT, foreseen=held(GOAL, GOAL, RED)).estimate
    assert found.probability == pytest.approx(3 / 5) and not found.is_calibrated
    assert 'run mtv-world fit success again' in found.reasons[-1]


@pytest.mark.parametrize('calibration', [None, CALIBRATION.replace(segmenter='other')])
def test_an_uncalibrated_estimate_of_futures_says_that_it_is_their_share(calibration):
    estimator = SuccessEstimator(TASKS, calibration=calibration, segmenter=COLOUR)
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    found = estimator.estimate(shown, LEFT, foreseen=held(GOAL, GOAL, RED)).estimate
    assert found.probability == pytest.approx(3 / 5)
    assert found.trust.startswith('not fitted here')
    assert found.trust.endswith('the share of simulated futures that succeed')


def test_where_nothing_was_fitted_futures_that_disagree_leave_the_verdict_open():
    estimator = SuccessEstimator(TASKS, calibration=CALIBRATION, segmenter=COLOUR)
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]), OPEN)
    mixed = replace(held(*[GOAL] * 15, RED), is_fitted=False)
    found = estimator.estimate(shown, LEFT, foreseen=mixed).estimate
    assert found.probability == pytest.approx(16 / 18)
    assert found.interval[0] < 0.05 and found.interval[1] > 0.95
    assert verdict_word(found.probability, found.interval) == 'open'
    assert not found.is_calibrated
    assert found.trust.startswith('not fitted here') and 'wide prior' in found.trust
    # what no value of the prior changes has a verdict
    for end, word in ((GOAL, 'success'), (RED, 'failure')):
        alike = replace(held(*[end] * 16), is_fitted=False)
        found = estimator.estimate(shown, LEFT, foreseen=alike).estimate
        assert verdict_word(found.probability, found.interval) == word
