import numpy as np
import pytest

from mtv_world_ros.ranking.jobs import make_jobs
from mtv_world_ros.ranking.no_picture_rule import Thing
from mtv_world_ros.simulation.scenes.tasks import tasks_named


def thing(name, centre, size=(0.04, 0.04, 0.04), **more):
    return Thing(name=name, centre=np.array(centre), size=np.array(size), **more)


def test_what_is_let_go_rests_on_what_is_below():
    block, plate = thing('red block', (0, 0, 0.02)), thing('plate', (0, 0, 0.01), (0.1, 0.1, 0.02))
    held = thing('blue block', (0.01, 0, 0.2))
    assert held.resting([]).centre.tolist() == [0.01, 0, 0.02]
    assert held.resting([block]).centre[2] == pytest.approx(0.06)
    # plates are hollow: it stands on their floor
    assert held.resting([plate]).centre[2] == pytest.approx(0.025)
    aside = thing('blue block', (0.03, 0, 0.2))
    assert aside.resting([block]).centre[2] == 0.02


def test_reach_is_2_cm_in_the_plane_and_3_in_height_and_at_the_rim_of_a_plate():
    block = thing('red block', (0, 0, 0.02))
    assert block.is_within_reach(np.array([0.019, 0, 0.049]))
    assert not block.is_within_reach(np.array([0.021, 0, 0.02]))
    assert not block.is_within_reach(np.array([0, 0, 0.051]))
    plate = thing('plate', (0, 0, 0.01), (0.1, 0.1, 0.02), is_rim_held=True)
    assert plate.is_within_reach(np.array([0.05, 0, 0.02]))


@pytest.mark.slow
def test_the_rule_sees_a_grasp_that_is_too_high_and_not_a_gripper_that_is_too_wide(runner, expert):
    """The expert, a grasp 5 cm too high, and one whose fingers stay a little open."""
    names = ('expert', 'expert-high-0.05', 'expert-drops-1')
    jobs = make_jobs(names, tasks_named('place_block_a2b_left'), 1, 0, expert)
    said = {job.policy: runner.score(job) for job in jobs}
    assert {name: found.no_picture.success for name, found in said.items()} == {
        'expert': 1.0, 'expert-high-0.05': 0.0, 'expert-drops-1': 0.0,
    }  # fmt: skip
    assert [found.final for found in said.values()] == [True, False, False]
