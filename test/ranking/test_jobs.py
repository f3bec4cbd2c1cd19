import pytest

from mtv_world_ros.core.errors import ConfigError, PolicyError, SimulatorError
from mtv_world_ros.ranking.rollout_jobs import DEFAULT_POLICIES, make_jobs, policies_named


def test_policies_are_named_once_each():
    assert policies_named('expert, expert-miss-.5') == ('expert', 'expert-miss-0.5')
    assert len(set(policies_named(','.join(DEFAULT_POLICIES)))) == 10
    with pytest.raises(ConfigError, match="'expert-miss-0.5' is listed twice"):
        policies_named('expert-miss-0.5,expert-miss-.5')
    with pytest.raises(ConfigError, match='no policy is listed'):
        policies_named(' ,')
    with pytest.raises(PolicyError, match="unknown fault 'mis'"):
        policies_named('expert-mis-0.5')


def test_all_policies_meet_the_same_episodes_and_tasks_take_turns(expert):
    tasks = ('stack_blocks_two', 'place_bread_plate')
    jobs = make_jobs(('expert', 'expert-stop-0.5'), tasks, 2, 0, expert)
    assert [(job.index, job.task) for job in jobs[::2]] == [
        (index, task) for index in range(2) for task in tasks
    ]
    assert all(
        a.seed == b.seed and a.policy != b.policy
        for a, b in zip(jobs[::2], jobs[1::2], strict=True)
    )
    assert len({job.seed for job in jobs}) == 4 and len({job.name for job in jobs}) == 8
    assert jobs == make_jobs(('expert', 'expert-stop-0.5'), tasks, 2, 0, expert)
    assert jobs[0].seed != make_jobs(('expert',), tasks, 1, 1, expert)[0].seed


def test_wrong_numbers_and_tasks_are_refused(expert):
    with pytest.raises(ConfigError, match='--episodes is 0'):
        make_jobs(('expert',), ('stack_blocks_two',), 0, 0, expert)
    with pytest.raises(ConfigError, match='each once'):
        make_jobs(('expert',), ('stack_blocks_two', 'stack_blocks_two'), 1, 0, expert)
    with pytest.raises(SimulatorError, match='did you mean'):
        make_jobs(('expert',), ('stack_block_two',), 1, 0, expert)
