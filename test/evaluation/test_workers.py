from functools import partial

import pytest

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import plain
from mtv_world_ros.core.workers import Workers
from mtv_world_ros.evaluation.evaluate_episodes import evaluate, make_jobs, Parallel
from mtv_world_ros.evaluation.settings import EvaluationConfig
from test.support.small_episodes import persistence

QUIET = {'show_progress': False}


@pytest.fixture
def make(make_pipeline):
    """Make a pipeline in any process."""
    return partial(persistence, make_pipeline().spec)


@pytest.mark.slow
def test_two_workers_find_what_one_finds(make, episodes, tmp_path):
    paths = [*episodes, tmp_path / 'nothing']
    parallel = Parallel(workers=Workers(count=2, threads=1), make_pipeline=make)
    alone = evaluate(make(), paths, tmp_path / 'one', **QUIET)
    both = evaluate(make(), paths, tmp_path / 'two', parallel=parallel, **QUIET)
    assert list(both.failed) == [str(tmp_path / 'nothing')]
    for name in ('rows.csv', 'tables.md'):
        assert (tmp_path / 'one' / name).read_text() == (tmp_path / 'two' / name).read_text()
    timing = {'seconds', 'seconds_per_chunk'}
    for first, second in zip(alone.results, both.results, strict=True):
        left, right = (plain(found.as_json()) for found in (first, second))
        assert all(left[key] == right[key] for key in left if key not in timing)


@pytest.mark.slow
def test_what_a_worker_lacks_is_the_reason(make, episodes, tmp_path):
    parallel = Parallel(workers=Workers(count=2, threads=1), make_pipeline=make)
    config = EvaluationConfig(fid_weights=tmp_path / 'weights.pth')
    with pytest.raises(EpisodeError, match="fid_weights '.*weights.pth' does not exist"):
        evaluate(make(), episodes[:2], tmp_path / 'o', config, parallel=parallel, **QUIET)


def test_less_than_one_worker_is_an_error(make, episodes, tmp_path):
    parallel = Parallel(workers=Workers(count=0), make_pipeline=make)
    with pytest.raises(ConfigError, match='workers is 0'):
        evaluate(make(), episodes, tmp_path, parallel=parallel, **QUIET)


def test_episodes_that_are_called_alike_keep_results_of_their_own(tmp_path):
    paths = [tmp_path / 'a' / 'x', tmp_path / 'b' / 'x', tmp_path / 'b' / 'y']
    jobs = {job.path: job.name for job in make_jobs(paths, {}, seed=0)}
    assert jobs[paths[2]] == 'y'
    assert len(set(jobs.values())) == 3 and jobs[paths[0]].endswith('a__x')
