"""What is carried from chunk to chunk, and what grasps say about imagined moves."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.cameras.mask_geometry import count_reversals
from mtv_world_ros.core.files import share_path
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.success.footage_memory import MAX_FRAMES, remember
from test.support.drawn_blocks import BLUE, CAMERAS, footage, LEFT, masks, path, POSES, RED, STACK

HOME = np.array([0.25, 0.15, 0.15])
GOAL = (BLUE[0] - 0.13, BLUE[1], 0.025)
ON_TOP = (BLUE[0], BLUE[1], 0.065)


@pytest.fixture(scope='module')
def estimator():
    return SuccessEstimator(load_tasks(share_path('config', 'tasks')))


def with_robot(shown, tools, openings):
    """The footage with one arm's tool (1 + T, 3) and gripper (1 + T,)."""
    return replace(shown, tools=np.array(tools)[None], openings=np.array(openings, float)[None])


def pick_and_place(end, shift=(0.0, 0.0, 0.0), moves=True):
    """Footage of a pick and place whose grasp is off by `shift`, and of the red block's path."""
    red = [RED, RED, RED, *path(RED, end), end]
    if not moves:
        red = [RED] * len(red)
    num_carried = len(path(RED, end))
    tools = [HOME, np.add(RED, shift), *np.add([RED, RED, *path(RED, end)], shift), HOME]
    openings = [1.0, 1.0, 1.0, 0.0, *[0.0] * (num_carried - 1), 1.0, 1.0]
    shown = footage(masks(red[1:], [BLUE] * (len(red) - 1)), masks(red[:1], [BLUE]))
    tools, openings = np.array(tools), np.array(openings)
    assert len(tools) == len(openings) == len(red) + 1
    # the tool is home one frame before the objects' first frame
    return with_robot(shown, tools[1:], openings[1:])


def test_grasp_that_closed_on_the_block_explains_its_move(estimator):
    found = estimator.estimate(pick_and_place(GOAL), LEFT).estimate
    assert found.probability > 0.8
    assert found.features['grasp'] > 0.7
    assert found.features['carry'] > 0.5


@pytest.mark.parametrize('shift', [(0.0, 0.04, 0.0), (-0.035, 0.0, 0.0)])
def test_block_that_moves_without_a_grasp_is_no_success(estimator, shift):
    found = estimator.estimate(pick_and_place(GOAL, shift), LEFT).estimate
    assert found.features['margin'] > 2  # all that the masks say is that it worked
    assert found.features['grasp'] < -0.6
    assert found.probability < 0.3
    assert any('no gripper closed where it could hold it' in reason for reason in found.reasons)


def test_block_that_stays_where_it_was_needs_no_grasp(estimator):
    found = estimator.estimate(pick_and_place(GOAL, (0, 0.04, 0), moves=False), LEFT).estimate
    assert found.features['grasp'] == found.features['carry'] == 1.0
    assert found.probability < 0.1


def cut(shown, at):
    """The footage in two chunks, the second one starting from the last frame of the first."""
    whole = shown.masks.masks
    first = replace(
        shown,
        masks=replace(shown.masks, masks=whole[:, :, :at]),
        poses=shown.poses[:, : at + 1],
        tools=shown.tools[:, : at + 1],
        openings=shown.openings[:, : at + 1],
    )
    second = replace(
        shown,
        start_masks=replace(shown.masks, masks=whole[:, :, at - 1 : at]),
        masks=replace(shown.masks, masks=whole[:, :, at:]),
        poses=shown.poses[:, at:],
        tools=shown.tools[:, at:],
        openings=shown.openings[:, at:],
    )
    return first, second


@pytest.mark.parametrize('at', [2, 5, 9])
@pytest.mark.parametrize(('end', 'instruction'), [(GOAL, LEFT), (ON_TOP, STACK)])
def test_two_chunks_say_what_one_of_the_same_frames_says(estimator, at, end, instruction):
    shown = pick_and_place(end)
    whole = estimator.estimate(shown, instruction).estimate
    first, second = cut(shown, at)
    memory = estimator.estimate(first, instruction).memory
    found = estimator.estimate(second, instruction, memory).estimate
    assert found.probability == pytest.approx(whole.probability, abs=0.03)
    assert found.jaccard == pytest.approx(whole.jaccard, abs=1e-9)
    assert found.features == pytest.approx(whole.features, abs=0.1, nan_ok=True)


def test_second_chunk_by_itself_does_not_know_how_it_began(estimator):
    _, second = cut(pick_and_place(ON_TOP, (0, 0.04, 0)), 9)
    forgot = estimator.estimate(second, STACK).estimate
    first, second = cut(pick_and_place(ON_TOP, (0, 0.04, 0)), 9)
    memory = estimator.estimate(first, STACK).memory
    knows = estimator.estimate(second, STACK, memory).estimate
    assert forgot.features['grasp'] == 1.0 > 0 > knows.features['grasp']


def test_other_objects_begin_a_new_memory(estimator):
    shown = pick_and_place(GOAL)
    memory = remember(None, shown)
    names = ('green block', 'pink block')
    other = replace(
        shown,
        masks=replace(shown.masks, names=names),
        start_masks=replace(shown.start_masks, names=names),
    )
    assert remember(memory, other).points.shape == memory.points.shape
    assert remember(memory, shown).points.shape[1] == 2 * memory.points.shape[1] - 1


def test_memory_is_bounded_and_keeps_the_start():
    shown = footage(masks([BLUE] * 3, [RED] * 3), masks([RED], [BLUE]))
    memory = remember(None, shown)
    first = memory.points[:, 0]
    trail = np.concatenate([memory.points, np.zeros((2, MAX_FRAMES, 3))], axis=1)
    leans = np.concatenate([memory.leans, np.zeros((2, MAX_FRAMES, 2))], axis=1)
    memory = replace(memory, points=trail[:, :MAX_FRAMES], leans=leans[:, :MAX_FRAMES])
    memory = remember(memory, shown)
    assert memory.points.shape[1] == memory.leans.shape[1] == MAX_FRAMES
    assert (memory.points[:, 0] == first).all()


def test_places_and_gaps_are_those_of_the_drawn_blocks():
    shown = pick_and_place(GOAL, (0.0, 0.04, 0.0))
    memory = remember(None, shown)
    assert memory.start_point(0) == pytest.approx(RED, abs=0.005)
    assert memory.points[1, -1] == pytest.approx(BLUE, abs=0.005)
    grasp = memory.grasps[0]
    assert np.hypot(*(grasp.closed_at - grasp.points[0])[:2]) == pytest.approx(0.04, abs=0.005)
    assert 0.0 < grasp.gaps_m[0] < 0.03  # beside it; the block's half width is 25 mm
    inside = remember(None, pick_and_place(GOAL)).grasps[0].gaps_m[0]
    assert -0.035 < inside < -0.01
    assert len(CAMERAS) == len(POSES) == 2


@pytest.mark.parametrize(
    ('angles', 'count'),
    [([0, 0.4, 0.0, 0.4, 0.0], 3), ([0, 0.1, 0, 0.1, 0], 0), ([0, 0.2, 0.4, 0.6], 0), ([], 0)],
)
def test_reversals_are_counted_beyond_the_noise(angles, count):
    counts = count_reversals(np.array(angles, float), 0.15)
    assert (counts[-1] if len(counts) else 0) == count


def put_on_another(openings_at_end, tool_at_end):
    """The red block is put on the blue one; then the gripper and its tool are as given."""
    shown = pick_and_place(ON_TOP)
    openings, tools = np.array(shown.openings), np.array(shown.tools)
    openings[:, -2:], tools[:, -1] = openings_at_end, tool_at_end
    return replace(shown, openings=openings, tools=tools)


@pytest.mark.parametrize(
    ('opening', 'tool', 'released'),
    [(1.0, ON_TOP, 1.0), (0.0, ON_TOP, 0.0), (0.0, HOME, 1.0), (0.5, np.add(ON_TOP, 0.05), 0.0)],
)
def test_a_shut_gripper_away_from_what_it_moved_has_let_go(opening, tool, released):
    tasks = load_tasks(share_path('config', 'tasks', 'any_size'))
    found = SuccessEstimator(tasks).estimate(put_on_another(opening, tool), STACK).estimate
    assert found.features['released'] == released
    assert (found.probability > 0.75) is bool(released)


def test_a_task_that_wants_open_grippers_does_not_ask_where_they_are(estimator):
    found = estimator.estimate(put_on_another(0.0, HOME), STACK).estimate
    assert found.features['released'] == 0.0
    assert 'gripper: released' in ' '.join(found.reasons)


def test_real_frames_need_no_grasp_that_explains_them(estimator):
    shown = pick_and_place(GOAL, (0.0, 0.04, 0.0))
    seen = estimator.estimate(shown, LEFT, is_real=True).estimate
    assert seen.probability > 0.75
    assert estimator.estimate(shown, LEFT).estimate.probability < 0.3


def test_a_grasp_counts_from_where_the_block_was_pushed_to():
    # pushed by 6 cm with a third of it hidden, so that it never was seen unhidden there
    pushed = (RED[0] - 0.06, RED[1], RED[2])
    red = [RED, RED, pushed, pushed]
    rollout, start = masks(red[1:], [BLUE] * 3), masks(red[:1], [BLUE])
    hidden = np.array(rollout.masks)
    for view in range(2):
        for frame in (1, 2):
            rows = np.flatnonzero(hidden[view, 0, frame].any(1))
            hidden[view, 0, frame, rows[: len(rows) // 3]] = False
    shown = footage(replace(rollout, masks=hidden), start)
    shown = with_robot(shown, [HOME, HOME, pushed, pushed], [1.0, 1.0, 1.0, 0.0])
    (grasp,) = remember(None, shown).grasps
    assert np.linalg.norm((grasp.points[0] - pushed)[:2]) < 0.015
    assert grasp.gaps_m[0] < 0.01


def test_masks_are_filled_from_those_that_were_followed_where_a_search_finds_none():
    found, followed = masks([RED], [BLUE]), masks([RED], [BLUE])
    lost = np.array(found.masks)
    lost[1, 0] = False
    found = replace(found, masks=lost, status=(('ok', 'ok'), ('absent', 'ok')))
    filled = found.filled_from(followed)
    assert filled.status == (('ok', 'ok'), ('ok', 'ok'))
    assert (filled.masks == followed.masks).all()
    doubted = replace(followed, status=(('ok', 'ok'), ('lost', 'ok')))
    assert found.filled_from(doubted) is found
    assert followed.filled_from(found) is followed


def test_last_masks_are_those_of_the_last_frame():
    shown = masks(path(RED, ON_TOP), [BLUE] * 9)
    assert (shown.last().masks[:, :, 0] == shown.masks[:, :, -1]).all()
    assert shown.last().status == shown.status
