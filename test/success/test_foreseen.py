from dataclasses import replace

from drawn_blocks import BLUE, footage, LEFT, masks, NAMES, path, RED
import numpy as np
import pytest

from mtv_world_ros.files import share_path
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.success.foreseen import foreseen_feature, ForeseenMotions
from mtv_world_ros.success.task import match_task

TASKS = load_tasks(share_path('config', 'tasks'))
GOAL = (BLUE[0] - 0.13, BLUE[1], 0.025)


def matched():
    found = match_task(TASKS, LEFT)
    assert found is not None
    return found


def foreseen(*ends):
    """Motions of 9 steps in which the red block ends at each of `ends`, the gripper open."""
    points = np.array([[[red, BLUE] for red in path(RED, end)] for end in ends], float)
    turns = np.broadcast_to(np.eye(3), (*points.shape, 3))
    sizes = np.broadcast_to([[0.05] * 3, [0.04] * 3], (len(points), 2, 3))
    openings = np.ones((2, points.shape[1]))
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
        openings=longer(moving.openings, 1),
    )


def test_the_share_of_motions_that_end_at_the_goal_is_told():
    task, bound = matched()
    unknown = np.full((2, 3), np.nan)
    ends = held(GOAL, RED, GOAL, BLUE).ends(task, bound, unknown)
    np.testing.assert_array_equal(ends.done, [True, False, True, False])
    assert foreseen_feature(ends) == 0.0
    assert foreseen_feature(held(GOAL).ends(task, bound, unknown)) == 1.0


def test_motions_count_by_weight():
    task, bound = matched()
    motions = replace(held(GOAL, RED, BLUE), weights=np.array([3.0, 1.0, 1.0]))
    ends = motions.ends(task, bound, np.full((2, 3), np.nan))
    assert ends.share == pytest.approx(0.6)
    np.testing.assert_array_equal(ends.as_most, [True, False, False])
    assert foreseen_feature(ends) == pytest.approx(0.2)


def test_objects_that_were_not_found_leave_it_open():
    task, bound = matched()
    seen = held(GOAL)
    lost = replace(seen, points=np.where(np.array([True, False])[:, None], np.nan, seen.points))
    for motions in (lost, replace(seen, names=('green cup', 'bowl'))):
        assert np.isnan(foreseen_feature(motions.ends(task, bound, np.zeros((2, 3)))))


def test_motions_that_fail_lower_an_estimate_whose_pictures_succeed():
    shown = footage(masks(path(RED, GOAL), [BLUE] * 9), masks([RED], [BLUE]))
    estimator = SuccessEstimator(TASKS)
    found = {
        name: estimator.estimate(shown, LEFT, None, motions).estimate
        for name, motions in {
            'not told': None,
            'good': held(GOAL, GOAL, GOAL),
            'doubtful': held(GOAL, RED, RED),
        }.items()
    }
    assert '1 of 3 foreseen motions succeed, 33% by weight' in found['doubtful'].reasons
    assert found['doubtful'].probability < found['not told'].probability
    assert found['good'].probability > found['not told'].probability
    assert found['good'].features['foreseen'] == pytest.approx(1.0)
