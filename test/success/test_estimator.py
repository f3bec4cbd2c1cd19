import numpy as np
import pytest

from mtv_world_ros.core.data_types import ObjectMasks
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.success.calibration import Calibration, Weights
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.success.fitted_to import FittedTo, Setting
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.drawn_blocks import (
    BLUE,
    CAMERAS,
    footage,
    LEFT,
    masks,
    NAMES,
    path,
    POSES,
    RED,
    STACK,
)


def judge(shown, instruction=LEFT, task=None):
    estimator = SuccessEstimator(load_tasks(share_path('config', 'tasks')), task=task)
    return estimator.estimate(shown, instruction).estimate


def estimate(end, instruction, *, status=None, blue_end=BLUE, task=None, openings=None):
    rollout = masks(path(RED, end), path(BLUE, blue_end) if blue_end != BLUE else [BLUE] * 9)
    if status:
        rollout = ObjectMasks(names=NAMES, masks=rollout.masks, status=status)
    return judge(footage(rollout, masks([RED], [BLUE]), openings), instruction, task)


@pytest.mark.parametrize('dx', [-0.1, -0.13, -0.17])
def test_block_on_the_left_is_a_success(dx):
    found = estimate((BLUE[0] + dx, BLUE[1], 0.025), LEFT)
    assert found.probability > 0.8
    assert found.interval[0] <= found.probability <= found.interval[1]


@pytest.mark.parametrize(
    'end',
    [
        RED,
        (BLUE[0] + 0.13, BLUE[1], 0.025),
        (BLUE[0] - 0.05, BLUE[1], 0.025),
        (BLUE[0] - 0.25, BLUE[1], 0.025),
        (BLUE[0] - 0.13, BLUE[1] + 0.08, 0.025),
        (BLUE[0] - 0.13, BLUE[1], 0.1),
    ],
)
def test_block_elsewhere_is_a_failure(end):
    assert estimate(end, LEFT).probability < 0.2


def test_block_that_stays_has_not_moved_and_is_capped():
    found = judge(footage(masks([RED] * 9, [BLUE] * 9), masks([RED], [BLUE])))
    assert found.features['moved'] == 0.0 and found.probability <= 0.1
    assert any('has not moved' in reason for reason in found.reasons)
    there = estimate((BLUE[0] - 0.13, BLUE[1], 0.025), LEFT)
    assert there.features['moved'] == 1.0


def test_stacked_block_is_a_success_although_it_hides_the_lower_one():
    found = estimate((BLUE[0], BLUE[1], 0.065), STACK)
    assert found.probability > 0.7
    assert any('partly hidden' in reason for reason in found.reasons)


@pytest.mark.parametrize(
    'end',
    [
        RED,
        (BLUE[0] + 0.04, BLUE[1], 0.065),
        (BLUE[0], BLUE[1] - 0.045, 0.065),
        (BLUE[0], BLUE[1], 0.1),
        (BLUE[0] - 0.05, BLUE[1], 0.025),
    ],
)
def test_block_not_on_the_other_is_a_failure(end):
    assert estimate(end, STACK).probability < 0.35


def test_jaccard_is_that_of_goal_for_the_subject_and_of_start_for_the_other():
    found = estimate((BLUE[0] - 0.13, BLUE[1], 0.025), LEFT)
    assert found.jaccard.shape == (2, 2)
    assert (found.jaccard[:, 0] > 0.6).all()
    assert (found.jaccard[:, 1] == 1.0).all()
    still = estimate(RED, LEFT)
    assert (still.jaccard[:, 0] == 0.0).all()


def test_target_that_was_dragged_along_counts_where_it_ends():
    moved = (0.0, 0.3, 0.02)
    found = estimate((moved[0] - 0.13, 0.3, 0.025), LEFT, blue_end=moved)
    assert found.probability > 0.8


def test_every_estimate_says_how_far_it_is_to_be_trusted():
    found = estimate((BLUE[0] - 0.13, BLUE[1], 0.025), LEFT)
    assert found.trust == found.reasons[-1]
    assert found.trust.startswith('not fitted here: there is no fit')


def test_closed_gripper_is_no_success():
    end = (BLUE[0] - 0.13, BLUE[1], 0.025)
    closed = estimate(end, LEFT, openings=np.array([1.0, 0.1]))
    assert closed.probability <= 0.1
    assert any('gripper is still closed' in reason for reason in closed.reasons)
    assert estimate(end, LEFT, openings=np.array([1.0, 1.0])).probability > 0.8


def assert_abstains(found, *words):
    assert np.isnan(found.probability) and np.isnan(found.interval).all()
    assert all(word in found.reasons[0] for word in ('cannot tell, because', *words)), (
        found.reasons
    )


def test_unknown_instruction_abstains_and_names_the_known_tasks():
    found = estimate(RED, 'polish the bottle')
    assert_abstains(found, 'polish the bottle', 'stack the {a} on the {b}')
    assert np.isfinite(found.jaccard).all()


def test_object_without_a_mask_abstains():
    assert_abstains(estimate(RED, 'stack the green block on the blue block'), "'green block'")


@pytest.mark.parametrize('word', ['absent', 'ambiguous', 'teleport', 'area_jump'])
def test_object_lost_in_one_of_two_views_abstains_with_view_and_status(word):
    found = estimate((BLUE[0] - 0.13, BLUE[1], 0.025), LEFT, status=((word, 'ok'), ('ok', 'ok')))
    assert_abstains(found, "'red block'", f'low: {word}')
    assert np.isnan(found.jaccard[:, 0]).all() and np.isfinite(found.jaccard[:, 1]).all()


def test_views_that_show_different_places_abstain():
    one = masks(path(RED, (-0.08, 0.3, 0.025)), [BLUE] * 9)
    other = masks(path(RED, (0.15, 0.2, 0.025)), [BLUE] * 9)
    mixed = ObjectMasks(
        names=NAMES, masks=np.stack([one.masks[0], other.masks[1]]), status=one.status
    )
    found = judge(footage(mixed, masks([RED], [BLUE])))
    assert_abstains(found, 'views disagree')


def test_object_that_vanished_abstains():
    rollout = masks(path(RED, RED), [BLUE] * 9)
    gone = rollout.masks.copy()
    gone[:, 0, -4:] = False
    gone[:, 0, -4:, 30, 40] = True
    rollout = ObjectMasks(names=NAMES, masks=gone, status=rollout.status)
    found = judge(footage(rollout, masks([RED], [BLUE])))
    assert_abstains(found, 'vanished')


def test_single_view_abstains():
    rollout, start = masks([RED] * 4, [BLUE] * 4), masks([RED], [BLUE])
    rollout, start = (
        ObjectMasks(names=NAMES, masks=m.masks[:1], status=m.status[:1]) for m in (rollout, start)
    )
    found = judge(footage(rollout, start, cameras=CAMERAS[:1], poses=POSES[:1]))
    assert_abstains(found, 'fewer than two views')


def test_no_objects_abstain():
    empty = ObjectMasks(names=(), masks=np.zeros((2, 0, 3, 72, 96), bool), status=((), ()))
    start = ObjectMasks(names=(), masks=empty.masks[:, :, :1], status=((), ()))
    found = SuccessEstimator().estimate(footage(empty, start), LEFT).estimate
    assert_abstains(found, 'known: none')
    assert found.jaccard.shape == (2, 0)


def test_given_task_takes_the_objects_in_their_order():
    found = estimate((BLUE[0], BLUE[1], 0.065), 'do it', task='stack_blocks_two')
    assert found.probability > 0.7


def test_unknown_task_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'stack_blocks_two'"):
        SuccessEstimator(load_tasks(share_path('config', 'tasks')), task='stack_block_two')


CALIBRATION = Calibration(
    features=('margin',),
    means=(1.0,),
    scales=(2.0,),
    weights=(0.0,),
    bias=0.0,
    segmenter='colour',
    tasks=('place_block_a2b_left',),
    num_episodes=40,
)


class Named(ColourSegmenter):
    """One that goes by another name."""

    def __init__(self, name):
        super().__init__()
        self.name = name


def put_to_the_left():
    """Footage in which the red block ends to the left of the blue one."""
    end = (BLUE[0] - 0.13, BLUE[1], 0.025)
    return footage(masks(path(RED, end), [BLUE] * 9), masks([RED], [BLUE]))


@pytest.mark.parametrize(
    ('segmenter', 'task', 'words'),
    [
        ('colour', 'place_block_a2b_left', 'fitted here: weights of 40 episodes of 1 tasks'),
        (
            'sam2',
            'place_block_a2b_left',
            "not fitted here: fitted with the segmenter 'colour', not with 'sam2', so this is a",
        ),
        (
            'colour',
            'stack_blocks_two',
            "not fitted here: fitted on 1 tasks without 'place_block_a2b_left', so this is a",
        ),
    ],
)
def test_fitted_weights_are_used_only_where_they_were_fitted(segmenter, task, words):
    estimator = SuccessEstimator(
        load_tasks(share_path('config', 'tasks')),
        calibration=CALIBRATION.replace(tasks=(task,)),
        segmenter=Named(segmenter),
    )
    shown = put_to_the_left()
    found = estimator.estimate(shown, LEFT).estimate
    assert found.trust.startswith(words)
    assert 'given the world model' in found.trust
    assert found.is_calibrated == words.startswith('fitted')
    # weights of zero say one half, whatever is seen; the stated ones do not
    assert (found.probability == 0.5) == found.is_calibrated


def test_weights_of_a_fit_elsewhere_are_used_and_called_not_fitted_here():
    shown, tasks = put_to_the_left(), load_tasks(share_path('config', 'tasks'))
    here = Setting(robot='one', tools=((0.0, 0.0, 0.0),))
    calibration = CALIBRATION.replace(fitted_to=FittedTo.episodes(here, [shown.cameras]))
    for setting, words in (
        (here, 'fitted here: weights of 40'),
        (
            here.replace(robot='two'),
            "not fitted here: fitted with another robot than this 'two', with weights of 40",
        ),
    ):
        estimator = SuccessEstimator(
            tasks, calibration=calibration, segmenter=Named('colour'), setting=setting
        )
        found = estimator.estimate(shown, LEFT).estimate
        assert found.trust.startswith(words)
        assert found.is_calibrated == words.startswith('fitted')
        assert found.probability == 0.5


@pytest.mark.parametrize(
    ('foresight', 'rate', 'is_real', 'is_stated'),
    [
        ('', 0.27, False, True),
        ('', 0.27, True, False),  # nothing is wrong with frames that were seen
        ('a digest', 0.27, False, False),  # futures decide there
        ('', None, False, False),
    ],
)
def test_an_estimate_of_pictures_states_how_optimistic_its_fit_was(
    foresight, rate, is_real, is_stated
):
    shown = put_to_the_left()
    here = Setting(robot='one', tools=((0.0, 0.0, 0.0),), foresight=foresight)
    calibration = CALIBRATION.replace(
        fitted_to=FittedTo.episodes(here, [shown.cameras]),
        scores={'after': {'false_success_rate': rate}},
    )
    estimator = SuccessEstimator(
        load_tasks(share_path('config', 'tasks')),
        calibration=calibration,
        segmenter=Named('colour'),
    )
    found = estimator.estimate(shown, LEFT, is_real=is_real).estimate
    assert ('27% of the failures' in found.reasons[-1]) == is_stated


def test_frames_that_were_seen_have_weights_of_their_own():
    seen = Weights(features=('margin',), means=(1.0,), scales=(2.0,), weights=(0.0,), bias=2.0)
    task = CALIBRATION.replace(observed=seen)
    shown = put_to_the_left()
    tasks = load_tasks(share_path('config', 'tasks'))
    for calibration, expected in ((task, 1 / (1 + np.exp(-2))), (CALIBRATION, 0.5)):
        estimator = SuccessEstimator(tasks, calibration=calibration, segmenter=Named('colour'))
        real = estimator.estimate(shown, LEFT, is_real=True).estimate
        assert real.probability == pytest.approx(expected)
        assert 'given frames that were seen' in real.reasons[-1]
        assert estimator.estimate(shown, LEFT).estimate.probability == 0.5


def test_where_nothing_is_foreseen_weights_are_others():
    alone = Weights(features=('margin',), means=(1.0,), scales=(2.0,), weights=(0.0,), bias=2.0)
    calibration = CALIBRATION.replace(unforeseen=alone)
    shown = put_to_the_left()
    tasks = load_tasks(share_path('config', 'tasks'))
    estimator = SuccessEstimator(tasks, calibration=calibration, segmenter=Named('colour'))
    found = estimator.estimate(shown, LEFT).estimate
    assert found.probability == pytest.approx(1 / (1 + np.exp(-2)))
    assert estimator.estimate(shown, LEFT, is_real=True).estimate.probability == 0.5


@pytest.mark.parametrize(
    ('views', 'word'), [(('low',), 'not used by the task'), (('top',), 'top')]
)
def test_views_that_a_task_leaves_out_do_not_count(views, word):
    tasks = [t.replace(views=views) for t in load_tasks(share_path('config', 'tasks'))]
    shown = put_to_the_left()
    assert_abstains(SuccessEstimator(tasks).estimate(shown, LEFT).estimate, word)


def test_an_episode_that_defines_its_task_is_judged_by_it_unless_another_is_given():
    """It counts also where a bundled task has the same instruction."""
    tasks, shown = load_tasks(share_path('config', 'tasks')), put_to_the_left()
    estimator = SuccessEstimator(tasks)
    (left,) = (task for task in tasks if task.name == 'place_block_a2b_left')
    far = left.replace(
        name='far_left', relations=[left.relations[0].replace(distance_m=(0.3, 0.4))]
    )
    assert estimator.for_task(None) is estimator
    assert estimator.estimate(shown, LEFT).estimate.probability > 0.8
    assert estimator.for_task(far).estimate(shown, LEFT).estimate.probability < 0.2
    given = SuccessEstimator(tasks, task='place_block_a2b_left')
    assert given.for_task(far) is given
