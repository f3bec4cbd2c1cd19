import pickle

import pytest

from mtv_world_ros.core.errors import ConfigError, PolicyError
from mtv_world_ros.ranking.jobs import DEFAULT_POLICIES, make_jobs, policies_named
from mtv_world_ros.simulation.scenes.tasks import task_named, tasks_named
from test.support.own_task import write_shift_right


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
    tasks = tasks_named('stack_blocks_two,place_bread_plate')
    jobs = make_jobs(('expert', 'expert-stop-0.5'), tasks, 2, 0, expert)
    assert [(job.index, job.task) for job in jobs[::2]] == [
        (index, task.name) for index in range(2) for task in tasks
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
        make_jobs(('expert',), tasks_named('stack_blocks_two'), 0, 0, expert)
    with pytest.raises(ConfigError, match='each once'):
        make_jobs(('expert',), tasks_named('stack_blocks_two, stack_blocks_two'), 1, 0, expert)
    with pytest.raises(ConfigError, match='at least one task'):
        make_jobs(('expert',), tasks_named(' ,'), 1, 0, expert)


def test_a_job_holds_the_definition_of_a_task_of_ones_own(expert, tmp_path):
    path = write_shift_right(tmp_path)
    tasks = tasks_named(f'stack_blocks_two,{path}')
    bundled, own = make_jobs(('expert',), tasks, 1, 0, expert)
    path.unlink()  # workers on other machines do not have it
    assert own.name == 'shift_right_00000_expert' and len({bundled, own}) == 2
    assert bundled.task_definition == '' and bundled.load_task() is task_named('stack_blocks_two')
    assert pickle.loads(pickle.dumps(own)).load_task() == tasks[1]  # noqa: S301
